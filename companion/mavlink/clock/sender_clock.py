"""One sender's boot clock on the node's timeline.

A sender stamps with milliseconds since its own boot. Its offset, node time less sender time, is
known as an interval, which every stamp and every answer narrows:

- no frame arrives before it was sent, so the offset is below every (arrival - stamp), aged by the
  largest drift assumed (``floor.py``);
- TIMESYNC round trips bound it on both sides; so does GNSS time at both ends if the settings
  trust it (``evidence.py``);
- without either, the lower side is an assumption: the least latency, which one-way frames cannot
  show, is at most the median of its visible part. A frame relayed by another node may have arrived
  earlier by its doubt.

The interval is valid at the time asked for, and widens while nothing arrives. No report is ever
placed later than it arrived. See docs/math.md 6. ``epochs.py`` decides which stamps are on one
line.

Over 300 lines: one clock, of which each kind of evidence moves the same interval.
"""

import math
from collections import deque
from typing import Final

from companion.mavlink.clock.epochs import WRAP_NS, BootLine
from companion.mavlink.clock.estimates import (
    ClockAssumptions,
    ClockChange,
    ClockEstimate,
    ClockKind,
    Stamp,
)
from companion.mavlink.clock.evidence import DriftProven, Interval, OffsetEvidence
from companion.mavlink.clock.reading import ClockReading

_NS: Final = 1_000_000_000
_NS_PER_MS: Final = 1_000_000
_MAX_DEPTH_NS: Final = 10 * _NS
"""Largest depth of the offset below the floor that evidence may claim."""
_LATENCY_S: Final = (-0.02, 5.0)
"""Least and greatest plausible latency by a trusted GNSS time, seconds."""
_GNSS_CHECKS: Final = 5  # GNSS times in a row that must be plausible before one is used
INVISIBLE_RATIO: Final = 0.1
"""Estimated ratio of the invisible part of the latency to the median of the visible part.

A point estimate, not a bound: it improves most of the latency laws tried (docs/math.md 6), and
makes none much worse.
"""
SETTLED_NS: Final = 5 * _NS  # time after which a clock is known to some tenths of a second
ROUTE_LATE_NS: Final = 250 * _NS_PER_MS
"""Lateness of a route above which the first stamps over it may be late."""
ROUTE_STAMPS: Final = 8
"""Stamps in a row of which at least one is assumed to be no later than other senders' are."""
MIN_INVISIBLE_NS: Final = 25 * _NS_PER_MS
"""Least limit assumed for the invisible latency, even if visible parts are shorter."""


