"""What the array's receiver measured of each UAV, and in which directions UAVs may be by it.

Measurements are pending until an attitude is reported that was measured after them; then they are
placed by the nearest attitude and join their UAV's ``Sightings``. Between two attitudes the carrier
turns by its reported rates, within its largest angular acceleration. See docs/math.md 5.7.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from companion.beams.aim import SeenDirection
from companion.settings.observations import ObservationSettings
from companion.tracking.compass import Misalignment
from companion.tracking.extrapolated import ExtrapolatedAttitude
from companion.tracking.likely_error import LikelyError
from companion.tracking.moved_caps import Caps, Motion, moved_caps
from companion.tracking.relative import ErrorBounds, Relative
from companion.tracking.sightings import CONFIRMED, WINDOW, Guide, Sightings, possible
from companion.values import Cap, FloatArray

MEMORY_S: Final = 3.0  # time constant with which measurements of the likely error are forgotten
ANY_DIRECTION: Final = Cap(np.array([1.0, 0.0, 0.0]), math.pi)
PENDING_MAX: Final = WINDOW  # most measurements of a UAV that wait for an attitude


class Measured(NamedTuple):
    """Measured direction that waits for an attitude: when, where in the array frame, how exact."""

    t_ns: int
    direction: FloatArray
    bound_rad: float
    time_bound_s: float


@dataclass(slots=True, kw_only=True)
class SightedUav:
    """What the array saw of one UAV; the values in it are immutable.

    latest           its position relative to the array, and the attitude, at the newest sighting
    contradicted_ns  since when it is seen elsewhere than it reports; None: it is not
    agrees_ns        since when it is not
    """

    sightings: Sightings | None = None
    latest: tuple[Relative, ExtrapolatedAttitude] | None = None
    pending: tuple[Measured, ...] = ()
    contradicted_ns: int | None = None
    agrees_ns: int | None = None
    is_refuted: bool = False


class Look(NamedTuple):
    """Snapshot of what the array saw of one UAV, for any thread."""

    sightings: Sightings | None
    pending: tuple[Measured, ...]
    is_refuted: bool


class Looks(NamedTuple):
    """Snapshot of what the array saw of some UAVs, for any thread.

    each       by UAV
    error      error of reported attitudes
    bounds     bounds on its angle
    likely     its likely rotation, (3, 3), local frame
    """

    each: dict[str, Look]
    error: Misalignment
    bounds: ErrorBounds
    likely: FloatArray


PoseAt = Callable[[int], ExtrapolatedAttitude | None]
"""Attitude at a time; None if it is unknown."""


class SightedUavs:
    """What the array saw of all UAVs.

    array_from_body  mount of the array, (3, 3)
    """

    def __init__(self, settings: ObservationSettings, array_from_body: FloatArray) -> None:
        self._outliers = settings.outliers
        self._drift_radps = math.radians(settings.drift_max_degps)
        self._array_from_body = array_from_body
        self._uavs: dict[str, SightedUav] = {}
        self.likely = LikelyError(MEMORY_S)
        self.used = 0  # measurements that agreed with the others of their UAV

    def __bool__(self) -> bool:
        return bool(self._uavs)

    def __iter__(self) -> Iterator[tuple[str, SightedUav]]:
        return iter(self._uavs.items())

    def get(self, uav: str) -> SightedUav | None:
        """Return what was seen of a UAV; None if nothing was."""
        return self._uavs.get(uav)

    def forget(self, uav: str) -> None:
        """Forget a UAV whose track is dropped or restarted."""
        self._uavs.pop(uav, None)

    def forget_directions(self, uav: str) -> None:
        """Forget the directions in which a UAV was seen, which contradict one another."""
        record = self._uavs[uav]
        record.sightings = record.latest = None

    def clear(self) -> None:
        """Forget all UAVs."""
        self._uavs.clear()
        self.likely = LikelyError(MEMORY_S)

    def add(self, uav: str, measured: Measured) -> None:
        """Add a measurement of a UAV."""
        record = self._uavs.get(uav)
        if record is None:
            record = self._uavs.setdefault(uav, SightedUav())
        record.pending = (*record.pending[1 - PENDING_MAX :], measured)

    def ready(self, newest_ns: int, uav: str | None = None) -> list[tuple[str, Measured]]:
        """Remove and return the measurements that an attitude of ``newest_ns`` can place.

        uav  whose measurements; None: of all UAVs
        """
        found = list[tuple[str, Measured]]()
        for name in self._uavs if uav is None else (uav,):
            record = self._uavs[name]
            if not record.pending or record.pending[0].t_ns > newest_ns:
                continue
            found += [(name, one) for one in record.pending if one.t_ns <= newest_ns]
            record.pending = tuple(one for one in record.pending if one.t_ns > newest_ns)
        return found

    def join(
        self,
        uav: str,
        one: Measured,
        *,
        pose: ExtrapolatedAttitude,
        near: Relative,
        bounds: ErrorBounds,
    ) -> bool:
        """Add a measurement to a UAV's sightings. Returns whether it agrees with them.

        pose       the carrier's attitude at that time
        near       the UAV's position relative to the array then
        bounds     bounds on the error of reported attitudes
        """
        record = self._uavs[uav]
        cap = self._placed(one, pose, near, self.aged_rad(pose))
        before, latest = record.sightings, record.latest
        if before is None or latest is None:
            record.sightings, record.latest = Sightings.of(one.t_ns, cap), (near, pose)
            return True
        turned_rad = pose.turned_from(latest[1])
        forward = one.t_ns >= before.t_ns
        first_ns, last_ns = (before.t_ns, one.t_ns) if forward else (one.t_ns, before.t_ns)
        motion = self._motion(near, first_ns, last_ns, bounds, turned_rad)
        if forward:
            before = before.moved(one.t_ns, motion)
            record.latest = near, pose
        else:
            later = Sightings.of(one.t_ns, cap).moved(before.t_ns, motion)
            cap = Cap(later.caps.centers[0], float(later.caps.radii_rad[0]))
        if before.contradicts(cap, self._outliers):
            record.sightings = before.against(cap)
            return False
        self.used += 1
        record.sightings = before.with_cap(cap)
        if forward and record.contradicted_ns is None:
            self.likely.add(
                one.t_ns,
                body_from_local=pose.body_from_local,
                reported=near.reported.center,
                seen=cap.center,
                bound_rad=cap.radius_rad,
            )
        return True

    def aged_rad(self, pose: ExtrapolatedAttitude) -> float:
        """Return the bound on what a reported attitude's age adds to its error."""
        return pose.extrapolation_rad + self._drift_radps * abs(pose.age_s)

    def _placed(
        self, one: Measured, pose: ExtrapolatedAttitude, near: Relative, extrapolation_rad: float
    ) -> Cap:
        """Return a measurement as directions in the local frame."""
        local_from_array = (self._array_from_body @ pose.body_from_local).T
        radius = one.bound_rad + extrapolation_rad + near.swept_rad(one.time_bound_s)
        return Cap(local_from_array @ one.direction, min(radius, math.pi))

    def _motion(
        self, near: Relative, from_ns: int, to_ns: int, bounds: ErrorBounds, turned_rad: float
    ) -> Motion:
        drifted = self._drift_radps * abs(to_ns - from_ns) * 1e-9
        return near.motion(
            from_ns=from_ns,
            to_ns=to_ns,
            turned_rad=turned_rad,
            misaligned=bounds,
            drifted_rad=drifted,
        )

    def directions(
        self,
        looks: Looks,
        near: Mapping[str, Relative],
        *,
        pose: ExtrapolatedAttitude,
        pose_at: PoseAt,
    ) -> dict[str, SeenDirection]:
        """Return the directions in which UAVs are, array frame, by UAV.

            near      positions of UAVs relative to the array at the time of the beam
            pose      the reported attitude then
            pose_at   that of another time, by the same report

        A UAV is missing if its measurements say nothing, or if those that were not placed yet or
        have no other beside them contradict the rest. Without a cap, nothing bounds the error: the
        others contradict one another, or the reported position.
        """
        carried = {
            uav: parts
            for uav, at in near.items()
            if (parts := list(self._carried(looks, uav, at, pose=pose, pose_at=pose_at)))
        }
        if not carried:
            return {}
        every = [part for parts in carried.values() for part in parts]
        centers, radii = moved_caps([caps for caps, _ in every], [motion for _, motion in every])
        many, guides, last = list[Caps](), list[Guide | None](), 0
        for uav, parts in carried.items():
            first, last = last, last + sum(len(caps.radii_rad) for caps, _ in parts)
            kept = slice(max(first, last - WINDOW), last)
            many.append(Caps(centers[kept], radii[kept]))
            guides.append(self._guide(looks, uav, near[uav].reported, self.aged_rad(pose)))
        array_from_local = self._array_from_body @ pose.body_from_local
        found = dict[str, SeenDirection]()
        around = possible(many, self._outliers, guides)
        for uav, caps, guide, cap in zip(carried, many, guides, around, strict=True):
            waiting = len(carried[uav]) - (looks.each[uav].sightings is not None)
            seen = cap or self._possible_by_placed(caps.without_newest(waiting), guide)
            if seen is None:
                found[uav] = SeenDirection(None)
            elif seen.radius_rad < math.pi / 2:
                in_array = Cap(array_from_local @ seen.center, seen.radius_rad)
                found[uav] = SeenDirection(in_array, looks.each[uav].is_refuted)
        return found

    def _possible_by_placed(self, caps: Caps, guide: Guide | None) -> Cap | None:
        """Return the possible directions by caps that were compared with one another.

        Any direction, if there are too few to contradict anything.
        """
        if len(caps.radii_rad) < CONFIRMED:
            return ANY_DIRECTION
        (cap,) = possible([caps], self._outliers, [guide])
        return cap

    @staticmethod
    def _guide(looks: Looks, uav: str, reported: Cap, aged_rad: float) -> Guide | None:
        """Return where a UAV may be by its reported position; None if that is not used."""
        if looks.each[uav].is_refuted:
            return None
        spread = min(reported.radius_rad + looks.error.bound_rad + aged_rad, math.pi)
        within = Cap(looks.error.center @ reported.center, spread)
        return Guide(within, looks.likely @ reported.center)

    def _carried(
        self, looks: Looks, uav: str, near: Relative, *, pose: ExtrapolatedAttitude, pose_at: PoseAt
    ) -> Iterator[tuple[Caps, Motion]]:
        """Yield caps of a UAV, oldest first, and their motion to the time of a beam."""
        to_ns, look = near.t_ns, looks.each[uav]
        if look.sightings is not None:
            before = look.sightings
            turned_rad = near.turned_rad(abs(to_ns - before.t_ns) * 1e-9)
            motion = self._motion(near, before.t_ns, to_ns, looks.bounds, turned_rad)
            yield before.caps, replace(motion, turned_rad=motion.turned_rad + self.aged_rad(pose))
        for one in look.pending:
            at = pose_at(one.t_ns)
            if at is None:
                continue
            cap = self._placed(one, at, near, pose.extrapolated_since(at))
            turned_rad = pose.turned_from(at) + pose.extrapolated_since(at)
            motion = self._motion(near, one.t_ns, to_ns, looks.bounds, turned_rad)
            yield Caps.of(cap), motion
