"""Senders of frames: who sent a message, and when it was true. Every frame comes here first.

Each sender has a clock, bounds on the noise of its reports, and a presence. A message leaves here
with its time on the sender's and on the node's timeline, or as a rejection with its reason.

Over 300 lines: every kind of message comes through here.
"""

import math
from collections.abc import Container
from dataclasses import dataclass, replace
from itertools import islice
from typing import Final

from companion.mavlink.clock.estimates import ClockChange, ClockEstimate, Stamp
from companion.mavlink.clock.sender_clock import SenderClock
from companion.mavlink.trust.admission import Admission
from companion.mavlink.trust.adsb import Aircraft
from companion.mavlink.trust.dedupe import Dedupe, LinkShare
from companion.mavlink.trust.remote_id import RemoteIds
from companion.mavlink.wire.decode import ATTITUDE, decode
from companion.mavlink.wire.stamps import boot_ms
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.tracking import noise
from companion.values import (
    AdsbVehicle,
    Attitude,
    EstimatorStatus,
    Frame,
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
    SystemTime,
    reports_itself,
)

CLOCKS_MAX: Final = 4096
"""Clocks kept. Beyond it those of senders without a track are forgotten, the oldest first."""
CLOCKS_AT_ONCE: Final = 256
"""Clocks that are forgotten at once where too many come between two ticks."""
WAITS_NS: Final = 10_000_000_000
"""Time for which a track waits for its receiver to vouch for it."""
STATED_LATE_US: Final = 30_000_000
"""Greatest time by which what a receiver states may come after something newer; a longer step back
is another boot's. As long as reports are remembered (``dedupe``)."""
CLOCK_KEPT_NS: Final = 3_600_000_000_000
"""How long the clock of a sender without a track is kept: each takes some 50 kB."""
FIX_3D: Final = 3
"""GPS_FIX_TYPE_3D_FIX; better fixes have greater numbers."""
NEAR_HEIGHT_M: Final = 50.0
"""Greatest distance between a receiver's own height and the autopilot's that stands by it.

Before an autopilot stands by its height it may be hundreds of metres off (docs/field-notes.md 1).
"""


APART_SHARE: Final = 0.1
"""Share of the newest report in how far the two heights are apart of late."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedReport:
    """A report with its time.

    sender_ns  when it was true, on the sender's timeline
    t_ns       the same instant on the node's timeline
    noise      bounds on its errors; None for a relayed aircraft, whose errors depend on its
               speed
    limits     what the aircraft is taken to be able to do
    """

    report: Report
    sender_ns: int
    t_ns: int
    noise: ReportNoise | None
    limits: Limits


@dataclass(frozen=True, slots=True)
class PlacedAttitude:
    """An attitude of the carrier with its time on the carrier's timeline."""

    attitude: Attitude
    sender_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """The outcome of one frame.

    message    a message with its time; None if nothing is to be done further
    said       notices and rejections on the way to it
    restarted  the sender whose past is to be forgotten; None if there is none
    change     what the frame showed of a change of its sender's clock; None where it showed none
    """

    message: PlacedReport | PlacedAttitude | EstimatorStatus | None = None
    said: tuple[Notice | Rejection, ...] = ()
    restarted: str | None = None
    change: ClockChange | None = None


NOTHING: Final = Heard()
"""The outcome of a frame that asks for nothing further."""


