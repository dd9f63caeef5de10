"""Position and attitude of the array's carrier, as shown by the API."""

import math
from dataclasses import dataclass
from typing import Annotated

from companion.pipeline.fold import Pipeline
from companion.settings.center import FixedCenter
from companion.tracking.geodesy import Place
from companion.tracking.rotations import rotation
from companion.values import Carrier, roll_pitch_yaw_rad
from companion.values.described import Inline, Meaning
from companion.views.as_json import degrees


@dataclass(frozen=True, slots=True)
class Angles:
    """Attitude of the carrier's body, in degrees."""

    roll: Annotated[float, Meaning("roll, right side down positive, degrees")]
    pitch: Annotated[float, Meaning("pitch, nose up positive, degrees")]
    yaw: Annotated[float, Meaning("yaw of the nose, from true north, clockwise, degrees")]


@dataclass(frozen=True, slots=True)
class Pose:
    """Position and attitude of the array's carrier at one time."""

    place: Annotated[Place, Inline()]
    carrier: Annotated[Carrier, Inline()]

    @property
    def heading_deg(self) -> Annotated[float, Meaning("bearing of the nose from true north")]:
        return self.attitude_deg.yaw % 360

    @property
    def attitude_deg(
        self,
    ) -> Annotated[Angles, Meaning("attitude", deprecated="roll_deg, pitch_deg and yaw_deg")]:
        angles = (self.carrier.roll_rad, self.carrier.pitch_rad, self.carrier.yaw_rad)
        return Angles(*(degrees(angle) or 0.0 for angle in angles))


@dataclass(frozen=True, slots=True)
class LastPose:
    """Last known position and attitude of the array's carrier."""

    t_ns: Annotated[int, Meaning("time of the position")]
    pose: Annotated[Pose, Inline()]


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservedAttitude:
    """What the array's own measurements of UAVs say of the carrier's attitude.

    The suggested mount explains the whole error that is seen; the compass's error is part of it.
    """

    uavs: Annotated[int, Meaning("UAVs whose directions the array measured in the last second")]
    measurements: Annotated[int, Meaning("measurements used since the start")]
    error_rad: Annotated[float, Meaning("likely error of the reported attitude, as an angle")]
    error_bound_rad: Annotated[
        float, Meaning("bound on the error of the attitude after its correction")
    ]
    mount_roll_rad: Annotated[float, Meaning("roll of the mount that explains what is seen")]
    mount_pitch_rad: Annotated[float, Meaning("pitch of the mount that explains what is seen")]
    mount_yaw_rad: Annotated[float, Meaning("yaw of the mount that explains what is seen")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Center:
    """Carrier of the array; position and attitude are null while unknown."""

    source: Annotated[
        str, Meaning("the vehicle SYSID:COMPID, the coordinates, or home", example="5:1")
    ]
    fixed: Annotated[bool, Meaning("whether the carrier is a fixed station")]
    pose: Annotated[Pose | None, Inline()] = None
    unfit: Annotated[
        str | None, Meaning("why the carrier's position is unknown; null: it is known")
    ] = None
    observed: Annotated[
        ObservedAttitude | None,
        Meaning("what the array's own measurements say of the attitude; null without any"),
    ] = None
    last_known: Annotated[
        LastPose | None, Meaning("last known position, while the present one is unknown")
    ] = None


def center(pipeline: Pipeline, now_ns: int) -> Center:
    """Return position and attitude of the carrier, or the reason why they are unknown."""
    place = pipeline.center.place
    source, fixed = str(place), isinstance(place, FixedCenter)
    found = pipeline.carrier(now_ns, now_ns)
    if not isinstance(found, str):
        return Center(
            source=source,
            fixed=fixed,
            pose=_pose(pipeline, found),
            observed=_observed(pipeline, now_ns),
        )
    last = pipeline.last_carrier
    known = None if last is None else LastPose(last.valid_at_ns, _pose(pipeline, last))
    return Center(source=source, fixed=fixed, unfit=found, last_known=known)


def _pose(pipeline: Pipeline, carrier: Carrier) -> Pose:
    assert pipeline.local is not None
    return Pose(pipeline.local.place(*carrier.position_ned_m.tolist()), carrier)


def _observed(pipeline: Pipeline, now_ns: int) -> ObservedAttitude | None:
    observing, reported = pipeline.observing, pipeline.observing.reported(now_ns, now_ns)
    if observing.compass.error is None or isinstance(reported, str):
        return None
    body_from_local = reported.carrier.body_from_local
    likely = observing.uavs.likely.vector_rad(body_from_local)
    mount = pipeline.array.array_from_body @ rotation(body_from_local @ likely)
    roll, pitch, yaw = roll_pitch_yaw_rad(mount)
    return ObservedAttitude(
        uavs=observing.compass.observed,
        measurements=observing.uavs.used,
        error_rad=math.sqrt(likely @ likely),
        error_bound_rad=observing.compass.error_at(reported.carrier).bound_rad,
        mount_roll_rad=roll,
        mount_pitch_rad=pitch,
        mount_yaw_rad=yaw,
    )
