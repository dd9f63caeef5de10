"""Each sender's boot clock on the node's timeline.

A sender stamps with milliseconds since its own boot. Three kinds of evidence place that clock on
the node's timeline, the best first: TIMESYNC round trips; GNSS time at both ends, where the
settings trust it; and the lower envelope of (arrival - boot), which is always there. The envelope
(``envelope.py``) gives offset and drift up to the latency of the best frame, which no one-way
observation can see; the other two (``evidence.py``) say how far below the envelope the true
offset lies. No report is ever placed later than it arrived.

Which stamps belong to one line, and what a reboot is, is told in ``epochs.py``.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from statistics import median_low
from typing import Final

from companion.mavlink.epochs import WRAP_NS, BootLine
from companion.mavlink.evidence import Evidence, Interval

_NS: Final = 1_000_000_000
_NS_PER_MS: Final = 1_000_000
_DEEPEST_NS: Final = 10 * _NS
_LATENCY_S: Final = (-0.02, 5.0)
"""Where the latencies lie that a trusted GNSS time may imply."""
_GNSS_CHECKS: Final = 5
"""Times of GNSS in a row that must be plausible before one is used."""
_WORST_LATENCY_NS: Final = 5.0 * _NS
"""Radios have been seen to deliver 4.8 s late: what may be wrong with the first frame of all."""
_OLD_WINDOWS: Final = 10


class ClockKind(StrEnum):
    """What a sender's clock is known from."""

    TIMESYNC = "timesync"
    GNSS = "gnss"
    ENVELOPE = "envelope"


@dataclass(frozen=True, slots=True)
class ClockSettings:
    """``constant_delay_s``: the known smallest latency, which the envelope cannot see.

    ``trust_gnss``: use SYSTEM_TIME, if ``node_utc_error_s`` says how far the node's own timeline
    can be from UTC (None: it is not UTC); ``gnss_error_s`` is what the sender's may be off.
    ``window_s``: what the envelope looks back over. Drifts are looked for up to
    ``max_drift_ppm``; ``drift_error_ppm`` is what a drift may be off in any case, undetected.
    ``late_max_s``: no frame is later than this.
    """

    constant_delay_s: float = 0.0
    trust_gnss: bool = False
    node_utc_error_s: float | None = None
    gnss_error_s: float = 0.02
    window_s: float = 60.0
    max_drift_ppm: float = 50_000.0
    drift_error_ppm: float = 100.0
    late_max_s: float = 10.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.constant_delay_s < math.inf:
            raise ValueError(f"constant_delay_s is {self.constant_delay_s}, allowed: at least 0")
        if not 1.0 <= self.window_s <= 3600.0:
            raise ValueError(f"window_s is {self.window_s}, allowed: 1 to 3600")
        if not 0.0 <= self.max_drift_ppm <= 500_000.0:
            raise ValueError(f"max_drift_ppm is {self.max_drift_ppm}, allowed: 0 to 500000")


@dataclass(frozen=True, slots=True)
class Stamp:
    """One stamp placed.

    ``sender_ns``: the sender's time since boot, past the wrap of 32-bit milliseconds; after a
    reboot it begins anew, and ``rebooted`` is true once. ``latency_s``: how long before its
    arrival it was true, by all that is known now; at least 0.
    """

    sender_ns: int
    latency_s: float
    rebooted: bool


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """A sender's clock against the node's, at the newest stamp.

    ``offset_ns``: node time less sender time. ``drift_ppm``: how fast that grows with sender
    time; positive where the sender's clock is slow. ``constant_delay_s``: how far the offset lies
    below the envelope, that is the latency of the best frame: measured, or from the settings.
    ``latency_s``: of the newest stamp.

    ``uncertainty_s``: how far ``node_ns`` can be off at the newest stamp, if

    - TIMESYNC: the drift is off by no more than is taken for it (``drift_error_ppm``, or what the
      envelope leaves open if that is more). A drift of some percent that has to be told from the
      jitter of a radio is misjudged by more than that now and then, at one stamp in 200 or so.
    - GNSS: moreover both ends keep UTC within the settings.
    - ENVELOPE: the smallest latency, which is invisible, is no longer than the median of its
      visible part (the latency above the envelope, over the window), or is ``constant_delay_s``.
      What a finite window misses of the very best frame is added, for latencies whose smallest
      values are about as dense as those of an exponential law.
    """

    kind: ClockKind
    offset_ns: int
    drift_ppm: float
    uncertainty_s: float
    constant_delay_s: float
    latency_s: float


