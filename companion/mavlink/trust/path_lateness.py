"""How late the reports of a path may arrive: the largest latencies of the last seconds."""

from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Final

PATHS_MAX: Final = 4096  # most paths remembered; a log may name one for each of its frames
KEPT_NS: Final = 30_000_000_000
"""How long the newest report of a path tells how late others are."""
OVERDUE_MAX_NS: Final = 10_000_000_000  # longest time by which a report counts as overdue
ROUTE_SENDERS: Final = 16  # senders of a route that are remembered, the newest ones
SLOT_NS: Final = 5_000_000_000
"""The newest one or two of these times have the largest latency and the least interval."""


@dataclass(slots=True, kw_only=True)
class _Path:
    """How late the reports of a path may be, in this slot and the one before.

    newest_ns    newest arrival of a report, or of a repeat
    latencies_s  largest latencies
    doubt_s      how much larger the newest one may be
    intervals_ns least intervals between arrivals
    """

    since_ns: int
    newest_ns: int
    latencies_s: tuple[float, float]
    doubt_s: float
    intervals_ns: tuple[int, int] = KEPT_NS, KEPT_NS


class PathLateness:
    """Lateness of each path, under any key."""

    def __init__(self) -> None:
        self._paths: dict[Hashable, _Path] = {}

    def note(self, path: Hashable, t_ns: int, latency_s: float, doubt_s: float) -> None:
        """Note the latency of a report, and how much larger it may be.

        Short expressions stand for calls: this runs for each report.
        """
        known = self._paths.get(path)
        if known is None:
            if len(self._paths) < PATHS_MAX:
                self._paths[path] = _Path(
                    since_ns=t_ns, newest_ns=t_ns, latencies_s=(latency_s, 0.0), doubt_s=doubt_s
                )
            return
        known.doubt_s = doubt_s
        if t_ns - known.since_ns > SLOT_NS:
            known.since_ns = t_ns
            known.latencies_s = latency_s, known.latencies_s[0]
            known.intervals_ns = KEPT_NS, known.intervals_ns[0]
        elif latency_s > known.latencies_s[0]:
            known.latencies_s = latency_s, known.latencies_s[1]
        interval_ns, known.newest_ns = t_ns - known.newest_ns, t_ns
        if interval_ns < known.intervals_ns[0]:
            known.intervals_ns = interval_ns, known.intervals_ns[1]

    def largest_s(self, path: Hashable, t_ns: int, within_ns: int = KEPT_NS) -> float | None:
        """Return how late a report may be, as any of the newest ones.

        None if there was none in the last ``within_ns``.
        """
        known = self._paths.get(path)
        if known is None or t_ns - known.newest_ns > within_ns:
            return None
        return max(known.latencies_s) + known.doubt_s

    def forget(self, path: Hashable) -> None:
        """Forget a path, if it is known."""
        self._paths.pop(path, None)

    def overdue_s(self, path: Hashable, t_ns: int) -> float:
        """Return for how long the next report of a path is overdue."""
        known = self._paths[path]
        overdue_ns = t_ns - known.newest_ns - min(known.intervals_ns)
        return min(max(0, overdue_ns), OVERDUE_MAX_NS) * 1e-9


class RouteLateness:
    """Lateness of routes with several senders: the largest of each sender, and the least of these.

    Thus one sender with a wrong clock, or a forged one, does not make a route late.
    """

    def __init__(self) -> None:
        self._lateness = PathLateness()
        self._senders: dict[Hashable, OrderedDict[str, None]] = {}  # by route; the newest is last

    def note(
        self, route: Hashable, sender: str, t_ns: int, *, latency_s: float, doubt_s: float
    ) -> None:
        """Note the latency of a report, and how much larger it may be."""
        senders = self._senders.get(route)
        if senders is None:
            if len(self._senders) >= PATHS_MAX // ROUTE_SENDERS:
                return
            senders = self._senders[route] = OrderedDict()
        senders[sender] = None
        senders.move_to_end(sender)
        if len(senders) > ROUTE_SENDERS:
            silent, _ = senders.popitem(last=False)
            self._lateness.forget((route, silent))
        self._lateness.note((route, sender), t_ns, latency_s, doubt_s)

    def largest_s(self, route: Hashable, t_ns: int) -> float | None:
        """Return how late a report may be; None if nothing is known.

        Senders that were received in the last ``SLOT_NS`` tell, if there are any.
        """
        senders = self._senders.get(route, ())
        for within_ns in (SLOT_NS, KEPT_NS):
            late_s = [self._lateness.largest_s((route, one), t_ns, within_ns) for one in senders]
            if known_s := [one for one in late_s if one is not None]:
                return min(known_s)
        return None
