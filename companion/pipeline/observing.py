"""Measurements of the array's receiver, on their way from events to beams.

Joins what the other parts know - the carrier's pose, the UAVs' tracks, their clocks - with what the
array sees. Raises nothing: a measurement that cannot be used is a rejection with its reason.

Over 300 lines: the way of a measurement, from the event to the beam.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from companion.beams.aim import SeenDirection
from companion.beams.array import steering
from companion.beams.array.geometry import Array
from companion.beams.worth.directions_by_power import possible_directions
from companion.pipeline import assumptions
from companion.pipeline.array_compass import ArrayCompass
from companion.pipeline.center import CarrierTracker
from companion.pipeline.power_beams import POWERS_PER_S, PowerBeams
from companion.pipeline.records import UavRecords
from companion.pipeline.senders import Senders
from companion.pipeline.sighted_uavs import Measured, SightedUavs
from companion.pipeline.snapshots import ReportedCarrier, UavSnapshot
from companion.settings.model import Settings
from companion.tracking.extrapolated import ExtrapolatedAttitude
from companion.tracking.relative import Relative, relative
from companion.tracking.tracker import Tracker
from companion.values import Cap, Carrier, Observation, Output, Reason, Refuted, Rejection, Track

SeenDirections = Callable[[Sequence[Track]], dict[str, SeenDirection]]
"""Function from the UAVs' tracks at the time of use to the directions in which UAVs are seen."""


