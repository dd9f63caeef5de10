"""Each sender's boot clock on the node's timeline.

A sender stamps with milliseconds since its own boot. What is seen is

    arrival - boot = offset + latency,   latency >= its (unknown) smallest value

so the least of (arrival - boot) over a sliding window, the lower envelope, is the offset up to
that smallest latency, which no one-way observation can tell apart. The window lets the estimate
follow a clock that drifts. Two identical clocks never disagree by arrival order: a report's time
does not depend on how late it came, only on the best-case link of the last minute.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

WINDOW_NS: Final = 60_000_000_000
REBOOT_STEP_NS: Final = 10_000_000_000
"""A boot clock that steps back by more than this was restarted; by less, the frame is late.
Radios have been seen to deliver 4.8 s late, reboots to step back by 48 s and more."""
_NS_PER_MS: Final = 1_000_000
_WRAP_MS: Final = 1 << 32


@dataclass(frozen=True, slots=True)
class Reading:
    """One stamp placed: on the sender's timeline (its boot clock past any wrap), on the node's as
    far as known by now, and how long it took to come."""

    sender_ns: int
    t_ns: int
    latency_s: float
    rebooted: bool


class SenderClock:
    """The clock of one sender; ``place`` takes its stamps in order of arrival.

    ``constant_delay_ns``: what is known of the smallest latency, from outside; it is taken off
    every time.
    """

    def __init__(self, constant_delay_ns: int = 0) -> None:
        self._constant_delay_ns = constant_delay_ns
        self._newest_ns: int | None = None  # newest boot time, unwrapped
        self._envelope: deque[tuple[int, int]] = deque()  # (arrival, offset), offsets ascending

    def place(self, arrival_ns: int, boot_ms: int) -> Reading:
        """The time of a stamp that arrived at ``arrival_ns``; never later than its arrival."""
        boot_ns, rebooted = self._unwrap(boot_ms)
        if rebooted:
            self._envelope.clear()
            self._newest_ns = None
        if self._newest_ns is None or boot_ns > self._newest_ns:
            self._newest_ns = boot_ns
        offset_ns = self._lower(arrival_ns, arrival_ns - boot_ns)
        t_ns = boot_ns + offset_ns - self._constant_delay_ns
        return Reading(boot_ns, t_ns, (arrival_ns - t_ns) * 1e-9, rebooted)

    def sender_ns(self, node_ns: int) -> int:
        """A time of the node on the sender's timeline, by what is known now.

        ``ValueError`` before the first stamp.
        """
        if not self._envelope:
            raise ValueError("no stamp yet, so the sender's clock is not known")
        return node_ns - self._envelope[0][1] + self._constant_delay_ns

    def _unwrap(self, boot_ms: int) -> tuple[int, bool]:
        """Boot time past the wrap of 32-bit milliseconds (49.7 days), and whether it restarted."""
        if self._newest_ns is None:
            return boot_ms * _NS_PER_MS, False
        newest_ms = self._newest_ns // _NS_PER_MS
        step_ms = (boot_ms - newest_ms + _WRAP_MS // 2) % _WRAP_MS - _WRAP_MS // 2
        if step_ms * _NS_PER_MS < -REBOOT_STEP_NS:
            return boot_ms * _NS_PER_MS, True
        return (newest_ms + step_ms) * _NS_PER_MS, False

    def _lower(self, arrival_ns: int, offset_ns: int) -> int:
        """The least offset of the window, this one included."""
        envelope = self._envelope
        while envelope and envelope[-1][1] >= offset_ns:
            envelope.pop()
        envelope.append((arrival_ns, offset_ns))
        while envelope[0][0] < arrival_ns - WINDOW_NS:
            envelope.popleft()
        return envelope[0][1]
