"""What the pipeline makes of an event."""

from dataclasses import dataclass
from enum import StrEnum

from companion.values.aimed import BeamSet
from companion.values.received import Rejection
from companion.values.tracked import Carrier, Estimate, Track


class Severity(StrEnum):
    """How much a notice matters to an operator."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Notice:
    """Something that an operator should know: said once, when it changes."""

    t_ns: int
    severity: Severity
    subject: str
    text: str


@dataclass(frozen=True, slots=True)
class Update:
    """Every target at the time of use, and the beams on them; without a carrier there are none,
    and ``unfit`` says why."""

    t_ns: int
    carrier: Carrier | None
    unfit: str | None
    tracks: tuple[Track, ...]
    beams: BeamSet


Output = Rejection | Estimate | Notice | Update
"""What the pipeline makes of an event."""
