"""The whole program as a function from events to outputs, for live service, replay and tests.

Pure and synchronous. Time comes with the events; the same events always give the same outputs and
the same digest. A report passes through these parts in order:

1. ``senders``: its sender and its time; or why it is rejected;
2. ``center``: its position in the local frame;
3. ``tracker``: its track and the estimate;

and a relayed aircraft's report also goes to ``targets``, which returns nothing. A tick takes the
tracks that ``targets`` selects from ``tracker`` and the array from ``center``, and computes the
beams. A split tick does so in two steps; events received meanwhile come between it and its
``Tock``.

Over 300 lines: all events enter here, and all queries are answered here.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, partial
from typing import Final, NamedTuple

from companion.beams import hysteresis
from companion.beams.aim import RenewedBeam, aim, renewed, without
from companion.beams.hysteresis import Hysteresis
from companion.mavlink.clock.estimates import ClockChange, ClockEstimate, Guarantee
from companion.mavlink.wire.decode import DECODED
from companion.mavlink.wire.stamps import STAMPED
from companion.pipeline import assembly, assumptions
from companion.pipeline.blame import CarrierEvidence, LinkEvidence
from companion.pipeline.center import CarrierTracker
from companion.pipeline.digest import Digest
from companion.pipeline.health import HealthMonitor, LinkBatch
from companion.pipeline.link_gains import Site
from companion.pipeline.observing import Observing
from companion.pipeline.records import Records, UavRecord
from companion.pipeline.refusals import Refusals
from companion.pipeline.senders import NO_OUTCOME, PlacedAttitude, PlacedReport, Senders
from companion.pipeline.snapshots import UavSnapshot
from companion.pipeline.targets import Targets
from companion.settings.model import Settings
from companion.tracking.geodesy import LocalFrame
from companion.values import (
    AttitudeEvidence,
    Carrier,
    Cause,
    ClockSet,
    Duty,
    Estimate,
    Event,
    FloatArray,
    Frame,
    LeftOut,
    Notice,
    Observation,
    Output,
    Reason,
    Rejection,
    Severity,
    Source,
    Tick,
    Tock,
    Track,
    Update,
    UtcNs,
    kind_of,
)

DROP_EVERY: Final = 100
"""Number of updates between two searches for tracks without recent reports."""
PROTECTED_SHARE: Final = 4
"""Array elements needed per protected UAV of another node, since each null costs one."""
NOTICED_STEP_S: Final = 0.5
"""Least step of the wall clock for a notice; smaller steps are applied silently."""
NEAR_M: Final = 2000.0
"""Largest distance between two reports of one aircraft, whatever its speed and their latency."""


class Aiming(NamedTuple):
    """Beams of a split tick that are computed until its ``Tock``.

    made computes the beams and assesses their links, once, on the first calling thread
    local  the local frame that they are in
    """

    made: Callable[[], tuple[Update, LinkBatch | None]]
    local: LocalFrame | None


class Pipeline:
    """State of the program, from which events produce outputs.

    ``step`` takes events in the order of ``values.Event``; the other methods change nothing.
    ``aiming``: beams of a split tick that are still to be computed; None if none are pending.

    Raises ``UserError`` for settings that are inconsistent with each other.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.frames = 0
        self.updates = 0
        self.utc_offset_ns = 0
        self.restarts: Counter[str] = Counter()
        self.last_update: Update | None = None
        self.last_carrier: Carrier | None = None
        self.aiming: Aiming | None = None
        self._clock_notices = assumptions.ClockNotices()
        self._waited_s = 0.0  # for which frames may have waited for this machine at the last tick
        self._hysteresis: Hysteresis | None = None  # updated by ticks only, so that looks are pure
        self.digest = Digest()
        self.array = assembly.array(settings)
        self.coverage = assembly.coverage(settings)
        self.precoder = assembly.precoder(settings)
        self.center = CarrierTracker(settings)
        self.tracker = assembly.tracker(settings)
        self.records = Records(UavRecord, self.tracker.__contains__)
        self.refusals = Refusals(self.records)
        self.senders = Senders(
            settings=settings,
            carrier=self.center.vehicle,
            records=self.records,
            tracked=self.tracker,
        )
        self.targets = Targets(settings, self.center.vehicle)
        budget, antennas = assembly.radio(settings)
        site = Site(array=self.array, coverage=self.coverage, budget=budget, uav_antennas=antennas)
        self.health = HealthMonitor(settings.link, site, settings.beams.update_hz)
        self.observing = Observing(
            settings=settings,
            array=self.array,
            center=self.center,
            senders=self.senders,
            tracker=self.tracker,
            records=self.records,
        )

    # --- the fold ---------------------------------------------------------------------------

    def step(self, event: Event) -> list[Output]:
        """Process one event. Returns rejections, notices, estimates, and the update of a tick."""
        if isinstance(event, Frame):  # first, for speed: nearly all events are frames
            outputs = self._frame(event)
        elif isinstance(event, Tick):
            outputs = self._tick(event)
        elif isinstance(event, Tock):
            outputs = self._finish_update(event.t_ns)
        elif isinstance(event, Rejection):
            outputs = [event]
        elif isinstance(event, Duty):
            self.targets.duty, outputs = event, []
        elif isinstance(event, ClockSet):
            outputs = self._clock_set(event)
        elif isinstance(event, Observation):
            outputs = self.observing.add(event)
        else:
            change = self.senders.round_trip(event)
            source = str(event.source)
            outputs = [] if change is None else self._changed(event.t_ns, source, change)
        if not outputs:  # most frames
            return outputs
        told = []
        for output in outputs:
            if isinstance(output, Rejection):
                told.append(self.refusals.add(output))
            elif isinstance(output, (Estimate, Update)):
                self.digest.add(output)
        return [*outputs, *filter(None, told)] if told else outputs

    def _clock_set(self, event: ClockSet) -> list[Output]:
        step_s = (event.utc_offset_ns - self.utc_offset_ns) * 1e-9
        self.utc_offset_ns = event.utc_offset_ns
        self.senders.utc_is(event.utc_offset_ns)
        if abs(step_s) < NOTICED_STEP_S:
            return []
        way = "forward" if step_s > 0 else "back"
        text = f"this machine's clock was set {way} by {abs(step_s):.3f} s; UTC times now follow it"
        return [Notice(t_ns=event.t_ns, severity=Severity.WARNING, subject="clock", text=text)]

    def _frame(self, frame: Frame) -> list[Output]:
        self.frames += 1
        if frame.msgid not in DECODED:
            change = self.senders.add_stamp(frame) if frame.msgid in STAMPED else None
            return [] if change is None else self._changed(frame.t_ns, str(frame.source), change)
        heard = self.senders.hear(frame)
        if heard is NO_OUTCOME:
            return []
        if heard.restarted is not None:
            self.restarts[heard.restarted] += 1
            self._restart(heard.restarted)
        said: list[Output] = list(heard.outputs)
        if heard.change is not None:
            said += self._changed(frame.t_ns, str(frame.source), heard.change)
        if isinstance(heard.message, PlacedReport):
            said += self._report(heard.message)
        elif isinstance(heard.message, PlacedAttitude):
            turn_degps2 = self.senders.assumed(str(frame.source)).turn_degps2
            refuted, jumped = self.center.turn(heard.message, turn_degps2)
            said += [*assumptions.notices(self.records, refuted), *jumped]
            said += self.observing.attitude_reported(frame.t_ns)
        elif isinstance(heard.message, AttitudeEvidence):
            said += assumptions.notices(self.records, self.center.trust(heard.message))
        return said

    def _changed(self, t_ns: int, sender: str, change: ClockChange) -> list[Output]:
        if sender not in self.tracker:
            return []
        record, assumed = self.records[sender], self.settings.clocks
        refuted = assumptions.clock_changed(record, t_ns, sender, change, assumed)
        jump = self._clock_notices.add(t_ns, sender, change)
        return [refuted] if jump is None else [refuted, jump]

    def _report(self, placed: PlacedReport) -> list[Output]:
        report = placed.report
        begins = self.center.needs_home or report.uav not in self.tracker
        if begins and not self.senders.may_begin(report, self.center.needs_home):
            return [Rejection(t_ns=report.t_ns, source=report.uav, reason=Reason.NO_FIX)]
        said: list[Output] = self._restarted_for(self.center.move_origin(report)) if begins else []
        fix, begun = self.center.fix(placed)
        accepted, refuted = self.tracker.accept(fix)
        said += begun
        if refuted:
            said += assumptions.notices(self.records, *refuted)
        if isinstance(accepted, Rejection):
            return [*said, accepted]
        fix = accepted.fix  # with bounds that reports have raised
        self.refusals.used(fix.uav)
        if not kind_of(fix.uav).reports_itself:
            better = self.tracker.near(fix.position_ned_m, NEAR_M, better_than=fix.uav)
            near = self.targets.unmerged(better)
            tracks = [one.at(fix.t_ns, fix.t_ns) for one in self.snapshots(near)]
            same_as = self.targets.identities.observe(fix, tracks)
            if same_as is not None:
                text = (
                    f"{fix.uav}: is where {same_as} is, within the errors of both, and counts as"
                    " the same aircraft: it has no beam of its own"
                )
                said.append(
                    Notice(t_ns=fix.arrival_ns, severity=Severity.INFO, subject=fix.uav, text=text)
                )
        if accepted.reacquired:
            said.append(assumptions.track_restarted(self.records[fix.uav], accepted))
            # Its height may have been wrong when it set the origin.
            said += self._restarted_for(self.center.moved(placed, accepted))
            text = f"{fix.uav}: track restarted: its reports agree, but not with the old track"
            return [
                *said,
                Notice(t_ns=fix.arrival_ns, severity=Severity.WARNING, subject=fix.uav, text=text),
                accepted,
            ]
        return [*said, accepted]

    def _restarted_for(self, moved: Notice | None) -> list[Output]:
        """Restart all tracks if the origin of the local frame was moved."""
        if moved is None:
            return []
        for uav in self.tracker.uavs:
            self._restart(uav)
        return [moved]

    def _restart(self, uav: str) -> None:
        self.records.pop(uav, None)
        self.tracker.forget(uav)
        self.observing.forget(uav)
        self.center.restarted(uav)

    def _tick(self, tick: Tick) -> list[Output]:
        self._waited_s = tick.waited_ns * 1e-9
        dropped = self._drop_silent(tick.t_ns) if (self.updates + 1) % DROP_EVERY == 0 else []
        seen = self.observing.update(tick.t_ns)
        made = self._aimed_of(self.prepare_update(tick.t_ns))
        self.aiming = Aiming(cache(made) if tick.in_two else made, self.local)
        said = [*dropped, *seen]
        return said if tick.in_two else [*said, *self._finish_update(tick.t_ns)]

    def _finish_update(self, now_ns: int) -> list[Output]:
        """Adopt the computed beams of the last tick, and assess the links.

        Recompute the beams if the local frame was re-anchored meanwhile.
        """
        aiming, self.aiming = self.aiming, None
        if aiming is None:
            return []
        self.updates += 1
        is_old = aiming.local is not self.local
        made = self._aimed_of(self.prepare_update(now_ns)) if is_old else aiming.made
        self.last_update, weighed = made()
        self.observing.power_beams.add_update(self.updates - 1, self.last_update.beams.weights)
        self.last_carrier = self.last_update.carrier or self.last_carrier
        self._hysteresis = hysteresis.updated(self._hysteresis, self.last_update.beams)
        states = {track.uav: track.state for track in self.last_update.tracks}
        if self.center.vehicle is not None:
            now = self.senders.time(self.center.vehicle, now_ns)
            state = self.tracker.state(self.center.vehicle, now)
            states |= {} if state is None else {self.center.vehicle: state}
        said = self.targets.changes(now_ns, states)

        @cache
        def carrier() -> CarrierEvidence:
            return self._carrier_evidence(now_ns)

        evidence = partial(self._evidence, now_ns, carrier)
        judged = self.health.judge(self.last_update, weighed, evidence)
        changed = self._clock_notices.due(now_ns)
        return [*said, *judged, *([changed] if changed else ()), self.last_update]

    def _aimed_of(
        self, make: Callable[[], Update]
    ) -> Callable[[], tuple[Update, LinkBatch | None]]:
        def made() -> tuple[Update, LinkBatch | None]:
            update = make()
            return update, self.health.next_batch(update)

        return made

    def _evidence(
        self, now_ns: int, carrier: Callable[[], CarrierEvidence], uav: str
    ) -> LinkEvidence:
        return LinkEvidence(
            clock_assumed=self._is_assumed(uav),
            refused=self.refusals.current_rejection(uav, now_ns),
            waited_s=self._waited_s,
            carrier=carrier(),
            is_contradicted=self.observing.is_refuted(uav),
            dead_reckoning_s=self.senders.dead_reckoning_s(uav, now_ns),
            receiver_difference=self.senders.receiver_difference(uav),
        )

    def _carrier_evidence(self, now_ns: int) -> CarrierEvidence:
        vehicle = self.center.vehicle
        if vehicle is None:
            return CarrierEvidence()
        at = self.senders.stamp_time(vehicle, now_ns)
        turn_degps2 = self.senders.assumed(vehicle).turn_degps2
        attitude = self.center.attitude_parts(at, turn_degps2, self._waited_s)
        carrier = self.last_update.carrier if self.last_update is not None else None
        if carrier is not None and self.observing.compass.error is not None:
            error_rad = carrier.attitude_bound_rad - carrier.extrapolation_rad
            attitude = replace(attitude, error_rad=error_rad)
        return CarrierEvidence(
            attitude=attitude,
            attitude_age_s=self.center.attitude_age_s(at),
            clock_assumed=self._is_assumed(vehicle),
            refused=self.refusals.current_rejection(vehicle, now_ns),
            dead_reckoning_s=self.senders.dead_reckoning_s(vehicle, now_ns),
        )

    def _is_assumed(self, sender: str) -> bool:
        clock = self.clock_estimate(sender)
        return clock is not None and clock.guarantee is Guarantee.ASSUMED

    def _drop_silent(self, now_ns: int) -> list[Notice]:
        silent = self.tracker.silent(now_ns, self.settings.tracks.dropped_s)
        dropped = self.targets.dropped(now_ns, silent)
        for uav in silent:
            self._restart(uav)
            self.targets.forget(uav)
        self.senders.forget_silent(now_ns)
        return dropped

    # --- queries ----------------------------------------------------------------------------

    @property
    def newest_number(self) -> int | None:
        """Number of ``last_update``: updates are counted from 0; None before the first."""
        return self.updates - 1 if self.updates else None

    def look(self, now_ns: int, lead_s: float = 0.0) -> Update:
        """Return targets and beams for ``lead_s`` plus the actuation delay. Changes nothing."""
        return self.prepare_update(now_ns, lead_s)()

    def renewed(self, uav: str, now_ns: int) -> RenewedBeam | None:
        """Aim the beam of one UAV of ``last_update`` again. Changes nothing.

        None if that is not possible: then the next update decides.
        """
        update = self.last_update
        if update is None or uav not in self.tracker or self.targets.protected(self.tracker.uavs):
            return None
        valid_at_ns = now_ns + round(self.settings.beams.actuation_delay_s * 1e9)
        found = self.observing.reported(now_ns, valid_at_ns)
        if isinstance(found, str):
            return None
        snapshots = self.snapshots([uav])
        seen = self.observing.seen_directions(snapshots, valid_at_ns, found)
        tracks = [one.at(now_ns, valid_at_ns) for one in snapshots]
        return renewed(
            update.beams,
            tracks[0],
            now_ns=now_ns,
            valid_at_ns=valid_at_ns,
            carrier=self.observing.compass.corrected(found.carrier),
            array=self.array,
            precoder=self.precoder,
            coverage=self.coverage,
            before=self._hysteresis,
            seen_directions={} if seen is None else seen(tracks),
        )

    def prepare_update(self, now_ns: int, lead_s: float = 0.0) -> Callable[[], Update]:
        """Select the UAVs now, and return a function that computes the beams of ``look``.

        That function predicts the UAVs from snapshots. It may be called at any later time, on any
        thread.
        """
        delay_s = self.settings.beams.actuation_delay_s + lead_s
        valid_at_ns = now_ns + round(delay_s * 1e9)
        selected, others = self._selected(now_ns)
        snapshots = self.snapshots(selected)
        found = self.observing.reported(now_ns, valid_at_ns)
        known, unfit = None, None
        if isinstance(found, str):
            unfit = found
        else:
            known = self.observing.compass.corrected(found.carrier)
        seen_directions = self.observing.seen_directions(snapshots, valid_at_ns, found)
        before = self._hysteresis
        spared = self.snapshots(self.targets.protected(self.tracker.uavs))

        def made() -> Update:
            tracks = [one.at(now_ns, valid_at_ns) for one in snapshots]
            protected = self._protected([one.at(now_ns, valid_at_ns) for one in spared], known)
            beams = aim(
                now_ns,
                valid_at_ns=valid_at_ns,
                tracks=[*tracks, *protected],
                carrier=known,
                array=self.array,
                precoder=self.precoder,
                coverage=self.coverage,
                before=before,
                seen_directions={} if seen_directions is None else seen_directions(tracks),
            )
            if protected:
                beams = without(beams, {track.uav for track in protected})
            if others:
                why = f"limit of {self.settings.beams.most} UAVs with beams is reached"
                left_out = (LeftOut(uav, Cause.MACHINE, why) for uav in others)
                beams = replace(beams, left_out=(*beams.left_out, *left_out))
            return Update(
                t_ns=now_ns, carrier=known, unfit=unfit, tracks=tuple(tracks), beams=beams
            )

        return made

    def _selected(self, now_ns: int) -> tuple[list[str], list[str]]:
        """Return the targets that get beams, and those beyond ``[beams] most``."""
        wanted, most = self.targets.among(self.tracker.uavs), self.settings.beams.most
        if len(wanted) <= most:
            return wanted, []
        ranked = self.ranked(now_ns, wanted)
        selected = frozenset(ranked[:most])
        return [uav for uav in wanted if uav in selected], ranked[most:]

    def ranked(self, now_ns: int, uavs: list[str]) -> list[str]:
        """Return UAVs in the order in which they get beams if there are too many.

        Order: UAVs of ``priority``, then those with recent reports, then those tracked longest.
        """
        first = frozenset(self.settings.beams.priority)
        silent = frozenset(self.tracker.silent(now_ns, self.settings.tracks.lost_s))
        if not first and not silent:
            return uavs
        return sorted(uavs, key=lambda uav: (uav not in first, uav in silent))

    def _protected(self, tracks: list[Track], carrier: Carrier | None) -> list[Track]:
        """Return the UAVs of other nodes to protect by nulls: the nearest ones, up to a limit."""
        if carrier is None or not tracks:
            return []
        by_distance = sorted(
            tracks, key=lambda one: math.dist(one.position_ned_m, carrier.position_ned_m)
        )
        return by_distance[: self.array.size // PROTECTED_SHARE]

    def tracks(
        self, now_ns: int, valid_at_ns: int, uavs: Iterable[str] | None = None
    ) -> list[Track]:
        """Return every tracked UAV, target or not, predicted to ``valid_at_ns``, but no carrier.

        ``uavs`` limits the tracks; None: all.
        """
        others = self.tracker.uavs if uavs is None else uavs
        others = [uav for uav in others if uav != self.center.vehicle]
        return [one.at(now_ns, valid_at_ns) for one in self.snapshots(others)]

    def snapshots(self, uavs: Iterable[str]) -> list[UavSnapshot]:
        """Return snapshots of those UAVs that have a track, in the order given."""
        tracks = ((uav, self.tracker.snapshot(uav)) for uav in uavs)
        timeline = self.senders.timeline
        return [UavSnapshot(track, timeline(uav)) for uav, track in tracks if track is not None]

    def carrier(self, now_ns: int, valid_at_ns: int) -> Carrier | str:
        """Return position and attitude of the array, or the reason why they are unknown."""
        return self.observing.carrier(now_ns, valid_at_ns)

    def utc_ns(self, t_ns: int) -> UtcNs:
        """Convert a time of the node's timeline to UTC, by the current wall clock."""
        return UtcNs(t_ns + self.utc_offset_ns)

    def reporters(self) -> list[Source]:
        """Return the senders that report their own position, including the carrier."""
        return [Source.parse(uav) for uav in self.tracker.uavs if kind_of(uav).reports_itself]

    def refuted(self, uav: str) -> int:
        """Return how often assumptions about a UAV were refuted."""
        record = self.records.get(uav)
        return 0 if record is None else record.refuted

    def clock_estimate(self, uav: str) -> ClockEstimate | None:
        """Return the state of a UAV's clock; None if no clock is known."""
        return self.senders.clock_estimate(uav)

    @property
    def local(self) -> LocalFrame | None:
        """Local frame; None before the first report, unless the station is fixed."""
        return self.center.local

    def geodetic(self, position_ned_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Convert local points (N, 3) to latitude and longitude in degrees and height in metres.

        Raises ``ValueError`` before the first report, when there is no local frame.
        """
        if self.local is None:
            raise ValueError("no report yet, so there is no local frame")
        return self.local.geodetic(position_ned_m)
