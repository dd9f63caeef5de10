"""Violations of the product's bounds, and whether they were announced.

An answer whose truth is outside its bound is a violation. It was announced if the product had
reported by then, or within the same second, that an assumption about this UAV was refuted. Answers
in the windows of declared faults do not count: the assumptions do not hold there.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from companion.studies.origin import Row
from companion.studies.prediction import hostile_link
from companion.studies.prediction.pointing import Answers, Questions
from companion.values import BoolArray

SAME_SECOND_NS: Final = 1_000_000_000
KEYS: Final = ("answers", "violations", "announced", "in_faults", "worst_of_bound", "regimes")


def counted(asked: Questions, given: Answers, lead: int) -> Row:
    """Return the counts of violations for one lead; None for predictors without a bound.

    answers         answers outside the windows of declared faults
    violations      those whose truth is outside the bound
    announced       violations that were announced
    in_faults       answers inside such a window
    worst_of_bound  the largest error over its bound, outside the windows
    regimes the first three counts for each regime of a hostile link
    """
    bound = given.bound_m[lead]
    known = asked.counts[lead] & ~np.isnan(given.position_ned_m[lead, :, 0])
    if np.isnan(bound[known]).any():
        return dict.fromkeys(KEYS)
    error_m = np.linalg.norm(given.position_ned_m[lead] - asked.truth_ned_m[lead], axis=1)
    counts = known & ~asked.in_fault[lead]
    beyond = counts & (np.nan_to_num(error_m) > np.nan_to_num(bound))
    told = beyond & announced(asked, given)
    return {
        "answers": int(counts.sum()),
        "violations": int(beyond.sum()),
        "announced": int(told.sum()),
        "in_faults": int((known & asked.in_fault[lead]).sum()),
        "worst_of_bound": float(np.max(error_m[counts] / bound[counts])) if counts.any() else 0.0,
        "regimes": None if asked.regime is None else _by_regime(asked, counts, beyond, told),
    }


def announced(asked: Questions, given: Answers) -> BoolArray:
    """Return whether an assumption about the UAV was refuted before each question, (K,)."""
    if not given.refuted_ns:
        return np.zeros(len(asked.now_ns), dtype=bool)
    return asked.now_ns + SAME_SECOND_NS >= min(given.refuted_ns)


def _by_regime(
    asked: Questions, counts: BoolArray, beyond: BoolArray, told: BoolArray
) -> dict[str, dict[str, int]]:
    found = {}
    for number, regime in enumerate(hostile_link.REGIMES):
        here = asked.regime == number
        if (counts & here).any():
            found[regime.name] = {
                "answers": int((counts & here).sum()),
                "violations": int((beyond & here).sum()),
                "announced": int((told & here).sum()),
            }
    return found


def unannounced(rows: Iterable[Row]) -> int:
    """Return the number of unannounced violations."""
    return sum(
        row["violations"] - row["announced"] for row in rows if row["violations"] is not None
    )


def notice(rows: Sequence[Row]) -> str | None:
    """Return one line on unannounced violations, by the worst row; None if there are none."""
    total = unannounced(rows)
    if not total:
        return None
    worst: Any = max(
        (row for row in rows if row["violations"]),
        key=lambda row: row["violations"] - row["announced"],
    )
    number = worst["violations"] - worst["announced"]
    return (
        f"{total} bounds were violated, but no assumption was refuted; most of them, "
        f"{number} of {worst['answers']}, by {worst['predictor']} on {worst['uav']} of "
        f"{worst['log']} over the {worst['link']} link at a lead of {worst['lead_s']:g} s"
    )
