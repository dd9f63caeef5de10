"""Decoders of what a vehicle states about its attitude beside ATTITUDE: headings and covariances.

GPS_RAW_INT and GPS2_RAW hold the heading of a GNSS receiver with two antennas, as extension fields.
ATTITUDE_QUATERNION_COV and ODOMETRY hold an attitude with a covariance. Source: the message
definitions of https://mavlink.io/en/messages/common.html. Functions raise ``ValueError`` for
invalid fields.
"""

import math
import struct
from collections.abc import Sequence
from typing import Final

from companion.mavlink.wire.payload import unpack
from companion.values import FIX_3D, Frame, GnssHeading, StatedAttitude

GPS_RAW_INT: Final = 24
ATTITUDE_QUATERNION_COV: Final = 61
GPS2_RAW: Final = 124
ODOMETRY: Final = 331

ABOUT_ATTITUDE: Final = frozenset({GPS2_RAW, ATTITUDE_QUATERNION_COV, ODOMETRY})
"""Messages that are only used for the attitude of the carrier, beside ATTITUDE."""

GPS_RAW_INT_FIELDS: Final = struct.Struct("<QiiiHHHHBBiIIIIH")
_GPS2_RAW = struct.Struct("<QiiiIHHHHBBBHiIIII")
_NORTH_CDEG: Final = 36_000  # yaw 0 means "not available"; larger values are invalid or unknown
_UNKNOWN: Final = 0xFFFF_FFFF


def about_attitude(frame: Frame) -> GnssHeading | StatedAttitude | None:
    """Decode a message in ``ABOUT_ATTITUDE``; None without relevant content."""
    if frame.msgid == GPS2_RAW:
        return gnss_heading(frame)
    return odometry(frame) if frame.msgid == ODOMETRY else attitude_quaternion_cov(frame)


def first_has_fix(frame: Frame) -> bool:
    """Return whether a vehicle's first receiver has a 3D fix (GPS_RAW_INT)."""
    return bool(unpack(frame, GPS_RAW_INT_FIELDS)[8] >= FIX_3D)


def second_has_fix(frame: Frame) -> bool:
    """Return whether a vehicle's second receiver has a 3D fix (GPS2_RAW)."""
    return bool(unpack(frame, _GPS2_RAW)[9] >= FIX_3D)


def gnss_heading(frame: Frame) -> GnssHeading | None:
    """Decode the heading in GPS_RAW_INT or GPS2_RAW; None if the receiver gives none.

    A heading without a 3D fix is not used.
    """
    if frame.msgid == GPS_RAW_INT:
        fields = unpack(frame, GPS_RAW_INT_FIELDS)
        fix_type, accuracy_1e5, yaw_cdeg = fields[8], fields[14], fields[15]
    else:
        fields = unpack(frame, _GPS2_RAW)
        fix_type, accuracy_1e5, yaw_cdeg = fields[9], fields[17], fields[12]
    if not 0 < yaw_cdeg <= _NORTH_CDEG or fix_type < FIX_3D:
        return None
    known = accuracy_1e5 not in (0, _UNKNOWN)
    return GnssHeading(
        t_ns=frame.t_ns,
        source=frame.source,
        link=frame.link,
        receiver=1 if frame.msgid == GPS_RAW_INT else 2,
        heading_rad=math.radians(yaw_cdeg * 1e-2),
        accuracy_rad=math.radians(accuracy_1e5 * 1e-5) if known else None,
    )


_ATTITUDE_QUATERNION_COV = struct.Struct("<Q4f3f9f")
_ODOMETRY = struct.Struct("<Q3f4f3f3f21f21fBBBBb")
_LOCAL_NED: Final = 1  # MAV_FRAME_LOCAL_NED; the heading of other local frames is arbitrary
_NORM_ERROR: Final = 0.01  # largest deviation of a quaternion's norm from 1


def attitude_quaternion_cov(frame: Frame) -> StatedAttitude:
    """Decode attitude and covariance; the diagonal of the row-major 3x3 matrix is used."""
    fields = unpack(frame, _ATTITUDE_QUATERNION_COV)
    covariance = fields[8:17]
    return _stated(frame, fields[1:5], covariance[0], covariance[0::4])


def odometry(frame: Frame) -> StatedAttitude | None:
    """Decode the attitude of ODOMETRY; None if it is not relative to north.

    The covariance is the upper right triangle of a 6x6 matrix by rows: roll, pitch and yaw are its
    elements 15, 18 and 20. Quality -1 means that odometry has failed.
    """
    fields = unpack(frame, _ODOMETRY)
    quality, is_failed = fields[-1], fields[-1] < 0
    if quality < -1:
        raise ValueError(f"odometry quality {quality} is below -1")
    if fields[-5] != _LOCAL_NED:
        return None
    pose = fields[14:35]
    variances = (pose[15], pose[18], pose[20])
    return _stated(frame, fields[4:8], pose[0], variances, is_failed)


def _stated(
    frame: Frame,
    quaternion: Sequence[float],
    first: float,
    variances: Sequence[float],
    is_failed: bool = False,
) -> StatedAttitude:
    """Return an attitude; ``first`` is the first element of its covariance, NaN if unknown.

    A variance of 0 is not a possible result of an estimator: the covariance is unknown.
    """
    norm = math.hypot(*quaternion)
    if not is_failed and not abs(norm - 1.0) <= _NORM_ERROR:
        raise ValueError(f"norm of the attitude quaternion is {norm:.3g}")
    deviations = None
    if not (math.isnan(first) or any(map(math.isnan, variances))):
        if not all(0.0 <= variance < math.inf for variance in variances):
            raise ValueError("variance of the attitude is negative or infinite")
        if all(variances):
            roll, pitch, yaw = map(math.sqrt, variances)
            deviations = (roll, pitch, yaw)
    w, x, y, z = (0.0, 0.0, 0.0, 0.0) if is_failed else (part / norm for part in quaternion)
    return StatedAttitude(
        t_ns=frame.t_ns,
        source=frame.source,
        link=frame.link,
        msgid=frame.msgid,
        ned_from_body=None if is_failed else (w, x, y, z),
        deviations_rad=None if is_failed else deviations,
    )
