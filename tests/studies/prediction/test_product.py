"""The product in the study: it receives frames like the pipeline; bound violations are counted."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from support import ROOT

from companion.cli.main import main
from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.recording.reader import read_log
from companion.settings.model import Settings
from companion.studies.prediction import comparison, violations
from companion.studies.prediction.delivery import deliver
from companion.studies.prediction.hostile_link import REGIMES
from companion.studies.prediction.pointing import Answers, Questions, product_answers, questions
from companion.studies.prediction.predictors import product
from companion.studies.prediction.radio_link import CLEAN, HOSTILE, NOISY, RADIO, RadioLink
from companion.studies.truth import vehicles
from companion.studies.truth.vehicles import Flight, Flown
from companion.values import Estimate, Frame, Refuted, RoundTrip

S = 1_000_000_000
CUT = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
PLACE = "47.3977419,8.5455938,25"


@pytest.fixture(scope="module")
def circling() -> Flown:
    return vehicles.load(CUT, PLACE)


def test_product_over_the_clean_link_equals_the_pipeline(circling: Flown) -> None:
    """A pipeline fed with the whole log gives the same tracks."""
    settings = Settings()
    flight = circling.flights[0]
    delivery = deliver(flight, CLEAN, 1)
    plan = questions(circling, flight, (0.0, 0.3), delivery.observed[0].arrival_ns).every(20)
    given = product_answers(
        product(settings, "uio-kinematic", flight.uav, circling.origin), delivery.events, plan
    )
    whole = Pipeline(settings.override(center={"source": PLACE}))
    events = iter(read_log(CUT))
    event = next(events, None)
    for k, now_ns in enumerate(plan.now_ns.tolist()):
        while event is not None and event.t_ns <= now_ns:
            whole.step(event)
            event = next(events, None)
        for lead, lead_ns in enumerate(plan.leads_ns.tolist()):
            tracks = {track.uav: track for track in whole.tracks(now_ns, now_ns + lead_ns)}
            track = tracks[flight.uav]
            assert given.position_ned_m[lead, k] == pytest.approx(track.position_ned_m, abs=1e-6)
            assert given.bound_m[lead, k] == pytest.approx(track.bound_m)


@pytest.mark.parametrize("link", [CLEAN, RADIO, HOSTILE], ids=lambda link: link.name)
def test_baselines_and_product_use_the_same_clock(link: RadioLink, circling: Flown) -> None:
    """Both use the same timestamps: they agree when an accepted report was measured.

    The product also knows the lag of the position behind its timestamp.
    """
    flight = next(flight for flight in circling.flights if flight.uav == "2:1")
    delivery = deliver(flight, link, 1, lambda: assembly.clock(Settings()))
    pipeline = Pipeline(Settings().override(center={"source": PLACE}))
    made_ns = {}
    for event in delivery.events:
        for output in pipeline.step(event):
            if isinstance(output, Estimate):
                made_ns[output.fix.arrival_ns, output.fix.sender_ns] = output.fix.t_ns
    lags_s = [
        (each.sent_ns - t_ns) * 1e-9
        for each in delivery.observed
        for (came_ns, _), t_ns in made_ns.items()
        if came_ns == each.arrival_ns
    ]
    assert len(made_ns) > 10
    assert np.median(lags_s) == pytest.approx(0.03, abs=1e-3)
    # If several arrive at once, the match is ambiguous.
    assert np.ptp(lags_s) < 0.001 or link is HOSTILE


def kinds(events: tuple[Frame | RoundTrip, ...]) -> dict[int, int]:
    found: dict[int, int] = {}
    for event in events:
        if isinstance(event, Frame):
            found[event.msgid] = found.get(event.msgid, 0) + 1
    return found


def test_radio_link_thins_each_message_type(circling: Flown) -> None:
    flight = circling.flights[0]
    clean, radio = (kinds(deliver(flight, link, 1).events) for link in (CLEAN, RADIO))
    span_s = (circling.span_ns[1] - circling.span_ns[0]) * 1e-9
    assert radio.keys() <= clean.keys() >= {0, 2, 24, 30, 33}
    assert not {108, 164} & clean.keys()  # the simulator's messages are only for the study
    for msgid in (30, 33, 24):
        assert radio[msgid] == pytest.approx(span_s * 1.2 * 0.9, rel=0.25)
    delivery = deliver(flight, RADIO, 1)
    arrivals = [event.t_ns for event in delivery.events]
    assert arrivals == sorted(arrivals)
    reports = [e.t_ns for e in delivery.events if isinstance(e, Frame) and e.msgid == 33]
    # The first reports may have no clock yet: all others are the same for the baselines.
    assert {each.arrival_ns for each in delivery.observed} <= set(reports)
    assert len(reports) - len(delivery.observed) <= 2


def test_known_delay_gives_a_tight_clock_bound(straight_flight: Callable[..., Flight]) -> None:
    flight = straight_flight(600)
    known = RadioLink(name="radio", rate_hz=1.2, latency_s=(0.6, 2.2), loss=0.1, known_delay=True)
    for link, bound_s in ((RADIO, 0.1), (known, 0.05)):
        pipeline = Pipeline(Settings())
        for event in deliver(flight, link, 1).events:
            pipeline.step(event)
        found = pipeline.clock_estimate(flight.uav)
        assert found is not None
        assert (found.uncertainty_s < bound_s) == link.known_delay


def test_frames_and_reports_share_noise_within_stated_accuracy(circling: Flown) -> None:
    """Frames and observed reports hold the same noise, and the receiver's accuracy covers it."""
    flight = circling.flights[0]
    delivery = deliver(flight, NOISY, 1)
    pipeline = Pipeline(Settings().override(center={"source": PLACE}))
    seen = {}
    for event in delivery.events:
        for output in pipeline.step(event):
            fix = getattr(output, "fix", None)
            if fix is not None:
                seen[fix.arrival_ns] = fix
    row = {tuple(np.round(p, 3)): p for p in flight.position_ned_m}
    assert len(seen) > 10
    compared = 0
    for each in delivery.observed:
        assert tuple(np.round(each.position_ned_m, 3)) not in row
        if each.arrival_ns in seen:
            fix = seen[each.arrival_ns]
            assert fix.position_ned_m == pytest.approx(each.position_ned_m, abs=0.03)
            assert fix.velocity_ned_mps == pytest.approx(each.velocity_ned_mps, abs=0.03)
            compared += 1
    assert compared > 10
    assert fix.noise.position_m > 3


