"""Verdicts on the links to UAVs as the API shows them.

Where this machine is behind, that is the cause of whatever is not good: all that the pipeline sees
then is that news is old.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from companion.mavlink.links.lag import LagSeen
from companion.values import Blame, Cause, Level, UtcNs, Verdict
from companion.views.words import rfc3339

Json = dict[str, Any]


def behind(seen: LagSeen) -> Blame | None:
    """What is to blame where this machine does not keep up; None where it does."""
    if not seen.behind:
        return None
    return Blame(
        Cause.MACHINE,
        f"this machine is behind: frames wait {seen.max_s or 0.0:.1f} s for it",
        "close other programs and pages, or lower [beams] update_hz",
    )


def verdict(
    found: Verdict | None,
    machine: Blame | None,
    utc_ns: Callable[[int], UtcNs],
    unserved: Blame | None = None,
) -> Json:
    """The fields of one UAV: ``verdict``, and ``health`` with what is behind it.

    ``unserved`` is why no node of the fleet serves it, where none does: it has no link then.
    """
    if unserved is not None:
        return {"verdict": str(Level.NONE), "health": _behind_none(machine or unserved)}
    if found is None:
        return {"verdict": None, "health": None}
    why = None if found.level is Level.GOOD else machine or found.blame
    return {
        "verdict": str(found.level),
        "health": {
            "cause": None if why is None else str(why.cause),
            "reason": None if why is None else why.reason,
            "remedy": None if why is None else why.remedy,
            "since": rfc3339(utc_ns(found.since_ns)),
            "needed_gain_db": found.needed_db,
            "guaranteed_gain_db": found.guaranteed_db,
            "likely_gain_db": found.likely_db,
        },
    }


def _behind_none(why: Blame) -> Json:
    """``health`` of a UAV that nobody serves: since when is not kept, and there are no gains."""
    return {
        "cause": str(why.cause),
        "reason": why.reason,
        "remedy": why.remedy,
        "since": None,
        "needed_gain_db": None,
        "guaranteed_gain_db": None,
        "likely_gain_db": None,
    }


def summary(
    verdicts: Iterable[Verdict], machine: Blame | None, *, unserved: int = 0, elsewhere: int = 0
) -> Json:
    """How many links there are of each level, the same in words, and whether all of it is late.

    ``unserved`` UAVs no node of the fleet serves; ``elsewhere`` are with other nodes.
    """
    counts = Counter(found.level for found in verdicts)
    counts[Level.NONE] += unserved
    good, total = counts[Level.GOOD], counts.total()
    parts = [f"{good} of {total} links good"] if total else []
    parts += [f"{elsewhere} with other nodes"] if elsewhere else []
    return {
        "good": good,
        "weak": counts[Level.WEAK],
        "none": counts[Level.NONE],
        "headline": ", ".join(parts) or "no UAV to aim at",
        "behind": None if machine is None else machine.reason,
    }
