"""Receivers worse than their stated accuracy: detection, and the noise assumed afterwards."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from companion.tracking.noise import NoiseSettings
from companion.tracking.receiver_check import GOOD_DEVIATION_M, ReceiverCheck
from companion.values import Fix, FloatArray, Refuted, ReportNoise

S = 1_000_000_000
ACCELERATION_MPS2 = 5.0
DEFAULT = ReportNoise(horizontal_m=3.0, vertical_m=3.0, position_m=3.0, velocity_mps=0.5)
SETTINGS = NoiseSettings(DEFAULT, 3.0)
STATED = ReportNoise(horizontal_m=0.9, vertical_m=0.9, position_m=1.27, velocity_mps=0.5)
MakeFix = Callable[..., Fix]
Wander = Callable[[float], tuple[float, float]]


def flown(
    fix: MakeFix, wander: Wander, noise: ReportNoise = STATED, step_s: float = 0.1
) -> Iterator[Fix]:
    """Return one minute on a circle 60 m wide at 6 m/s, as a wandering receiver reports it."""
    for n in range(round(60 / step_s)):
        t_s = n * step_s
        turn = 0.1 * t_s
        place = 60 * np.array([math.cos(turn), math.sin(turn), 0.0])
        velocity: FloatArray = 6 * np.array([-math.sin(turn), math.cos(turn), 0.0])
        off = np.array([*wander(t_s), 0.0])
        yield fix(round(t_s * S), place + off, velocity, noise=noise)


def told(straying: ReceiverCheck, fixes: Iterator[Fix]) -> list[tuple[float, Refuted]]:
    looked = ((one.sender_ns / S, straying.look(one, ACCELERATION_MPS2)) for one in fixes)
    return [(at_s, found) for at_s, found in looked if found is not None]


def wave(size_m: float, period_s: float) -> Wander:
    return lambda t_s: (size_m * math.sin(2 * math.pi * t_s / period_s), 0.0)


def test_good_receiver_is_trusted(fix: MakeFix) -> None:
    straying = ReceiverCheck(SETTINGS)
    rng = np.random.default_rng(1)
    noisy = flown(fix, lambda _t: tuple((0.05 * rng.standard_normal(2)).tolist()))
    assert told(straying, noisy) == []
    assert straying.noise(STATED) is STATED
    assert straying.common_error_m(STATED) == pytest.approx(0.07 * STATED.position_m)


def test_constant_offset_is_not_detectable(fix: MakeFix) -> None:
    assert told(ReceiverCheck(SETTINGS), flown(fix, lambda _t: (5.0, 5.0))) == []


@pytest.mark.parametrize("size_m", [0.8, 1.6, 3.2])
def test_wandering_receiver_is_detected_while_the_bound_holds(fix: MakeFix, size_m: float) -> None:
    """It is reported early and a few times only, and the raised bound covers the error."""
    straying, wander = ReceiverCheck(SETTINGS), wave(size_m, 15)
    found = told(straying, flown(fix, wander))
    assert 1 <= len(found) <= 12
    first_s, first = found[0]
    assert math.hypot(*wander(first_s)) < STATED.position_m
    assert first.setting == "observer.follow_accuracy"
    assert first.limit == pytest.approx(0.3)
    assert first.proven > GOOD_DEVIATION_M
    raised = straying.noise(STATED)
    assert raised.horizontal_m >= max(DEFAULT.horizontal_m, size_m)
    assert raised.position_m == pytest.approx(math.hypot(raised.horizontal_m, 0.9))
    assert raised.vertical_m == STATED.vertical_m
    assert straying.common_error_m(raised) > size_m / math.sqrt(2)


def test_receiver_with_poor_stated_accuracy_may_wander(fix: MakeFix) -> None:
    honest = ReportNoise(horizontal_m=2.7, vertical_m=2.7, position_m=3.8, velocity_mps=0.5)
    assert told(ReceiverCheck(SETTINGS), flown(fix, wave(0.6, 15), honest)) == []


def test_residual_lag_is_not_attributed_to_the_receiver(fix: MakeFix) -> None:
    late = ReportNoise(
        horizontal_m=0.9, vertical_m=0.9, position_m=1.27, velocity_mps=0.5, time_s=0.06
    )

    def lag(t_s: float) -> tuple[float, float]:
        turn, off_m = 0.1 * t_s, 6 * 0.06 * (1 if t_s % 4 < 2 else -1)
        return -off_m * math.sin(turn), off_m * math.cos(turn)

    assert told(ReceiverCheck(SETTINGS), flown(fix, lag, late)) == []


def test_motion_between_reports_is_not_attributed_to_the_receiver(fix: MakeFix) -> None:
    """Gusts at 5 rad/s, 25 m/s strong, reported every half second: the velocities do not
    show them.
    """

    def gusty() -> Iterator[Fix]:
        for n in range(120):
            t_s, rate = 0.45 * n, 5.0
            place = np.array([25 / rate * math.sin(rate * t_s), 0.0, 0.0])
            velocity: FloatArray = np.array([25 * math.cos(rate * t_s), 0.0, 0.0])
            yield fix(round(t_s * S), place, velocity, noise=STATED)

    straying = ReceiverCheck(SETTINGS)
    assert [found for one in gusty() if (found := straying.look(one, 125.0))] == []
    careless = ReceiverCheck(SETTINGS)
    assert [found for one in gusty() if (found := careless.look(one, 0.0))]


def test_position_jump_is_left_to_the_gate(fix: MakeFix) -> None:
    """Neither the jump nor the return counts against the receiver."""
    assert (
        told(ReceiverCheck(SETTINGS), flown(fix, lambda t_s: (25.0 * (20 < t_s < 22), 0.0))) == []
    )


def test_sparse_reports_are_not_assessed(fix: MakeFix) -> None:
    assert told(ReceiverCheck(SETTINGS), flown(fix, wave(3.0, 15), step_s=0.8)) == []


def test_receiver_without_stated_accuracy_is_not_assessed(fix: MakeFix) -> None:
    for settings, noise in ((NoiseSettings(DEFAULT, None), STATED), (SETTINGS, DEFAULT)):
        straying = ReceiverCheck(settings)
        assert told(straying, flown(fix, wave(3.0, 15), noise)) == []
        assert straying.noise(noise) is noise


def test_height_difference_counts_as_common_error_within_the_bound() -> None:
    straying = ReceiverCheck(SETTINGS)
    for apart_m, usual_m in ((0.3, 0.3), (50.0, 0.9)):
        noise = ReportNoise(
            horizontal_m=0.9, vertical_m=0.9, position_m=1.27, velocity_mps=0.5, apart_m=apart_m
        )
        assert straying.common_error_m(noise) == pytest.approx(usual_m)
