"""Conversion of the program's values to messages of a recording, and back for events."""

import math
from typing import Any, Final

from companion.recording import fields, schemas
from companion.values import (
    DUTY_MAX,
    ClockSet,
    Duty,
    Fix,
    Frame,
    Notice,
    Observation,
    Rejection,
    RoundTrip,
    Severity,
    Source,
    Track,
    reason_invalid,
)

FRAME_ID: Final = "wgs84"
"""Frame of reference of every LocationFix: Earth-fixed, x through 0° E, z to the north pole."""
OFFSET_MAX_NS: Final = 1 << 62
"""Limit on UTC less the node's timeline, 146 years, so that results are valid dates."""
_LEVEL: Final = {
    Severity.INFO: schemas.LogMessage.INFO,
    Severity.WARNING: schemas.LogMessage.WARNING,
    Severity.ERROR: schemas.LogMessage.ERROR,
}


def timestamp(t_ns: int) -> dict[str, int]:
    """Return a ``google.protobuf.Timestamp``, or a ``Duration``, from nanoseconds."""
    seconds, nanos = divmod(t_ns, 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}


def fix(value: Fix) -> Any:
    """Return the position that a UAV reported, in the report's own degrees.

    The covariance is derived from the bounds on the report's noise, as in ``predicted``.
    """
    report = value.report
    message = schemas.LocationFixMessage(
        timestamp=timestamp(value.t_ns),
        frame_id=FRAME_ID,
        latitude=report.lat_deg,
        longitude=report.lon_deg,
        altitude=report.alt_m,
    )
    _spread(message, value.noise.horizontal_m, value.noise.vertical_m)
    return message


def predicted(track: Track, lat_deg: float, lon_deg: float, alt_m: float) -> Any:
    """Return the predicted position of a UAV at ``valid_at_ns``, with a covariance from its bound.

    The bound is a guarantee, not a statistic. The covariance is half the square of the horizontal
    bound on each of its two axes, and the square of the vertical one: its traces are the largest
    mean square errors of any distribution within the bounds. A viewer's 1-sigma ellipsoid is
    therefore conservative on average. Without a finite bound there is no covariance.
    """
    message = schemas.LocationFixMessage(
        timestamp=timestamp(track.valid_at_ns),
        frame_id=FRAME_ID,
        latitude=lat_deg,
        longitude=lon_deg,
        altitude=alt_m,
    )
    if math.isfinite(track.bound_m):
        _spread(message, track.horizontal_bound_m, track.vertical_bound_m)
    return message


def _spread(message: Any, horizontal_m: float, vertical_m: float) -> None:
    """Set the covariance of a LocationFix from error bounds; order east, north, up."""
    plane_m2, height_m2 = horizontal_m**2 / 2, vertical_m**2
    message.position_covariance.extend((plane_m2, 0, 0, 0, plane_m2, 0, 0, 0, height_m2))
    message.position_covariance_type = schemas.LocationFixMessage.APPROXIMATED


def log(value: Notice) -> Any:
    """Return a notice as a line of a viewer's log panel, named after its subject."""
    return schemas.LogMessage(
        timestamp=timestamp(value.t_ns),
        level=_LEVEL[value.severity],
        name=value.subject,
        message=value.text,
    )


# --- decoding -----------------------------------------------------------------------------------


def to_frame(data: bytes, sources: dict[tuple[int, int], Source]) -> Frame:
    """Decode a frame. Raises ``DecodeError`` for malformed bytes.

    ``sources`` caches the senders seen so far, so that each has one value.
    """
    message = schemas.FrameMessage.FromString(data)
    ids = (message.sysid, message.compid)
    source = sources.get(ids)
    if source is None:
        source = sources.setdefault(ids, Source(*ids))
    doubt_ns = message.doubt_ns
    return Frame(
        t_ns=message.t_ns,
        link=message.link,
        source=source,
        msgid=message.msgid,
        raw=message.raw,
        doubt_ns=doubt_ns,
    )


def to_round_trip(data: bytes) -> RoundTrip:
    """Decode a round trip. Raises ``DecodeError`` for malformed bytes."""
    return fields.value_of(RoundTrip, schemas.RoundTripMessage.FromString(data))


def to_duty(data: bytes) -> Duty:
    """Decode a duty. Raises ``DecodeError``, or ``ValueError`` if it names too many UAVs."""
    found = fields.value_of(Duty, schemas.DutyMessage.FromString(data))
    if max(len(found.serves), len(found.spares)) > DUTY_MAX:
        raise ValueError(f"duty of more than {DUTY_MAX} UAVs")
    return found


def to_clock_set(data: bytes) -> ClockSet:
    """Decode a step of the wall clock. Raises ``DecodeError``, or ``ValueError`` out of range."""
    found = fields.value_of(ClockSet, schemas.ClockSetMessage.FromString(data))
    if abs(found.utc_offset_ns) > OFFSET_MAX_NS:
        raise ValueError("UTC offset out of range")
    return found


def to_observation(data: bytes) -> Observation:
    """Decode an observation. Raises ``DecodeError``, or ``ValueError`` if it is invalid."""
    found = fields.value_of(Observation, schemas.ObservationMessage.FromString(data))
    reason = reason_invalid(found)
    if reason is not None:
        raise ValueError(f"invalid observation: {reason}")
    return found


def to_rejection(data: bytes) -> Rejection | None:
    """Decode a rejection; None for the pipeline's own rejections, which a replay repeats."""
    message = schemas.RejectionMessage.FromString(data)
    if not message.is_event:
        return None
    return fields.value_of(Rejection, message)
