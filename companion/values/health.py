"""Values of the verdict on a UAV's link: how good it is, why, and what can be done."""

from dataclasses import dataclass
from typing import Annotated

from companion.values.described import DescribedEnum, Meaning


class Level(DescribedEnum):
    """How good the link to a UAV is."""

    GOOD = "good", "its beam has the gain that the link needs, guaranteed"
    WEAK = "weak", "its beam usually has the gain that the link needs"
    NONE = "none", "its beam lacks the gain that the link needs, or there is no beam"


class Cause(DescribedEnum):
    """What limits a link most."""

    CARRIER = "carrier", "the array's position or attitude is too uncertain"
    SILENT = "silent", "no report arrives"
    REFUSED = "refused", "reports arrive and are not used"
    RATE = "rate", "its reports are far apart"
    LATE = "late", "its reports arrive late"
    AGILE = "agile", "it can turn away quickly"
    CLOCK = "clock", "its clock is too uncertain"
    POSITION = "position", "its reported positions are too inaccurate at this range"
    CROWDED = "crowded", "other UAVs are in the same direction, or the policy leaves it out"
    COVERAGE = "coverage", "the array does not cover its direction"
    RANGE = "range", "even the full gain of the array is too little at this range"
    MACHINE = "machine", "this machine does not keep up"
    UNSERVED = "unserved", "no node of the fleet serves it"


@dataclass(frozen=True, slots=True)
class Blame:
    """What holds a link back: the cause, in words, and what to do about it."""

    cause: Annotated[Cause, Meaning("what limits the link most; null where it is good")]
    reason: Annotated[str, Meaning("the cause in words", example="reports 1.1 s apart")]
    remedy: Annotated[str, Meaning("what to do", example="ask for 10 Hz ([presence] position_hz)")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """How good the link to a UAV is."""

    uav: str
    level: Level  # how good
    blame: Blame | None  # why it is not good; None where it is
    since_ns: Annotated[int, Meaning("since when the link is so")]
    needed_gain_db: Annotated[
        float | None, Meaning("array gain that the link needs; null without a beam")
    ] = None
    guaranteed_gain_db: Annotated[
        float | None, Meaning("least array gain wherever the UAV can be; null: none")
    ] = None
    likely_gain_db: Annotated[
        float | None, Meaning("least array gain where the UAV usually is; null: none")
    ] = None