class SenderClock:
    """The clock of one sender. ``observe`` takes its stamps in order of arrival, of any message.

    ``timesync_refused``, ``gnss_refused``: why the newest of that evidence was not used (None
    where it was, or where there was none).
    """

    def __init__(self, settings: ClockSettings | None = None) -> None:
        self.settings = settings or ClockSettings()
        self.timesync_refused: str | None = None
        self.gnss_refused: str | None = None
        self._constant_delay_ns = round(self.settings.constant_delay_s * _NS)
        window_ns = round(self.settings.window_s * _NS)
        self._line = BootLine(
            window_ns,
            self.settings.max_drift_ppm * 1e-6,
            self.settings.drift_error_ppm * 1e-6,
            round(self.settings.late_max_s * _NS),
        )
        self._timesync = Evidence(_DEEPEST_NS, _OLD_WINDOWS * window_ns)
        self._gnss = Evidence(_DEEPEST_NS, _OLD_WINDOWS * window_ns)
        self._gnss_plausible = 0
        self._latency_s = 0.0
        self._now: ClockEstimate | None = None  # what is known, until something more is
        self._median_gap: tuple[tuple[int, int], int] = ((-1, -1), 0)  # as of what state, and it

    def observe(self, arrival_ns: int, boot_ms: int) -> Stamp | None:
        """Place a stamp. None: it is a frame of the boot before, or it is off the line and no
        others have confirmed it so far; the report has no time and cannot be used."""
        self._now = None
        placed = self._line.observe(arrival_ns, boot_ms)
        if placed is None:
            return None
        if placed.new_line:
            self._timesync.clear()
            self._gnss.clear()
            self._gnss_plausible = 0
        latency_s = (arrival_ns - self.node_ns(placed.x_ns)) * 1e-9
        if placed.x_ns == self._line.newest_ns:
            self._latency_s = latency_s
        self._remember_median()
        return Stamp(placed.x_ns, latency_s, placed.rebooted)

    def is_shared(self, arrival_ns: int) -> bool:
        """Whether two clocks go on side by side: two senders have this one's id."""
        return self._line.is_shared(arrival_ns)

    def timesync(self, sent_ns: int, received_ns: int, remote_ns: int) -> None:
        """One TIMESYNC round trip, of any length: sent and received on the node's timeline, and
        the sender's time since boot when it replied. Refused until a stamp was observed."""
        self._now = None
        if not self._line.envelope:
            self.timesync_refused = "no stamp of this sender was seen so far"
        elif received_ns < sent_ns:
            self.timesync_refused = "it was received before it was sent"
        else:
            x_ns = remote_ns + round((self._line.newest_ns - remote_ns) / WRAP_NS) * WRAP_NS
            interval = Interval(x_ns, sent_ns - x_ns, received_ns - x_ns)
            self.timesync_refused = self._timesync.add(interval, self._line.envelope)

    def system_time(self, arrival_ns: int, unix_us: int, boot_ms: int) -> None:
        """A SYSTEM_TIME: its Unix time, microseconds, beside its boot time.

        Used only where the settings trust it and the node keeps UTC, and only after several in a
        row have implied latencies between -20 ms and 5 s.
        """
        self._now = None
        self.gnss_refused = self._system_time(arrival_ns, unix_us, boot_ms)
        if self.gnss_refused is not None:
            self._gnss_plausible = 0
            self._gnss.clear()

    def _system_time(self, arrival_ns: int, unix_us: int, boot_ms: int) -> str | None:
        if not self.settings.trust_gnss:
            return "the settings do not trust it"
        if self.settings.node_utc_error_s is None:
            return "the node's own timeline is not known to be UTC"
        if unix_us == 0:
            return "the sender does not know the time"
        x_ns = self._line.unwrap(boot_ms)
        if not self._line.fits(arrival_ns, x_ns):
            return "its boot time is not on the line of the sender's stamps"
        latency_s = (arrival_ns - unix_us * 1000) * 1e-9
        error_s = self.settings.node_utc_error_s
        if not _LATENCY_S[0] - error_s <= latency_s <= _LATENCY_S[1] + error_s:
            return f"it implies a latency of {latency_s:.6g} s"
        self._gnss_plausible += 1
        error_ns = round((error_s + self.settings.gnss_error_s) * _NS) + _NS_PER_MS
        offset_ns = unix_us * 1000 - x_ns
        interval = Interval(x_ns, offset_ns - error_ns, offset_ns + error_ns)
        return self._gnss.add(interval, self._line.envelope)

    def node_ns(self, sender_ns: int) -> int:
        """Node time of a sender time, ns; it never decreases. Call it after a first stamp."""
        depth_ns = self._depth()[1]
        return sender_ns + self._line.envelope.at(sender_ns) - depth_ns

    def sender_ns(self, node_ns: int) -> int:
        """Sender time of a node time, ns: ``node_ns`` the other way round, to a few ns."""
        newest_ns = self._line.newest_ns  # rounding grows with the distance from here
        known = self._now or self.estimate()
        if known is None:
            raise ValueError("no stamp of this sender was seen so far")
        ahead_ns = node_ns - newest_ns - known.offset_ns
        return newest_ns + round(ahead_ns / (1.0 + self._line.envelope.drift))

    def estimate(self) -> ClockEstimate | None:
        """What is known of the clock at its newest stamp; None before any."""
        if self._now is not None or not self._line.envelope:
            return self._now
        kind, depth_ns, error_ns = self._depth()
        if kind is ClockKind.ENVELOPE:
            error_ns = self._envelope_error_ns()
        self._now = ClockEstimate(
            kind=kind,
            offset_ns=self.node_ns(self._line.newest_ns) - self._line.newest_ns,
            drift_ppm=self._line.envelope.drift * 1e6,
            uncertainty_s=(error_ns + _NS_PER_MS) * 1e-9,
            constant_delay_s=depth_ns * 1e-9,
            latency_s=self._latency_s,
        )
        return self._now

    def _depth(self) -> tuple[ClockKind, int, float]:
        """How far below the envelope the clock is, by the best evidence, and its error; ns."""
        best = (ClockKind.ENVELOPE, self._constant_delay_ns, math.inf)
        candidates = [(ClockKind.TIMESYNC, self._timesync.depth(self._line.envelope))]
        if self._gnss_plausible >= _GNSS_CHECKS:
            candidates.append((ClockKind.GNSS, self._gnss.depth(self._line.envelope)))
        for kind, depth in candidates:
            if depth is not None:
                age_ns = abs(self._line.newest_ns - depth.x_ns)
                error_ns = depth.error_ns + self._line.envelope.drift_error * age_ns
                if error_ns < best[2]:
                    best = (kind, depth.depth_ns, error_ns)
        return best

    def _remember_median(self) -> None:
        """The median gap, now and then: as stamps come, so that who asks when changes nothing."""
        state = (self._line.envelope.fits, self._line.envelope.count // 16)
        if self._median_gap[0] != state:
            self._median_gap = (state, median_low(self._line.envelope.gaps_ns()))

    def _envelope_error_ns(self) -> float:
        """See ``ClockEstimate.uncertainty_s``; the first few frames may all have been slow."""
        count = self._line.envelope.count
        invisible_ns = max(0, self._median_gap[1] - self._constant_delay_ns)
        return invisible_ns + self._line.envelope.residual_ns() + _WORST_LATENCY_NS / count**2