class Senders:
    """All senders of frames, by MAVLink source.

    ``carrier`` is admitted whatever the lists say, and is the only one whose attitude is used.
    ``tracked`` are those who have a track at any time: their clocks are kept.
    """

    def __init__(
        self, settings: Settings, carrier: str | None, tracked: Container[str] = ()
    ) -> None:
        self.presence: dict[Source, Presence] = {}
        self.aircraft = Aircraft()
        self.remote_ids = RemoteIds()
        self._settings = settings
        self._carrier = carrier
        self._tracked = tracked
        self._carrier_source = None if carrier is None else Source.parse(carrier)
        self._noise_settings = assembly.noise(settings)
        self._noise: dict[Source, ReportNoise] = {}
        self._clocks: dict[str, SenderClock] = {}  # by SYSID:COMPID
        self._clocks_most = CLOCKS_MAX
        self._stamped_ns: dict[str, int] = {}  # when each of them was last told its time
        self._dedupe = Dedupe()
        self._admission = Admission(settings.tracks.allow, settings.tracks.deny)
        self._shared: set[str] = set()
        self._known: dict[str, assembly.Assumed] = {}  # by UAV
        self._receivers: dict[Source, GnssStatus] = {}
        self._stated_us: dict[str, int] = {}  # the receiver's time of it, by SYSID:COMPID
        self._apart_m2: dict[Source, float] = {}  # receiver's height less the autopilot's, squared
        self._utc_offset_ns = 0  # UTC less the node's timeline
        self._waits: dict[str, int] = {}  # since when a UAV's receiver does not vouch for it

    # --- what they say ----------------------------------------------------------------------

    def hear(self, frame: Frame) -> Heard:
        """Take in one frame of a message that is decoded (``decode.DECODED``)."""
        if frame.msgid == ATTITUDE and frame.source != self._carrier_source:
            change = self.notice(frame)
            return NOTHING if change is None else Heard(change=change)
        message = decode(frame)
        match message:
            case Rejection():
                return Heard(said=(message,))
            case Report():
                if self._dedupe.is_repeat(frame):
                    return _refused(message, Reason.DUPLICATE)
                if message.uav != self._carrier and not self._admission.admits(message.uav):
                    return _refused(message, Reason.NOT_ALLOWED)
                return self._telemetry(message, frame.doubt_ns)
            case AdsbVehicle():
                if not self._admission.admits(message.uav):
                    return _refused(message, Reason.NOT_ALLOWED)
                return self._relayed(message)
            case RemoteId():
                return self._remote_id(frame, message)
            case Attitude():
                return self._attitude(message)
            case EstimatorStatus():
                carries = message.source == self._carrier_source
                return Heard(message=message) if carries else NOTHING
            case None:
                return NOTHING
            case _:
                return self._beside(frame, message)

    def _beside(self, frame: Frame, message: GnssStatus | SystemTime | Presence) -> Heard:
        """Take in what is said beside positions: of a receiver, a clock, a vehicle."""
        match message:
            case GnssStatus() if self._is_outdated(message):
                pass
            case GnssStatus():
                self._stated_us[str(message.source)] = message.time_us
                self._noise[message.source] = noise.reported(message, self._noise_settings)
                self._receivers[message.source] = message
            case SystemTime():
                change = self.notice(frame)
                if message.unix_us is not None:
                    clock = self._clock(str(message.source))
                    on_timeline_us = message.unix_us - self._utc_offset_ns // 1000
                    clock.system_time(message.t_ns, on_timeline_us, message.boot_ms)
                return NOTHING if change is None else Heard(change=change)
            case Presence():
                self.presence[message.source] = message
                self._known.pop(str(message.source), None)
        return NOTHING

    def _is_outdated(self, status: GnssStatus) -> bool:
        """Whether a receiver has said something newer, as where a second link lags behind."""
        newest_us = self._stated_us.get(str(status.source), 0)
        return 0 < status.time_us < newest_us <= status.time_us + STATED_LATE_US

    def notice(self, frame: Frame) -> ClockChange | None:
        """Take in the stamp of a frame that is not decoded otherwise, for its sender's clock.

        Returns what it showed of a change of that clock.
        """
        clock = self._clocks.get(str(frame.source))
        if clock is None:
            return None
        clock.notice(frame.t_ns, boot_ms(frame))
        return clock.change

    def round_trip(self, event: RoundTrip) -> ClockChange | None:
        """Take in a TIMESYNC round trip, as evidence of its sender's clock.

        Returns what it showed of a change of that clock.
        """
        clock = self._clock(str(event.source))
        clock.timesync(event.sent_ns, event.t_ns, event.remote_ns)
        return clock.change

    def utc_is(self, offset_ns: int) -> None:
        """Take in by how much UTC is beyond the node's timeline, from now on."""
        self._utc_offset_ns = offset_ns
        for clock in self._clocks.values():
            clock.forget_gnss()

    def _telemetry(self, report: Report, doubt_ns: int = 0) -> Heard:
        """Place a report by its stamp; its noise is a vehicle's own matter if it reports itself.

        ``doubt_ns`` is that of its frame.
        """
        assert report.boot_ms is not None
        uav, t_ns = report.uav, report.t_ns
        if uav not in self._clocks and len(self._clocks) >= CLOCKS_MAX and not reports_itself(uav):
            return _refused(report, Reason.TOO_MANY)  # any number of names can be made up
        stamp, restarted = self._stamp(uav, t_ns, report.boot_ms, doubt_ns)
        said = _restart_notice(t_ns, uav, report.boot_ms) if restarted else ()
        if self._clock(uav).is_shared(t_ns):
            return Heard(
                message=None, said=(*said, *self._shared_id(uav, t_ns)), restarted=restarted
            )
        self._shared.discard(uav)
        if stamp is None:
            return Heard(
                message=None,
                said=(*said, Rejection(t_ns=t_ns, source=uav, reason=Reason.UNPLACED_STAMP)),
                restarted=restarted,
            )
        self._dedupe.took(stamp.latency_s)
        errors = self._noise.get(report.source, self._noise_settings.default)
        assumed = self.assumed(uav)
        lag_ns = round(assumed.lag_middle_s * 1e9)
        errors = replace(errors, time_s=assumed.lag_rest_s, apart_m=self._apart(report))
        true_ns = t_ns - round(stamp.latency_s * 1e9) - lag_ns
        known = errors if reports_itself(uav) else None
        placed = PlacedReport(
            report=report,
            sender_ns=stamp.sender_ns - lag_ns,
            t_ns=true_ns,
            noise=known,
            limits=assumed.limits,
        )
        return Heard(message=placed, said=said, restarted=restarted, change=self._clock(uav).change)

    def _apart(self, report: Report) -> float:
        """By how much a receiver's own heights differ from its autopilot's of late, in metres."""
        receiver = self._receivers.get(report.source)
        if receiver is None or receiver.fix_type < FIX_3D or report.alt_m is None:
            return 0.0
        before = self._apart_m2.get(report.source)
        apart_m2 = (report.alt_m - receiver.alt_m) ** 2
        if before is not None:
            apart_m2 = before + APART_SHARE * (apart_m2 - before)
        self._apart_m2[report.source] = apart_m2
        return math.sqrt(apart_m2)

    def _relayed(self, said: AdsbVehicle) -> Heard:
        """Place a report of an aircraft that a receiver relays.

        A track is begun anew when the altitude datum changes, since datums differ by the weather.
        """
        datum = self.aircraft.datum(said.uav)
        merged = self.aircraft.merge(said)
        if isinstance(merged, Rejection):
            return Heard(said=(merged,))
        true_ns = merged.t_ns - round((merged.tslc_s or 0.0) * 1e9)
        limits = self.assumed(said.uav).limits
        placed = PlacedReport(
            report=merged, sender_ns=true_ns, t_ns=true_ns, noise=None, limits=limits
        )
        if datum in (None, merged.alt_datum):
            return Heard(message=placed)
        text = f"{said.uav} is tracked anew: its altitude is {merged.alt_datum} now, not {datum}"
        return Heard(
            message=placed,
            said=(Notice(t_ns=said.t_ns, severity=Severity.INFO, subject=said.uav, text=text),),
            restarted=said.uav,
        )

    def _remote_id(self, frame: Frame, said: RemoteId) -> Heard:
        """Place a position that an aircraft broadcasts, by the stamp that it has."""
        named = self.remote_ids.named(said)
        if named is None:
            return NOTHING
        if isinstance(named, Rejection):
            return Heard(said=(named,))
        if not self._admission.admits(named.uav):
            return _refused(named, Reason.NOT_ALLOWED)
        if self._dedupe.is_repeat(frame):
            return _refused(named, Reason.DUPLICATE)
        if named.boot_ms is None:
            return _refused(named, Reason.UNPLACED_STAMP)
        return self._telemetry(named)

    def _attitude(self, attitude: Attitude) -> Heard:
        carrier = str(attitude.source)
        stamp, restarted = self._stamp(carrier, attitude.t_ns, attitude.boot_ms)
        said = _restart_notice(attitude.t_ns, carrier, attitude.boot_ms) if restarted else ()
        placed = None if stamp is None else PlacedAttitude(attitude, stamp.sender_ns)
        return Heard(
            message=placed, said=said, restarted=restarted, change=self._clock(carrier).change
        )

    def _shared_id(self, uav: str, t_ns: int) -> tuple[Notice | Rejection, ...]:
        """Reject a report under an id with two boot clocks; the notice is given once."""
        refused = Rejection(
            t_ns=t_ns, source=uav, reason=Reason.SHARED_ID, detail="two boot clocks under this id"
        )
        if uav in self._shared:
            return (refused,)
        self._shared.add(uav)
        text = f"two vehicles share the id {uav}: neither is believed"
        return Notice(t_ns=t_ns, severity=Severity.WARNING, subject=uav, text=text), refused

    def vouch(self, report: Report, always: bool) -> bool:
        """Take in a report that would begin a track. Returns whether one may begin with it.

        Its sender's receiver, if one was heard, has to have a 3-D fix near the report's height. For
        that no more than ``WAITS_NS`` are waited, as heights may be of other data for good; home
        waits ``always``.
        """
        receiver = self._receivers.get(report.source)
        if receiver is None or not reports_itself(report.uav):
            return True
        if receiver.fix_type >= FIX_3D and abs(receiver.alt_m - report.alt_m) < NEAR_HEIGHT_M:
            self._waits.pop(report.uav, None)
            return True
        return not always and report.t_ns - self._waits.setdefault(report.uav, report.t_ns) >= (
            WAITS_NS
        )

    # --- when they said it ------------------------------------------------------------------

    def _stamp(
        self, name: str, arrival_ns: int, boot_ms: int, doubt_ns: int = 0
    ) -> tuple[Stamp | None, str | None]:
        """Place a stamp on the sender's timeline; also returns the sender's name if it rebooted."""
        stamp = self._clock(name).observe(arrival_ns, boot_ms, doubt_ns)
        self._stamped_ns[name] = arrival_ns
        if stamp is None or not stamp.rebooted:
            return stamp, None
        self._stated_us.pop(name, None)
        return stamp, name

    def _clock(self, name: str) -> SenderClock:
        clock = self._clocks.get(name)
        if clock is None:
            if len(self._clocks) >= self._clocks_most:
                self._make_room()
            clock = self._clocks[name] = assembly.clock(self._settings)
        return clock

    def _make_room(self) -> None:
        """Forget the oldest clocks between two ticks: senders without end may come before one.

        Those who are tracked keep theirs. There may be more of them than ``CLOCKS_MAX``, so that it
        is looked through again only when as many have come as are forgotten at once.
        """
        unwanted = (name for name in self._clocks if not self._is_kept(name, self._tracked))
        for name in list(islice(unwanted, CLOCKS_AT_ONCE)):
            self._forget_clock(name)
        self._clocks_most = max(CLOCKS_MAX, len(self._clocks) + CLOCKS_AT_ONCE)

    def time(self, uav: str, node_ns: int) -> SenderTime:
        """A node time on a UAV's own timeline; a relayed aircraft's timeline is the node's."""
        clock = self._clocks.get(uav)
        known = clock.time(node_ns) if clock else None
        if known is None:
            bound_s = noise.ADSB_TIME_BOUND_S
            return SenderTime(node_ns=node_ns, sender_ns=node_ns, before_s=bound_s, after_s=bound_s)
        offset_ns, before_s, after_s, usual_s = known
        rest_s = self.assumed(uav).lag_rest_s
        return SenderTime(
            node_ns=node_ns,
            sender_ns=node_ns - offset_ns,
            before_s=before_s + rest_s,
            after_s=after_s + rest_s,
            usual_s=math.hypot(usual_s, rest_s),
        )

    def clock_estimate(self, uav: str) -> ClockEstimate | None:
        """The state of a UAV's clock; None for a UAV that has none."""
        clock = self._clocks.get(uav)
        return clock.estimate() if clock else None

    def assumed(self, uav: str) -> assembly.Assumed:
        """What is assumed of a UAV, by its newest heartbeat."""
        if uav not in self._known:
            if len(self._known) >= CLOCKS_MAX:  # a cache only
                self._known.clear()
            heard = self.presence.get(Source.parse(uav)) if reports_itself(uav) else None
            what = (None, None) if heard is None else (heard.mav_type, heard.autopilot)
            self._known[uav] = assembly.assumed(self._settings, uav, *what)
        return self._known[uav]

    # --- memory -----------------------------------------------------------------------------

    def forget(self, uav: str) -> None:
        """Forget for how long a sender's receiver has not vouched for it: it begins anew."""
        self._waits.pop(uav, None)

    def forget_clocks(self, wanted: Container[str], now_ns: int) -> None:
        """Forget clocks that were long silent, but for those wanted, and what goes with them.

        Who comes and goes all day takes no memory.
        """
        silent_ns = now_ns - CLOCK_KEPT_NS
        names = [name for name in self._clocks if self._stamped_ns.get(name, now_ns) < silent_ns]
        for name in names:
            if not self._is_kept(name, wanted):
                self._forget_clock(name)
        self._forget_beside(wanted, silent_ns)

    def _is_kept(self, name: str, wanted: Container[str]) -> bool:
        return name in wanted or name == self._carrier

    def _forget_clock(self, name: str) -> None:
        self._clocks.pop(name, None)
        self._stamped_ns.pop(name, None)

    def _forget_beside(self, wanted: Container[str], silent_ns: int) -> None:
        """Forget what senders without a track have said beside positions, as their clocks are."""
        for heard in (self._receivers, self.presence):
            gone = [source for source, said in heard.items() if said.t_ns < silent_ns]
            for source in (*gone, *list(heard)[: max(0, len(heard) - CLOCKS_MAX)]):
                name = str(source)
                if self._is_kept(name, wanted):
                    continue
                heard.pop(source, None)
                self._known.pop(name, None)
                if heard is self._receivers:
                    self._noise.pop(source, None)
                    self._stated_us.pop(name, None)
                    self._apart_m2.pop(source, None)
        self._shared = {uav for uav in self._shared if uav in wanted or uav in self._clocks}

    def link_share(self, link: str) -> LinkShare:
        """What a link has contributed to the reports so far."""
        return self._dedupe.shares.get(link) or LinkShare()


def _refused(message: Report | AdsbVehicle, reason: Reason) -> Heard:
    return Heard(said=(Rejection(t_ns=message.t_ns, source=message.uav, reason=reason),))


def _restart_notice(t_ns: int, name: str, boot_ms: int) -> tuple[Notice]:
    text = f"{name} was restarted: its boot clock stepped back to {boot_ms / 1e3:.1f} s"
    return (Notice(t_ns=t_ns, severity=Severity.WARNING, subject=name, text=text),)
