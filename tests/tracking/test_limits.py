"""Limits of aircraft, and reports that refute them."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.tracking.limits import (
    DECAY_S,
    RAISED,
    Airframe,
    RaisedLimit,
    Refutations,
    airframe,
    lag_s,
)
from companion.values import Fix, Limits, LimitSource, ReportNoise

S = 1_000_000_000
COPTER = Limits(60.0, 4.0, LimitSource.TYPE)
NOISE = ReportNoise(horizontal_m=1.0, vertical_m=1.0, position_m=1.4, velocity_mps=0.3)


def told(fix: Callable[..., Fix], t_s: float, velocity: object, limits: Limits = COPTER) -> Fix:
    made = fix(round(t_s * S), [0, 0, 0], velocity, noise=NOISE)
    return made._replace(limits=limits)


@pytest.mark.parametrize(
    ("mav_type", "kind"),
    [
        (None, Airframe.UNKNOWN), (1, Airframe.AEROPLANE), (2, Airframe.COPTER),
        (4, Airframe.HELICOPTER), (6, Airframe.UNKNOWN), (10, Airframe.ROVER),
        (13, Airframe.COPTER), (20, Airframe.VTOL), (12345, Airframe.UNKNOWN),
    ],
)  # fmt: skip
def test_airframe_of_each_mav_type(mav_type: int | None, kind: Airframe) -> None:
    assert airframe(mav_type) is kind


def test_position_lag_depends_on_airframe_and_autopilot() -> None:
    copter, aeroplane = lag_s(Airframe.COPTER, 3), lag_s(Airframe.AEROPLANE, 3)
    assert 0 < copter[0] < 0.0295 < copter[1]
    assert aeroplane[0] < -0.0267 < aeroplane[1] < 0
    either = lag_s(Airframe.UNKNOWN, 3)
    assert either[0] <= aeroplane[0] and copter[1] <= either[1]
    assert lag_s(Airframe.COPTER, 12) == lag_s(Airframe.UNKNOWN, None) == (0.0, 0.06)
    assert lag_s(Airframe.COPTER, 0) == lag_s(Airframe.AEROPLANE, 0) == (0.0, 0.5)


def test_most_specific_setting_applies() -> None:
    """Order: the UAV's setting, its type's, the general one, the built-in value of its type."""
    given = Settings().override(
        observer={
            "acceleration_max_mps2": 7.0,
            "types": {"aeroplane": {"acceleration_max_mps2": 20.0}},
            "uav": {"3:1": {"acceleration_max_mps2": 30.0, "lag_s": (0.0, 0.01)}},
        }
    )
    found = [assembly.assumed(given, uav, 1, 3) for uav in ("3:1", "4:1")]
    assert [one.limits.acceleration_max_mps2 for one in found] == [30.0, 20.0]
    assert [one.lag_s for one in found] == [(0.0, 0.01), (-0.033, -0.019)]
    assert assembly.assumed(given, "4:1", 2, 3).limits.acceleration_max_mps2 == 7.0
    assert assembly.assumed(Settings(), "4:1", 2, 3).limits == COPTER
    relayed = assembly.assumed(Settings(), "icao:4CA7B3", None, None)
    assert relayed.limits.speed_max_mps == 400.0
    assert relayed.lag_s == (0.0, 0.0)


@settings(max_examples=examples(200))
@given(
    st.lists(
        st.tuples(st.floats(0.05, 2.0), *[st.floats(-1, 1)] * 3, *[st.floats(-1, 1)] * 3),
        min_size=2,
        max_size=30,
    )
)
def test_motion_within_the_limits_is_never_refuted(
    fix: Callable[..., Fix], steps: list[tuple[float, ...]]
) -> None:
    """At any noise within its bound, and with stamps in whole milliseconds."""
    known, velocity, t_s = Refutations(), np.zeros(3), 0.0
    for length_s, *rest in steps:
        push, wrong = np.array(rest[:3]), np.array(rest[3:])
        push *= 4.0 / max(1.0, float(np.linalg.norm(push)) * math.sqrt(3))
        wrong *= 0.3 / max(1.0, float(np.linalg.norm(wrong)))
        if float(np.linalg.norm(velocity + push * length_s)) > 59:
            push = -push
        velocity, t_s = velocity + push * length_s, t_s + length_s
        if float(np.linalg.norm(velocity)) > 60:
            return
        stamped = math.floor(t_s * 1e3) / 1e3
        assert known.look(told(fix, stamped, velocity + wrong)) == []
    assert known.speed == known.acceleration == RaisedLimit()


def test_acceleration_limit_is_refuted_raised_and_decays(fix: Callable[..., Fix]) -> None:
    """8 m/s² for two seconds by a type with a limit of 4 m/s²."""
    known, found = Refutations(), []
    for n in range(40):
        t_s = n / 10
        found += known.look(told(fix, t_s, [8.0 * min(2.0, max(0.0, t_s - 1)), 0, 0]))
    assert found
    assert {one.setting for one in found} == {"observer.acceleration_max_mps2"}
    assert found[0].limit == 4.0
    assert all(4.0 < one.proven <= 8.0 for one in found)
    assert found[0].t_ns <= 2 * S  # within one second of its start
    raised = known.limits(COPTER, 3 * S)
    assert raised.limits_source is LimitSource.RAISED
    assert 4.0 < raised.acceleration_max_mps2 <= RAISED * 8.0
    later = known.limits(COPTER, round((3 + 3 * DECAY_S) * S))
    assert 4.0 < later.acceleration_max_mps2 < 4.7
    assert later.speed_max_mps == 60.0


def test_excess_speed_refutes_the_speed_limit(fix: Callable[..., Fix]) -> None:
    known = Refutations()
    (found,) = known.look(told(fix, 0, [70, 0, 0]))
    assert (found.setting, found.limit, found.proven) == ("observer.speed_max_mps", 60.0, 69.7)
    assert known.limits(COPTER, 0).speed_max_mps == RAISED * 69.7


def test_implausible_reports_do_not_refute_limits(fix: Callable[..., Fix]) -> None:
    """A false report: 500 m/s, or from rest to 30 m/s in a tenth of a second."""
    known = Refutations()
    assert known.look(told(fix, 0, [500, 0, 0])) == []
    known = Refutations()
    known.look(told(fix, 0, [0, 0, 0]))
    assert known.look(told(fix, 0.1, [30, 0, 0])) == []
    assert known.limits(COPTER, S) is COPTER
