"""Values of the verdict on a UAV's link: how good it is, why, and what can be done."""

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """How good the link to a UAV is.

    GOOD  its beam surely has the gain that the link needs
    WEAK  it usually has it
    NONE  it has not, or there is no beam
    """

    GOOD = "good"
    WEAK = "weak"
    NONE = "none"


class Cause(StrEnum):
    """What holds a link back most.

    CARRIER   where the array is, or how it is turned, is not known well enough
    SILENT    no report has come for long
    REFUSED   reports come, and are not used
    RATE      its reports are far apart
    LATE      its reports come late
    AGILE     it may turn away quickly
    CLOCK     its clock is not known well enough
    POSITION  its reported positions are not accurate enough, so near
    CROWDED   other UAVs are in the same direction, or the policy leaves it out
    COVERAGE  the array does not reach that direction
    RANGE     the whole gain of the array would not be enough there
    MACHINE   this machine does not keep up
    UNSERVED  no node of the fleet serves it
    """

    CARRIER = "carrier"
    SILENT = "silent"
    REFUSED = "refused"
    RATE = "rate"
    LATE = "late"
    AGILE = "agile"
    CLOCK = "clock"
    POSITION = "position"
    CROWDED = "crowded"
    COVERAGE = "coverage"
    RANGE = "range"
    MACHINE = "machine"
    UNSERVED = "unserved"


@dataclass(frozen=True, slots=True)
class Blame:
    """What holds a link back: the cause, in words, and what to do about it."""

    cause: Cause
    reason: str
    remedy: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """How good the link to a UAV is.

    uav            the UAV's name
    level          how good
    blame          why it is not good; None where it is
    since_ns       when it became so, node time
    needed_db      array gain that the link needs; None where there is no beam to tell
    guaranteed_db  least gain within the bound; None where nothing is sure
    likely_db      least gain where the UAV usually is; None where even that is not sure
    """

    uav: str
    level: Level
    blame: Blame | None
    since_ns: int
    needed_db: float | None = None
    guaranteed_db: float | None = None
    likely_db: float | None = None
