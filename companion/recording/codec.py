"""The program's values as messages of a recording, and back for those that are read back."""

import math
from typing import Any, Final

import numpy as np

from companion.recording import schemas
from companion.values import (
    DUTY_MAX,
    BeamSet,
    ClockSet,
    Duty,
    Fix,
    FloatArray,
    Frame,
    Notice,
    Reason,
    Rejection,
    RoundTrip,
    Severity,
    Source,
    Track,
)

FRAME_ID: Final = "wgs84"
"""Frame of every LocationFix: the Earth's own, x through 0° E, z through the north pole."""
OFFSET_MAX_NS: Final = 1 << 62
"""Most that UTC can be off a timeline: 146 years, so that their sum has a date."""
_LEVEL: Final = {
    Severity.INFO: schemas.LogMessage.INFO,
    Severity.WARNING: schemas.LogMessage.WARNING,
    Severity.ERROR: schemas.LogMessage.ERROR,
}


def timestamp(t_ns: int) -> dict[str, int]:
    """A ``google.protobuf.Timestamp``, or a ``Duration``, from nanoseconds."""
    seconds, nanos = divmod(t_ns, 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}


def fix(value: Fix) -> Any:
    """The position that a UAV reported, with the report's own degrees.

    The covariance is made from the bounds on the report's noise, as that of ``predicted`` is.
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
    """The predicted position of a UAV at ``valid_at_ns``, with a covariance made from its bound.

    The bound is a guarantee, not a statistic. The covariance is half the square of the horizontal
    bound on each of its two axes, and the square of the vertical one: its traces are the largest
    mean square errors that any distribution within the bounds can have. A viewer's 1-sigma
    ellipsoid is therefore on the safe side on average. There is no covariance without a finite
    bound.
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
    """Put bounds into a LocationFix as a covariance; east, north, up."""
    plane_m2, height_m2 = horizontal_m**2 / 2, vertical_m**2
    message.position_covariance.extend((plane_m2, 0, 0, 0, plane_m2, 0, 0, 0, height_m2))
    message.position_covariance_type = schemas.LocationFixMessage.APPROXIMATED


def track(value: Track, t_ns: int) -> Any:
    """A track; ``t_ns`` is when the update was made to which it belongs."""
    return schemas.TrackMessage(
        t_ns=t_ns,
        uav=value.uav,
        state=value.state.value,
        valid_at_ns=value.valid_at_ns,
        age_s=value.age_s,
        position_ned_m=_vector(value.position_ned_m),
        velocity_ned_mps=_vector(value.velocity_ned_mps),
        unknown_input_mps=_vector(value.unknown_input_mps),
        bound_m=value.bound_m,
        dt_s=value.dt_s,
        latency_s=value.latency_s,
        gamma=value.gamma,
        innovation_m=value.innovation_m,
        acceleration_ned_mps2=_vector(value.acceleration_ned_mps2),
        horizontal_bound_m=value.horizontal_bound_m,
        vertical_bound_m=value.vertical_bound_m,
        clock_bound_s=value.clock_bound_s,
        set_center_ned_m=value.set_center_ned_m.tolist(),
        set_radius_m=value.set_radius_m,
        speed_max_mps=value.limits.speed_mps,
        acceleration_max_mps2=value.limits.acceleration_mps2,
        limits_source=value.limits.source.value,
        error_p95_m=value.error_p95_m,
        reports=value.reports,
    )


def _vector(value: FloatArray | None) -> list[float]:
    return [] if value is None else value.tolist()


