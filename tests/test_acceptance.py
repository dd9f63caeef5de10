"""Promised prediction accuracy, on flights with known truth."""

import json
import random
import struct
from pathlib import Path

import numpy as np
import pytest
from support import SHARED, shared_log

from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.recording.reader import read_log
from companion.settings.model import Settings
from companion.studies.prediction import violations
from companion.studies.prediction.comparison import LEADS_S
from companion.studies.prediction.delivery import deliver
from companion.studies.prediction.pointing import (
    Answers,
    Questions,
    answers,
    product_answers,
    questions,
    score,
)
from companion.studies.prediction.predictors import SIMPLE, product
from companion.studies.prediction.radio_link import CLEAN, RADIO, RadioLink
from companion.studies.truth import vehicles
from companion.studies.truth.vehicles import Flown
from companion.values import Estimate, Event, Frame, Notice, Rejection, Track

EVERY = 2
"""Ten predictions per second: half of what the study makes."""


OURS = "uio-kinematic"


def asked(
    flown: Flown, name: str, link: RadioLink, settings: Settings
) -> list[tuple[str, Questions, Answers]]:
    """Run one predictor on every UAV of a log."""
    found = []
    for flight in flown.flights:
        sent = deliver(flight, link, 1, lambda: assembly.clock(settings))
        plan = questions(flown, flight, LEADS_S, sent.observed[0].arrival_ns).every(EVERY)
        if name == OURS:
            ours = product(settings, name, flight.uav, flown.origin)
            found.append((flight.uav, plan, product_answers(ours, sent.events, plan)))
        else:
            found.append((flight.uav, plan, answers(SIMPLE[name](), sent.observed, plan)))
    return found


def rms_deg(flown: Flown, name: str, link: RadioLink, settings: Settings) -> np.ndarray:
    """Return the RMS angle error, (UAV, lead)."""
    rows = []
    for _, plan, given in asked(flown, name, link, settings):
        scores = [score(plan, given, lead) for lead in range(len(LEADS_S))]
        rows.append([found["angle_rms_deg"] for found in scores if found is not None])
    return np.array(rows)


@pytest.fixture(scope="module")
def circling() -> Flown:
    """Return four UAVs on circles around the carrier."""
    return vehicles.load(shared_log("sitl_4circle.tlog"), "5:1")


@pytest.mark.full
def test_prediction_error_over_a_clean_link(circling: Flown) -> None:
    settings = Settings()
    found = rms_deg(circling, OURS, CLEAN, settings)
    assert np.all(found <= [0.13, 0.13, 0.14, 0.20]), found


@pytest.mark.full
def test_prediction_error_over_a_radio_link(circling: Flown) -> None:
    settings = Settings()
    ours = rms_deg(circling, OURS, RADIO, settings)
    over_all = np.sqrt(np.mean(ours**2, axis=0))
    assert np.all(over_all <= 1.0), over_all
    for name in SIMPLE:
        theirs = np.sqrt(np.mean(rms_deg(circling, name, RADIO, settings) ** 2, axis=0))
        assert np.all(over_all <= theirs), name
        if name == "dead-reckoning-arrival":
            assert np.all(over_all <= theirs / 4)


@pytest.mark.full
@pytest.mark.parametrize("link", [CLEAN, RADIO], ids=lambda link: link.name)
@pytest.mark.parametrize("suited", [False, True])
def test_no_bound_is_violated(circling: Flown, link: RadioLink, suited: bool) -> None:
    noise = {"follow_accuracy": False, "position_noise_m": 0.3, "velocity_noise_mps": 0.3}
    settings = Settings().override(observer=noise if suited else {})
    bounds, errors = [], []
    for _, plan, given in asked(circling, OURS, link, settings):
        off_m = np.linalg.norm(given.position_ned_m - plan.truth_ned_m, axis=2)[plan.counts]
        errors.append(off_m)
        bounds.append(given.bound_m[plan.counts])
    error_m, bound_m = np.concatenate(errors), np.concatenate(bounds)
    assert np.all(error_m <= bound_m)
    if suited and link is CLEAN:
        assert np.median(bound_m) <= 6 * np.percentile(
            error_m, 95
        )  # the clock is known from arrivals only


@pytest.mark.full
def test_bound_violations_occur_only_during_gps_faults() -> None:
    """A walk of 3.8 m under a noise bound of 4 m."""
    flown = vehicles.load(shared_log("sitl_4circle_wander.tlog"), "5:1")
    events = json.loads((SHARED / "sitl_4circle_wander.tlog.events.json").read_text())
    noise = {"follow_accuracy": False, "position_noise_m": 4.0}
    settings = Settings().override(observer=noise)
    for uav, plan, given in asked(flown, OURS, CLEAN, settings):
        off_m = np.linalg.norm(given.position_ned_m - plan.truth_ned_m, axis=2)
        beyond = plan.counts & (off_m > given.bound_m)
        faults = [event["unix"] for event in events if f"{event['sysid']}:1" == uav]
        for at_s in plan.now_ns[beyond.any(axis=0)] * 1e-9:
            assert any(-1 <= at_s - begun_s <= 14 for begun_s in faults), (uav, at_s)


