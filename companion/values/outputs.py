"""Values that the pipeline returns for an event."""

from dataclasses import dataclass
from typing import Annotated

from companion.values.aimed import BeamSet
from companion.values.described import DescribedEnum, Meaning
from companion.values.rejections import Rejection
from companion.values.tracked import Carrier, Estimate, Refuted, Track


class Severity(DescribedEnum):
    """How important a notice is to an operator."""

    INFO = "info", "for information"
    WARNING = "warning", "something is worse than it should be"
    ERROR = "error", "something is lost or not used"


@dataclass(frozen=True, slots=True, kw_only=True)
class Notice:
    """A message to the operator, emitted once when the state it describes changes."""

    t_ns: Annotated[int, Meaning("when it was issued")]
    severity: Annotated[Severity, Meaning("how important it is")]
    subject: Annotated[str, Meaning("UAV, link or part of the service that it is about")]
    text: Annotated[str, Meaning("the message", example="3:1 is coasting")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Update:
    """Every tracked UAV at the time of use, and the beams towards them.

    carrier  where the array is; None while that is not known, and then there are no beams
    """

    t_ns: int  # when the update was made, node time
    carrier: Carrier | None
    unfit: str | None  # why there are no beams; None if the service is fit to be used
    tracks: tuple[Track, ...]  # every target, predicted to the time of use
    beams: BeamSet  # the weights


Output = Rejection | Estimate | Notice | Refuted | Update
"""Everything that the pipeline can return for an event."""
