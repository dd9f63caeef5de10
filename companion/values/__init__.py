"""Frozen values that the program passes on, from a received frame to a set of weights.

Conventions, here and everywhere:

* Time is integer nanoseconds since the Unix epoch on the node's own timeline (``_ns``). The
  timeline starts at the wall clock and never steps. ``UtcNs`` is UTC by the current wall clock.
* The *local frame* is north-east-down (NED), metres, tangent to WGS84 at a fixed origin.
* The *body frame* is forward-right-down (FRD), as in MAVLink; so is the *array frame*, with
  x along boresight.
* ``a_from_b`` is the 3x3 matrix that transforms coordinates in frame b to coordinates in frame a.
* Unknown is ``None``, never 0.

Arrays inside these values must not be written to.
"""

from companion.values.aimed import (
    ArrayKind,
    Beam,
    BeamSet,
    LeftOut,
    Method,
    Normalisation,
    Policy,
    Power,
    WeightFormat,
    Widen,
)
from companion.values.caps import Cap, angle_rad, lens
from companion.values.clock import ClockSet, UtcNs
from companion.values.errors import UserError, printable, shown, text_of
from companion.values.events import DUTY_MAX, Duty, Event, RoundTrip, Tick, Tock
from companion.values.fleet import Offer, Shared, SharedFrame, Standing
from companion.values.health import Blame, Cause, Level, Verdict
from companion.values.names import UAV_FORMS, Source, UavKind, is_uav_id, kind_of
from companion.values.numbers import BoolArray, ComplexArray, FloatArray, IntArray, Vector, vector
from companion.values.observed import READINGS_MAX, Observation, reason_invalid
from companion.values.outputs import Notice, Output, Severity, Update
from companion.values.received import (
    FIX_3D,
    RELAYED_DELAY_S,
    RELAYED_TIME_ERROR_S,
    Accuracy,
    AdsbVehicle,
    AltitudeDatum,
    Attitude,
    AttitudeEvidence,
    EstimatorStatus,
    Frame,
    GnssHeading,
    GnssStatus,
    Message,
    Presence,
    RemoteId,
    Report,
    StatedAttitude,
    SystemTime,
)
from companion.values.rejections import Reason, Rejection
from companion.values.toml import read_toml
from companion.values.tracked import (
    Carrier,
    Estimate,
    Fix,
    Limits,
    LimitSource,
    Refuted,
    ReportNoise,
    SenderTime,
    Track,
    TrackState,
    roll_pitch_yaw_rad,
)

__all__ = [
    "DUTY_MAX",
    "FIX_3D",
    "READINGS_MAX",
    "RELAYED_DELAY_S",
    "RELAYED_TIME_ERROR_S",
    "UAV_FORMS",
    "Accuracy",
    "AdsbVehicle",
    "AltitudeDatum",
    "ArrayKind",
    "Attitude",
    "AttitudeEvidence",
    "Beam",
    "BeamSet",
    "Blame",
    "BoolArray",
    "Cap",
    "Carrier",
    "Cause",
    "ClockSet",
    "ComplexArray",
    "Duty",
    "Estimate",
    "EstimatorStatus",
    "Event",
    "Fix",
    "FloatArray",
    "Frame",
    "GnssHeading",
    "GnssStatus",
    "IntArray",
    "LeftOut",
    "Level",
    "LimitSource",
    "Limits",
    "Message",
    "Method",
    "Normalisation",
    "Notice",
    "Observation",
    "Offer",
    "Output",
    "Policy",
    "Power",
    "Presence",
    "Reason",
    "Refuted",
    "Rejection",
    "RemoteId",
    "Report",
    "ReportNoise",
    "RoundTrip",
    "SenderTime",
    "Severity",
    "Shared",
    "SharedFrame",
    "Source",
    "Standing",
    "StatedAttitude",
    "SystemTime",
    "Tick",
    "Tock",
    "Track",
    "TrackState",
    "UavKind",
    "Update",
    "UserError",
    "UtcNs",
    "Vector",
    "Verdict",
    "WeightFormat",
    "Widen",
    "angle_rad",
    "is_uav_id",
    "kind_of",
    "lens",
    "printable",
    "read_toml",
    "reason_invalid",
    "roll_pitch_yaw_rad",
    "shown",
    "text_of",
    "vector",
]
