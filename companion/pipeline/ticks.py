"""Ticks of a timer, for logs that have none."""

from collections.abc import Iterable, Iterator
from typing import Final

from companion.values import Event, Tick

LONGEST_PAUSE_NS: Final = 3_600_000_000_000
"""Longest pause of several logs together that is ticked through: none of them alone has more."""


def with_ticks(events: Iterable[Event], update_hz: float) -> Iterator[Event]:
    """Events of a log with the ticks among them that a timer of ``update_hz`` would have made."""
    period_ns = round(1e9 / update_hz)
    due_ns: int | None = None
    for event in events:
        if due_ns is None:
            due_ns = event.t_ns + period_ns
        if event.t_ns - due_ns > LONGEST_PAUSE_NS:
            due_ns = event.t_ns
        while due_ns <= event.t_ns:
            yield Tick(due_ns)
            due_ns += period_ns
        yield event
