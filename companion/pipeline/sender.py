"""State of one sender of frames, and of one MAVLink component."""

from copy import deepcopy
from dataclasses import dataclass, field
from typing import Final

from companion.mavlink.clock.sender_clock import SenderClock
from companion.mavlink.wire.stamps import step_ms
from companion.tracking.noise import StatedNoise
from companion.values import GnssStatus, Reason

CONFIRMED_NS: Final = 5_000_000_000
"""Largest difference between the steps of arrivals and of stamps of two reports that agree."""
OUTDATED_MS: Final = 10_000  # age of a Cursor on Target event beside the newest of its source
OUTDATED_FOR_NS: Final = 60_000_000_000
"""Time after the newest event for which older ones are rejected; then its clock was set back."""
ANOTHER_CLOCK_NS: Final = 10_000_000_000
"""Time after a vehicle's newest stamp here until which others must share stamps of that clock.

It is also the largest lateness of such a stamp.
"""
ANOTHER_CLOCK_EARLY_NS: Final = 1_000_000_000  # largest earliness of such a stamp
ANOTHER_CLOCK_LATE_NS: Final = 3_000_000_000
"""Lateness of a stamp here, by a clock that others shared, which shows that this was another."""
TYPES_MAX: Final = 4  # newest types of a vehicle that are remembered
TYPE_KEPT_NS: Final = 60_000_000_000
"""Time for which a type counts beside the newest one, so that a forged one does not last."""


@dataclass(slots=True, kw_only=True)
class Sender:
    """Sender with a clock: a vehicle, or an aircraft that broadcasts its own stamps.

    ``received_clock`` is its clock without what other nodes said of it, while their frames are
    used; None while they are not.
    """

    clock: SenderClock
    received_clock: SenderClock | None = None
    received_ns: int | None = None  # arrival of its newest stamp here; None: never received
    stamped_ns: int | None = None  # arrival of the clock's newest stamp; None: none yet
    is_shared: bool = False  # whether a notice said that two senders share this id
    first: tuple[int, int] | None = None  # arrival and stamp of an event that none confirmed yet
    newest: tuple[int, int] | None = None  # the same of the newest event that was placed

    @property
    def own_clock(self) -> SenderClock:
        """Its clock by what this node received."""
        return self.received_clock or self.clock

    def share(self, arrival_ns: int, boot_ms: int) -> bool:
        """Switch to the clock with what other nodes share; return whether a stamp may be its own.

        Until ``ANOTHER_CLOCK_NS`` after its newest stamp was received here, stamps that are not on
        its line are another clock's.
        """
        if self.received_clock is None:
            self.received_clock, self.received_ns = deepcopy(self.clock), self.stamped_ns
        if self.received_ns is None or arrival_ns - self.received_ns > ANOTHER_CLOCK_NS:
            return True
        late_ns = self.received_clock.lateness_ns(arrival_ns, boot_ms)
        return late_ns is None or -ANOTHER_CLOCK_EARLY_NS <= late_ns <= ANOTHER_CLOCK_NS

    def receive(self, arrival_ns: int, boot_ms: int) -> bool:
        """Switch back to the clock of this node; return whether others shared another clock."""
        if self.received_clock is None:
            return False
        shared, self.clock, self.received_clock = self.clock, self.received_clock, None
        late_ns = shared.lateness_ns(arrival_ns, boot_ms)
        return late_ns is not None and not -ANOTHER_CLOCK_NS <= late_ns <= ANOTHER_CLOCK_LATE_NS

    def refuses_event(self, arrival_ns: int, boot_ms: int) -> Reason | None:
        """Return why a Cursor on Target event must be rejected by its time; None to use it.

        Servers send old events to each new client, so the first event of a source is not used, and
        a second one only if as much time passed by its stamp as by its arrival. A clock of the day
        does not start again: a stamp far below the newest is an old event, not a restart.
        """
        if self.stamped_ns is None:
            before, self.first = self.first, (arrival_ns, boot_ms)
            if before is None:
                return Reason.UNPLACED_STAMP
            elapsed_ns = step_ms(boot_ms, before[1]) * 1_000_000
            agrees = abs(arrival_ns - before[0] - elapsed_ns) <= CONFIRMED_NS
            return None if agrees else Reason.UNPLACED_STAMP
        if self.newest is None or arrival_ns - self.newest[0] > OUTDATED_FOR_NS:
            return None
        is_old = step_ms(boot_ms, self.newest[1]) < -OUTDATED_MS
        return Reason.OUT_OF_ORDER if is_old else None


@dataclass(slots=True, kw_only=True)
class ComponentState:
    """State of a MAVLink component other than its positions.

    stated_us  the receiver's own time of that status; 0 if unknown or from before a reboot
    apart_m2   mean square of the receiver's height less the autopilot's, m²
    """

    heard_ns: int = 0  # arrival of the newest of these messages
    types: dict[tuple[int, int], int] = field(default_factory=dict)
    """Types and autopilots of its heartbeats, the newest last, with their newest arrivals."""
    receiver: GnssStatus | None = None  # its newest GNSS status
    stated_us: int = 0
    noise: StatedNoise  # of its reports, by these statuses
    apart_m2: float | None = None

    def note_type(self, newest: tuple[int, int], t_ns: int) -> None:
        """Note the type and autopilot of a heartbeat; forget those of long ago."""
        self.types.pop(newest, None)
        since_ns = t_ns - TYPE_KEPT_NS
        kept = [(one, at_ns) for one, at_ns in self.types.items() if at_ns >= since_ns]
        self.types = dict([*kept[1 - TYPES_MAX :], (newest, t_ns)])
