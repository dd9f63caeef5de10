"""Telemetry and ADS-B of one aircraft are merged; two aircraft that pass each other are not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import tracks
from numpy.typing import ArrayLike

from companion.tracking import noise
from companion.tracking.identity import RELAYED_MAX, REPORTS_TO_DECIDE, Identities
from companion.values import Fix, GnssStatus, ReportNoise, Source, Track, TrackState

MakeFix = Callable[..., Fix]
S = 1_000_000_000
AIRCRAFT = "icao:4CA7B3"
VELOCITY = (20.0, 0.0, 0.0)


def track(uav: str, position: ArrayLike, velocity: ArrayLike | None = VELOCITY) -> Track:
    speeds = None if velocity is None else np.array(velocity, dtype=float)
    return tracks.track(
        np.array(position, dtype=float), uav=uav, age_s=0.0, velocity_ned_mps=speeds, bound_m=5.0
    )


def relayed(fix: MakeFix, n: int, position: ArrayLike, velocity: ArrayLike = VELOCITY) -> Fix:
    speeds = np.array(velocity, dtype=float)
    return fix(
        n * S,
        position,
        velocity,
        uav=AIRCRAFT,
        noise=noise.relayed(speeds, 0.0, speed_max_mps=60.0),
    )


def after(fix: MakeFix, offsets: list[float], *others: Track) -> str | None:
    """Return the merged UAV id after reports at those distances east of the first track."""
    identities = Identities()
    for n, east in enumerate(offsets):
        here = [20.0 * n, 0, -300]
        telemetry = [track("1:1", here), *others]
        identities.observe(relayed(fix, n, [20.0 * n, east, -310]), telemetry)
    return identities.same_as(AIRCRAFT)


def test_same_aircraft_under_two_ids_is_identified_after_enough_reports(fix: MakeFix) -> None:
    assert after(fix, [30.0] * (REPORTS_TO_DECIDE - 1)) is None
    assert after(fix, [30.0] * REPORTS_TO_DECIDE) == "1:1"


@pytest.mark.parametrize("state", TrackState)
@pytest.mark.parametrize("is_merged", [True, False])
def test_silent_track_is_not_identified_with_the_aircraft_around_it(
    fix: MakeFix, state: TrackState, is_merged: bool
) -> None:
    """A coasting one keeps an aircraft that was identified with it while it was live."""
    identities = Identities()
    for n in range(2 * REPORTS_TO_DECIDE):
        now = state if n >= REPORTS_TO_DECIDE else TrackState.LIVE
        here = [20.0 * n, 0 if is_merged or n >= REPORTS_TO_DECIDE else 5000, -300]
        telemetry = replace(track("1:1", here), state=now)
        identities.observe(relayed(fix, n, [20.0 * n, 30.0, -310]), [telemetry])
    usable = {TrackState.LIVE, TrackState.COASTING} if is_merged else {TrackState.LIVE}
    assert identities.same_as(AIRCRAFT) == ("1:1" if state in usable else None)


def test_distant_aircraft_is_not_merged(fix: MakeFix) -> None:
    assert after(fix, [500.0] * 20) is None


@pytest.mark.parametrize(("above_m", "same"), [(120.0, "1:1"), (-120.0, "1:1"), (130.0, None)])
def test_aircraft_at_a_different_height_is_not_merged(
    fix: MakeFix, above_m: float, same: str | None
) -> None:
    """100 m of noise, 20 m for one second of time uncertainty, and 5 m of the track."""
    identities = Identities()
    for n in range(REPORTS_TO_DECIDE):
        here = [20.0 * n, 0, -300]
        report = relayed(fix, n, [20.0 * n, 10, -300 - above_m])
        identities.observe(report, [track("1:1", here)])
    assert identities.same_as(AIRCRAFT) == same


def test_nearest_track_is_chosen(fix: MakeFix) -> None:
    assert after(fix, [30.0] * 6, track("2:1", [100, 200, -300])) == "1:1"


def test_short_encounter_does_not_merge_tracks(fix: MakeFix) -> None:
    """They are within their errors for too few reports."""
    assert after(fix, [400, 300, 100, 0, -100, -300, -400, -500]) is None


def test_different_velocity_does_not_merge_tracks(fix: MakeFix) -> None:
    identities = Identities()
    for n in range(20):
        telemetry = [track("1:1", [0, 0, -300])]
        identities.observe(relayed(fix, n, [0, 10, -300], (0.0, 25.0, 0.0)), telemetry)
    assert identities.same_as(AIRCRAFT) is None


def test_merged_tracks_separate_when_they_part(fix: MakeFix) -> None:
    assert after(fix, [30.0] * 8 + [900.0] * (REPORTS_TO_DECIDE - 1)) == "1:1"
    assert after(fix, [30.0] * 8 + [900.0] * REPORTS_TO_DECIDE) is None


def test_aircraft_is_separated_at_once_from_a_track_that_is_too_old(fix: MakeFix) -> None:
    """Neither had a beam until five more reports."""
    identities = Identities()
    for n in range(REPORTS_TO_DECIDE):
        here = [20.0 * n, 0, -300]
        identities.observe(relayed(fix, n, [20.0 * n, 30.0, -310]), [track("1:1", here)])
    identities.separate("2:1")
    assert identities.merged == {AIRCRAFT}
    identities.separate("1:1")
    assert (identities.merged, identities.same_as(AIRCRAFT)) == (set(), None)


# --- bounds on a report's errors ------------------------------------------------------------------

DEFAULT = ReportNoise(horizontal_m=3.0, vertical_m=3.0, position_m=3.0, velocity_mps=0.5)


def status(h: float | None, v: float | None, vel: float | None) -> GnssStatus:
    return GnssStatus(
        t_ns=0, source=Source(1, 1), fix_type=3, alt_m=500.0, h_acc_m=h, v_acc_m=v, vel_acc_mps=vel
    )


@pytest.mark.parametrize(
    ("accuracies", "expected"),
    [
        ((0.5, 1.0, 0.1), (1.5, 3.0, 3.354, 0.3)),
        ((None, 1.0, None), (3.0, 3.0, 4.243, 0.5)),
        ((0.001, 0.001, 0.001), (0.9, 0.9, 1.273, 0.02)),  # below the best accuracy of the fix type
    ],
)
def test_noise_bound_is_reported_accuracy_times_a_factor(
    accuracies: tuple[float | None, ...], expected: tuple[float, ...]
) -> None:
    found = noise.reported(status(*accuracies), noise.NoiseSettings(DEFAULT, 3.0))
    values = (found.horizontal_m, found.vertical_m, found.position_m, found.velocity_mps)
    assert values == pytest.approx(expected, abs=1e-3)


def test_reported_accuracies_can_be_ignored() -> None:
    given = noise.NoiseSettings(DEFAULT, None)
    assert noise.reported(status(0.5, 1.0, 0.1), given) == DEFAULT


@pytest.mark.parametrize(
    ("fix_type", "least_m"), [(2, 3.0), (3, 0.9), (4, 0.6), (5, 0.3), (6, 0.03), (8, 0.03)]
)
def test_reported_accuracy_is_limited_by_the_fix_type(fix_type: int, least_m: float) -> None:
    """Some receivers state 1 mm when they do not know, or what was true before the fix was lost."""
    claimed = status(0.001, 0.001, None)._replace(fix_type=fix_type)
    found = noise.reported(claimed, noise.NoiseSettings(DEFAULT, 3.0))
    assert (found.horizontal_m, found.vertical_m) == pytest.approx((least_m, least_m))
    honest = claimed._replace(h_acc_m=0.3)
    found = noise.reported(honest, noise.NoiseSettings(DEFAULT, 3.0))
    assert found.horizontal_m == pytest.approx(0.9 if fix_type >= 3 else 3.0)


def test_forgotten_aircraft_is_compared_again(fix: MakeFix) -> None:
    identities = Identities()
    telemetry = [track("1:1", [0, 0, -300])]
    for number in range(20_000):
        identities.observe(relayed(fix, number, [0, 10, -300]), telemetry)
    assert identities.same_as(AIRCRAFT) == "1:1"
    identities.forget(AIRCRAFT)
    assert identities.same_as(AIRCRAFT) is None
    assert vars(identities) == vars(Identities())


def test_invented_ids_use_bounded_memory(fix: MakeFix) -> None:
    """The oldest entry is evicted, and decided again when it is received again."""
    identities = Identities()
    here = [20.0, 0, -300]
    for n in range(REPORTS_TO_DECIDE):
        identities.observe(relayed(fix, n, here), [track("1:1", here)])
    assert identities.same_as(AIRCRAFT) == "1:1"
    for number in range(RELAYED_MAX):
        identities.observe(relayed(fix, 9, here)._replace(uav=f"cot:{number}"), [])
    assert len(identities._relayed) == RELAYED_MAX
    assert identities.same_as(AIRCRAFT) is None
