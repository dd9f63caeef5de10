"""One sender's boot clock on the node's timeline.

A sender stamps with milliseconds since its own boot. Three kinds of evidence place that clock on
the node's timeline: TIMESYNC round trips; GNSS time at both ends, where the settings trust it; and
the lower envelope of (arrival - boot), which is always there. The envelope (``envelope.py``) gives
offset and drift up to the latency of the fastest frame, which one-way observation cannot show. The
other two (``evidence.py``) say how far below the envelope the true offset lies; where both are
there, the one with the smaller error is used. No report is ever placed later than it arrived. See
docs/math.md 6.

``epochs.py`` decides which stamps belong to one line, and what is a reboot.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from statistics import median_low
from typing import Final

from companion.mavlink.clock.epochs import WRAP_NS, BootLine
from companion.mavlink.clock.evidence import Evidence, Interval

_NS: Final = 1_000_000_000
_NS_PER_MS: Final = 1_000_000
_DEEPEST_NS: Final = 10 * _NS
"""Greatest depth of the offset below the envelope that evidence may claim."""
_LATENCY_S: Final = (-0.02, 5.0)
"""Least and greatest latency that a trusted GNSS time may imply, seconds."""
_GNSS_CHECKS: Final = 5
"""GNSS times in a row that must be plausible before one is used."""
_WORST_LATENCY_NS: Final = 5.0 * _NS
"""Latency that the very first frame may have had; radios have been seen to deliver 4.8 s late."""
_OLD_WINDOWS: Final = 10
"""Lifetime of evidence, in windows of the envelope."""


class ClockKind(StrEnum):
    """The evidence from which a sender's clock is known."""

    TIMESYNC = "timesync"
    GNSS = "gnss"
    ENVELOPE = "envelope"


@dataclass(frozen=True, slots=True)
class ClockAssumptions:
    """What is assumed of a sender's clock and its link.

    constant_delay_s  known smallest latency, which the envelope cannot show
    trust_gnss        use SYSTEM_TIME, if ``node_utc_error_s`` is known
    node_utc_error_s  bound on the node's distance from UTC; None: its timeline is not UTC
    gnss_error_s      bound on the sender's distance from UTC
    window_s          how far back the envelope looks
    max_drift_ppm     largest drift that is looked for
    drift_error_ppm   least error assumed of a drift
    late_max_s        greatest lateness of any frame
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
    """A stamp placed on the sender's and the node's timelines.

    sender_ns  the sender's time since boot, past the wrap of its 32-bit milliseconds; it begins
               anew after a reboot
    latency_s  how long before its arrival the stamp was made, by all that is known now; at
               least 0
    rebooted   True once, at the stamp that confirms a reboot
    """

    sender_ns: int
    latency_s: float
    rebooted: bool


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """A sender's clock against the node's, at the newest stamp.

        kind              the evidence used
        offset_ns         node time less sender time
        drift_ppm         growth of the offset with sender time; positive where the sender is slow
        uncertainty_s     bound on the error of ``node_ns`` at the newest stamp, on the terms below
        constant_delay_s  depth of the offset below the envelope, which is the latency of the
                          fastest frame: measured, or from the settings
        latency_s         latency of the newest stamp

    The bound ``uncertainty_s`` holds if:

    - TIMESYNC: the drift is off by no more than is assumed (``drift_error_ppm``, or what the
      envelope leaves open if that is more). A drift of some percent that has to be told from the
      jitter of a radio is misjudged by more than that at about one stamp in 200.
    - GNSS: moreover both ends keep UTC within the settings.
    - ENVELOPE: the smallest latency, which is invisible, is no longer than the median of its
      visible part (the latency above the envelope, over the window), or is ``constant_delay_s``.
      What a finite window misses of the fastest frame is added, for latencies whose smallest values
      are about as dense as those of an exponential law.
    """

    kind: ClockKind
    offset_ns: int
    drift_ppm: float
    uncertainty_s: float
    constant_delay_s: float
    latency_s: float


class SenderClock:
    """The clock of one sender.

    ``observe`` takes the stamps of all its messages in order of arrival.

    ``timesync_refused`` and ``gnss_refused`` say why the newest evidence of that kind was not used;
    None where it was used, or where there was none.
    """

    def __init__(self, settings: ClockAssumptions | None = None) -> None:
        self.settings = settings or ClockAssumptions()
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
        self._now: ClockEstimate | None = None  # cached until new evidence comes
        self._median_gap: tuple[tuple[int, int], int] = ((-1, -1), 0)  # envelope's state, and value

    def observe(self, arrival_ns: int, boot_ms: int) -> Stamp | None:
        """Place a stamp.

        Returns None for a frame of the boot before, and for a stamp off the line that others have
        not confirmed so far: that report has no time and cannot be used.
        """
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
        """Whether two clocks go on side by side, which means that two senders share this id."""
        return self._line.is_shared(arrival_ns)

    def timesync(self, sent_ns: int, received_ns: int, remote_ns: int) -> None:
        """Take in one TIMESYNC round trip, of any length.

            sent_ns      when the request was sent, node time
            received_ns  when the answer was received, node time
            remote_ns    the sender's time since boot when it answered

        It is refused until a stamp of the sender was observed.
        """
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
        """Take in one SYSTEM_TIME: the sender's Unix time in microseconds beside its boot time.

        It is used only if the settings trust it and the node keeps UTC, and only after five in a
        row have implied latencies between -20 ms and 5 s (each limit widened by the node's own
        error).
        """
        self._now = None
        self.gnss_refused = self._system_time(arrival_ns, unix_us, boot_ms)
        if self.gnss_refused is not None:
            self._gnss_plausible = 0
            self._gnss.clear()

    def _system_time(self, arrival_ns: int, unix_us: int, boot_ms: int) -> str | None:
        """Take in a SYSTEM_TIME. Returns None, or the reason for which it was not used."""
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
        """Convert a sender time to node time, ns; monotonic. Needs a first stamp."""
        depth_ns = self._depth()[1]
        return sender_ns + self._line.envelope.at(sender_ns) - depth_ns

    def sender_ns(self, node_ns: int) -> int:
        """Convert a node time to sender time, ns: the inverse of ``node_ns``, to a few ns.

        Raises ``ValueError`` before the first stamp.
        """
        newest_ns = self._line.newest_ns  # rounding grows with the distance from here
        known = self._now or self.estimate()
        if known is None:
            raise ValueError("no stamp of this sender was seen so far")
        ahead_ns = node_ns - newest_ns - known.offset_ns
        return newest_ns + round(ahead_ns / (1.0 + self._line.envelope.drift))

    def estimate(self) -> ClockEstimate | None:
        """The state of the clock at its newest stamp; None before the first."""
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
        """The evidence with the smallest error: its kind, depth below the envelope, and error; ns.

        The error is infinite where only the envelope is known.
        """
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
        """Update the median gap as stamps come: the result must not depend on who asks when."""
        state = (self._line.envelope.fits, self._line.envelope.count // 16)
        if self._median_gap[0] != state:
            self._median_gap = (state, median_low(self._line.envelope.gaps_ns()))

    def _envelope_error_ns(self) -> float:
        """Bound on the error of the envelope alone, ns: see ``ClockEstimate``.

        Its last term allows for the first few frames to have all been slow.
        """
        count = self._line.envelope.count
        invisible_ns = max(0, self._median_gap[1] - self._constant_delay_ns)
        return invisible_ns + self._line.envelope.residual_ns() + _WORST_LATENCY_NS / count**2
