"""Verdicts on the links to UAVs, as shown by the API.

If this machine is overloaded, no link is shown as good: beams are aimed by old reports, or held for
longer than planned.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Final

from companion.mavlink.links.lag import LagSeen
from companion.pipeline.blame import of_machine
from companion.pipeline.health import HealthMonitor
from companion.values import Blame, Cause, Level, Verdict
from companion.values.described import Inline, Meaning

UPDATE_AGE_S: Final = 0.6  # age of the newest update beyond which no link is good, seconds
PERIODS: Final = 5  # the same in periods, if updates are rarer


@dataclass(frozen=True, slots=True)
class LinkHealth:
    """Verdict on the link to a UAV: cause, and gains of the array."""

    blame: Annotated[Blame | None, Inline()]
    verdict: Annotated[Verdict | None, Inline()]


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """Number of good, weak and missing links to UAVs, also as text."""

    good: Annotated[int, Meaning("number of UAVs whose link has the guaranteed gain that it needs")]
    weak: Annotated[int, Meaning("number of UAVs whose link usually has the gain that it needs")]
    none: Annotated[
        int, Meaning("number of UAVs whose link lacks the gain that it needs, or has no beam")
    ]
    headline: Annotated[str, Meaning("number of good links, as text", example="3 of 4 links good")]
    behind: Annotated[str | None, Meaning("text that this machine is overloaded; null: it is not")]


def behind(seen: LagSeen, update_age_s: float | None, update_hz: float) -> Blame | None:
    """Return the cause of weak links if this machine is overloaded; None otherwise.

    ``update_age_s`` is the age of the newest update, None before the first one.
    """
    if seen.behind:
        return of_machine(seen.longest_s)
    if update_age_s is None or update_age_s <= max(UPDATE_AGE_S, PERIODS / update_hz):
        return None
    return Blame(
        Cause.MACHINE,
        f"this machine is overloaded: the newest beams are {update_age_s:.1f} s old",
        of_machine(0.0).remedy,
    )


def shown(found: Verdict, machine: Blame | None) -> Verdict:
    """Return a verdict as it is shown: no link is good while this machine is overloaded."""
    if machine is None or found.level is not Level.GOOD:
        return found
    return replace(found, level=Level.WEAK, blame=machine)


def shown_verdicts(monitor: HealthMonitor, machine: Blame | None) -> Mapping[str, Verdict]:
    """Return the verdicts as they are shown, by UAV."""
    if machine is None:
        return monitor.verdicts
    return {uav: shown(one, machine) for uav, one in monitor.verdicts.items()}


def verdict(
    found: Verdict | None, machine: Blame | None, unserved: Blame | None = None
) -> tuple[Level | None, LinkHealth | None]:
    """Return the verdict on the link to one UAV, and its cause.

    ``unserved`` is the reason why no node of the fleet serves the UAV, which then has no link.
    """
    if unserved is not None:
        return Level.NONE, LinkHealth(machine or unserved, None)
    if found is None:
        return None, None
    found = shown(found, machine)
    return found.level, LinkHealth(found.blame, found)


def summary(
    verdicts: Iterable[Verdict], machine: Blame | None, *, unserved: int = 0, elsewhere: int = 0
) -> Headline:
    """Return the number of links of each level, also as text.

    verdicts   those shown
    machine    cause of weak links by overload; None without overload
    unserved   number of UAVs that no node of the fleet serves
    elsewhere  number of UAVs that other nodes serve
    """
    counts = Counter(found.level for found in verdicts)
    counts[Level.NONE] += unserved
    good, total = counts[Level.GOOD], counts.total()
    parts = [f"{good} of {total} links good"] if total else []
    parts += [f"{elsewhere} with other nodes"] if elsewhere else []
    return Headline(
        good=good,
        weak=counts[Level.WEAK],
        none=counts[Level.NONE],
        headline=", ".join(parts) or "no UAV to aim at",
        behind=None if machine is None else machine.reason,
    )
