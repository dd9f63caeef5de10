"""Verdicts on links: by their gains, with hysteresis before a notice, one notice per cause."""

import math
from dataclasses import replace

import numpy as np
import pytest
import tracks

from companion.beams.aim import aim
from companion.beams.array.coverage import EVERYWHERE
from companion.beams.array.geometry import uniform_linear
from companion.beams.weights.precoding import Precoder
from companion.beams.worth.link_budget import LinkBudget
from companion.pipeline.blame import CarrierEvidence, LinkEvidence
from companion.pipeline.health import AT_ONCE, COASTING_S, FALLEN_AT_ONCE, MARGIN_DB, HealthMonitor
from companion.pipeline.link_gains import GainMeter, Site
from companion.settings.beams import NeedSettings
from companion.values import Carrier, Level, Notice, Reason, Severity, Track, TrackState, Update

S = 1_000_000_000
ARRAY = uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
SITE = Site(
    array=ARRAY,
    coverage=EVERYWHERE,
    budget=LinkBudget(tx_power_dbm=20.0, bandwidth_hz=50e6, noise_figure_db=7.0),
    uav_antennas=4,
)
CARRIER = Carrier(
    valid_at_ns=9,
    position_ned_m=np.zeros(3),
    velocity_ned_mps=None,
    body_from_local=np.eye(3),
    body_rates_radps=np.zeros(3),
    bound_m=0.0,
    attitude_bound_rad=0.0,
    age_s=None,
)
PLACES = {"1:1": (100.0, 20.0, -10.0), "2:1": (80.0, -60.0, 5.0), "3:1": (30.0, 90.0, 0.0)}


def track(uav: str, bound_m: float, usual_m: float, state: str = "live") -> Track:
    return tracks.track(
        np.array(PLACES[uav]),
        uav=uav,
        state=TrackState(state),
        valid_at_ns=9,
        bound_m=bound_m,
        error_p95_m=usual_m,
        dt_s=0.1,
        latency_s=0.0,
        reports=9,
    )


def update(t_s: float, tracks: list[Track], carrier: Carrier | None = CARRIER) -> Update:
    t_ns = round(t_s * S)
    beams = aim(
        t_ns, valid_at_ns=t_ns, tracks=tracks, carrier=carrier, array=ARRAY, precoder=Precoder()
    )
    unfit = None if carrier else "the carrier is not known"
    return Update(t_ns=t_ns, carrier=carrier, unfit=unfit, tracks=tuple(tracks), beams=beams)


NEED = NeedSettings(needed_db=10.0)


class Watch:
    """Link assessment that requires 10 dB, with its notices."""

    def __init__(self, **need: float) -> None:
        self.carrier = CarrierEvidence()
        self.health = HealthMonitor(NeedSettings(**need) if need else NEED, SITE, 10.0)
        self.said: list[Notice] = []

    def see(self, t_s: float, tracks: list[Track], carrier: Carrier | None = CARRIER) -> str:
        news = update(t_s, tracks, carrier)
        weighed = self.health.next_batch(news)
        known = LinkEvidence(clock_assumed=False, refused=None, carrier=self.carrier)
        self.said += self.health.judge(news, weighed, lambda _uav: known)
        return " ".join(str(one.level) for one in self.health.verdicts.values())


SURE, USUAL, WILD = (0.5, 0.1), (12.0, 0.5), (60.0, 50.0)
"""Bound and p95 error at 100 m with which 10 dB are guaranteed, likely, and neither."""


@pytest.mark.parametrize(("errors", "level"), [(SURE, "good"), (USUAL, "weak"), (WILD, "none")])
def test_verdict_follows_guaranteed_or_likely_gain(errors: tuple[float, float], level: str) -> None:
    watch = Watch()
    assert watch.see(0, [track("1:1", *errors)]) == level
    verdict = watch.health.verdicts["1:1"]
    assert verdict.needed_gain_db == 10.0
    assert (verdict.blame is None) == (level == "good")
    sure, likely = verdict.guaranteed_gain_db, verdict.likely_gain_db
    assert (sure is not None and sure >= 10) == (level == "good")
    assert (likely is not None and likely >= 10) == (level != "none")


def test_links_are_assessed_once_per_second() -> None:
    watch = Watch()
    watch.see(0, [track("1:1", *SURE)])
    assert watch.see(0.9, [track("1:1", *SURE), track("2:1", *SURE)]) == "good"
    assert watch.see(1.0, [track("1:1", *SURE), track("2:1", *SURE)]) == "good good"


