"""Senders of frames: determines the sender and the time of every message.

Each sender has a record of its clock; each component one of its other messages: heartbeat, GNSS
status, and the noise bounds derived from it. A message leaves here with its time on the sender's
and on the node's timeline, or as a rejection with its reason.

Over 300 lines: every kind of message passes through here.
"""

import math
from collections import defaultdict
from collections.abc import Container
from copy import deepcopy
from dataclasses import replace
from functools import lru_cache, partial
from itertools import islice
from typing import Final, NamedTuple

from companion.mavlink.clock.estimates import ClockChange, ClockEstimate, Stamp
from companion.mavlink.clock.reading import ClockReading
from companion.mavlink.clock.sender_clock import SenderClock
from companion.mavlink.trust.admission import admission
from companion.mavlink.trust.adsb import Aircraft
from companion.mavlink.trust.dedupe import Dedupe, LinkShare
from companion.mavlink.trust.path_lateness import RouteLateness
from companion.mavlink.trust.remote_id import RemoteIds
from companion.mavlink.wire.attitudes import ABOUT_ATTITUDE, GPS2_RAW, gnss_heading, second_has_fix
from companion.mavlink.wire.decode import ATTITUDE, decode
from companion.mavlink.wire.stamps import boot_ms, stamp_step
from companion.pipeline import assembly
from companion.pipeline.gnss_fix import FixNotice
from companion.pipeline.receiver_difference import NEAR_M, ReceiverDifference
from companion.pipeline.records import RECORDS_MAX, Records, UavRecords
from companion.pipeline.sender import (
    ANOTHER_CLOCK_LATE_NS,
    NO_AUTOPILOT,
    UNKNOWN_TYPE,
    AircraftType,
    ComponentState,
    Sender,
    SharedState,
)
from companion.settings.model import Settings
from companion.tracking import noise
from companion.tracking.noise import StatedNoise
from companion.values import (
    FIX_3D,
    RELAYED_DELAY_S,
    RELAYED_TIME_ERROR_S,
    Accuracy,
    AdsbVehicle,
    Attitude,
    AttitudeEvidence,
    EstimatorStatus,
    Frame,
    GnssHeading,
    GnssStatus,
    Limits,
    Notice,
    Presence,
    Reason,
    Rejection,
    RemoteId,
    Report,
    ReportNoise,
    RoundTrip,
    SenderTime,
    Severity,
    Source,
    StatedAttitude,
    SystemTime,
    UavKind,
    kind_of,
)

RECEIVER_WAIT_NS: Final = 10_000_000_000  # time for which a new track waits for its GNSS receiver
STATUS_REORDER_MAX_US: Final = 30_000_000
"""Largest step back of a receiver status that is out of order; a larger one is a reboot.

Equal to the time for which reports are remembered (``dedupe``).
"""
STATUS_ALONE_NS: Final = 2_000_000_000
"""Time without a newer status after which an older one counts: the receiver's clock was set."""
KEPT_NS: Final = 3_600_000_000_000
"""Time for which a silent sender without a track is kept; each clock takes some 20 kB."""
HEIGHT_FILTER_WEIGHT: Final = (
    0.1  # weight of the newest report in the mean square height difference
)


class PlacedReport(NamedTuple):
    """Report with its time on the sender's and the node's timeline.

    noise      bounds on its errors; None for a relayed aircraft, whose errors depend on its
               speed
    """

    report: Report
    sender_ns: int  # when it was true, on the sender's timeline
    t_ns: int  # the same instant on the node's timeline
    noise: ReportNoise | None
    limits: Limits  # assumed limits of the aircraft


class PlacedAttitude(NamedTuple):
    """Attitude of the carrier with its time on the carrier's timeline."""

    attitude: Attitude
    sender_ns: int


class FrameOutcome(NamedTuple):
    """Outcome of processing one frame.

    message    a message with its time; None if nothing remains to be done
    outputs    notices and rejections
    restarted  sender whose records must be discarded; None: none
    change     change of the sender's clock that the frame showed; None without one
    """

    message: PlacedReport | PlacedAttitude | AttitudeEvidence | None = None
    outputs: tuple[Notice | Rejection, ...] = ()
    restarted: str | None = None
    change: ClockChange | None = None


