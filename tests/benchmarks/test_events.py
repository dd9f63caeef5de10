"""What each kind of event costs in the fold: processor time and calls, for docs/performance.md.

    python tests/benchmarks/test_events.py LOG    prints the table of one log

Calls are those of Python functions and of built-in ones; those of numpy's universal functions are
not among them.
"""

import collections
import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
from figures import Figures
from support import shared_log

from companion import Pipeline, Settings
from companion.mavlink.wire.decode import DECODED
from companion.mavlink.wire.stamps import STAMPED
from companion.node.replay import log_events
from companion.values import Event, Frame, Tick

CENTER: Final = "5:1"
NAMES: Final = {30: "attitude", 33: "position", 246: "relayed aircraft"}
COUNTED_EACH: Final = 50  # of this many events of a kind, one has its calls counted
MOST_CALLS: Final = {
    "tick": 1500,
    "position": 275,
    "position of the carrier": 275,
    "relayed aircraft of the carrier": 1150,
    "attitude of the carrier": 150,
    "attitude": 27,
    "other decoded frame": 36,
    "frame with a stamp alone": 26,
    "frame that nobody reads": 5,
}
"""Calls of each kind of event, a tenth above those of docs/performance.md: counts do not vary."""
FEWEST: Final = 20  # events of a kind, below which it is left out


def kind_of(event: Event) -> str:
    """What kind of event it is, as the table names it."""
    if isinstance(event, Tick):
        return "tick"
    if not isinstance(event, Frame):
        return "other"
    if event.msgid in NAMES:
        carrier = f"{event.source}" == CENTER
        return f"{NAMES[event.msgid]}{' of the carrier' if carrier else ''}"
    if event.msgid in DECODED:
        return "other decoded frame"
    return "frame with a stamp alone" if event.msgid in STAMPED else "frame that nobody reads"


class Calls:
    """Number of calls while a block runs."""

    def __enter__(self) -> "Calls":
        self.count = 0
        sys.setprofile(self._seen)
        return self

    def _seen(self, _frame: Any, what: str, _argument: Any) -> None:
        self.count += what in ("call", "c_call")

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)


def costs(log: Path) -> Iterator[tuple[str, int, float, float, float]]:
    """Kind, events, median and total processor time (us, s), and median of calls."""
    pipeline = Pipeline(Settings().override(center={"source": CENTER}))
    took_s, calls = collections.defaultdict(list), collections.defaultdict(list)
    for event in log_events([log], pipeline.settings):
        kind = kind_of(event)
        if len(took_s[kind]) % COUNTED_EACH == COUNTED_EACH - 1 and len(calls[kind]) < 400:
            with Calls() as counted:
                pipeline.step(event)
            calls[kind].append(counted.count)
            took_s[kind].append(took_s[kind][-1])
            continue
        began_s = time.perf_counter()
        pipeline.step(event)
        took_s[kind].append(time.perf_counter() - began_s)
    for kind, each in sorted(took_s.items(), key=lambda one: -sum(one[1])):
        if len(each) >= FEWEST * COUNTED_EACH:
            count = statistics.median(calls[kind])
            yield kind, len(each), statistics.median(each) * 1e6, sum(each), count


@pytest.mark.benchmark
def test_cost_of_each_kind_of_event(figures: Figures) -> None:
    for kind, _, each_us, _, calls in costs(shared_log("sitl_4circle.tlog")):
        figures.note(f"event: {kind}, 4 UAVs", each_us, "us", "less")
        figures.note(f"event: {kind}, 4 UAVs, calls", calls, "calls", "less")
        assert calls <= MOST_CALLS[kind], kind


if __name__ == "__main__":
    for kind, events, each_us, total_s, calls in costs(Path(sys.argv[1])):
        print(f"| {kind} | {events} | {calls:.0f} | {each_us:.1f} | {total_s:.2f} |")
