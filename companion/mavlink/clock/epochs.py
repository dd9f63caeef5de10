"""Assignment of stamps to clock lines: late frames, reboots, clock jumps, and clock wrap.

While a sender runs, its stamps lie on or above one line (``floor.py``). A stamp belongs to the
line while it is less than ``late_max_ns`` off it:

- Stamps further off start a *run*. A run of three advancing stamps, over at least half a second
  and with none between them that advances the line, becomes the new line; until then its stamps
  have no time. If the boot clock stepped back, it is a reboot. If it jumped ahead, it is the same
  boot with a new offset, and the sender's timeline jumps with it.
- A sender that restarts within ``late_max_ns`` of its boot steps back no further than late frames
  do. Late frames catch up with the line, a restarted clock does not: five stamps from the first
  seconds of a boot, over at least a second, none of which advances the line and all of which are
  equally late (to a second), are a reboot. A stalled clock is late in the same way, but by more
  than ``late_max_ns``, and its stamps advance.
- Stamps off the line that lie on a line of their own for three seconds, while the first line
  advances between them, belong to a second clock: two senders share one id. Those that are at most
  half a minute late may be copies over a slow route, and have no time.
- A stamp that is more than a second early on a line of 20 implies that all earlier ones were
  late. It counts once three stamps of reports over at least half a second agree; until then they
  have no time. Late ones may arrive between them, from a slower link or one that becomes fast:
  no frame arrives before it was sent, so these prove nothing against the early ones.
- Frames of the previous line that arrive within ``late_max_ns`` after it was left have no time.

A reboot is therefore reported once, at the stamp that confirms it. One case is ambiguous: a
second link that lags by seconds, and is the only one left within the first ``late_max_ns`` of a
boot, looks like a reboot.

Over 300 lines: one state, which each stamp moves.
"""

from dataclasses import dataclass, field
from typing import Final, NamedTuple

from companion.mavlink.clock.floor import Floor
from companion.mavlink.wire.stamps import WRAP_MS, unwrapped_ns

_NS: Final = 1_000_000_000
_NS_PER_MS: Final = 1_000_000
WRAP_NS: Final = WRAP_MS * _NS_PER_MS
_EARLY_NS: Final = -_NS
"""Least lateness of a stamp that fits an established line: -1 s, so 1 s early still fits."""
_ESTABLISHED: Final = 20  # stamps of a line that a single early stamp can no longer move
_RUN_KEPT: Final = 64  # stamps kept of a run
_RIVAL_LASTS_NS: Final = 3 * _NS
"""Least duration of a second clock line under one id before it counts as a second clock."""
_RIVAL_SILENT_NS: Final = 10 * _NS  # silence after which a second clock is forgotten
_COPY_LATE_NS: Final = 30 * _NS  # largest lateness of a frame that took a slow route
_RIVALS_MAX: Final = 4  # other clocks under one id that are followed


class PlacedStamp(NamedTuple):
    """Stamp that was assigned to a clock line."""

    x_ns: int  # the sender's time since boot, unwrapped
    new_line: bool = False  # True for the first stamp on a new line
    rebooted: bool = False  # True if the new line was begun by a reboot
    jump_ns: int = 0  # height of a new line without reboot above the previous one; else 0
    ahead_ns: int = 0  # by how much earlier than all before it this stamp arrived, if confirmed


@dataclass(slots=True, kw_only=True)
class _RivalLine:
    """Stamps off the line, (arrival ns, boot ms), that fit a second line."""

    stamps: list[tuple[int, int]] = field(default_factory=list)
    lowest_ns: int = 0
    highest_ns: int = 0
    begun_ns: int = 0

    def add(self, arrival_ns: int, boot_ms: int, spread_ns: int) -> bool:
        """Add a stamp; drop the earlier ones if it is more than ``spread_ns`` off them.

        Returns whether the stamp is now the newest of the run.
        """
        lag_ns = arrival_ns - boot_ms * _NS_PER_MS
        if self.stamps and not self.has_place(arrival_ns, boot_ms, spread_ns):
            self.stamps.clear()
        if not self.stamps:
            self.lowest_ns = self.highest_ns = lag_ns
            self.begun_ns = arrival_ns
        elif boot_ms <= self.stamps[-1][1]:
            return False
        self.lowest_ns = min(self.lowest_ns, lag_ns)
        self.highest_ns = max(self.highest_ns, lag_ns)
        self.stamps.append((arrival_ns, boot_ms))
        del self.stamps[:-_RUN_KEPT]
        return True

    def has_place(self, arrival_ns: int, boot_ms: int, spread_ns: int) -> bool:
        """Return whether a stamp is at most ``spread_ns`` off the others."""
        lag_ns = arrival_ns - boot_ms * _NS_PER_MS
        return self.highest_ns - spread_ns <= lag_ns <= self.lowest_ns + spread_ns

    def forget(self, arrival_ns: int) -> None:
        """Drop all stamps if the newest is more than ``_RIVAL_SILENT_NS`` old."""
        if self.stamps and arrival_ns - self.stamps[-1][0] > _RIVAL_SILENT_NS:
            self.stamps.clear()

    def lasts(self, count: int, span_ns: int) -> bool:
        """Return whether the run has at least ``count`` stamps over at least ``span_ns``."""
        return len(self.stamps) >= count and self.stamps[-1][0] - self.stamps[0][0] >= span_ns


