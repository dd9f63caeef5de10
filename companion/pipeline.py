"""The whole program as a fold over events: the live service, replay and the tests drive this one.

Pure and synchronous. Time comes with the events; the same events give the same outputs and the
same digest, whoever feeds them.
"""

from collections.abc import Iterable
from typing import Final

import numpy as np

from companion import assembly
from companion.beams.aim import AIMABLE, aim
from companion.config import Center, FixedCenter, Settings, VehicleCenter, parse_center
from companion.digest import Digest
from companion.mavlink.admission import Admission
from companion.mavlink.adsb import Aircraft
from companion.mavlink.clocks import ClockEstimate, SenderClock, Stamp
from companion.mavlink.decode import DECODED, decode
from companion.mavlink.dedupe import Dedupe, LinkShare
from companion.refusals import Refusals
from companion.tracking import carrier, noise
from companion.tracking.fleet import SenderTime
from companion.tracking.geodesy import LocalFrame
from companion.tracking.identity import Identities
from companion.values import (
    Attitude,
    Carrier,
    Estimate,
    Event,
    Fix,
    FloatArray,
    Frame,
    GnssStatus,
    Notice,
    Output,
    Presence,
    Reason,
    Rejection,
    Report,
    ReportNoise,
    RoundTrip,
    Severity,
    Source,
    SystemTime,
    Tick,
    Track,
    TrackState,
    Traffic,
    Update,
)

DROP_EVERY: Final = 100
"""Updates between two looks for those that have gone."""
CLOCKS_MAX: Final = 4096
"""Of senders that are not tracked the clocks are forgotten beyond, the oldest first."""
NEAR_M: Final = 2000.0
"""Two reports of one aircraft are not further apart, however fast it is and however old one is."""


