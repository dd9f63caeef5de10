"""Ticks of a timer, for logs that have none."""

from collections.abc import Iterable, Iterator
from typing import Final

from companion.values import Event, Tick

LONGEST_PAUSE_NS: Final = 3_600_000_000_000
"""Longest pause of several logs together that is ticked through: none of them alone has more."""
PAUSE_NS: Final = 60_000_000_000  # what counts as a pause: after it every track is lost
PAUSES_NS: Final = 4 * LONGEST_PAUSE_NS
"""Pauses of a log, together, that are ticked through.

A few bytes of a made-up log are an hour without anything, and an hour is 36 000 ticks.
"""


def with_ticks(events: Iterable[Event], update_hz: float) -> Iterator[Event]:
    """Events of a log with the ticks among them that a timer of ``update_hz`` would have made."""
    period_ns = round(1e9 / update_hz)
    due_ns: int | None = None
    paused_ns = 0
    for event in events:
        if due_ns is None:
            due_ns = event.t_ns + period_ns
        pause_ns = event.t_ns - due_ns
        if pause_ns > PAUSE_NS:
            paused_ns += min(pause_ns, LONGEST_PAUSE_NS)
            if pause_ns > LONGEST_PAUSE_NS or paused_ns > PAUSES_NS:
                due_ns = event.t_ns
        while due_ns <= event.t_ns:
            yield Tick(due_ns)
            due_ns += period_ns
        yield event