# --- violations ---------------------------------------------------------------------------------


def asked_and_given(
    errors_m: list[float], refuted_ns: tuple[int, ...] = ()
) -> tuple[Questions, Answers]:
    """One answer per second with a bound of 1 m."""
    n = len(errors_m)
    truth = np.zeros((1, n, 3))
    asked = Questions(
        now_ns=np.arange(n) * S,
        leads_ns=np.zeros(1, dtype=np.int64),
        truth_ned_m=truth,
        array_ned_m=truth + 100.0,
        counts=np.ones((1, n), dtype=bool),
        in_fault=np.zeros((1, n), dtype=bool),
    )
    position = truth.copy()
    position[0, :, 0] = errors_m
    return asked, Answers(
        position_ned_m=position,
        bound_m=np.ones((1, n)),
        usual_m=np.ones((1, n)),
        refuted_ns=refuted_ns,
    )


def test_violations_and_announced_violations_are_counted() -> None:
    """Refuted at 3.5 s: the violation at 2 s was not announced, those at 3 and 5 s were."""
    errors_m = [0.5, 0.9, 1.5, 1.1, 0.2, 4.0]
    asked, given = asked_and_given(errors_m, (round(3.5 * S), 50 * S))
    found = violations.counted(asked, given, 0)
    assert (found["answers"], found["violations"], found["announced"]) == (6, 3, 2)
    assert found["worst_of_bound"] == pytest.approx(4.0)
    assert found["regimes"] is None
    silent = violations.counted(asked, replace(given, refuted_ns=()), 0)
    assert (silent["violations"], silent["announced"]) == (3, 0)
    head = {"predictor": "p", "uav": "1:1", "log": "x", "link": "clean", "lead_s": 0.0}
    assert violations.unannounced([head | found, head | silent]) == 1 + 3
    said = violations.notice([head | found, head | silent])
    assert said is not None
    assert "3 of 6, by p on 1:1 of x over the clean link at a lead of 0 s" in said
    kept = violations.counted(*asked_and_given([0.1]), 0)
    assert violations.notice([head | kept]) is None


