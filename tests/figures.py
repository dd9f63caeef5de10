"""What benchmarks found: a table at the end, a file, and what is not as it was the last time.

make bench                        build/bench.json; what is there is the last time's
BENCH_JSON=there.json make bench  another file
"""

import json
import os
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

from support import ROOT

FILE: Final = Path(os.environ.get("BENCH_JSON", ROOT / "build" / "bench.json"))
CHANGED: Final = 0.2
"""Share by which a figure differs from the last time's before that is said."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure.

    value        the median
    unit         "times" for ratios against a peer in the same run, which alone compare between
                 machines
    better       whether more of it is better, or less
    least, most  over the rounds; the median itself where it was taken once
    """

    value: float
    unit: str
    better: Literal["more", "less"]
    least: float
    most: float


class Figures:
    """The figures of one run, by name."""

    def __init__(self) -> None:
        self.found: dict[str, Figure] = {}

    def note(
        self, name: str, values: float | Sequence[float], unit: str, better: Literal["more", "less"]
    ) -> float:
        """Keep a figure, or the median of several. Returns it."""
        several = [values] if isinstance(values, float | int) else list(values)
        figure = Figure(
            float(statistics.median(several)), unit, better, float(min(several)),
            float(max(several)),
        )  # fmt: skip
        self.found[name] = figure
        return figure.value

    def ratio(
        self,
        name: str,
        ours: Sequence[float],
        theirs: Sequence[float],
        better: Literal["more", "less"] = "less",
    ) -> float:
        """Keep the ratio of what was taken in the same rounds. Returns its median."""
        rounds = [one / other for one, other in zip(ours, theirs, strict=True)]
        return self.note(name, rounds, "times", better)

    def write(self, path: Path = FILE) -> list[str]:
        """Write the file; returns the lines of the table, and of what changed."""
        last = _last(path)
        width = max(map(len, self.found))
        lines = []
        for name, one in self.found.items():
            spread = "" if one.least == one.most else f"   {one.least:.3g} to {one.most:.3g}"
            line = f"{name.ljust(width)}  {one.value:10.4g} {one.unit}{spread}"
            before = last.get(name, {}).get("value")
            if before and abs(one.value / before - 1) > CHANGED:
                is_better = (one.value > before) == (one.better == "more")
                line += f"   {'better' if is_better else 'WORSE'}: it was {before:.4g}"
            lines.append(line)
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = last | {name: asdict(one) for name, one in self.found.items()}
        path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
        return lines


def _last(path: Path) -> dict[str, dict[str, Any]]:
    try:
        found: dict[str, dict[str, Any]] = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return found