class _RivalLines:
    """Lines of stamps off the line: more than one where several senders share an id."""

    def __init__(self) -> None:
        self._lines: list[_RivalLine] = []

    def add(self, arrival_ns: int, boot_ms: int, spread_ns: int) -> None:
        """Add a stamp to the line on which it has a place, or begin one."""
        self.forget(arrival_ns)
        for line in self._lines:
            if line.has_place(arrival_ns, boot_ms, spread_ns):
                break
        else:
            line = _RivalLine()
            self._lines.append(line)
            del self._lines[:-_RIVALS_MAX]
        line.add(arrival_ns, boot_ms, spread_ns)

    def forget(self, arrival_ns: int) -> None:
        """Drop the lines that are silent."""
        for line in self._lines:
            line.forget(arrival_ns)
        self._lines = [line for line in self._lines if line.stamps]

    def clear(self) -> None:
        """Drop all lines."""
        self._lines.clear()

    def has_clock(self, arrival_ns: int) -> bool:
        """Return whether one of the lines has lasted long enough to be a clock of its own."""
        if not self._lines:  # nearly always
            return False
        self.forget(arrival_ns)
        return any(
            len(line.stamps) >= 5 and line.stamps[-1][0] - line.begun_ns >= _RIVAL_LASTS_NS
            for line in self._lines
        )