def test_violations_in_declared_faults_are_counted_apart() -> None:
    asked, given = asked_and_given([0.5, 2.0, 2.0, 0.5])
    fault = np.array([[False, True, False, False]])
    found = violations.counted(replace(asked, in_fault=fault), given, 0)
    assert (found["answers"], found["violations"], found["in_faults"]) == (3, 1, 1)


def test_violations_are_counted_per_regime() -> None:
    asked, given = asked_and_given([0.5, 2.0, 2.0, 0.5])
    found = violations.counted(replace(asked, regime=np.array([0, 0, 3, 3])), given, 0)
    assert found["regimes"] == {
        "first-fast": {"answers": 2, "violations": 1, "announced": 0},
        REGIMES[3].name: {"answers": 2, "violations": 1, "announced": 0},
    }


def test_product_records_refuted_settings_of_its_uav(
    monkeypatch: pytest.MonkeyPatch, circling: Flown
) -> None:
    refuted = Refuted(
        t_ns=5, uav="1:1", setting="acceleration_max_mps2", limit=5.0, proven=7.0, raised_to=10.5
    )
    said: list[Any] = [[refuted], [replace(refuted, t_ns=6, uav="9:1"), "else"], []]
    monkeypatch.setattr(Pipeline, "step", lambda _self, _event: said.pop(0))
    asks = product(Settings(), "uio-position", "1:1", circling.origin)
    for _ in range(3):
        asks.hear(
            RoundTrip(t_ns=0, source=circling.flights[0].frames[0].source, sent_ns=0, remote_ns=0)
        )
    assert asks.refuted_ns == [5]


# --- the exit status ----------------------------------------------------------------------------


def short(path: Path) -> Path:
    path.write_bytes(CUT.read_bytes()[:150_000])
    return path


@pytest.mark.parametrize("announces", [False, True])
def test_unannounced_bound_violation_sets_the_exit_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, announces: bool
) -> None:
    """Bounds of 1 mm are all violated: exit status 3 and one line unless announced; files are
    written."""
    answers = comparison.product_answers

    def tight(*asked: Any) -> Answers:
        given = answers(*asked)
        return replace(given, bound_m=given.bound_m * 0 + 1e-3, refuted_ns=(0,) * announces)

    monkeypatch.setattr(comparison, "product_answers", tight)
    monkeypatch.setattr(comparison, "DENSITIES", {})
    out = tmp_path / "report"
    words = [short(tmp_path / "short.tlog"), "--center", "5:1", "--links", "clean", "--lead", "0"]
    asked = ["study", "prediction", *map(str, words), "--jobs", "1", "--out", str(out)]
    done = CliRunner().invoke(main, asked)
    assert done.exit_code == (0 if announces else 3), done.output
    assert (out / "prediction.json").exists()
    assert (out / "prediction.html").exists()
    lines = [line for line in done.stderr.splitlines() if "bounds were violated" in line]
    assert len(lines) == (0 if announces else 1)
    assert ("announced" in done.stdout) == announces


def test_unknown_link_names_are_rejected(tmp_path: Path) -> None:
    asked = ["study", "prediction", str(CUT), "--links", "clean,bad", "--out", str(tmp_path)]
    done = CliRunner().invoke(main, asked)
    assert done.exit_code == 1
    assert "give some of clean, radio, hostile, noisy" in done.stderr


def test_hostile_link_starts_in_flight(circling: Flown) -> None:
    flying = [flight for flight in circling.flights if flight.uav != "5:1"]  # that one hovers
    assert len(flying) == 4
    for flight in flying:
        delivery = deliver(flight, HOSTILE, 1)
        assert delivery.begins_ns is not None
        assert delivery.events[0].t_ns == delivery.begins_ns + 5_000_000
        assert flight.flying(np.array([delivery.begins_ns])).all()