class SenderClock:
    """Clock of one sender, on the node's timeline.

    ``observe`` takes the stamps of its reports in order of arrival, ``add_stamp`` those of its
    other messages. ``change`` is the clock change that the newest stamp or answer revealed, or
    None.
    """

    def __init__(self, settings: ClockAssumptions | None = None) -> None:
        self._settings = settings or ClockAssumptions()
        self.change: ClockChange | None = None
        self._constant_delay_ns = round(self._settings.constant_delay_s * _NS)
        drift_max = self._settings.drift_max_ppm * 1e-6
        self._line = BootLine(
            round(self._settings.window_s * _NS), drift_max, round(self._settings.late_max_s * _NS)
        )
        self._timesync = OffsetEvidence(drift_max)
        self._gnss = OffsetEvidence(drift_max)
        self._evidence = ((ClockKind.TIMESYNC, self._timesync), (ClockKind.GNSS, self._gnss))
        self._gnss_plausible = 0
        self._latency_s = 0.0
        self._doubt_ns = 0  # largest doubt of all stamps
        self._drift_max = drift_max
        self._begun_ns = 0  # sender time of the line's first stamp
        self._route: tuple[int, float] | None = None
        """Least offset by the lateness of other senders: its sender time, and the offset, ns.

        None if those of the route are in time, or unknown.
        """
        self._newest_routes = deque[tuple[int, int]](maxlen=ROUTE_STAMPS)
        """The same by each of the newest stamps."""
        self._known: tuple[ClockKind, int, int, int] | None = None  # at the newest stamp
        self._reading: ClockReading | None = None

    def observe(
        self, arrival_ns: int, boot_ms: int, doubt_ns: int = 0, *, late_ns: int | None = None
    ) -> Stamp | None:
        """Place a stamp whose frame may have arrived up to ``doubt_ns`` earlier.

        ``late_ns`` is how late other senders' stamps over the same route are, at most; None if
        unknown. The first stamps may be as late. Returns None for a frame of the previous boot, and
        for a stamp off the line that is not yet confirmed by others: that report has no time and
        cannot be used.
        """
        hidden_ns = 0 if self._route is None else self._hidden_ns(self._route)
        placed = self._line.observe(arrival_ns, boot_ms)
        self.change = self._known = self._reading = None
        # A stamp without a place may start a line that later ones confirm, and be its floor.
        self._doubt_ns = max(self._doubt_ns, doubt_ns)
        if placed is None:
            return None
        if placed.new_line:
            self._timesync.clear()
            self.forget_gnss()
        line, x_ns = self._line, placed.x_ns
        if placed.rebooted or not self._begun_ns:
            self._begun_ns = x_ns
            self._newest_routes.clear()
        if placed.rebooted and hidden_ns:
            self._route = x_ns, line.floor.heights(x_ns).upper_bound - hidden_ns
        elif late_ns is not None:
            self._follow_route(x_ns, arrival_ns, late_ns)
        if placed.ahead_ns:
            self._note_earlier(placed.ahead_ns)
        elif placed.jump_ns or line.floor.rise_ns or line.floor.jump_ns:
            self._note_change(placed.jump_ns or round(line.floor.jump_ns))
        _, low_ns, _, likely_ns = self._now()
        at_ns = x_ns + line.floor.drifted_ns(x_ns)
        latency_s = max(0.0, (arrival_ns - at_ns - likely_ns) * 1e-9)
        if x_ns == line.newest_ns:
            self._latency_s = latency_s
        return Stamp(
            sender_ns=x_ns, latency_s=latency_s, rebooted=placed.rebooted, oldest_ns=at_ns + low_ns
        )

    @property
    def is_settled(self) -> bool:
        """Whether the clock is known well enough to tell how late others of its route are."""
        return self._route is None and self._line.newest_ns - self._begun_ns >= SETTLED_NS

    def _follow_route(self, x_ns: int, arrival_ns: int, late_ns: int) -> None:
        """Note that a stamp may be as late as those of other senders over the same route.

        All of the line's first stamps may have been late, so the least offset of these counts.
        After them the largest counts: when the route is in time again, stamps show how late the
        first ones were. As single stamps may be later than those of others, each offset is the
        least of ``ROUTE_STAMPS`` in a row.
        """
        least_ns, is_new = arrival_ns - x_ns - late_ns, x_ns - self._begun_ns < SETTLED_NS
        if is_new:
            known_ns = math.inf if self._route is None else self._aged_ns(self._route, x_ns)
            if late_ns > ROUTE_LATE_NS and least_ns < known_ns:
                self._route = x_ns, least_ns
        elif self._route is not None:
            newest = self._newest_routes
            newest.append((x_ns, least_ns))
            least = min(self._aged_ns(one, x_ns) for one in newest)
            if len(newest) == newest.maxlen and least > self._aged_ns(self._route, x_ns):
                is_late = self._line.floor.heights(x_ns).upper_bound - least > ROUTE_LATE_NS
                self._route = (x_ns, least) if is_late else None

    def _hidden_ns(self, route: tuple[int, float]) -> int:
        """Return how late all stamps of the line may be."""
        newest_ns = self._line.newest_ns
        floor_ns = self._line.floor.heights(newest_ns).upper_bound
        return max(0, round(floor_ns - self._aged_ns(route, newest_ns)))

    def _aged_ns(self, least: tuple[int, float], x_ns: int) -> float:
        """Return a least offset, noted at another sender time, at this one."""
        noted_ns, least_ns = least
        return least_ns - self._drift_max * abs(x_ns - noted_ns)

    def may_be_own(self, arrival_ns: int, boot_ms: int, late_ns: int = _MAX_DEPTH_NS) -> bool:
        """Return whether a stamp that arrived by ``arrival_ns`` may be this clock's, so late."""
        if not self._line.floor:
            return True
        x_ns = self._line.unwrap(boot_ms)
        return -_NS_PER_MS <= arrival_ns - x_ns - self._interval(x_ns)[1] <= late_ns

    def add_stamp(self, arrival_ns: int, boot_ms: int) -> None:
        """Add the stamp of any other message, if it lies on the line of the reports."""
        self.change = self._known = self._reading = None
        line = self._line
        if line.add_stamp(arrival_ns, boot_ms) and (line.floor.rise_ns or line.floor.jump_ns):
            self._note_change(round(line.floor.jump_ns))

    def _note_change(self, jump_ns: int) -> None:
        rise_ns = jump_ns or self._line.floor.rise_ns
        self.change = ClockChange(
            proven=False, step_s=rise_ns * 1e-9, drift_ppm=math.inf, leapt=jump_ns != 0
        )

    def _note_earlier(self, ahead_ns: int) -> None:
        self.change = ClockChange(proven=False, step_s=-ahead_ns * 1e-9, drift_ppm=math.inf)

    def is_shared(self, arrival_ns: int) -> bool:
        """Return whether two clocks run side by side: two senders then share this id."""
        return self._line.is_shared(arrival_ns)

    def has_late_copies(self, arrival_ns: int) -> bool:
        """Return whether stamps arrive that have no time, as copies over a slow route have none."""
        return self._line.has_late_copies(arrival_ns)

    # --- two-way evidence -------------------------------------------------------------------

    def timesync(self, sent_ns: int, received_ns: int, remote_ns: int) -> str | None:
        """Add one TIMESYNC round trip, of any length.

        Returns None, or the reason why it is not used, as before the first stamp.

            sent_ns      when the request was sent, node time
            received_ns  when the answer was received, node time
            remote_ns    the sender's boot time when it answered
        """
        self.change = self._known = self._reading = None
        if not self._line.floor:
            return "no stamp of this sender received yet"
        if received_ns < sent_ns:
            return "answer was received before its request was sent"
        since_ns = self._line.since_ns
        if since_ns is not None and sent_ns < since_ns:
            return "request was sent before the sender's clock restarted or jumped"
        x_ns = remote_ns + round((self._line.newest_ns - remote_ns) / WRAP_NS) * WRAP_NS
        return self._add(self._timesync, Interval(x_ns, sent_ns - x_ns, received_ns - x_ns))

    def system_time(self, arrival_ns: int, unix_us: int, boot_ms: int) -> str | None:
        """Add one SYSTEM_TIME: the sender's Unix time in microseconds, with its boot time.

        ``unix_us`` counts on the node's timeline: the caller has removed the timeline's offset to
        UTC.

        It is used only if the settings trust it, the node keeps UTC, and five in a row have implied
        latencies between -20 ms and 5 s (each limit widened by the node's own error). Returns None,
        or the reason why it is not used.
        """
        self.change = self._known = self._reading = None
        refused = self._system_time(arrival_ns, unix_us, boot_ms)
        if refused is not None:
            self.forget_gnss()
        return refused

    def forget_gnss(self) -> None:
        """Discard the evidence of SYSTEM_TIME, for example after the node's own clock was set."""
        self._known = self._reading = None
        self._gnss_plausible = 0
        self._gnss.clear()

    def _system_time(self, arrival_ns: int, unix_us: int, boot_ms: int) -> str | None:
        if not self._settings.trust_gnss:
            return "settings do not trust GNSS time"
        if self._settings.node_utc_error_s is None:
            return "UTC error of the node's own timeline is unknown"
        if unix_us == 0:
            return "sender does not know the time"
        x_ns = self._line.unwrap(boot_ms)
        if not self._line.fits(arrival_ns, x_ns):
            return "boot time does not match the sender's other stamps"
        latency_s = (arrival_ns - unix_us * 1000) * 1e-9
        error_s = self._settings.node_utc_error_s
        if not _LATENCY_S[0] - error_s <= latency_s <= _LATENCY_S[1] + error_s:
            return f"implied latency of {latency_s:.6g} s is implausible"
        self._gnss_plausible += 1
        error_ns = round((error_s + self._settings.gnss_error_s) * _NS) + _NS_PER_MS
        offset_ns = unix_us * 1000 - x_ns
        return self._add(self._gnss, Interval(x_ns, offset_ns - error_ns, offset_ns + error_ns))

    def _add(self, evidence: OffsetEvidence, new: Interval) -> str | None:
        """Add an interval to the evidence. Return None, or why it cannot belong to this clock."""
        floor = self._line.floor
        sure_ns, highest_ns, _, _ = floor.heights(new.x_ns)
        early_ns = new.low_ns - highest_ns - _NS_PER_MS
        if early_ns > 0:
            return f"frames would have arrived {early_ns / 1e9:.3f} s before they were sent"
        if sure_ns - new.high_ns > _MAX_DEPTH_NS:
            least_s = (sure_ns - new.high_ns) / 1e9
            return f"fastest frame would have taken {least_s:.3f} s: answer is from another clock"
        proven = evidence.add(new)
        if new.low_ns > sure_ns + _NS_PER_MS:
            floor.restart_at(round(new.high_ns), new.x_ns)
            proven = proven or DriftProven(math.inf, new.low_ns - sure_ns)
        if proven is not None:
            self.change = ClockChange(
                proven=True, step_s=proven.step_ns * 1e-9, drift_ppm=proven.drift * 1e6
            )
        return None

    # --- the two timelines ------------------------------------------------------------------

    def node_ns(self, sender_ns: int) -> int:
        """Convert a sender time to node time, ns; monotonic. Needs a first stamp."""
        return sender_ns + self._now()[3] + self._line.floor.drifted_ns(sender_ns)

    def sender_ns(self, node_ns: int) -> int:
        """Convert a node time to sender time, ns: the inverse of ``node_ns``, to a few ns.

        Raises ``ValueError`` before the first stamp.
        """
        newest_ns, floor = self._line.newest_ns, self._line.floor
        if not floor.count:
            raise ValueError("no stamp of this sender received yet")
        ahead_ns = node_ns - newest_ns - self._now()[3]
        return newest_ns + round(ahead_ns / (1.0 + floor.drift))

    def reading(self) -> ClockReading | None:
        """Return the clock as known now, for any thread; None before the first stamp."""
        if not self._line.floor.count:
            return None
        if self._reading is None:
            kind, *offset_ns = self._now()
            newest_ns, floor = self._line.newest_ns, self._line.floor
            self._reading = ClockReading(
                kind=kind,
                offset_ns=(offset_ns[0], offset_ns[1], offset_ns[2]),
                newest_ns=newest_ns,
                assumed_drift=max(
                    self._timesync.drift_at(newest_ns), self._gnss.drift_at(newest_ns)
                ),
                drift=floor.drift,
                may_be_queue=floor.may_be_queue,
                usual_s=math.hypot(INVISIBLE_RATIO * floor.median_ns + _NS_PER_MS, floor.late_ns)
                * 1e-9,
                floor_ns=floor.at(newest_ns),
                latency_s=self._latency_s,
            )
        return self._reading

    def estimate(self, node_ns: int | None = None) -> ClockEstimate | None:
        """Return the clock at a node time (default: its newest stamp); None before the first."""
        reading = self.reading()
        if reading is None or node_ns is None:
            return None if reading is None else reading.estimate()
        x_ns = reading.sender_ns(node_ns)
        return reading.estimate(x_ns, self._line.floor.at(x_ns))

    def time(self, node_ns: int) -> tuple[int, float, float, float] | None:
        """Return the clock at a node time, as ``ClockReading``; None before the first stamp."""
        reading = self.reading()
        return None if reading is None else reading.time(node_ns)

    def _now(self) -> tuple[ClockKind, int, int, int]:
        """Return the interval of the offset at the newest stamp; cached until new input."""
        if self._known is None:
            self._known = self._interval(self._line.newest_ns)
        return self._known

    def _interval(self, x_ns: int) -> tuple[ClockKind, int, int, int]:
        """Return the offset at a sender time: kind of evidence, least, greatest and likeliest; ns.

        The kind is the evidence that leaves the least uncertainty. A measurement takes precedence
        where it contradicts an assumption.
        """
        floor = self._line.floor
        sure_ns, highest_ns, line_ns, least_ns = floor.heights(x_ns)
        median_ns, delay_ns, best = floor.median_ns, self._constant_delay_ns, ClockKind.ENVELOPE
        low_ns = least_ns - max(delay_ns, median_ns, MIN_INVISIBLE_NS) - floor.residual_ns()
        low_ns -= self._doubt_ns
        if self._route is not None:
            low_ns = min(low_ns, self._aged_ns(self._route, x_ns))
        low_ns = max(low_ns, sure_ns - _MAX_DEPTH_NS)
        high_ns: float = sure_ns - delay_ns
        likely_ns = line_ns - delay_ns - INVISIBLE_RATIO * max(0.0, median_ns - delay_ns)
        rise_ns = highest_ns - sure_ns
        for kind, evidence in self._evidence:
            known = evidence.at(x_ns)
            if known is None or (kind is ClockKind.GNSS and self._gnss_plausible < _GNSS_CHECKS):
                continue
            newest = evidence.newest(x_ns)
            upper_ns = min(sure_ns, known.high_ns)
            if known.high_ns >= low_ns and upper_ns - known.low_ns >= high_ns - low_ns:
                continue
            best, low_ns, high_ns = kind, known.low_ns, upper_ns
            likely_ns = (newest.low_ns + min(newest.high_ns, sure_ns)) / 2
            likely_ns += max(0, line_ns - sure_ns)
        high_ns = max(high_ns + rise_ns, low_ns)
        likely_ns = min(max(likely_ns, low_ns), high_ns)
        return best, math.floor(low_ns), math.ceil(high_ns), round(likely_ns)
