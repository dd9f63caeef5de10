"""State of one sender of frames, and of one MAVLink component."""

from dataclasses import dataclass, field
from typing import Final

from companion.mavlink.clock.sender_clock import SenderClock
from companion.mavlink.clock.stamp_unit import Stamped, StampUnit
from companion.mavlink.wire.stamps import stamp_step
from companion.pipeline.gnss_fix import REGULAR_NS, GnssFix
from companion.pipeline.receiver_difference import ReceiverDifference
from companion.tracking.noise import STATED_NS, StatedNoise
from companion.values import FIX_3D, GnssStatus, Reason, Report

CONFIRMED_NS: Final = 5_000_000_000
"""Largest difference between the steps of arrivals and of stamps of two reports that agree."""
OUTDATED_MS: Final = 10_000  # age of a Cursor on Target event beside the newest of its source
OUTDATED_FOR_NS: Final = 60_000_000_000
"""Time after the newest event for which older ones are rejected; then its clock was set back."""
ANOTHER_CLOCK_NS: Final = 10_000_000_000
"""Time for which a clock is known from its newest stamp here, whatever other nodes share."""
ANOTHER_CLOCK_LATE_NS: Final = 3_000_000_000
"""Lateness of a stamp here, by a clock that others shared, which shows that this was another."""
BRINGS_NS: Final = 10_000_000_000
"""Time after a node's newest position for which its other messages are used."""
NO_AUTOPILOT: Final = 8  # MAV_AUTOPILOT_INVALID
AircraftType = tuple[int | None, int | None]
"""Type and autopilot of a vehicle, as MAVLink numbers them."""
UNKNOWN_TYPE: Final[AircraftType] = None, None
TYPES_MAX: Final = 4  # newest types of a vehicle that are remembered
TYPE_KEPT_NS: Final = 60_000_000_000
"""Time for which a type counts beside the newest one, so that a forged one does not last."""


@dataclass(slots=True, kw_only=True)
class ComponentState:
    """State of a MAVLink component other than its positions.

    stated_us  the receiver's own time of that status; 0 if unknown or from before a reboot
    apart_m2   mean square of the receiver's height less the autopilot's, m²
    no_position_ns
               arrival of the estimator's newest status, if it has no valid position; else None
    position_ns, position_since_ns
               arrival of the newest one with a valid position, and since when they were regular
    has_estimator
               whether they were regular for long enough, since the vehicle started
    """

    heard_ns: int = 0  # arrival of the newest of these messages
    types: dict[AircraftType, int] = field(default_factory=dict)
    """Types of its heartbeats, the newest last, with their newest arrivals."""
    is_armed: bool | None = None  # by its autopilot's newest heartbeat; None: none yet
    receiver: GnssStatus | None = None  # its newest GNSS status
    stated_us: int = 0
    noise: StatedNoise  # of its reports, by these statuses
    apart_m2: float | None = None
    difference: ReceiverDifference = field(default_factory=ReceiverDifference)
    fix: GnssFix = field(default_factory=GnssFix)
    no_position_ns: int | None = None
    position_ns: int | None = None
    position_since_ns: int = 0
    has_estimator: bool = False

    def restarted(self) -> None:
        """Forget the receiver's clock and fixes: the vehicle was restarted."""
        self.stated_us = 0
        self.has_estimator, self.position_ns = False, None
        if not self.is_in_flight:
            self.difference = ReceiverDifference()
        self.fix.restarted(is_in_flight=self.is_in_flight)

    def note_estimator(self, *, knows_position: bool, t_ns: int) -> None:
        """Note a status of the estimator."""
        if not knows_position:
            self.no_position_ns = t_ns
            return
        if self.position_ns is None or t_ns - self.position_ns > REGULAR_NS:
            self.position_since_ns = t_ns
        elif t_ns - self.position_since_ns >= STATED_NS:
            self.has_estimator = True
        self.position_ns, self.no_position_ns = t_ns, None

    @property
    def is_in_flight(self) -> bool:
        """Whether it may fly: until its autopilot's heartbeat states that it is disarmed."""
        return self.is_armed is not False

    @property
    def estimates_in_flight(self) -> bool:
        """Whether its estimator's word counts for more than its receivers': in flight.

        It must have stated positions regularly once: a stranger in a gap of the radio of a vehicle
        that sends no such statuses could state anything.
        """
        return self.has_estimator and self.is_in_flight

    def knows_position(self, t_ns: int) -> bool:
        """Return False if the estimator states that it knows none, in flight or without a fix.

        While disarmed, with a fix, estimators state so until they are ready, or until take-off.
        """
        if self.no_position_ns is None or t_ns - self.no_position_ns > STATED_NS:
            return True
        if self.estimates_in_flight:
            return False
        return self.receiver is None or self.receiver.fix_type >= FIX_3D

    def note_type(self, newest: AircraftType, t_ns: int, *, is_known: bool) -> None:
        """Note the type of a heartbeat; forget those of long ago.

        Before its first position, when no peer ``is_known``, anybody may have sent it: the vehicle
        may be of any other type too.
        """
        since_ns = t_ns - TYPE_KEPT_NS
        kept = [
            (one, at_ns)
            for one, at_ns in self.types.items()
            if at_ns >= since_ns and one not in (newest, UNKNOWN_TYPE)
        ]
        unknown = [] if is_known else [(UNKNOWN_TYPE, t_ns)]
        self.types = dict([*unknown, *kept[1 - TYPES_MAX :], (newest, t_ns)])


