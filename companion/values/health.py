"""Verdict on a UAV's link: its level, the cause, and the remedy."""

from dataclasses import dataclass
from typing import Annotated, Final

from companion.values.described import DescribedEnum, Meaning


class Level(DescribedEnum):
    """Quality of the link to a UAV."""

    GOOD = "good", "its beam is guaranteed to have the gain that the link needs"
    WEAK = "weak", "its beam usually has the gain that the link needs"
    NONE = "none", "its beam lacks the gain that the link needs, or there is no beam"

    @property
    def rank(self) -> int:
        """Place in the order from the worst level, 0, to the best."""
        return _RANKS[self]


_RANKS: Final = {level: rank for rank, level in enumerate(reversed(Level))}


class Cause(DescribedEnum):
    """Main cause that limits a link."""

    CARRIER = "carrier", "the array's position or attitude is too uncertain"
    SILENT = "silent", "no report arrives"
    REFUSED = "refused", "reports arrive and are not used"
    RATE = "rate", "its reports are far apart"
    LATE = "late", "its reports arrive late"
    AGILE = "agile", "it can change its velocity quickly"
    CLOCK = "clock", "its clock is too uncertain"
    CONTRADICTED = "contradicted", "the array sees it elsewhere than it reports"
    POSITION = "position", "its reported positions are too inaccurate at this range"
    CROWDED = "crowded", "other UAVs are in the same direction, or the policy leaves it out"
    COVERAGE = "coverage", "the array does not cover its direction"
    RANGE = "range", "even the full gain of the array is too little at this range"
    MACHINE = "machine", "this machine does not keep up"
    UNSERVED = "unserved", "no node of the fleet serves it"


@dataclass(frozen=True, slots=True)
class Blame:
    """Cause of a weak link, with the reason in words and a remedy."""

    cause: Annotated[Cause, Meaning("main limit of the link; null for a good link")]
    reason: Annotated[str, Meaning("the cause in words", example="reports 1.1 s apart")]
    remedy: Annotated[
        str,
        Meaning(
            "remedy: an action that a person can take now",
            example="request reports at 10 Hz: set `[presence] position_hz = 10`",
        ),
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Verdict on the link to a UAV."""

    uav: str
    level: Level
    blame: Blame | None  # None if the link is good
    since_ns: Annotated[int, Meaning("when the link reached this level")]
    needed_gain_db: Annotated[
        float | None, Meaning("array gain that the link needs; null without a beam")
    ] = None
    guaranteed_gain_db: Annotated[
        float | None, Meaning("least array gain within the pointing bound; null: none")
    ] = None
    likely_gain_db: Annotated[
        float | None, Meaning("least array gain within the usual pointing error; null: none")
    ] = None

    @property
    def spare_gain_db(self) -> float | None:
        """Guaranteed gain beyond the needed one; None without a guarantee or a beam."""
        if self.guaranteed_gain_db is None or self.needed_gain_db is None:
            return None
        return self.guaranteed_gain_db - self.needed_gain_db