NO_ESTIMATE: Final = "its estimator reports no valid position"
_OF_CARRIER: Final = ABOUT_ATTITUDE | {ATTITUDE}  # messages used only of the carrier
NO_OUTCOME: Final = FrameOutcome()  # outcome of a frame without further effect


class Timeline(NamedTuple):
    """Timeline of one UAV, which any thread may convert times with.

    clock   its sender's clock; None: reports are on the node's timeline
    rest_s  largest error of its reports' time that the clock does not include
    """

    clock: ClockReading | None
    rest_s: float

    def time(self, node_ns: int) -> SenderTime:
        """Convert a node time to this timeline."""
        if self.clock is None:
            bound_s = RELAYED_TIME_ERROR_S
            return SenderTime(node_ns=node_ns, sender_ns=node_ns, before_s=bound_s, after_s=bound_s)
        offset_ns, before_s, after_s, usual_s = self.clock.time(node_ns)
        return SenderTime(
            node_ns=node_ns,
            sender_ns=node_ns - offset_ns,
            before_s=before_s + self.rest_s,
            after_s=after_s + self.rest_s,
            usual_s=math.hypot(usual_s, self.rest_s),
        )


class Senders:
    """All senders of frames, with their clocks.

        carrier  id of the vehicle that carries the array: always admitted, and the only one whose
                 attitude is used
        records  records of the UAVs
        tracked  ids of the current tracks, whose clocks are kept

    Clocks are kept by the id under which reports are tracked: Remote ID and Cursor on Target
    aircraft have a clock, but no MAVLink source of their own.
    """

    def __init__(
        self,
        *,
        settings: Settings,
        carrier: str | None,
        records: UavRecords,
        tracked: Container[str] = (),
    ) -> None:
        self.aircraft = Aircraft()  # by ICAO address, over all relays
        self.remote_ids = RemoteIds()  # by radio address, for each receiver
        self._receivers = RouteLateness()  # of Remote ID, by link and sender
        self._carrier = carrier
        self._carrier_source = None if carrier is None else Source.parse(carrier)
        self._records = records
        self._tracked = tracked
        self._new_clock = partial(assembly.clock, settings)
        self._senders = Records(lambda: Sender(clock=self._new_clock()), self._is_kept)
        self._noise_settings = assembly.noise(settings)
        self._components: defaultdict[Source, ComponentState] = defaultdict(
            lambda: ComponentState(noise=StatedNoise(self._noise_settings.default))
        )
        self._dedupe = Dedupe()  # by content, over all links
        self._admits = admission(settings.tracks.allow, settings.tracks.deny)
        self._assumed = lru_cache(RECORDS_MAX)(partial(_assumed, settings))
        self._utc_offset_ns = 0  # UTC less the node's timeline

    # --- messages ---------------------------------------------------------------------------

    def hear(self, frame: Frame) -> FrameOutcome:  # noqa: PLR0912 - one for each kind of message
        """Process one frame of a message that is decoded (``decode.DECODED``)."""
        if frame.msgid == GPS2_RAW:
            return self._second_receiver(frame)
        if frame.msgid in _OF_CARRIER and frame.source != self._carrier_source:
            change = self.add_stamp(frame) if frame.msgid == ATTITUDE else None
            return NO_OUTCOME if change is None else FrameOutcome(change=change)
        message = decode(frame)
        match message:
            case Rejection():
                return FrameOutcome(outputs=(message,))
            case Report():
                if self._dedupe.is_repeat(frame):
                    return _refused(message, Reason.DUPLICATE)
                if message.uav != self._carrier and not self._admits(message.uav):
                    return _refused(message, Reason.NOT_ALLOWED)
                return self._telemetry(message, frame)
            case AdsbVehicle():
                if not self._admits(message.uav):
                    return _refused(message, Reason.NOT_ALLOWED)
                return self._relayed(frame, message)
            case RemoteId():
                return self._remote_id(frame, message)
            case Attitude():
                return self._attitude(message)
            case GnssHeading() | StatedAttitude():
                carries = message.source == self._carrier_source
                return FrameOutcome(message=message) if carries else NO_OUTCOME
            case None:
                return NO_OUTCOME
            case _:
                return self._take_other(frame, message)

    def _second_receiver(self, frame: Frame) -> FrameOutcome:
        """Note the fix of a vehicle's second receiver; decode the heading of the carrier's."""
        component, uav = self._components.get(frame.source), str(frame.source)
        said: tuple[Notice, ...] = ()
        if component is not None and uav in self._senders and not frame.doubt_ns:
            has_fix, t_ns = second_has_fix(frame), frame.t_ns
            said = self._about_fix(uav, component.fix.note_second(has_fix=has_fix, t_ns=t_ns), t_ns)
        heading = gnss_heading(frame) if frame.source == self._carrier_source else None
        if heading is None and not said:
            return NO_OUTCOME
        return FrameOutcome(message=heading, outputs=said)

    def _about_fix(self, uav: str, what: FixNotice | None, t_ns: int) -> tuple[Notice, ...]:
        """Return the notice about the fix of a tracked vehicle."""
        if what is None or uav not in self._tracked:
            return ()
        text = f"{uav}: {what.value}"
        return (Notice(t_ns=t_ns, severity=Severity.WARNING, subject=uav, text=text),)

    def _about_receiver(
        self, uav: str, component: ComponentState, t_ns: int, before_ns: int | None
    ) -> tuple[Notice, ...]:
        """Return the notices that a vehicle's receiver is silent, or its position another one."""
        said: tuple[Notice, ...] = ()
        if t_ns > component.fix.silent_ns:
            said = self._about_fix(uav, component.fix.note_silence(t_ns, before_ns), t_ns)
        if component.difference.is_news and uav in self._tracked:
            for severity, words in component.difference.announce(t_ns):
                text = f"{uav}: {words}"
                notice = Notice(t_ns=t_ns, severity=severity, subject=uav, text=text)
                said = (*said, notice)
        return said

    def _take_other(  # noqa: PLR0912 - one call less for each of them
        self, frame: Frame, message: GnssStatus | SystemTime | Presence | EstimatorStatus
    ) -> FrameOutcome:
        """Process a message other than positions: receiver, clock, vehicle or estimator status.

        One that another node shares counts only while that node shares positions, too.
        """
        if type(message) is SystemTime:
            return self._system_time(frame, message)
        name = str(message.source)
        sender = self._senders[name] if name in self._senders else None  # noqa: SIM401 - one call less
        shared = None if sender is None else sender.shared
        if frame.doubt_ns and (
            shared is None or not shared.brings_positions(frame.link, message.t_ns)
        ):
            return NO_OUTCOME
        if frame.doubt_ns or shared is None:
            component = self._components[message.source]
        else:
            component = shared.received
        component.heard_ns = message.t_ns
        match message:
            case GnssStatus():
                stated_us, newest_us = message.time_us, component.stated_us
                # An older status comes over a second, slower link, while newer ones come too.
                is_newest = (
                    not 0 < stated_us < newest_us <= stated_us + STATUS_REORDER_MAX_US
                    or component.receiver is None
                    or message.t_ns - component.receiver.t_ns > STATUS_ALONE_NS
                )
                # Before its first position, no peer is known to speak for the vehicle.
                if sender is not None:
                    if frame.doubt_ns:  # others may only raise what is known here
                        is_newest &= not sender.is_known(message.t_ns)
                    stated = noise.reported(message, self._noise_settings)
                    component.noise.add(message.t_ns, stated, is_newest=is_newest)
                said: tuple[Notice, ...] = ()
                if is_newest:
                    component.stated_us = stated_us
                    component.receiver = message
                    has_fix = message.fix_type >= FIX_3D
                    # Before its first position, anybody may have sent it.
                    if sender is not None:
                        what = component.fix.note_first(has_fix=has_fix, t_ns=message.t_ns)
                        if what is not None:
                            said = self._about_fix(name, what, message.t_ns)
                heading = gnss_heading(frame) if message.source == self._carrier_source else None
                if heading is None and not said:
                    return NO_OUTCOME
                return FrameOutcome(message=heading, outputs=said)
            case EstimatorStatus():
                component.note_estimator(knows_position=message.knows_position, t_ns=message.t_ns)
                said = ()
                if component.estimates_in_flight:
                    what = component.fix.note_estimator(
                        is_absolute=message.is_absolute, t_ns=message.t_ns
                    )
                    said = self._about_fix(name, what, message.t_ns)
                is_carrier = message.source == self._carrier_source
                if is_carrier or said:
                    return FrameOutcome(message=message if is_carrier else None, outputs=said)
            case Presence():
                if message.autopilot != NO_AUTOPILOT:
                    component.is_armed = message.is_armed
                component.note_type(
                    (message.mav_type, message.autopilot), message.t_ns, is_known=sender is not None
                )
        return NO_OUTCOME

    def _system_time(self, frame: Frame, message: SystemTime) -> FrameOutcome:
        change = self.add_stamp(frame)
        if message.unix_us is not None:
            clock = self._senders[str(message.source)].clock
            on_timeline_us = message.unix_us - self._utc_offset_ns // 1000
            clock.system_time(message.t_ns, on_timeline_us, message.boot_ms)
            change = clock.change or change
        return NO_OUTCOME if change is None else FrameOutcome(change=change)

    def add_stamp(self, frame: Frame) -> ClockChange | None:
        """Pass the stamp of an otherwise ignored frame to its sender's clock.

        Returns the clock change that the stamp revealed.
        """
        sender = self._senders.get(str(frame.source))
        if sender is None:
            return None
        sender.clock.add_stamp(frame.t_ns, boot_ms(frame))
        return sender.clock.change

    def round_trip(self, event: RoundTrip) -> ClockChange | None:
        """Pass a TIMESYNC round trip to its sender's clock.

        One that another node measured counts only while frames of other nodes are used, and the
        clock is not known here. Returns the change of the clock in force that it revealed.
        """
        sender = self._senders.get(str(event.source))
        if sender is None:
            return None
        if event.is_shared and (sender.shared is None or sender.is_known(event.t_ns)):
            return None
        in_force = (sender.shared or sender).clock
        for clock in (
            (in_force,) if event.is_shared or not sender.shared else (in_force, sender.clock)
        ):
            clock.timesync(event.sent_ns, event.t_ns, event.remote_ns)
        return in_force.change

    def utc_is(self, offset_ns: int) -> None:
        """Set the difference between UTC and the node's timeline, valid from now on."""
        self._utc_offset_ns = offset_ns
        for sender in self._senders.values():
            sender.clock.forget_gnss()
            (sender.shared or sender).clock.forget_gnss()

    def _telemetry(
        self, report: Report, frame: Frame, *, late_ns: int | None = None
    ) -> FrameOutcome:
        """Place a report in time by its stamp; noise bounds only for a vehicle that reports itself.

        The arrival of ``frame`` is uncertain if another node shared it. ``late_ns`` as in
        ``SenderClock.observe``.
        """
        uav, t_ns, boot_ms, doubt_ns = report.uav, report.t_ns, report.boot_ms, frame.doubt_ns
        assert boot_ms is not None
        kind = kind_of(uav)
        is_own, is_event = kind.reports_itself, kind is UavKind.COT
        if uav not in self._senders and len(self._senders) >= RECORDS_MAX and not is_own:
            return _refused(report, Reason.TOO_MANY)  # ids can be forged in any number
        sender = self._senders[uav]
        if sender.unit is not None:
            boot_ms = sender.unit.milliseconds(t_ns, boot_ms, sender.newest_attitude)
            report = report._replace(boot_ms=boot_ms)
        refused: Reason | None = None
        switched: tuple[Notice, ...] = ()
        if doubt_ns or sender.shared is not None:
            refused, switched = self._switch(sender, report, frame)
        elif is_event:
            refused = sender.refuses_event(t_ns, boot_ms)
        if refused is not None:
            return _refused(report, refused)
        clock = (sender.shared or sender).clock
        stamp, said = self._stamp(clock, uav, t_ns, boot_ms, doubt_ns, late_ns=late_ns)
        said = (*switched, *said)
        before_ns = sender.stamped_ns
        if not doubt_ns:
            sender.stamped_ns = t_ns
        restarted = uav if said else None
        if clock.is_shared(t_ns):
            return FrameOutcome(
                outputs=(*said, *_shared_id(sender, uav, t_ns)), restarted=restarted
            )
        sender.is_shared = False
        if stamp is None:
            return self._unplaced(sender, report, said)
        self._dedupe.set_latency(stamp.latency_s, (t_ns - stamp.oldest_ns) * 1e-9)
        newest = sender.newest
        if is_event and (newest is None or stamp_step(boot_ms, newest[1]) > 0 or stamp.rebooted):
            sender.newest = t_ns, boot_ms
        component = self._components.get(report.source) if is_own else None
        types = () if component is None else tuple(component.types)
        assumed = self._assumed(uav, types)
        lag_ns = round(assumed.lag_middle_s * 1e9)
        made_ns = stamp.oldest_ns - lag_ns
        errors: ReportNoise | None = None
        if is_own:
            if (
                component is not None
                and component.no_position_ns is not None
                and not component.knows_position(t_ns)
            ):
                unused = Rejection(t_ns=t_ns, source=uav, reason=Reason.NO_FIX, detail=NO_ESTIMATE)
                return FrameOutcome(
                    outputs=(*said, unused), restarted=restarted, change=clock.change
                )
            errors = self._errors(report, component, made_ns, assumed.lag_rest_s)
            if component is not None and (
                t_ns > component.fix.silent_ns or component.difference.is_news
            ):
                said = (*said, *self._about_receiver(uav, component, t_ns, before_ns))
        true_ns = t_ns - round(stamp.latency_s * 1e9) - lag_ns
        placed = PlacedReport(
            report=report,
            sender_ns=stamp.sender_ns - lag_ns,
            t_ns=true_ns,
            noise=errors,
            limits=assumed.limits,
        )
        return FrameOutcome(message=placed, outputs=said, restarted=restarted, change=clock.change)

    def _unplaced(self, sender: Sender, report: Report, said: tuple[Notice, ...]) -> FrameOutcome:
        """Reject a report whose stamp fits no clock; its stamps may have another unit."""
        uav, t_ns, in_force = report.uav, report.t_ns, sender.shared or sender
        if kind_of(uav).reports_itself and sender.has_other_unit(report):
            in_force.clock, said = self._new_clock(), (*said, _other_unit(sender, uav, t_ns))
        late = _late_copies(sender, in_force.clock, uav, t_ns)
        unused = Rejection(t_ns=t_ns, source=uav, reason=Reason.UNPLACED_STAMP)
        return FrameOutcome(outputs=(*said, *late, unused), restarted=uav if said else None)

    def _switch(
        self, sender: Sender, report: Report, frame: Frame
    ) -> tuple[Reason | None, tuple[Notice, ...]]:
        """Put in force what other nodes share of a vehicle, or again what this node received.

        Returns why the report must be rejected, and a notice if the track must restart.
        """
        assert report.boot_ms is not None
        uav, source, shared = report.uav, report.source, sender.shared
        if frame.doubt_ns:
            if shared is None:
                received = self._components[source]
                shared = sender.shared = SharedState(
                    clock=deepcopy(sender.clock), received=received, stamped_ns=report.t_ns
                )
                self._components[source] = deepcopy(received)
            shared.stamped_ns = report.t_ns
            if not sender.agrees(report.t_ns, report.boot_ms):
                return Reason.UNPLACED_STAMP, ()
            shared.agreed_ns[frame.link] = report.t_ns
            return None, ()
        if shared is None:
            return None, ()
        self._components[source], sender.shared = shared.received, None
        if shared.clock.may_be_own(report.t_ns, report.boot_ms, ANOTHER_CLOCK_LATE_NS):
            return None, ()
        text = f"{uav}: track restarted: the reports that other nodes shared had another clock"
        told = Notice(t_ns=report.t_ns, severity=Severity.WARNING, subject=uav, text=text)
        return None, (told,)

    def _errors(
        self, report: Report, component: ComponentState | None, made_ns: int, time_s: float
    ) -> ReportNoise:
        """Return bounds on a report's errors, which cover its difference from the receiver.

        ``made_ns`` is the earliest node time of its measurement, ``time_s`` the largest error of
        the time that is assumed.
        """
        known, apart_m, off_m, height_off_m = None, 0.0, 0.0, 0.0
        if component is not None and component.receiver is not None:
            known, receiver = component.noise.since(made_ns), component.receiver
            is_recent = report.t_ns - receiver.t_ns <= noise.FORGOTTEN_NS
            if is_recent and receiver.fix_type >= FIX_3D:
                apart_m2, before = (report.alt_m - receiver.alt_m) ** 2, component.apart_m2
                if before is not None:
                    apart_m2 = before + HEIGHT_FILTER_WEIGHT * (apart_m2 - before)
                component.apart_m2, apart_m = apart_m2, apart_m2**0.5
            difference = component.difference
            if receiver is not difference.compared:
                late_s = (report.t_ns - made_ns) * 1e-9
                difference.compare(receiver, report, late_s, known)
            difference.before = report
            if report.t_ns - receiver.t_ns <= noise.STATED_NS or component.fix.is_trusted:
                off_m = difference.horizontal.covered_m
                height_off_m = difference.height.covered_m
        known = known or self._noise_settings.default
        if component is not None and not component.fix.is_certain:
            known = noise.dead_reckoned(known, component.fix.dead_reckoning_s(report.t_ns))
        made = ReportNoise(
            horizontal_m=known.horizontal_m + off_m,
            vertical_m=known.vertical_m + height_off_m,
            position_m=known.position_m + (off_m * off_m + height_off_m * height_off_m) ** 0.5,
            velocity_mps=known.velocity_mps,
            time_s=time_s,
            apart_m=apart_m,
        )
        if report.accuracy is None and not report.alt_step_m:  # nearly always
            return made
        return self._stated_accuracy(report, made)

    def _stated_accuracy(self, report: Report, noise: ReportNoise) -> ReportNoise:
        """Widen bounds by what the message itself states: accuracy, and steps of height."""
        said, factor = report.accuracy or Accuracy(), self._noise_settings.factor or 0.0
        horizontal_m = max(noise.horizontal_m, factor * (said.horizontal_m or 0.0))
        vertical_m = max(noise.vertical_m, factor * (said.vertical_m or 0.0)) + report.alt_step_m
        return noise._replace(
            horizontal_m=horizontal_m,
            vertical_m=vertical_m,
            position_m=max(noise.position_m, math.hypot(horizontal_m, vertical_m)),
        )

    def _relayed(self, frame: Frame, said: AdsbVehicle) -> FrameOutcome:
        """Place in time a report of an aircraft that a receiver relays.

        Where the relay's own reports may come late over this link, this one is up to as late: half
        of that is added to its age, and half to the error of the age. The track restarts when the
        altitude datum changes, since the difference depends on the weather.
        """
        late_s = self._dedupe.late_s(frame)
        if late_s > RELAYED_DELAY_S:
            known = said.accuracy or Accuracy()
            time_s = (known.time_s or RELAYED_TIME_ERROR_S) + late_s / 2
            accuracy = known._replace(time_s=time_s)
            said = replace(said, tslc_s=said.tslc_s + late_s / 2, accuracy=accuracy)
        datum = self.aircraft.datum(said.uav)
        merged = self.aircraft.merge(said)
        if isinstance(merged, Rejection):
            return FrameOutcome(outputs=(merged,))
        true_ns = merged.t_ns - round((merged.tslc_s or 0.0) * 1e9)
        limits = self.assumed(said.uav).limits
        placed = PlacedReport(
            report=merged, sender_ns=true_ns, t_ns=true_ns, noise=None, limits=limits
        )
        if datum in (None, merged.alt_datum):
            return FrameOutcome(message=placed)
        text = f"{said.uav}: track restarted: altitude datum is {merged.alt_datum} now, not {datum}"
        return FrameOutcome(
            message=placed,
            outputs=(Notice(t_ns=said.t_ns, severity=Severity.INFO, subject=said.uav, text=text),),
            restarted=said.uav,
        )

    def _remote_id(self, frame: Frame, said: RemoteId) -> FrameOutcome:
        named = self.remote_ids.merge(said)
        if named is None:
            return NO_OUTCOME
        if isinstance(named, Rejection):
            return FrameOutcome(outputs=(named,))
        if not self._admits(named.uav):
            return _refused(named, Reason.NOT_ALLOWED)
        if self._dedupe.is_repeat(frame):
            return _refused(named, Reason.DUPLICATE)
        if named.boot_ms is None:
            return _refused(named, Reason.UNPLACED_STAMP)
        route, uav = (frame.link, frame.source), named.uav
        known = self._senders.get(uav)
        late_s: float | None = None
        if known is None or not known.clock.is_settled:
            late_s = self._receivers.largest_s(route, frame.t_ns)
        late_ns = None if late_s is None else round(late_s * 1e9)
        outcome = self._telemetry(named, frame, late_ns=late_ns)
        if outcome.message is not None:
            self._note_receiver(route, uav, frame.t_ns)
        return outcome

    def _note_receiver(self, route: tuple[str, Source], uav: str, t_ns: int) -> None:
        """Note how late a report was, if the clock of its aircraft is known well enough."""
        clock = self._senders[uav].clock
        reading = clock.reading() if clock.is_settled else None
        if reading is not None:
            low_ns, _, likely_ns = reading.offset_ns
            doubt_s = (likely_ns - low_ns) * 1e-9
            self._receivers.note(route, uav, t_ns, latency_s=reading.latency_s, doubt_s=doubt_s)

    def _attitude(self, attitude: Attitude) -> FrameOutcome:
        carrier = str(attitude.source)
        sender = self._senders[carrier]
        stamp, said = self._stamp(sender.clock, carrier, attitude.t_ns, attitude.boot_ms)
        sender.stamped_ns = attitude.t_ns
        sender.newest_attitude = attitude.t_ns, attitude.boot_ms
        placed = None if stamp is None else PlacedAttitude(attitude, stamp.sender_ns)
        return FrameOutcome(
            message=placed,
            outputs=said,
            restarted=carrier if said else None,
            change=sender.clock.change,
        )

    def may_begin(self, report: Report, always: bool) -> bool:
        """Return whether a track may begin with this report.

        Its sender's receiver, if one was received, must have a 3D fix near the report's height. In
        flight, after the loss of a fix, it need not: then a redundant autopilot takes over. After
        ``RECEIVER_WAIT_NS`` the track begins anyway, as heights may have different datums; home
        waits ``always``. A status that was not repeated for ``FORGOTTEN_NS`` is ignored: it may be
        forged.
        """
        component = self._components.get(report.source)
        receiver = None if component is None else component.receiver
        if receiver is None or not kind_of(report.uav).reports_itself:
            return True
        if report.t_ns - receiver.t_ns > noise.FORGOTTEN_NS:
            return True
        assert component is not None
        if component.is_in_flight and component.fix.is_trusted and not component.fix.is_certain:
            return True
        record = self._records[report.uav]
        if receiver.fix_type >= FIX_3D and abs(receiver.alt_m - report.alt_m) < NEAR_M:
            record.waits_ns = None
            return True
        if record.waits_ns is None:
            record.waits_ns = report.t_ns
        return not always and report.t_ns - record.waits_ns >= RECEIVER_WAIT_NS

    # --- times ------------------------------------------------------------------------------

    def _stamp(
        self,
        clock: SenderClock,
        name: str,
        arrival_ns: int,
        boot_ms: int,
        doubt_ns: int = 0,
        *,
        late_ns: int | None = None,
    ) -> tuple[Stamp | None, tuple[Notice, ...]]:
        """Place a stamp on the sender's timeline; return a notice if the stamp shows a reboot."""
        stamp = clock.observe(arrival_ns, boot_ms, doubt_ns, late_ns=late_ns)
        if stamp is None or not stamp.rebooted:
            return stamp, ()
        if kind_of(name).reports_itself and (source := Source.parse(name)) in self._components:
            self._components[source].restarted()
        text = f"{name} was restarted: its boot clock stepped back to {boot_ms / 1e3:.1f} s"
        if kind_of(name) is UavKind.COT:  # its events have times of day
            text = f"{name}: track restarted: the times of its events stepped back"
        return stamp, (Notice(t_ns=arrival_ns, severity=Severity.WARNING, subject=name, text=text),)

    def time(self, uav: str, node_ns: int) -> SenderTime:
        """Convert a node time to a UAV's own timeline; a relayed aircraft's is the node's."""
        return self.timeline(uav).time(node_ns)

    def stamp_time(self, vehicle: str, node_ns: int) -> SenderTime:
        """Convert a node time to a vehicle's own timeline, as its messages are stamped.

        Positions lag behind their stamps; attitudes do not.
        """
        sender = self._senders.get(vehicle)
        return Timeline(sender.clock.reading() if sender else None, 0.0).time(node_ns)

    def timeline(self, uav: str) -> Timeline:
        """Return a UAV's own timeline as it is known now."""
        sender = self._senders.get(uav)
        reading = (sender.shared or sender).clock.reading() if sender else None
        return Timeline(reading, 0.0 if reading is None else self.assumed(uav).lag_rest_s)

    def clock_estimate(self, uav: str) -> ClockEstimate | None:
        """Return the state of a UAV's clock; None if no clock is known."""
        sender = self._senders.get(uav)
        return (sender.shared or sender).clock.estimate() if sender else None

    def receiver_difference(self, uav: str) -> ReceiverDifference:
        """Return by how much a vehicle's position differs from its receiver's."""
        source = _source(uav)
        component = None if source is None else self._components.get(source)
        return ReceiverDifference() if component is None else component.difference

    def dead_reckoning_s(self, uav: str, now_ns: int) -> float:
        """Return for how long a vehicle has had no GNSS fix; 0 if it has one, or never had."""
        source = _source(uav)
        component = None if source is None else self._components.get(source)
        return 0.0 if component is None else component.fix.dead_reckoning_s(now_ns)

    def assumed(self, uav: str) -> assembly.AircraftAssumptions:
        """Return the assumptions about a UAV, by the types in its heartbeats.

        An aircraft that changes its type, as one that takes off vertically and then flies as an
        aeroplane, is between both for a while: the assumptions contain those of all its types.
        """
        source = _source(uav)
        component = None if source is None else self._components.get(source)
        return self._assumed(uav, () if component is None else tuple(component.types))

    # --- memory -----------------------------------------------------------------------------

    def forget_silent(self, now_ns: int) -> None:
        """Drop records of silent senders without a track.

        This bounds the memory for transient senders. Beyond ``RECORDS_MAX``, the oldest components
        are dropped too.
        """
        silent_ns, senders, components = now_ns - KEPT_NS, self._senders, self._components
        newest_ns = ((n, (one.shared or one).stamped_ns) for n, one in senders.items())
        for name in [n for n, stamped_ns in newest_ns if (stamped_ns or now_ns) < silent_ns]:
            if not self._is_kept(name):
                del senders[name]
        gone = [source for source, one in components.items() if one.heard_ns < silent_ns]
        too_many = max(0, len(components) - RECORDS_MAX)
        for source in {*gone, *islice(components, too_many)}:
            if not self._is_kept(str(source)):
                del components[source]

    def _is_kept(self, name: str) -> bool:
        return name in self._tracked or name == self._carrier

    def link_share(self, link: str) -> LinkShare:
        """Return the contribution of a link to the reports so far."""
        return self._dedupe.shares.get(link) or LinkShare()


