"""Hysteresis: shapes change at a limited rate; method and time slots change only after a delay."""

import itertools
import math

import numpy as np
import pytest
import tracks

from companion.beams import hysteresis
from companion.beams.aim import aim
from companion.beams.array.geometry import Array, uniform_linear, uniform_rectangular
from companion.beams.hysteresis import Hysteresis
from companion.beams.weights.precoding import Precoder
from companion.values import BeamSet, Carrier, Method, Policy, Track, Widen

STILL = np.zeros(3)
AT = Carrier(
    valid_at_ns=0,
    position_ned_m=STILL,
    velocity_ned_mps=STILL,
    body_from_local=np.eye(3),
    body_rates_radps=STILL,
    bound_m=0.0,
    attitude_bound_rad=0.0,
    age_s=None,
)
ARRAY = uniform_linear(64, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
PLANE = uniform_rectangular(
    16, columns=16, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)
)
TICK_NS = 100_000_000


def track(uav: str, aside_m: float, bound_m: float) -> Track:
    return tracks.track(np.array([100.0, aside_m, 0.0]), uav=uav, bound_m=bound_m)


def flown(
    bounds_m: list[float], how: Precoder, apart_m: list[float] | None = None, array: Array = ARRAY
) -> list[BeamSet]:
    """Return beams for a UAV whose bound changes from tick to tick, with a second UAV beside it."""
    state: Hysteresis | None = None
    found = []
    for tick, bound_m in enumerate(bounds_m):
        at_ns = tick * TICK_NS
        aside_m = 60.0 if apart_m is None else apart_m[tick]
        tracks = [track("a", 0.0, bound_m), track("b", aside_m, 0.1)]
        found.append(
            aim(
                at_ns,
                valid_at_ns=at_ns,
                tracks=tracks,
                carrier=AT,
                array=array,
                precoder=how,
                before=state,
            )
        )
        state = hysteresis.updated(state, found[-1])
    return found


@pytest.mark.parametrize("widen", [Widen.LIKELY, Widen.GUARANTEE])
@pytest.mark.parametrize("bounds_m", [[2.0] + [30.0] * 40, [30.0] + [2.0] * 60, [90.0, 300.0] * 9])
@pytest.mark.parametrize("array", [ARRAY, PLANE], ids=["line", "plane"])
def test_beam_shape_does_not_jump_at_a_report(
    array: Array, widen: Widen, bounds_m: list[float]
) -> None:
    made = flown(bounds_m, Precoder(widen=widen), array=array)
    gains = [each.beams[0].gain_db for each in made]
    assert np.abs(np.diff(gains)).max() < 1.5
    for one, other in itertools.pairwise(made):
        assert abs(np.vdot(one.weights[:, 0], other.weights[:, 0])) > 0.75 * (
            np.linalg.norm(one.weights[:, 0]) * np.linalg.norm(other.weights[:, 0])
        )


def test_beam_shape_converges_to_the_wanted_shape() -> None:
    made = flown([2.0] + [30.0] * 60, Precoder())
    (alone, _) = flown([30.0], Precoder())[0].beams
    assert made[-1].beams[0].shaped_bound_rad == pytest.approx(alone.shaped_bound_rad)
    assert made[-1].beams[0].gain_db == pytest.approx(alone.gain_db, abs=0.02)
    assert made[1].beams[0].shaped_bound_rad < alone.shaped_bound_rad
    assert made[1].beams[0].pointing_bound_rad == pytest.approx(math.asin(0.3))


@pytest.mark.parametrize("widen", [Widen.LIKELY, Widen.GUARANTEE])
def test_uav_with_small_bound_keeps_a_narrow_beam(widen: Widen) -> None:
    """Narrower than any shape; one natural width is 1/32 rad."""
    made = flown([0.3] * 5 + [0.5] * 20 + [0.3] * 20, Precoder(widen=widen))
    for tick, bound_m in ((4, 0.3), (24, 0.5), (44, 0.3)):
        wanted = math.asin(bound_m / 100)
        assert made[tick].beams[0].shaped_bound_rad == pytest.approx(wanted)
    gains = [each.beams[0].gain_db for each in made]
    assert np.abs(np.diff(gains)).max() < 0.1


def test_shape_bound_shrinks_within_eight_seconds() -> None:
    """After a large or missing bound, the shape reaches the new bound within eight seconds."""
    for before_m in (99.0, 1000.0):
        made = flown([before_m] * 20 + [4.0] * 80, Precoder())
        wanted = math.asin(0.04)
        assert made[10].beams[0].shaped_bound_rad != pytest.approx(wanted)
        assert made[-1].beams[0].shaped_bound_rad == pytest.approx(wanted)


def test_sawtooth_bound_hardly_changes_the_shape() -> None:
    """Twelve ticks between reports; one natural width is 1/32 rad."""
    made = flown([6.0 + 14.0 * (tick % 12) / 12 for tick in range(96)], Precoder())
    shaped = np.array([each.beams[0].shaped_bound_rad for each in made[24:]])
    assert np.diff(shaped).min() > -1.1 * 0.1 / 32
    assert shaped.min() > 0.75 * math.asin(0.2 - 0.14 / 12)


def test_method_returns_to_zero_forcing_only_after_a_delay() -> None:
    """Two UAVs repeatedly become inseparable and separate again."""
    near, far = 0.05, 60.0
    apart = [far] * 3 + [near] + [far] * 3 + [near] + [far] * 9
    names = [each.method for each in flown([0.1] * len(apart), Precoder(), apart)]
    assert set(names[:3]) == {Method.ZERO_FORCING}
    assert set(names[3:12]) == {Method.REGULARISED}
    assert set(names[12:]) == {Method.ZERO_FORCING}


@pytest.mark.parametrize("policy", [Policy.GROUP, Policy.DROP])
def test_time_slots_do_not_alternate(policy: Policy) -> None:
    """Near the distance at which zero forcing reaches its loss limit."""
    apart = [1.38 + 0.06 * math.sin(2.1 * tick) for tick in range(40)]
    how = Precoder(policy=policy, widen=Widen.NO, priority=("b", "a"))
    sizes = [len(set(each.uavs)) + 10 * each.groups for each in flown([0.1] * 40, how, apart)]
    fresh = [
        len(set(each.uavs)) + 10 * each.groups
        for aside_m in apart
        for each in flown([0.1], how, [aside_m])
    ]
    assert np.count_nonzero(np.diff(fresh)) > 10
    assert np.count_nonzero(np.diff(sizes)) <= 8


@pytest.mark.parametrize("stopped_s", [100.0, 1000.0, 86_400.0, 2.0**31])
def test_rate_limit_survives_any_pause(stopped_s: float) -> None:
    """The next tick comes much later after SIGSTOP or a suspended machine."""
    before = Hysteresis(
        valid_at_ns=0,
        shaped={"1:1": (0.01, 0.2)},
        filled_ns={},
        slots={"1:1": 0},
        known=frozenset({"1:1"}),
        slots_since_ns=0,
        inexact_ns=None,
    )
    wanted = np.array([[0.05, 0.3]])
    at_ns = round(stopped_s * 1e9)
    for then_ns in (at_ns, -at_ns):
        assert np.array_equal(
            hysteresis.rate_limited_rad(
                before, then_ns, ["1:1"], wanted_rad=wanted, natural_rad=0.1
            ),
            wanted,
        )
