"""Ticks of a timer, for logs that have none."""

from collections.abc import Iterable, Iterator

from companion.values import Event, Tick


def with_ticks(events: Iterable[Event], update_hz: float) -> Iterator[Event]:
    """Events of a log with the ticks among them that a timer of ``update_hz`` would have made."""
    period_ns = round(1e9 / update_hz)
    due_ns: int | None = None
    for event in events:
        if due_ns is None:
            due_ns = event.t_ns + period_ns
        while due_ns <= event.t_ns:
            yield Tick(due_ns)
            due_ns += period_ns
        yield event
