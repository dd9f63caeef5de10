"""Evidence of attitude errors: the bound holds whichever is right; truth never contradicts."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import examples

from companion.tracking.attitude_evidence import LAG_S, AttitudeAssumptions, AttitudeTrust
from companion.values import Attitude, EstimatorStatus, GnssHeading, Source, StatedAttitude

S = 1_000_000_000
SOURCE = Source(5, 1)
DEG = math.radians(1.0)
UNIT = st.floats(-1.0, 1.0)
AXES = st.tuples(UNIT, UNIT, UNIT).filter(lambda axis: math.hypot(*axis) > 0.1)


def trust(*, follows: bool = False, bound_deg: float = 3.0) -> AttitudeTrust:
    return AttitudeTrust(
        AttitudeAssumptions(
            bound_rad=bound_deg * DEG, factor=3.0, follows_accuracy=follows, mount_rad=DEG
        )
    )


def attitude(
    pose: Rotation, t_s: float = 0.0, rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Attitude:
    yaw, pitch, roll = pose.as_euler("ZYX").tolist()
    return Attitude(
        t_ns=round(t_s * S),
        source=SOURCE,
        boot_ms=round(t_s * 1e3),
        roll_rad=roll,
        pitch_rad=pitch,
        yaw_rad=yaw,
        rollspeed_radps=rates[0],
        pitchspeed_radps=rates[1],
        yawspeed_radps=rates[2],
    )


LEVEL = Rotation.identity()


def heading(
    deg: float, t_s: float = 0.1, accuracy_deg: float | None = 1.0, *, link: str = "a"
) -> GnssHeading:
    return GnssHeading(
        t_ns=round(t_s * S),
        source=SOURCE,
        link=link,
        receiver=1,
        heading_rad=math.radians(deg) % math.tau,
        accuracy_rad=None if accuracy_deg is None else math.radians(accuracy_deg),
    )


def stated(
    pose: Rotation | None, deviation_deg: float | None, t_s: float = 0.1, *, link: str = "a"
) -> StatedAttitude:
    quaternion = None
    if pose is not None:
        x, y, z, w = pose.as_quat().tolist()
        quaternion = (w, x, y, z)
    each = None if deviation_deg is None else (deviation_deg * DEG,) * 3
    return StatedAttitude(
        t_ns=round(t_s * S),
        source=SOURCE,
        link=link,
        msgid=61,
        ned_from_body=quaternion,
        deviations_rad=each,
    )


def bound_deg(of: AttitudeTrust) -> float:
    return math.degrees(of.bound_rad)


def unit(axis: tuple[float, float, float]) -> np.ndarray:
    return np.array(axis) / math.hypot(*axis)


# --- truth is no contradiction, and the bound holds whichever is right ------------------------


@settings(max_examples=examples(300))
@given(
    angles=st.tuples(st.floats(-3.1, 3.1), st.floats(-1.2, 1.2), st.floats(-3.1, 3.1)),
    axis=AXES,
    share=st.floats(0.0, 1.0),
    rates=st.tuples(UNIT, UNIT, UNIT),
    lag_s=st.floats(0.0, LAG_S),
    apart_s=st.floats(0.0, 1.0),
    noise=UNIT,
)
@example(  # the nose passes the vertical, and its heading turns round
    angles=(0.0, 1.0, 0.0),
    axis=(0.0, 0.0, 1.0),
    share=0.0,
    rates=(0.0, 1.0, 0.0),
    lag_s=0.0,
    apart_s=1.0,
    noise=0.0,
)
def test_errors_within_all_bounds_are_no_contradiction(
    *,
    angles: tuple[float, float, float],
    axis: tuple[float, float, float],
    share: float,
    rates: tuple[float, float, float],
    lag_s: float,
    apart_s: float,
    noise: float,
) -> None:
    """The carrier turns evenly; both it and the evidence are off, and the latter is late."""
    of, start = trust(), Rotation.from_euler("ZYX", angles)
    off = Rotation.from_rotvec(unit(axis) * share * 2.99 * DEG)
    of.turned(attitude(start * off, 1.0, rates))
    then = start * Rotation.from_rotvec(np.array(rates) * (apart_s - lag_s))
    at_s = 1.0 + apart_s
    if abs(float(then.as_euler("ZYX")[1])) < 1.2:
        yaw_deg = math.degrees(float(then.as_euler("ZYX")[0]))
        of.add(heading(yaw_deg + noise * 2.9, at_s))
        assert bound_deg(of) == pytest.approx(3.0)
    noisy = then * Rotation.from_rotvec(unit(axis) * noise * 2.9 * DEG)
    of.add(stated(noisy, 0.33, at_s))
    assert bound_deg(of) == pytest.approx(3.0)


@settings(max_examples=examples(300))
@given(AXES, st.floats(0.0, math.pi), UNIT, st.booleans())
@example(axis=(0.0, 0.0, 1.0), off_rad=0.09375, noise=0.0, follows=True)
def test_bound_holds_if_a_second_attitude_is_right(
    axis: tuple[float, float, float], off_rad: float, noise: float, follows: bool
) -> None:
    of = trust(follows=follows)
    true = Rotation.from_euler("ZYX", [0.4, 0.2, -0.1])
    of.turned(attitude(true * Rotation.from_rotvec(unit(axis) * off_rad)))
    nearly = true * Rotation.from_rotvec(unit(axis) * noise * 2.9 * DEG)
    of.add(stated(nearly, 0.33))
    unopposed = (3 * 3 * 0.33 + 1.0 if follows else 3.0) * DEG + 1e-6
    if off_rad > 9.0 * DEG or of.bound_rad > unopposed:
        assert of.bound_rad >= max(off_rad - 1e-6, unopposed)


@settings(max_examples=examples(300))
@given(st.floats(-math.pi, math.pi), AXES, st.floats(0.0, 1.0), st.floats(-3.1, 3.1), UNIT)
def test_bound_holds_if_a_heading_is_right(
    off_rad: float, axis: tuple[float, float, float], share: float, yaw_rad: float, noise: float
) -> None:
    """The reported yaw is off by any angle, and all axes by the setting in addition."""
    of, true = trust(), Rotation.from_euler("ZYX", [yaw_rad, 0.3, -0.2])
    tilted = true * Rotation.from_rotvec(unit(axis) * share * 2.99 * DEG)
    said = Rotation.from_euler("Z", off_rad) * tilted
    of.turned(attitude(said))
    of.add(heading(math.degrees(yaw_rad) + noise * 2.9))
    error_rad = float((said * true.inv()).magnitude())
    if abs(off_rad) > 13.0 * DEG:
        assert of.bound_rad >= error_rad - 1e-6
        assert bound_deg(of) > 3.0
    if of.bound_rad > 3.001 * DEG:
        assert of.bound_rad >= error_rad - 1e-6


# --- single rules ---------------------------------------------------------------------------


def test_a_heading_that_agrees_never_lowers_the_bound() -> None:
    for follows in (False, True):
        of = trust(follows=follows)
        of.turned(attitude(LEVEL))
        of.add(heading(0.0, accuracy_deg=1e-5))
        assert bound_deg(of) == pytest.approx(3.0)


def test_contradicting_heading_until_one_agrees() -> None:
    of = trust()
    of.turned(attitude(LEVEL))
    of.add(heading(5.9))
    assert bound_deg(of) == pytest.approx(3.0)
    of.add(heading(6.1))
    assert bound_deg(of) == pytest.approx(3.0 + 6.1 + 3.0)
    of.add(heading(-20.0))
    assert bound_deg(of) == pytest.approx(3.0 + 20.0 + 3.0)
    of.add(heading(0.0))
    assert bound_deg(of) == pytest.approx(3.0)


def test_least_and_unstated_accuracy_of_a_heading() -> None:
    of = trust()
    of.turned(attitude(LEVEL))
    of.add(heading(5.9, accuracy_deg=0.01))
    of.add(heading(17.9, accuracy_deg=None))
    assert bound_deg(of) == pytest.approx(3.0)
    of.add(heading(18.1, accuracy_deg=None))
    assert bound_deg(of) == pytest.approx(3.0 + 18.1 + 15.0)


def test_heading_of_a_nose_up_carrier_is_not_used() -> None:
    of = trust()
    of.turned(attitude(Rotation.from_euler("Y", 88 * DEG)))
    of.add(heading(120.0))
    assert bound_deg(of) == pytest.approx(3.0)


@pytest.mark.parametrize(("rate_radps", "turned_deg"), [(0.0, 0.0), (0.1, math.degrees(0.05))])
def test_errors_of_heading_grow_with_pitch(rate_radps: float, turned_deg: float) -> None:
    """At 60 degrees an error of 3 turns the nose by 6 about the vertical; so does a rotation."""
    of = trust()
    of.turned(attitude(Rotation.from_euler("Y", 60 * DEG), rates=(0.0, 0.0, rate_radps)))
    most_deg = math.degrees(math.asin(2 * math.sin((3 + turned_deg) * DEG))) + 3.0
    of.add(heading(most_deg - 0.01, 0.0))
    assert bound_deg(of) == pytest.approx(3.0)
    of.add(heading(most_deg + 0.01, 0.0))
    assert bound_deg(of) > 10.0


def test_evidence_without_a_recent_attitude_is_not_compared() -> None:
    of = trust()
    of.add(heading(90.0, 0.1))
    of.turned(attitude(LEVEL, 1.0))
    of.add(heading(90.0, 2.1))
    of.add(stated(Rotation.from_euler("Z", 1.0), 0.1, 2.1))
    assert bound_deg(of) == pytest.approx(3.0)


def test_fast_rotation_shortly_before_is_allowed_for() -> None:
    of = trust()
    of.turned(attitude(LEVEL, 1.0, (0.0, 0.0, 1.0)))
    of.turned(attitude(LEVEL, 1.4))
    of.add(heading(30.0, 1.4))
    assert bound_deg(of) == pytest.approx(3.0)
    of.turned(attitude(LEVEL, 2.5))
    of.add(heading(30.0, 2.5))
    assert bound_deg(of) > 30.0


def test_larger_covariance_raises_the_bound() -> None:
    of = trust()
    of.turned(attitude(LEVEL))
    of.add(stated(LEVEL, 0.2))
    assert bound_deg(of) == pytest.approx(3.0)
    of.add(stated(LEVEL, 1.0))
    assert bound_deg(of) == pytest.approx(9.0)
    of.add(stated(LEVEL, 60.0))
    assert bound_deg(of) == 180.0
    of.add(stated(LEVEL, None))
    assert bound_deg(of) == pytest.approx(3.0)


@given(st.tuples(*[st.floats(-0.2, 0.2)] * 3), st.tuples(*[st.floats(-1.5, 1.5)] * 3))
def test_error_is_at_most_the_sum_of_its_angles(
    errors: tuple[float, float, float], angles: tuple[float, float, float]
) -> None:
    """The rule by which three standard deviations become one angle."""
    right = Rotation.from_euler("ZYX", angles)
    wrong = Rotation.from_euler("ZYX", [a + e for a, e in zip(angles, errors, strict=True)])
    of = trust(bound_deg=0.0)
    each = tuple(max(abs(error) / 3.0, 1e-12) for error in errors)
    said = stated(wrong, 1.0)
    of.add(
        StatedAttitude(
            t_ns=said.t_ns,
            source=SOURCE,
            link="a",
            msgid=61,
            ned_from_body=said.ned_from_body,
            deviations_rad=(each[2], each[1], each[0]),
        )
    )
    assert of.bound_rad >= float((wrong * right.inv()).magnitude()) - 1e-6


def test_a_smaller_covariance_lowers_the_bound_only_if_set_and_current() -> None:
    of = trust(follows=True)
    of.turned(attitude(LEVEL))
    of.add(stated(LEVEL, 0.1))
    assert bound_deg(of) == pytest.approx(0.9 + 1.0)
    of.turned(attitude(LEVEL, 5.0))
    assert bound_deg(of) == pytest.approx(1.9)
    of.turned(attitude(LEVEL, 5.2))
    assert bound_deg(of) == pytest.approx(3.0)


def test_nothing_is_lowered_by_what_is_contradicted() -> None:
    for other in (heading(9.0), stated(Rotation.from_euler("X", 9 * DEG), 0.1, link="b")):
        of = trust(follows=True)
        of.turned(attitude(LEVEL))
        of.add(stated(LEVEL, 0.1))
        of.add(other)
        assert bound_deg(of) > 12.0


def test_failed_odometry_means_any_attitude() -> None:
    of = trust(follows=True)
    of.turned(attitude(LEVEL))
    of.add(stated(None, None))
    assert bound_deg(of) == 180.0
    of.add(stated(LEVEL, None))
    assert bound_deg(of) == pytest.approx(3.0)


def test_worst_of_all_kinds_and_links_counts() -> None:
    of = trust()
    of.turned(attitude(LEVEL))
    status = EstimatorStatus(
        t_ns=0,
        source=SOURCE,
        link="a",
        knows_attitude=True,
        knows_position=True,
        is_absolute=True,
        compass_ratio=0.2,
    )
    of.add(status)
    of.add(heading(20.0))
    of.add(heading(0.0, link="b"))
    assert bound_deg(of) == pytest.approx(26.0)
    of.turned(attitude(LEVEL, 6.0))
    of.add(heading(0.0, 6.0, link="b"))
    assert bound_deg(of) == pytest.approx(math.degrees(0.12))
    of.clear()
    assert bound_deg(of) == pytest.approx(3.0)


def test_statement_that_is_not_repeated_counts_for_ten_seconds() -> None:
    """One that was forged before the carrier appeared would count for ever."""
    doubted = trust()
    doubted.add(
        EstimatorStatus(
            t_ns=0,
            source=SOURCE,
            link="a",
            knows_attitude=False,
            knows_position=True,
            is_absolute=True,
            compass_ratio=0.0,
        )
    )
    bounds = []
    for step in range(120):
        doubted.turned(attitude(LEVEL, step / 10))
        bounds.append(doubted.bound_rad)
    assert bounds == [math.pi] * 101 + [3.0 * DEG] * 19


@pytest.mark.parametrize("kind", ["heading", "attitude"])
def test_contradiction_stays_while_turns_hide_it(kind: str) -> None:
    """Only a comparison that could show it may end it. The carrier may have turned by 35°."""
    known = trust()

    def said(at_s: float, off_deg: float) -> GnssHeading | StatedAttitude:
        if kind == "heading":
            return heading(off_deg, at_s)
        return stated(Rotation.from_euler("z", off_deg, degrees=True), 1.0, at_s)

    known.turned(attitude(LEVEL, 0.0))
    known.add(said(0.1, 30.0))
    contradicted_deg = bound_deg(known)
    assert contradicted_deg > 30.0
    for number in range(1, 20):
        known.turned(attitude(LEVEL, float(number), rates=(0.0, 0.0, 60.0 * DEG)))
        known.add(said(number + 0.1, 30.0))
        assert bound_deg(known) == pytest.approx(contradicted_deg)
    for number in range(20, 23):
        known.turned(attitude(LEVEL, float(number)))
        known.add(said(number + 0.1, 0.0))
    assert bound_deg(known) < 15.0
