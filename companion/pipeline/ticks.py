"""Timer ticks added to logs that contain none."""

from collections.abc import Iterable, Iterator
from typing import Final

from companion.values import Event, Tick

PAUSE_MAX_NS: Final = 3_600_000_000_000
"""Longest pause in a log for which ticks are added; a single log has no longer one."""
PAUSE_NS: Final = 60_000_000_000  # least duration of a pause: after it every track is lost
TOTAL_PAUSE_NS: Final = 4 * PAUSE_MAX_NS
"""Limit on the total time of a log's pauses for which ticks are added.

A forged log of a few bytes can claim hours without events, and each hour is 36 000 ticks.
"""


def with_ticks(events: Iterable[Event], update_hz: float) -> Iterator[Event]:
    """Yield the events of a log, with the ticks of a timer of ``update_hz`` inserted."""
    period_ns = round(1e9 / update_hz)
    due_ns: int | None = None
    paused_ns = 0
    for event in events:
        t_ns = event.t_ns
        if due_ns is None:
            due_ns = t_ns + period_ns
        if due_ns <= t_ns:
            pause_ns = t_ns - due_ns
            if pause_ns > PAUSE_NS:
                paused_ns += min(pause_ns, PAUSE_MAX_NS)
                if pause_ns > PAUSE_MAX_NS or paused_ns > TOTAL_PAUSE_NS:
                    due_ns = t_ns
            while due_ns <= t_ns:
                yield Tick(due_ns)
                due_ns += period_ns
        yield event