@pytest.mark.full
def test_gps_wander_is_announced_before_a_bound_violation() -> None:
    """By default the receiver's accuracy is trusted down to 0.9 m, until its positions wander."""
    flown = vehicles.load(shared_log("sitl_4circle_wander.tlog"), "5:1")
    answers = broken = 0
    for _, plan, given in asked(flown, OURS, CLEAN, Settings()):
        for lead in range(len(plan.leads_ns)):
            counts = violations.counted(plan, given, lead)
            assert counts["announced"] == counts["violations"]
            answers, broken = answers + counts["answers"], broken + counts["violations"]
    assert answers > 10_000
    assert broken < 0.01 * answers


def late(events: list[Event], seed: int) -> list[Event]:
    """Return the frames of a log, each delayed by up to 3 s; its stamp is that of its arrival."""
    rng = random.Random(seed)
    held = [
        event._replace(t_ns=event.t_ns + rng.randrange(3_000_000_000))
        for event in events
        if isinstance(event, Frame)
    ]
    return sorted(held, key=lambda frame: frame.t_ns)


def final_tracks(events: list[Event], at_ns: int) -> dict[str, Track]:
    """Return the track of every vehicle after all frames."""
    pipeline = Pipeline(Settings().override(center={"source": "47.3977419,8.5455938,488"}))
    for event in events:
        pipeline.step(event)
    assert not pipeline.refusals.total.keys() - {"duplicate", "zero-position", "out-of-order"}
    tracks = pipeline.tracks(at_ns, at_ns)
    return {track.uav: track for track in tracks if not track.uav.startswith("icao:")}


@pytest.mark.parametrize("seed", [1, *(pytest.param(n, marks=pytest.mark.full) for n in (2, 3))])
def test_shuffled_reports_within_the_window_give_the_same_tracks(cut_log: Path, seed: int) -> None:
    """Values on the sender timeline are equal. The node's clock has seen other arrivals, and model
    selection other predictions: a prediction moves by at most the clock uncertainty."""
    events = list(read_log(cut_log))
    held_back = late(events, seed)
    in_order, shuffled = (final_tracks(each, held_back[-1].t_ns) for each in (events, held_back))
    assert set(in_order) == set(shuffled) == {"1:1", "2:1", "3:1", "4:1", "5:1"}
    for uav, track in in_order.items():
        other = shuffled[uav]
        assert other.reports == track.reports
        assert other.dt_s == track.dt_s
        assert other.innovation_m == pytest.approx(track.innovation_m, abs=1e-9)
        assert other.unknown_input_mps == pytest.approx(track.unknown_input_mps, abs=1e-9)
        apart_m = np.linalg.norm(other.position_ned_m - track.position_ned_m)
        assert apart_m <= other.clock_bound_s * 8.0 + 0.01


def test_tracking_continues_after_a_reboot() -> None:
    pipeline = Pipeline(Settings())
    reboots, since, refused = 0, 99, []
    for event in read_log(shared_log("real_dronekit_flight2015.tlog")):
        for output in pipeline.step(event):
            if isinstance(output, Notice) and "restarted" in output.text:
                reboots += 1
                refused, since = refused[-8:], 0
            elif isinstance(output, Rejection) and output.reason == "unplaced-stamp":
                refused.append(output.t_ns)
            elif isinstance(output, Estimate):
                since += 1
    assert reboots == 1
    assert len(refused) <= 3
    assert since > 2000


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("real_devmangrani_flight54.tlog", marks=pytest.mark.full),
        "real_eagle_c2_gui.tlog",
    ],
)
def test_reports_of_real_flights_pass_the_gate(name: str) -> None:
    """Real vehicles stay within the default limits."""
    pipeline = Pipeline(Settings())
    for event in read_log(shared_log(name)):
        pipeline.step(event)
    gated = {"unreachable", "altitude-jump", "frozen", "shared-id"}
    assert not gated & {str(reason) for reason in pipeline.refusals.total}


def with_glitch(events: list[Event], sysid: int, from_s: float, to_s: float) -> list[Event]:
    """Return the same log with one UAV's positions displaced 25 m to the north for a while."""
    begin = events[0].t_ns
    changed: list[Event] = []
    for event in events:
        at_s = (event.t_ns - begin) * 1e-9
        hit = isinstance(event, Frame) and (event.msgid, event.source.sysid) == (33, sysid)
        if isinstance(event, Frame) and hit and from_s <= at_s <= to_s:
            changed.append(event._replace(raw=_moved(event)))
        else:
            changed.append(event)
    return changed


def _moved(frame: Frame) -> bytes:
    lat_1e7 = struct.unpack_from("<i", frame.raw, 14)[0] + round(25 / 111_195 * 1e7)
    return frame.raw[:14] + struct.pack("<i", lat_1e7) + frame.raw[18:]


def test_only_the_glitch_is_rejected(cut_log: Path) -> None:
    events = list(read_log(cut_log))
    pipeline = Pipeline(Settings().override(center={"source": "5:1"}))
    for event in with_glitch(events, 2, 8.0, 10.0):
        pipeline.step(event)
    refused = pipeline.refusals.of("2:1").counts
    assert set(refused) == {"unreachable"}
    assert 15 <= refused.total() <= 22
    assert not any("unreachable" in pipeline.refusals.of(f"{n}:1").counts for n in (1, 3, 4, 5))
    now_ns = events[-1].t_ns
    (track,) = (t for t in pipeline.tracks(now_ns, now_ns) if t.uav == "2:1")
    assert track.state == "live"