@dataclass(slots=True, kw_only=True)
class SharedState:
    """State of a sender whose reports other nodes share; it begins with what is known here.

    received    what this node itself received of its component, which is in force again once it
                receives a report
    stamped_ns  arrival of the newest stamp that was shared
    agreed_ns   arrival of each node's newest position that may be of the clock known here, by its
                link
    """

    clock: SenderClock
    received: ComponentState
    stamped_ns: int
    agreed_ns: dict[str, int] = field(default_factory=dict)

    def brings_positions(self, link: str, t_ns: int) -> bool:
        """Return whether a node lately shared positions, so that its other messages are used."""
        agreed_ns = self.agreed_ns.get(link)
        return agreed_ns is not None and t_ns - agreed_ns <= BRINGS_NS


@dataclass(slots=True, kw_only=True)
class Sender:
    """Sender with a clock: a vehicle, or an aircraft that broadcasts its own stamps.

    ``shared`` is its state while reports that other nodes of a fleet share are used; then
    ``shared.clock`` is in force, and ``clock`` is its clock by what this node received.
    """

    clock: SenderClock
    shared: SharedState | None = None
    stamped_ns: int | None = None  # arrival of the clock's newest stamp; None: none yet
    is_shared: bool = False  # whether a notice said that two senders share this id
    has_late_copies: bool = False  # whether a notice said that reports over 10 s old arrive
    first: tuple[int, int] | None = None  # arrival and stamp of an event that none confirmed yet
    newest: tuple[int, int] | None = None  # the same of the newest event that was placed
    unit: StampUnit | None = None  # of its stamps; None: milliseconds, since all had a time
    newest_attitude: Stamped | None = None  # of a carrier

    def has_other_unit(self, report: Report) -> bool:
        """Note a report without a time; return whether stamps have another unit from now on."""
        assert report.boot_ms is not None
        if self.unit is None:
            self.unit = StampUnit(report.boot_ms)
        return self.unit.note_unexplained(report.t_ns)

    def is_known(self, now_ns: int) -> bool:
        """Return whether its clock is known here: from stamps of at most ``ANOTHER_CLOCK_NS``."""
        return self.stamped_ns is not None and now_ns - self.stamped_ns <= ANOTHER_CLOCK_NS

    def agrees(self, arrival_ns: int, boot_ms: int) -> bool:
        """Return whether a stamp that another node shares may be of its clock, if that is known."""
        return not self.is_known(arrival_ns) or self.clock.may_be_own(arrival_ns, boot_ms)

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
            elapsed_ns = stamp_step(boot_ms, before[1]) * 1_000_000
            agrees = abs(arrival_ns - before[0] - elapsed_ns) <= CONFIRMED_NS
            return None if agrees else Reason.UNPLACED_STAMP
        if self.newest is None or arrival_ns - self.newest[0] > OUTDATED_FOR_NS:
            return None
        is_old = stamp_step(boot_ms, self.newest[1]) < -OUTDATED_MS
        return Reason.OUT_OF_ORDER if is_old else None
