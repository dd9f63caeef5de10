"""Conversion of the program's values to messages of a recording, and back for events."""

import math
from typing import Any, Final

from companion.recording import fields, schemas
from companion.values import (
    DUTY_MAX,
    ClockSet,
    Duty,
    Event,
    Fix,
    Frame,
    Notice,
    Observation,
    Rejection,
    RoundTrip,
    Severity,
    Source,
    Tick,
    Tock,
    Track,
    reason_invalid,
)

FRAME_ID: Final = "wgs84"
"""Frame of reference of every LocationFix: Earth-fixed, x through 0° E, z to the north pole."""
OFFSET_MAX_NS: Final = 1 << 62
"""Limit on UTC less the node's timeline, 146 years, so that results are valid dates."""
TEXT_MAX: Final = 500  # limit on characters of links, senders and details, which are kept by name
FrameMessage: Final = schemas.message_class("Frame")
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
    message = FrameMessage.FromString(data)
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


EVENTS: Final[dict[str, type[Event]]] = {
    schemas.TOPICS[kind.__name__]: kind
    for kind in (Tick, Tock, Rejection, RoundTrip, Duty, ClockSet, Observation)
}
"""Classes of events other than frames, by topic."""


def to_event(topic: str, data: bytes) -> Event | None:
    """Decode an event other than a frame; None for a rejection by the pipeline itself.

    A replay repeats those rejections. Raises ``DecodeError`` for malformed bytes, ``ValueError``
    for an invalid event.
    """
    kind = EVENTS[topic]
    message = schemas.message_class(kind.__name__).FromString(data)
    if kind is Rejection and not message.is_event:
        return None
    event: Event = fields.value_of(kind, message)
    reason = _reason_invalid(event)
    if reason is not None:
        raise ValueError(reason)
    return event


def _reason_invalid(event: Event) -> str | None:
    match event:
        case RoundTrip() if max(event.source) > 255:
            return "round trip with an invalid source"
        case Duty() if max(len(event.serves), len(event.spares)) > DUTY_MAX:
            return f"duty of more than {DUTY_MAX} UAVs"
        case Rejection() if max(len(event.source), len(event.detail)) > TEXT_MAX:
            return f"rejection: source or detail has more than {TEXT_MAX} characters"
        case ClockSet() if abs(event.utc_offset_ns) > OFFSET_MAX_NS:
            return "UTC offset out of range"
        case Observation() if (reason := reason_invalid(event)) is not None:
            return f"invalid observation: {reason}"
    return None