def _assumed(
    settings: Settings, uav: str, types: tuple[AircraftType, ...]
) -> assembly.AircraftAssumptions:
    """Return the assumptions about a UAV whose heartbeats stated these types and autopilots."""
    return assembly.widest(
        [assembly.assumed(settings, uav, *one) for one in types or (UNKNOWN_TYPE,)]
    )


@lru_cache(RECORDS_MAX)
def _source(uav: str) -> Source | None:
    """Return the MAVLink source of a UAV; None for a relayed aircraft, which has none."""
    return Source.parse(uav) if kind_of(uav).reports_itself else None


def _refused(message: Report | AdsbVehicle, reason: Reason) -> FrameOutcome:
    return FrameOutcome(outputs=(Rejection(t_ns=message.t_ns, source=message.uav, reason=reason),))


def _late_copies(sender: Sender, clock: SenderClock, uav: str, t_ns: int) -> tuple[Notice, ...]:
    """Return a notice, once, that reports arrive too late to have a time, beside newer ones."""
    if sender.has_late_copies or not clock.has_late_copies(t_ns):
        return ()
    sender.has_late_copies = True
    text = (
        f"{uav}: reports more than 10 s old arrive beside newer ones and are rejected: by a slow"
        " route, or from a second vehicle with this id"
    )
    return (Notice(t_ns=t_ns, severity=Severity.WARNING, subject=uav, text=text),)


def _other_unit(sender: Sender, uav: str, t_ns: int) -> Notice:
    """Return a notice that the stamps of positions have another unit than before."""
    is_other = sender.unit is not None and sender.unit.is_microseconds
    text = f"{uav}: track restarted: its positions have stamps in milliseconds again"
    if is_other:
        text = (
            f"{uav}: track restarted: its positions have stamps in microseconds, which are"
            " converted to milliseconds"
        )
    return Notice(t_ns=t_ns, severity=Severity.WARNING, subject=uav, text=text)


def _shared_id(sender: Sender, uav: str, t_ns: int) -> tuple[Notice | Rejection, ...]:
    """Reject a report under an id with two boot clocks; publish one notice."""
    refused = Rejection(
        t_ns=t_ns, source=uav, reason=Reason.SHARED_ID, detail="two boot clocks under this id"
    )
    if sender.is_shared:
        return (refused,)
    sender.is_shared = True
    text = f"two vehicles send under the id {uav}; the reports of both are rejected"
    return Notice(t_ns=t_ns, severity=Severity.WARNING, subject=uav, text=text), refused