class BootLine:
    """Clock line of one sender's boot clock; ``observe`` takes its stamps in order of arrival.

    window_ns, drift_max
                 as for ``Floor``
    late_max_ns  greatest lateness of any frame
    newest_ns    attribute: newest sender time on the line
    since_ns     attribute: arrival of its first stamp if it replaced another line; else None
    """

    def __init__(self, window_ns: int, drift_max: float, late_max_ns: int) -> None:
        self._shape = (window_ns, drift_max)
        self._late_max_ns = late_max_ns
        self.floor = Floor(*self._shape)
        self.newest_ns = 0
        self.since_ns: int | None = None
        self._run = _RivalLine()
        self._ahead = _RivalLine()  # early stamps that are not confirmed yet
        self._rivals = _RivalLines()
        self._copies = _RivalLines()  # stamps so late that they may be copies
        self._previous: tuple[Floor, int] | None = None  # the previous line, and when it was left

    def observe(self, arrival_ns: int, boot_ms: int) -> PlacedStamp | None:
        """Place a stamp on the clock line.

        Returns None for a frame of the previous line, and for a stamp off the line that is not yet
        confirmed by others.
        """
        if not self.floor.count:
            return self._accept(arrival_ns, boot_ms * _NS_PER_MS)
        x_ns = unwrapped_ns(boot_ms, self.newest_ns)
        late_ns = arrival_ns - x_ns - self.floor.at(x_ns)
        if self._previous is not None:
            latency_ns = self._straggler_latency_ns(arrival_ns, boot_ms, late_ns)
            if latency_ns is not None:
                self.floor.note_latency_before(latency_ns)
                return None
        if abs(late_ns) <= self._late_max_ns:
            return self._place_near(arrival_ns, boot_ms, x_ns, late_ns)
        if late_ns > 0 and x_ns > self.newest_ns:
            return self._place_delayed(arrival_ns, boot_ms, x_ns)
        advances = self._run.add(arrival_ns, boot_ms, self._late_max_ns)
        others = self._copies if 0 < late_ns <= _COPY_LATE_NS else self._rivals
        others.add(arrival_ns, boot_ms, self._late_max_ns)
        if not (advances and self._run.lasts(3, _NS // 2)):
            return None
        # A step ahead by more than half of the period is nearer to one back.
        nearest_ns = self._nearest_ns(arrival_ns, boot_ms)
        is_less = boot_ms < self.newest_ns // _NS_PER_MS % WRAP_MS
        stepped_back = is_less or nearest_ns < self.newest_ns
        return self._begin_new_line(rebooted=stepped_back)

    def add_stamp(self, arrival_ns: int, boot_ms: int) -> bool:
        """Add a stamp that cannot start a line. Return whether it lies on the current line."""
        floor = self.floor
        if not floor.count:
            return False
        x_ns = unwrapped_ns(boot_ms, self.newest_ns)
        late_ns = arrival_ns - x_ns - floor.at(x_ns)
        if abs(late_ns) > self._late_max_ns // 2:
            return False
        if late_ns < _EARLY_NS and floor.count >= _ESTABLISHED:
            return False
        self.floor.add(x_ns, arrival_ns - x_ns)
        self.newest_ns = max(self.newest_ns, x_ns)
        return True

    def is_shared(self, arrival_ns: int) -> bool:
        """Return whether a second clock runs beside the line: two senders then share one id."""
        return self._rivals.has_clock(arrival_ns)

    def has_late_copies(self, arrival_ns: int) -> bool:
        """Return whether stamps arrive that have no time, as copies over a slow route have none."""
        return self._copies.has_clock(arrival_ns)

    def _nearest_ns(self, arrival_ns: int, boot_ms: int) -> int:
        """Unwrap boot milliseconds to the value nearest to what the line has at an arrival."""
        return unwrapped_ns(boot_ms, arrival_ns - self.floor.at(self.newest_ns))

    def unwrap(self, boot_ms: int) -> int:
        """Convert boot milliseconds to ns, unwrapped to the value nearest to the newest stamp."""
        return unwrapped_ns(boot_ms, self.newest_ns)

    def fits(self, arrival_ns: int, x_ns: int) -> bool:
        """Return whether a stamp can belong to the line."""
        floor = self.floor
        return bool(floor) and abs(arrival_ns - x_ns - floor.at(x_ns)) <= self._late_max_ns

    def _accept(self, arrival_ns: int, x_ns: int) -> PlacedStamp:
        self.floor.add(x_ns, arrival_ns - x_ns)
        self.newest_ns = max(self.newest_ns, x_ns)
        return PlacedStamp(x_ns=x_ns)

    def _place_near(
        self, arrival_ns: int, boot_ms: int, x_ns: int, late_ns: int
    ) -> PlacedStamp | None:
        """Place a stamp near the line: in order, late, or early in a second boot."""
        if x_ns > self.newest_ns:
            if late_ns < _EARLY_NS and self.floor.count >= _ESTABLISHED:
                return self._place_ahead(arrival_ns, boot_ms)
            self._run.stamps.clear()
        elif (
            x_ns < self.newest_ns
            and x_ns < self._late_max_ns  # soon after the boot, not after a wrap
            and self._run.add(arrival_ns, boot_ms, _NS)
            and self._run.lasts(5, _NS)
        ):
            return self._begin_new_line(rebooted=True)
        return self._accept(arrival_ns, x_ns)

    def _place_ahead(self, arrival_ns: int, boot_ms: int) -> PlacedStamp | None:
        """Place a stamp that implies that all earlier ones were late, once others confirm it.

        A single forged stamp could otherwise move the clock by any amount.
        """
        self._ahead.forget(arrival_ns)
        advances = self._ahead.add(arrival_ns, boot_ms, _NS)
        stamps = self._ahead.stamps
        if not (advances and self._ahead.lasts(3, _NS // 2)):
            return None
        x_ns = unwrapped_ns(boot_ms, self.newest_ns)
        before_ns = self.floor.at(x_ns)
        for at_ns, stamp_ms in stamps[:-1]:
            early_ns = unwrapped_ns(stamp_ms, self.newest_ns)
            self.floor.add(early_ns, at_ns - early_ns)
        stamps.clear()
        placed = self._accept(arrival_ns, x_ns)
        return placed._replace(ahead_ns=before_ns - self.floor.at(x_ns))

    def _place_delayed(self, arrival_ns: int, boot_ms: int, x_ns: int) -> PlacedStamp:
        """Place a stamp in order but too late: the link stalled, or the clock stalled."""
        if self._run.add(arrival_ns, boot_ms, _NS) and self._run.lasts(5, 2 * _NS):
            return self._begin_new_line(rebooted=False)
        self.newest_ns = x_ns
        return PlacedStamp(x_ns=x_ns)

    def _straggler_latency_ns(self, arrival_ns: int, boot_ms: int, late_ns: int) -> int | None:
        """Return the latency of a stamp that fits the previous line alone; None for any other."""
        assert self._previous is not None
        before, left_ns = self._previous
        if arrival_ns - left_ns > self._late_max_ns:
            self._previous = None
            return None
        x_ns = unwrapped_ns(boot_ms, before.newest_ns)
        latency_ns = arrival_ns - x_ns - before.at(x_ns)
        fits_before = _EARLY_NS <= latency_ns <= self._late_max_ns
        fits_now = _EARLY_NS <= late_ns <= self._late_max_ns
        return latency_ns if fits_before and not fits_now else None

    def _begin_new_line(self, *, rebooted: bool) -> PlacedStamp:
        """Make the run of stamps the new line. After a reboot the sender's timeline restarts."""
        stamps = list(self._run.stamps)
        self._run.stamps.clear()
        self._ahead.stamps.clear()
        self._rivals.clear()
        self._copies.clear()
        x_ns = stamps[0][1] * _NS_PER_MS if rebooted else self._nearest_ns(*stamps[0])
        before = self.floor
        self.since_ns = stamps[0][0]
        self._previous = (before, self.since_ns)
        self.floor = Floor(*self._shape, before.largest_ns)
        for arrival_ns, boot_ms in stamps:
            x_ns = unwrapped_ns(boot_ms, x_ns)
            self.floor.add(x_ns, arrival_ns - x_ns)
        self.newest_ns = x_ns
        jump_ns = 0 if rebooted else self.floor.at(x_ns) - before.at(x_ns)
        return PlacedStamp(x_ns=x_ns, new_line=True, rebooted=rebooted, jump_ns=jump_ns)
