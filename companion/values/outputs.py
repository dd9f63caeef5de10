"""Values that the pipeline returns for an event."""

from dataclasses import dataclass
from typing import Annotated

from companion.values.aimed import BeamSet
from companion.values.described import DescribedEnum, Meaning
from companion.values.rejections import Rejection
from companion.values.tracked import Carrier, Estimate, Refuted, Track


class Severity(DescribedEnum):
    """Importance of a notice to an operator."""

    INFO = "info", "for information"
    WARNING = "warning", "something is worse than it should be"
    ERROR = "error", "something is lost or not used"


@dataclass(frozen=True, slots=True, kw_only=True)
class Notice:
    """Message to the operator, emitted once when the state that it describes changes."""

    t_ns: Annotated[int, Meaning("time of the notice")]
    severity: Annotated[Severity, Meaning("severity of the notice")]
    subject: Annotated[str, Meaning("UAV, link or part of the service that it is about")]
    text: Annotated[str, Meaning("the message", example="3:1 is coasting")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Update:
    """Tracks of all UAVs at the time of use, with their beams.

    carrier  position of the array; None while unknown, and then there are no beams
    """

    t_ns: int  # when the update was computed, node time
    carrier: Carrier | None
    unfit: str | None  # why there are no beams; None if beams can be used
    tracks: tuple[Track, ...]  # every target, predicted to the time of use
    beams: BeamSet


Output = Rejection | Estimate | Notice | Refuted | Update
"""Any value that the pipeline can return for an event."""