class Pipeline:
    """State of the program. ``step`` takes events in order; the rest only looks.

    ``ConfigError`` or ``ValueError`` on settings that do not make sense together.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.frames = 0
        self.updates = 0
        self.refusals = Refusals()
        self.digest = Digest()
        self.array = assembly.array(settings)
        self.coverage = assembly.coverage(settings)
        self.precoder = assembly.precoder(settings)
        self.local: LocalFrame | None = None
        self.last_update: Update | None = None
        self._noise_settings = assembly.noise(settings)
        self._noise: dict[Source, ReportNoise] = {}
        self.presence: dict[Source, Presence] = {}
        self._center: Center = parse_center(settings.center.source or "home")
        self._carrier_id = str(self._center) if isinstance(self._center, VehicleCenter) else None
        self._attitude: tuple[int, Attitude] | None = None
        self._clocks: dict[str, SenderClock] = {}  # by SYSID:COMPID
        self._dedupe = Dedupe()
        self._admission = Admission(settings.tracks.allow, settings.tracks.deny)
        self.aircraft = Aircraft()
        self._fleet = assembly.fleet(settings, self._sender_time)
        self._targets: list[str] = []  # in the order in which they were first heard
        self._identities = Identities()
        self._shared_ids: set[str] = set()
        self._states: dict[str, TrackState] = {}
        if isinstance(self._center, FixedCenter):
            self._set_origin(self._center)

    # --- the fold ---------------------------------------------------------------------------

    def step(self, event: Event) -> list[Output]:
        """What one event brings. Events come in order of time."""
        match event:
            case Frame():
                outputs = self._frame(event)
            case Tick():
                outputs = self._tick(event)
            case Rejection():
                outputs = [event]
            case RoundTrip():
                self._clock(event.source).timesync(event.sent_ns, event.t_ns, event.remote_ns)
                outputs = []
        for output in outputs:
            if isinstance(output, Rejection):
                self.refusals.add(output)
            elif isinstance(output, Estimate | Update):
                self.digest.add(output)
        return outputs

    def _frame(self, frame: Frame) -> list[Output]:
        self.frames += 1
        if frame.msgid not in DECODED:
            return []
        message = decode(frame)
        match message:
            case Rejection():
                return [message]
            case Report():
                if self._dedupe.is_repeat(frame):
                    return [Rejection(frame.t_ns, message.uav, Reason.DUPLICATE)]
                if message.uav != self._carrier_id and not self._admission.admits(message.uav):
                    return [Rejection(frame.t_ns, message.uav, Reason.NOT_ALLOWED)]
                return self._report(message)
            case Traffic():
                if not self._admission.admits(message.uav):
                    return [Rejection(frame.t_ns, message.uav, Reason.NOT_ALLOWED)]
                return self._traffic(message)
            case Attitude() if str(message.source) == self._carrier_id:
                return self._carrier_attitude(message)
            case GnssStatus():
                self._noise[message.source] = noise.reported(message, self._noise_settings)
            case SystemTime() if message.unix_us is not None:
                clock = self._clock(message.source)
                clock.system_time(message.t_ns, message.unix_us, message.boot_ms)
            case Presence():
                self.presence[message.source] = message
        return []

    def _traffic(self, said: Traffic) -> list[Output]:
        """A track does not go on from one datum to another: they differ by the weather."""
        datum = self.aircraft.datum(said.uav)
        merged = self.aircraft.merge(said)
        if isinstance(merged, Rejection):
            return [merged]
        if datum in (None, merged.alt_datum):
            return self._report(merged)
        self._restart(said.uav)
        text = f"{said.uav} is tracked anew: its altitude is {merged.alt_datum} now, not {datum}"
        return [Notice(said.t_ns, Severity.INFO, said.uav, text), *self._report(merged)]

    def _report(self, report: Report) -> list[Output]:
        outputs: list[Output] = []
        if report.boot_ms is None:
            t_ns = report.t_ns - round((report.tslc_s or 0.0) * 1e9)
            sender_ns = t_ns
        else:
            stamp = self._stamp(report.source, report.t_ns, report.boot_ms, outputs)
            if self._clock(report.source).is_shared(report.t_ns):
                return [*outputs, *self._shared(report)]
            self._shared_ids.discard(report.uav)
            if stamp is None:
                return [*outputs, Rejection(report.t_ns, report.uav, Reason.UNPLACED_STAMP)]
            t_ns, sender_ns = report.t_ns - round(stamp.latency_s * 1e9), stamp.sender_ns
            self._dedupe.took(stamp.latency_s)
        if self.local is None:
            outputs.append(self._first_report(report))
        accepted = self._fleet.accept(self._fix(report, sender_ns, t_ns))
        if isinstance(accepted, Estimate):
            if accepted.dt_s is None and self.is_target(report.uav):
                self._targets = list(dict.fromkeys([*self._targets, report.uav]))
            if report.boot_ms is None:
                self._identities.observe(accepted.fix, self._telemetry_near(accepted.fix))
            if accepted.reacquired:
                text = f"{report.uav} is tracked anew: its reports agree, but not with its past"
                outputs.append(Notice(report.t_ns, Severity.WARNING, report.uav, text))
        return [*outputs, accepted]

    def _shared(self, report: Report) -> list[Output]:
        """Two boot clocks run under one id: whose report this is, nobody knows."""
        uav, t_ns = report.uav, report.t_ns
        refused = Rejection(t_ns, uav, Reason.SHARED_ID, detail="two boot clocks under this id")
        if uav in self._shared_ids:
            return [refused]
        self._shared_ids.add(uav)
        text = f"two vehicles share the id {uav}: neither is believed"
        return [Notice(t_ns, Severity.WARNING, uav, text), refused]

    def _clock(self, source: Source) -> SenderClock:
        name = str(source)
        clock = self._clocks.get(name)
        if clock is None:
            clock = self._clocks.setdefault(name, assembly.clock(self.settings))
        return clock

    def _stamp(
        self, source: Source, arrival_ns: int, boot_ms: int, outputs: list[Output]
    ) -> Stamp | None:
        """A stamp on the sender's timeline; a reboot begins the sender's track anew."""
        stamp = self._clock(source).observe(arrival_ns, boot_ms)
        if stamp is not None and stamp.rebooted:
            self._restart(str(source))
            text = f"{source} was restarted: its boot clock stepped back to {boot_ms / 1e3:.1f} s"
            outputs.append(Notice(arrival_ns, Severity.WARNING, str(source), text))
        return stamp

    def _sender_time(self, uav: str, node_ns: int) -> SenderTime:
        """A time of the node on a UAV's own timeline; that of ADS-B traffic is the node's."""
        clock = self._clocks.get(uav)
        estimate = clock.estimate() if clock else None
        if clock is None or estimate is None:
            return SenderTime(node_ns, noise.ADSB_TIME_BOUND_S)
        return SenderTime(clock.sender_ns(node_ns), estimate.uncertainty_s)

    def clock_estimate(self, uav: str) -> ClockEstimate | None:
        """What is known of a UAV's clock; None for one that has none."""
        clock = self._clocks.get(uav)
        return clock.estimate() if clock else None

    def _restart(self, uav: str) -> None:
        self._fleet.forget(uav)
        if uav in self._targets:
            self._targets.remove(uav)
        if uav == self._carrier_id:
            self._attitude = None

    def _first_report(self, report: Report) -> Notice:
        """The first position of all sets the origin of the local frame, and ``home``."""
        home = FixedCenter(report.lat_deg, report.lon_deg, report.alt_m)
        self._set_origin(home)
        place = f"{home.lat_deg:.6f}, {home.lon_deg:.6f}, {home.alt_m:.1f} m"
        if self._carrier_id is not None:
            return Notice(report.t_ns, Severity.INFO, "origin", f"local frame begins at {place}")
        self._center = home
        text = f"home is where {report.uav} first reported: {place}; level, facing north"
        return Notice(report.t_ns, Severity.INFO, "home", text)

    def _set_origin(self, at: FixedCenter) -> None:
        self.local = LocalFrame(at.lat_deg, at.lon_deg, at.alt_m)

    def _fix(self, report: Report, sender_ns: int, t_ns: int) -> Fix:
        assert self.local is not None
        velocity = None
        if report.velocity_ne_mps is not None and report.velocity_down_mps is not None:
            there = np.array([*report.velocity_ne_mps, report.velocity_down_mps])
            velocity = self.local.local_from_ned(report.lat_deg, report.lon_deg) @ there
        position = self.local.position_ned_m(report.lat_deg, report.lon_deg, report.alt_m)
        if report.boot_ms is None:
            most_mps = self.settings.observer.speed_max_mps
            errors = noise.relayed(velocity, report.alt_age_s, most_mps)
        else:
            errors = self._noise.get(report.source, self._noise_settings.default)
        return Fix(report.uav, sender_ns, t_ns, report.t_ns, position, velocity, errors, report)

    def _carrier_attitude(self, attitude: Attitude) -> list[Output]:
        outputs: list[Output] = []
        stamp = self._stamp(attitude.source, attitude.t_ns, attitude.boot_ms, outputs)
        if stamp is not None and (self._attitude is None or stamp.sender_ns > self._attitude[0]):
            self._attitude = (stamp.sender_ns, attitude)
        return outputs

    def _tick(self, tick: Tick) -> list[Output]:
        self.updates += 1
        dropped = self._drop_silent(tick.t_ns) if self.updates % DROP_EVERY == 0 else []
        self.last_update = self.look(tick.t_ns)
        return [*dropped, *self._state_changes(self.last_update), self.last_update]

    def _drop_silent(self, now_ns: int) -> list[Notice]:
        """Whoever has not been heard for long takes no more memory, and no time of any update."""
        for_s, notices = self.settings.tracks.dropped_s, []
        for uav in self._fleet.silent(now_ns, for_s):
            text = f"{uav} is dropped: nothing of it for {for_s:.0f} s"
            if self.is_target(uav):
                notices.append(Notice(now_ns, Severity.INFO, uav, text))
            self._restart(uav)
        for name in list(self._clocks)[: max(0, len(self._clocks) - CLOCKS_MAX)]:
            if self._fleet.newest(name) is None:
                del self._clocks[name]
        return notices

    def _state_changes(self, update: Update) -> list[Notice]:
        """One notice for each target, or the carrier, whose state is another than at the last tick.

        Passing traffic comes and goes without a word.
        """
        now_ns = update.t_ns
        states = {track.uav: track.state for track in update.tracks}
        if self._carrier_id is not None:
            states |= self._fleet.states(now_ns, [self._carrier_id])
        changed = [uav for uav, state in states.items() if self._states.get(uav) is not state]
        self._states = states
        notices = []
        for uav in changed:
            bad = states[uav] in (TrackState.STALE, TrackState.LOST)
            severity = Severity.WARNING if bad else Severity.INFO
            notices.append(Notice(now_ns, severity, uav, f"{uav} is {states[uav]}"))
        return notices

    # --- looking ----------------------------------------------------------------------------

    def look(self, now_ns: int, lead_s: float = 0.0) -> Update:
        """Targets and beams at the actuation delay and ``lead_s`` from now. Changes nothing."""
        delay_s = self.settings.beams.actuation_delay_s + lead_s
        valid_at_ns = now_ns + round(delay_s * 1e9)
        tracks = self._tracks(filter(self.is_target, self._targets), now_ns, valid_at_ns)
        found = self.carrier(now_ns, valid_at_ns)
        known, unfit = (None, found) if isinstance(found, str) else (found, None)
        beams = aim(now_ns, valid_at_ns, tracks, known, self.array, self.precoder, self.coverage)
        return Update(now_ns, known, unfit, tuple(tracks), beams)

    def tracks(self, now_ns: int, valid_at_ns: int) -> list[Track]:
        """Every UAV heard of, target or not, at a time; the carrier is not among them."""
        others = [uav for uav in self._fleet.uavs if uav != self._carrier_id]
        return self._tracks(others, now_ns, valid_at_ns)

    def _tracks(self, uavs: Iterable[str], now_ns: int, valid_at_ns: int) -> list[Track]:
        found = (self._fleet.track(uav, now_ns, valid_at_ns) for uav in uavs)
        return [track for track in found if track is not None]

    def _telemetry_near(self, relayed: Fix) -> list[Track]:
        """What reports itself and was last heard of near a relayed position, at its time."""
        near = []
        for uav in self._clocks:
            newest = self._fleet.newest(uav)
            if newest is not None:
                offset = newest.position_ned_m - relayed.position_ned_m
                if offset @ offset < NEAR_M**2:
                    near.append(uav)
        return self._tracks(near, relayed.t_ns, relayed.t_ns)

    def reporters(self) -> list[Source]:
        """Who reports its own position, the carrier among them."""
        return [Source.parse(uav) for uav in self._fleet.uavs if not uav.startswith("icao:")]

    def link_share(self, link: str) -> LinkShare:
        """What a link has brought of the reports so far."""
        return self._dedupe.shares.get(link) or LinkShare()

    def same_as(self, uav: str) -> str | None:
        """The telemetry track that a relayed aircraft is; None if it is itself."""
        return self._identities.same_as(uav)

    def is_target(self, uav: str) -> bool:
        """Whether beams are wanted for it: not for the carrier, for ADS-B traffic only if asked."""
        if uav == self._carrier_id or self.same_as(uav) is not None:
            return False
        return self.settings.beams.targets == "all" or not uav.startswith("icao:")

    def geodetic(self, position_ned_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude and longitude in degrees and height in metres of local points, (N, 3).

        ``ValueError`` before the first report, when there are no local points.
        """
        if self.local is None:
            raise ValueError("no report yet, so there is no local frame")
        return self.local.geodetic(position_ned_m)

    def newest(self, uav: str) -> Fix | None:
        """The newest accepted report of a UAV or of the carrier."""
        return self._fleet.newest(uav)

    @property
    def center(self) -> Center:
        """What carries the array, ``home`` resolved once it is known."""
        return self._center

    def carrier(self, now_ns: int, valid_at_ns: int) -> Carrier | str:
        """Where the array is and how it is turned, or why that is not known."""
        at = self._center
        if self.local is None:
            return "no report yet"
        if isinstance(at, FixedCenter):
            place = (at.lat_deg, at.lon_deg, at.alt_m)
            return carrier.fixed(valid_at_ns, self.local, place, np.radians(at.heading_deg))
        vehicle = str(at)
        track = self._fleet.track(vehicle, now_ns, valid_at_ns)
        newest = self._fleet.newest(vehicle)
        if track is None or newest is None:
            return f"no position from the carrier {vehicle}"
        if track.state not in AIMABLE:
            return f"the carrier {vehicle} is {track.state}"
        if self._attitude is None:
            return f"no attitude from the carrier {vehicle}"
        made_ns, attitude = self._attitude
        if (
            self._sender_time(vehicle, now_ns).sender_ns - made_ns
            > self.settings.tracks.coasting_s * 1e9
        ):
            return f"the attitude of the carrier {vehicle} is too old"
        since_ns = self._sender_time(vehicle, valid_at_ns).sender_ns - made_ns
        bound_rad = np.radians(self.settings.center.attitude_bound_deg)
        return carrier.moving(self.local, track, newest, attitude, since_ns, bound_rad)