class Observing:
    """Measurements of the array's receiver, and what follows from them."""

    def __init__(
        self,
        *,
        settings: Settings,
        array: Array,
        center: CarrierTracker,
        senders: Senders,
        tracker: Tracker,
        records: UavRecords,
    ) -> None:
        self._settings = settings.observations
        self._array = array
        self._center = center
        self._senders = senders
        self._tracker = tracker
        self._records = records
        self.power_beams = PowerBeams(settings, array)
        self.uavs = SightedUavs(settings.observations, array.array_from_body)
        bound_rad = 0.0 if center.vehicle is None else center.attitude_bound_rad
        self.compass = ArrayCompass(settings.observations, self.uavs, bound_rad)

    # --- input ------------------------------------------------------------------------------

    def add(self, event: Observation) -> list[Output]:
        """Process a measurement."""
        why = self._unusable(event)
        if why is not None:
            return [Rejection(t_ns=event.t_ns, source=event.uav, reason=why)]
        found = self._measured(event) if event.is_direction else self._measured_by_powers(event)
        if found is None:
            return []
        if isinstance(found, Rejection):
            return [found]
        self.uavs.add(event.uav, found)
        return self._settle(event.t_ns, only=event.uav)

    @staticmethod
    def _measured(event: Observation) -> Measured:
        assert event.azimuth_rad is not None and event.elevation_rad is not None
        assert event.bound_rad is not None
        (towards,) = steering.unit_directions(
            np.array([event.azimuth_rad]), np.array([event.elevation_rad])
        )
        return Measured(
            t_ns=event.measured_ns,
            direction=towards,
            bound_rad=event.bound_rad,
            time_bound_s=event.time_bound_ns * 1e-9,
        )

    def _measured_by_powers(self, event: Observation) -> Measured | Rejection | None:
        """Return the direction that powers show; None if they show no more than is known.

        Only directions in which the reported positions, within their bounds, allow the UAV to be
        are considered.
        """
        rejected = partial(Rejection, t_ns=event.t_ns, source=event.uav)
        weights = self.power_beams.weights(event)
        if isinstance(weights, str):
            return rejected(reason=Reason.MALFORMED, detail=weights)
        record = self.uavs.get(event.uav)
        if record is not None and record.is_refuted:
            return rejected(reason=Reason.CONTRADICTED_BY_ARRAY)
        within = self._reported_directions(event)
        if within is None:
            return None
        if not self.power_beams.has_room(event.t_ns):
            limit = f"more than {POWERS_PER_S:.0f} observations of powers a second"
            return rejected(reason=Reason.TOO_FREQUENT, detail=limit)
        assert event.power_bound_db is not None
        cap = possible_directions(
            self._array,
            within,
            weights=weights,
            powers_db=np.array(event.powers_db),
            bound_db=event.power_bound_db,
        )
        if cap is None:
            degrees = math.degrees(within.radius_rad)
            why = f"no direction within {degrees:.1f}° of the reported one explains the powers"
            return rejected(reason=Reason.OUTLIER, detail=why)
        if cap.radius_rad >= within.radius_rad:
            return None
        return Measured(
            t_ns=event.measured_ns,
            direction=cap.center,
            bound_rad=cap.radius_rad,
            time_bound_s=event.time_bound_ns * 1e-9,
        )

    def _reported_directions(self, event: Observation) -> Cap | None:
        """Return the directions in which a UAV can be by its report at a measurement, array frame.

        By the reported attitude without corrections, which measurements have not changed, and the
        whole bound on its error. None if the report says nothing.
        """
        reported = self.reported(event.t_ns, event.measured_ns)
        near = self._place(event.uav, event.t_ns, event.measured_ns, reported)
        pose = self._pose(event.measured_ns, nearest=False)
        if near is None or pose is None or isinstance(reported, str):
            return None
        carrier = reported.carrier
        misaligned = carrier.attitude_bound_rad - carrier.extrapolation_rad
        spread = max(misaligned, self.compass.bound_rad) + self.uavs.aged_rad(pose)
        spread += near.reported.radius_rad + near.swept_rad(event.time_bound_ns * 1e-9)
        array_from_local = self._array.array_from_body @ pose.body_from_local
        return Cap(array_from_local @ near.reported.center, min(spread, math.pi))

    def _unusable(self, event: Observation) -> Reason | None:
        oldest_ns = round(self._settings.oldest_s * 1e9)
        if not -event.time_bound_ns <= event.t_ns - event.measured_ns <= oldest_ns:
            return Reason.WRONG_TIME
        if event.uav == self._center.vehicle or event.uav not in self._tracker:
            return Reason.UNKNOWN_UAV
        return None if self._has_pose else Reason.NO_POSE

    @property
    def _has_pose(self) -> bool:
        vehicle = self._center.vehicle
        if vehicle is None:
            return self._center.local is not None
        return self._center.has_attitude and self._tracker.newest(vehicle) is not None

    def attitude_reported(self, now_ns: int) -> list[Output]:
        """Place measurements by a new attitude of the carrier."""
        if not self.uavs:
            return []
        if self._center.is_contradicted:
            self.forget_all()
            return []
        return self._settle(now_ns)

    def forget(self, uav: str) -> None:
        """Forget a UAV whose track is dropped or restarted; all of them, if it is the carrier."""
        if uav == self._center.vehicle:
            self.forget_all()
        self.uavs.forget(uav)

    def forget_all(self) -> None:
        """Forget everything: the error of reported attitudes may have jumped."""
        self.uavs.clear()
        self.compass.forget()

    def _settle(self, now_ns: int, only: str | None = None) -> list[Output]:
        """Place measurements by the newest attitude: of all UAVs, or of one."""
        now = self._senders.stamp_time(self._center.vehicle or "", now_ns)
        newest_ns = self._center.newest_attitude_ns(now)
        if newest_ns is None:
            return []
        ready = self.uavs.ready(newest_ns, only)
        if not ready:
            return []
        times = dict.fromkeys(one.t_ns for _, one in ready)  # a receiver measures several UAVs
        poses = {at_ns: self._pose(at_ns, nearest=True) for at_ns in times}
        reported = {at_ns: self.reported(now_ns, at_ns) for at_ns in times}
        said, bounds = list[Output](), self.compass.bounds
        for uav, one in ready:
            near = self._place(uav, now_ns, one.t_ns, reported[one.t_ns])
            pose = poses[one.t_ns]
            if near is None or pose is None:
                continue
            if not self.uavs.join(uav, one, pose=pose, near=near, bounds=bounds):
                said.append(Rejection(t_ns=now_ns, source=uav, reason=Reason.OUTLIER))
        return said

    def update(self, now_ns: int) -> list[Output]:
        """Estimate the error of the carrier's attitude, and judge the UAVs' positions."""
        if not self.uavs and self.compass.error is None:
            return []
        found = self.reported(now_ns, now_ns)
        if isinstance(found, str):
            return []
        bound_rad = found.carrier.attitude_bound_rad - found.carrier.extrapolation_rad
        said: list[Output] = []
        was_raised = self.compass.is_raised
        for one in self.compass.update(now_ns, found.carrier, bound_rad):
            if isinstance(one, Refuted):
                said += assumptions.notices(self._records, one)
            else:
                said.append(one)
        if was_raised and not self.compass.is_raised:
            said.append(assumptions.attitude_bound_restored(self._records, now_ns, bound_rad))
        return said

    def is_refuted(self, uav: str) -> bool:
        """Return whether the array sees a UAV elsewhere than it reports."""
        record = self.uavs.get(uav)
        return record is not None and record.is_refuted

    # --- the carrier ------------------------------------------------------------------------

    def carrier(self, now_ns: int, valid_at_ns: int) -> Carrier | str:
        """Return position and attitude of the array, or the reason why they are unknown."""
        found = self.reported(now_ns, valid_at_ns)
        return found if isinstance(found, str) else self.compass.corrected(found.carrier)

    def reported(self, now_ns: int, valid_at_ns: int) -> ReportedCarrier | str:
        """Return the carrier as it reports itself, or the reason why its pose is unknown."""
        vehicle = self._center.vehicle
        if vehicle is None:
            found = self._center.station(valid_at_ns)
            return found if isinstance(found, str) else ReportedCarrier(carrier=found)
        track = self._tracker.track(vehicle, now_ns, self._senders.time(vehicle, valid_at_ns))
        now, at = (self._senders.stamp_time(vehicle, t_ns) for t_ns in (now_ns, valid_at_ns))
        newest, turn_degps2 = self._tracker.newest(vehicle), self._turn_degps2(vehicle)
        found = self._center.on_vehicle(track, newest, now, at, turn_degps2)
        if isinstance(found, str):
            return found
        return ReportedCarrier(
            carrier=found,
            track=track,
            fix=newest,
            turn_acceleration_radps2=math.radians(turn_degps2),
        )

    def _turn_degps2(self, vehicle: str) -> float:
        return self._senders.assumed(vehicle).turn_degps2

    def _pose(self, at_ns: int, *, nearest: bool) -> ExtrapolatedAttitude | None:
        vehicle = self._center.vehicle
        if vehicle is None:
            return self._center.fixed_pose(at_ns)
        newest, at = self._tracker.newest(vehicle), self._senders.stamp_time(vehicle, at_ns)
        return self._center.pose(newest, at, self._turn_degps2(vehicle), nearest=nearest)

    def _place(
        self, uav: str, now_ns: int, at_ns: int, reported: ReportedCarrier | str
    ) -> Relative | None:
        """Return a UAV's position relative to the array; None if either is unknown."""
        track = self._tracker.snapshot(uav)
        if track is None or isinstance(reported, str):
            return None
        snapshot = UavSnapshot(track, self._senders.timeline(uav))
        return self._relative(snapshot, snapshot.at(now_ns, at_ns), reported)

    def _relative(
        self, snapshot: UavSnapshot, track: Track, reported: ReportedCarrier
    ) -> Relative | None:
        return relative(
            track,
            snapshot.track.fix,
            carrier=reported.carrier,
            carrier_track=reported.track,
            carrier_fix=reported.fix,
            lever_ned_m=reported.carrier.body_from_local.T @ self._array.lever_arm_m,
            turn_acceleration_radps2=reported.turn_acceleration_radps2,
        )

    # --- looks ------------------------------------------------------------------------------

    def seen_directions(
        self, snapshots: Sequence[UavSnapshot], valid_at_ns: int, reported: ReportedCarrier | str
    ) -> SeenDirections | None:
        """Return where the array sees UAVs at a time, as a function for any thread.

        None if it sees none.
        """
        if not self.uavs or isinstance(reported, str):
            return None
        looks = self.compass.looks((one.track.fix.uav for one in snapshots), reported.carrier)
        times = {one.t_ns for look in looks.each.values() for one in look.pending}
        poses = {t_ns: self._pose(t_ns, nearest=False) for t_ns in (*times, valid_at_ns)}
        pose, follows = poses[valid_at_ns], self._settings.follow

        def seen_directions(tracks: Sequence[Track]) -> dict[str, SeenDirection]:
            near, unbounded = dict[str, Relative](), dict[str, SeenDirection]()
            if pose is None:
                return unbounded
            for snapshot, track in zip(snapshots, tracks, strict=True):
                look = looks.each.get(track.uav)
                if look is None:
                    continue
                if look.is_refuted and not follows:
                    unbounded[track.uav] = SeenDirection(None)
                    continue
                at = self._relative(snapshot, track, reported)
                if at is not None:
                    near[track.uav] = at
            return unbounded | self.uavs.directions(looks, near, pose=pose, pose_at=poses.get)

        return seen_directions