def weights(value: BeamSet) -> Any:
    """The weights in single precision: a viewer's copy, since a replay computes them again."""
    return schemas.WeightsMessage(
        t_ns=value.t_ns,
        valid_at_ns=value.valid_at_ns,
        uavs=value.uavs,
        elements=value.weights.shape[0],
        weights_complex64=value.weights.astype(np.dtype("<c8")).tobytes("C"),
        method=value.method.value,
        condition_number=value.condition_number,
        beam=[
            {
                "uav": beam.uav,
                "azimuth_rad": beam.azimuth_rad,
                "elevation_rad": beam.elevation_rad,
                "range_m": beam.range_m,
                "pointing_bound_rad": beam.pointing_bound_rad,
                "gain_db": beam.gain_db,
                "azimuth_rate_radps": beam.azimuth_rate_radps,
                "elevation_rate_radps": beam.elevation_rate_radps,
                "range_rate_mps": beam.range_rate_mps,
                "loss_db": beam.loss_db,
                "group": beam.group,
                "widened": beam.widened,
            }
            for beam in value.beams
        ],
        left_out=[{"uav": out.uav, "reason": out.reason} for out in value.left_out],
        normalisation=value.normalisation.value,
    )


def log(value: Notice) -> Any:
    """A notice as a line of a viewer's log panel, named after its subject."""
    return schemas.LogMessage(
        timestamp=timestamp(value.t_ns),
        level=_LEVEL[value.severity],
        name=value.subject,
        message=value.text,
    )


def rejection(value: Rejection, *, is_event: bool) -> Any:
    """A rejection; ``is_event`` if it drove the pipeline rather than coming out of it."""
    return schemas.RejectionMessage(
        t_ns=value.t_ns,
        source=value.source,
        reason=value.reason.value,
        count=value.count,
        msgid=value.msgid,
        detail=value.detail,
        is_event=is_event,
    )


def round_trip(value: RoundTrip) -> Any:
    """A TIMESYNC request of the service and its answer."""
    return schemas.RoundTripMessage(
        t_ns=value.t_ns,
        sysid=value.source.sysid,
        compid=value.source.compid,
        sent_ns=value.sent_ns,
        remote_ns=value.remote_ns,
    )


def duty(value: Duty) -> Any:
    """Whom a node of a fleet serves from then on."""
    return schemas.DutyMessage(t_ns=value.t_ns, serves=value.serves, spares=value.spares)


def clock_set(value: ClockSet) -> Any:
    """By how much UTC is beyond the node's timeline from here on."""
    return schemas.ClockSetMessage(t_ns=value.t_ns, utc_offset_ns=value.utc_offset_ns)


# --- and back -----------------------------------------------------------------------------------


def to_frame(data: bytes, sources: dict[tuple[int, int], Source]) -> Frame:
    """Read a frame. Raises ``DecodeError`` for bytes that are no such message.

    ``sources`` holds the senders seen so far, so that one value for each is enough.
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
    """Read a round trip. Raises ``DecodeError`` for bytes that are no such message."""
    message = schemas.RoundTripMessage.FromString(data)
    source = Source(message.sysid, message.compid)
    return RoundTrip(
        t_ns=message.t_ns, source=source, sent_ns=message.sent_ns, remote_ns=message.remote_ns
    )


def to_duty(data: bytes) -> Duty:
    """Read a duty. Raises ``DecodeError``, or ``ValueError`` where it names too many."""
    message = schemas.DutyMessage.FromString(data)
    if max(len(message.serves), len(message.spares)) > DUTY_MAX:
        raise ValueError("a duty of too many UAVs")
    return Duty(message.t_ns, tuple(message.serves), tuple(message.spares))


def to_clock_set(data: bytes) -> ClockSet:
    """Read that the clock was set. Raises ``DecodeError``, or ``ValueError`` beyond all time."""
    message = schemas.ClockSetMessage.FromString(data)
    if abs(message.utc_offset_ns) > OFFSET_MAX_NS:
        raise ValueError("a clock that was set beyond all time")
    return ClockSet(message.t_ns, message.utc_offset_ns)


def to_rejection(data: bytes) -> Rejection | None:
    """Read a rejection; None for one that the pipeline made, since it will make it again."""
    message = schemas.RejectionMessage.FromString(data)
    if not message.is_event:
        return None
    return Rejection(
        t_ns=message.t_ns,
        source=message.source,
        reason=Reason(message.reason),
        count=message.count,
        msgid=message.msgid if message.HasField("msgid") else None,
        detail=message.detail,
    )