def test_many_links_are_assessed_in_batches_and_announced_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each link is assessed once per second, and links that got worse at once, up to a limit.

    Links that became worse for one cause share a notice.
    """
    many = {f"{n}:1": (200.0, 4.0 * n - 120.0, -10.0) for n in range(1, 61)}
    monkeypatch.setattr(f"{__name__}.PLACES", many)
    watch, judged, levels = Watch(needed_db=6.0), [], []
    for step in range(31):
        errors = SURE if step < 10 else WILD
        tracks = [track(uav, *errors) for uav in many]
        before = {uav: id(one) for uav, one in watch.health.verdicts.items()}
        levels.append(set(watch.see(step / 10, tracks).split()))
        after = watch.health.verdicts
        judged.append({uav for uav in after if id(after[uav]) != before.get(uav)})
    assert max(map(len, judged)) <= AT_ONCE + FALLEN_AT_ONCE
    assert max(map(len, judged[:10])) <= AT_ONCE
    for begun in (0, 20):
        turns = [uav for one in judged[begun : begun + 10] for uav in one]
        assert sorted(turns) == sorted(many)
    assert levels[9] == {"good"}
    assert levels[11] == {"none"}  # after two updates, a fifth of a second
    assert len(watch.said) == 1


def test_batches_do_not_grow_when_updates_are_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """They would be the later for it. A round takes longer, and is completed."""
    many = {f"{n}:1": (200.0, 4.0 * n - 120.0, -10.0) for n in range(1, 61)}
    monkeypatch.setattr(f"{__name__}.PLACES", many)
    watch, tracks = Watch(needed_db=6.0), [track(uav, *SURE) for uav in many]
    judged = []
    for step in range(12):
        before = {uav: id(one) for uav, one in watch.health.verdicts.items()}
        watch.see(step / 2, tracks)
        after = watch.health.verdicts
        judged.append([uav for uav in after if id(after[uav]) != before.get(uav)])
    assert max(map(len, judged)) <= AT_ONCE
    for begun in (0, 4, 8):
        turns = [uav for one in judged[begun : begun + 4] for uav in one]
        assert sorted(turns) == sorted(many)


def test_verdict_falls_at_once_and_rises_after_three_seconds() -> None:
    watch = Watch()
    levels = [watch.see(t_s, [track("1:1", *SURE)]) for t_s in (0.0, 0.1, 1.0)]
    levels += [watch.see(t_s / 10, [track("1:1", *USUAL)]) for t_s in (11, 12, 20, 30)]
    levels += [watch.see(t_s, [track("1:1", *SURE)]) for t_s in range(4, 10)]
    assert levels == [*["good"] * 3, *["weak"] * 7, *["good"] * 3]
    assert [(one.t_ns / S, one.severity) for one in watch.said] == [
        (3.0, Severity.WARNING),
        (8.0, Severity.INFO),
    ]
    assert watch.said[0].text.startswith("link to 1:1: weak – ")
    assert watch.said[1].text == "link to 1:1: good"
    assert watch.health.verdicts["1:1"].since_ns == 7 * S


def test_no_good_verdict_lies_below_its_need() -> None:
    """Bounds of any size from one update to the next, up to 30 a second."""
    watch, rng = Watch(), np.random.default_rng(3)
    seen = set[str]()
    for step in range(600):
        bound_m = 0.5 if step % 150 else float(rng.choice([5.0, 8.0, 12.0]))
        bound_m *= float(rng.uniform(0.8, 1.2))
        news = [track("1:1", bound_m, 0.1)]
        seen.add(watch.see(step / 30, news))
        verdict = watch.health.verdicts["1:1"]
        if verdict.level is Level.GOOD:
            now = GainMeter(NEED, SITE).gains(update(step / 30, news).beams, [0])[0]
            assert now.guaranteed_db is not None
            assert now.guaranteed_db >= now.needed_db
    assert seen >= {"good", "weak"}


def test_held_level_gives_its_current_reason() -> None:
    """A good link has no reason of its own: that of before is given as such."""
    watch = Watch()

    def reason(t_s: float, news: Track) -> str:
        assert watch.see(t_s, [news]) == "none"
        why = watch.health.verdicts["1:1"].blame
        assert why is not None
        return why.reason

    assert reason(0, replace(track("1:1", *WILD), age_s=2.0)) == "no report for 2.0 s"
    past = "good again, for less than 3 s; before: no report for 2.0 s"
    assert reason(1, track("1:1", *SURE)) == past
    assert reason(2, track("1:1", *SURE)) == past
    assert reason(3, replace(track("1:1", *USUAL), age_s=3.0)) == "no report for 3.0 s"


def test_brief_changes_are_not_announced() -> None:
    watch = Watch()
    for t_s in range(20):
        watch.see(t_s, [track("1:1", *SURE)])
        watch.see(t_s + 0.5, [track("1:1", *(USUAL if t_s % 5 == 1 else SURE))])
        watch.see(t_s + 0.6, [track("1:1", *SURE)])
    assert [one.text[:15] for one in watch.said] == []


def test_improvement_must_last_three_seconds_without_interruption() -> None:
    """It gets worse in between: the three seconds start again."""
    watch = Watch()
    watch.see(0, [track("1:1", *USUAL)])
    errors = [SURE, SURE, USUAL, SURE, SURE, SURE, SURE]
    seen = [watch.see(1 + t_s, [track("1:1", *one)]) for t_s, one in enumerate(errors)]
    assert seen == [*["weak"] * 6, "good"]


def test_level_rises_with_a_margin() -> None:
    """A level falls with the gain below the need, and rises with a margin above it."""
    watch = Watch()
    watch.see(0, [track("1:1", *SURE)])
    sure_db = watch.health.verdicts["1:1"].guaranteed_gain_db
    assert sure_db is not None
    for spare_db, is_good in ((-0.1, False), (0.1, True)):
        watch = Watch(needed_db=sure_db - spare_db)
        assert (watch.see(0, [track("1:1", *SURE)]) == "good") is is_good
    for spare_db, is_good in ((0.9 * MARGIN_DB, False), (1.1 * MARGIN_DB, True)):
        watch = Watch(needed_db=sure_db - spare_db)
        watch.see(0, [track("1:1", *USUAL)])
        levels = [watch.see(t_s, [track("1:1", *SURE)]) for t_s in range(1, 6)]
        assert (levels[-1] == "good") is is_good


def test_coasting_uav_is_not_good_beyond_two_seconds() -> None:
    watch = Watch()
    watch.see(0, [track("1:1", *SURE)])
    coasting = track("1:1", *SURE, "coasting")
    assert watch.see(1, [replace(coasting, age_s=COASTING_S)]) == "good"
    assert watch.see(2, [replace(coasting, age_s=COASTING_S + 0.1)]) == "weak"
    why = watch.health.verdicts["1:1"].blame
    assert why is not None
    assert why.reason == "no report for 2.1 s"


def test_uav_without_beam_has_no_link_at_once_without_a_notice() -> None:
    watch = Watch()
    watch.see(0, [track("1:1", *SURE), track("2:1", *SURE)])
    assert watch.see(0.1, [track("1:1", *SURE, "stale"), track("2:1", *SURE)]) == "none good"
    assert watch.said == []
    assert watch.health.verdicts["1:1"].guaranteed_gain_db is None


def test_common_cause_is_announced_once() -> None:
    everybody = [track(uav, *SURE) for uav in PLACES]
    watch = Watch()
    watch.see(0, everybody)
    assert watch.see(1, everybody, None) == "none none none"
    watch.see(2, everybody, None)
    for t_s in range(3, 9):
        watch.see(t_s, everybody)
    assert [one.text for one in watch.said] == [
        "no links: the carrier is not known",
        "links to 1:1, 2:1, 3:1: good",
    ]


def test_carrier_whose_positions_are_rejected_is_the_cause_for_all() -> None:
    watch = Watch()
    watch.carrier = CarrierEvidence(refused=Reason.BAD_SIGNATURE)
    watch.see(0, [track("1:1", *SURE)])
    assert watch.see(1, [track("1:1", *SURE)], None) == "none"
    why = watch.health.verdicts["1:1"].blame
    assert why is not None and why.reason.endswith("its positions are rejected (bad-signature)")
    assert "signing key" in why.remedy


def test_a_uav_that_is_gone_is_forgotten() -> None:
    watch = Watch()
    watch.see(0, [track("1:1", *SURE), track("2:1", *SURE)])
    assert watch.see(1, [track("2:1", *SURE)]) == "good"
    assert list(watch.health.verdicts) == ["2:1"]


def test_required_sinr_is_converted_to_a_gain() -> None:
    """Twice the range takes 6 dB more; alone in its time slot there is only noise."""
    found = []
    for factor in (1.0, 2.0):
        watch = Watch(needed_sinr_db=5.0)
        near = track("1:1", *SURE)
        watch.see(0, [replace(near, position_ned_m=factor * near.position_ned_m)])
        found.append(watch.health.verdicts["1:1"].needed_gain_db)
    wavelength_m, noise_dbm = 299_792_458 / 30e9, 10 * math.log10(1.380649e-20 * 290 * 50e6) + 7
    path_db = 20 * math.log10(wavelength_m / (4 * math.pi * math.hypot(*PLACES["1:1"])))
    expected = 5.0 - (20.0 + path_db + 10 * math.log10(4) - noise_dbm)
    assert found == pytest.approx([expected, expected + 20 * math.log10(2)], abs=1e-6)
