"""Headings and covariances: fields equal pymavlink's; unknown ones are None."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect
from pymavlink.quaternion import Quaternion
from scipy.spatial.transform import Rotation
from sent_frames import START_NS, sent

from companion.mavlink.wire.attitudes import gnss_heading
from companion.mavlink.wire.decode import decode
from companion.values import GnssHeading, Reason, Rejection, Source, StatedAttitude

ANGLES = st.floats(-math.pi, math.pi)
TILTS = st.floats(-1.5, 1.5)
VARIANCES = st.floats(2.0**-30, 100.0, width=32)
NAN = math.nan


def raw_int(yaw: int, hdg_acc: int = 0, fix_type: int = 3) -> dialect.MAVLink_message:
    return dialect.MAVLink_gps_raw_int_message(
        1, fix_type, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, hdg_acc, yaw
    )


def gps2_raw(yaw: int, hdg_acc: int = 0, fix_type: int = 3) -> dialect.MAVLink_message:
    return dialect.MAVLink_gps2_raw_message(
        1, fix_type, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, yaw, 12, 13, 14, 15, hdg_acc
    )


def quaternion_cov(
    q: tuple[float, ...], covariance: list[float] | None = None
) -> dialect.MAVLink_message:
    return dialect.MAVLink_attitude_quaternion_cov_message(
        5, q, 0.1, 0.2, 0.3, covariance or [0.01] * 9
    )


def odometry(
    q: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0),
    pose: list[float] | None = None,
    *,
    frame_id: int = dialect.MAV_FRAME_LOCAL_NED,
    quality: int = 0,
) -> dialect.MAVLink_message:
    return dialect.MAVLink_odometry_message(
        5, frame_id, dialect.MAV_FRAME_BODY_FRD, 1.0, 2.0, 3.0, q, 4.0, 5.0, 6.0, 0.1, 0.2, 0.3,
        pose or [0.01] * 21, [7.0] * 21, 8, dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT, quality,
    )  # fmt: skip


def heading(message: dialect.MAVLink_message) -> GnssHeading | None:
    return gnss_heading(sent(1.0, "5:1", message))


def stated(message: dialect.MAVLink_message) -> StatedAttitude:
    found = decode(sent(1.0, "5:1", message))
    assert isinstance(found, StatedAttitude), found
    return found


def malformed(message: dialect.MAVLink_message) -> bool:
    found = decode(sent(1.0, "5:1", message))
    return isinstance(found, Rejection) and found.reason is Reason.MALFORMED


@given(
    st.sampled_from([raw_int, gps2_raw]),
    st.integers(0, 0xFFFF),
    st.integers(0, 0xFFFF_FFFF),
    st.integers(0, 8),
)
def test_heading_equals_pymavlinks(make: Any, yaw: int, hdg_acc: int, fix_type: int) -> None:
    frame = sent(1.0, "5:1", make(yaw, hdg_acc, fix_type))
    fields = dialect.MAVLink(None).decode(bytearray(frame.raw))
    found = gnss_heading(frame)
    if fields.yaw == 0 or fields.yaw > 36_000 or fields.fix_type < 3:
        assert found is None
        return
    assert found is not None
    assert found.receiver == (1 if make is raw_int else 2)
    assert (found.t_ns, found.link) == (START_NS + 10**9, "udp")
    assert found.source == Source(5, 1)
    assert math.degrees(found.heading_rad) == pytest.approx(fields.yaw / 100)
    if fields.hdg_acc in (0, 2**32 - 1):
        assert found.accuracy_rad is None
    else:
        assert found.accuracy_rad == pytest.approx(math.radians(fields.hdg_acc / 1e5))


def test_heading_of_0_is_not_available_and_36000_is_north() -> None:
    for make in (raw_int, gps2_raw):
        assert heading(make(0)) is None
        assert heading(make(65535)) is None
        north = heading(make(36_000))
        assert north is not None
        assert north.heading_rad == pytest.approx(2 * math.pi)
    assert isinstance(decode(sent(1.0, "5:1", gps2_raw(9_000))), GnssHeading)


@given(ANGLES, TILTS, ANGLES)
def test_quaternion_rotates_body_to_ned(roll: float, pitch: float, yaw: float) -> None:
    """Oracle: pymavlink's quaternion of Euler angles, whose rotation scipy gives."""
    q = tuple(float(part) for part in Quaternion([roll, pitch, yaw]).q)
    for message in (quaternion_cov(q), odometry(q)):
        found = stated(message).ned_from_body
        assert found is not None
        w, x, y, z = found
        assert math.hypot(*found) == pytest.approx(1.0)
        wanted = Rotation.from_euler("ZYX", [yaw, pitch, roll])
        assert (Rotation.from_quat([x, y, z, w]) * wanted.inv()).magnitude() < 1e-5


@given(st.lists(VARIANCES, min_size=9, max_size=9))
def test_covariance_of_attitude_quaternion_cov(covariance: list[float]) -> None:
    message = quaternion_cov((1.0, 0.0, 0.0, 0.0), covariance)
    frame = sent(1.0, "5:1", message)
    fields = dialect.MAVLink(None).decode(bytearray(frame.raw)).covariance
    wanted = [math.sqrt(fields[at]) for at in (0, 4, 8)]
    assert stated(message).deviations_rad == pytest.approx(wanted)


@given(st.lists(VARIANCES, min_size=21, max_size=21))
def test_covariance_of_odometry(pose: list[float]) -> None:
    """The diagonal of the upper triangle is found through the whole matrix."""
    message = odometry(pose=pose)
    at = iter(pose)
    matrix = [[next(at) if column >= row else NAN for column in range(6)] for row in range(6)]
    wanted = [math.sqrt(matrix[axis][axis]) for axis in (3, 4, 5)]
    assert stated(message).deviations_rad == pytest.approx(wanted)


@pytest.mark.parametrize(
    "message",
    [
        quaternion_cov((1.0, 0.0, 0.0, 0.0), [NAN] + [0.01] * 8),
        quaternion_cov((1.0, 0.0, 0.0, 0.0), [0.01] * 8 + [0.0]),
        quaternion_cov((1.0, 0.0, 0.0, 0.0), [0.01] * 4 + [NAN] + [0.01] * 4),
        odometry(pose=[NAN] + [0.01] * 20),
        odometry(pose=[0.01] * 20 + [0.0]),
    ],
)
def test_unknown_covariance(message: dialect.MAVLink_message) -> None:
    found = stated(message)
    assert found.deviations_rad is None
    assert found.ned_from_body == (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "message",
    [
        quaternion_cov((0.0, 0.0, 0.0, 0.0)),
        quaternion_cov((NAN, 0.0, 0.0, 0.0)),
        quaternion_cov((1.0, 0.2, 0.0, 0.0)),
        quaternion_cov((1.0, 0.0, 0.0, 0.0), [-0.01] + [0.01] * 8),
        quaternion_cov((1.0, 0.0, 0.0, 0.0), [math.inf] + [0.01] * 8),
        odometry(pose=[0.01] * 20 + [-1.0]),
        odometry(quality=-2),
    ],
)
def test_malformed_attitudes(message: dialect.MAVLink_message) -> None:
    assert malformed(message)


def test_failed_odometry_has_no_attitude() -> None:
    found = stated(odometry(quality=-1))
    assert (found.ned_from_body, found.deviations_rad) == (None, None)
    assert stated(odometry(quality=1)).ned_from_body is not None


def test_odometry_without_north_is_not_decoded() -> None:
    message = odometry(frame_id=dialect.MAV_FRAME_LOCAL_FRD)
    assert decode(sent(1.0, "5:1", message)) is None
