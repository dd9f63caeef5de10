"""Values that the pipeline returns for an event."""

from dataclasses import dataclass
from enum import StrEnum

from companion.values.aimed import BeamSet
from companion.values.rejections import Rejection
from companion.values.tracked import Carrier, Estimate, Refuted, Track


class Severity(StrEnum):
    """How important a notice is to an operator."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True, kw_only=True)
class Notice:
    """A message to the operator, emitted once when the state it describes changes."""

    t_ns: int
    severity: Severity
    subject: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Update:
    """Every tracked UAV at the time of use, and the beams towards them.

    t_ns     when the update was made, node time
    carrier  where the array is; None while that is not known, and then there are no beams
    unfit    why there are no beams; None if the service is fit to be used
    tracks   every target, predicted to the time of use
    beams    the weights
    """

    t_ns: int
    carrier: Carrier | None
    unfit: str | None
    tracks: tuple[Track, ...]
    beams: BeamSet


Output = Rejection | Estimate | Notice | Refuted | Update
"""Everything that the pipeline can return for an event."""
