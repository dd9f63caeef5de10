"""The array as a compass: directions in which UAVs are seen confine the carrier's attitude.

The set of the attitude's errors is kept by evidence alone, so that a wrong
``center.attitude_bound_deg`` is never blamed on a UAV; its part within that bound is what beams
use. See docs/math.md 5.8.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from companion.pipeline.assumptions import ARRAY, ATTITUDE_BOUND
from companion.pipeline.sighted_uavs import Look, Looks, SightedUavs
from companion.settings.observations import ObservationSettings
from companion.tracking import compass
from companion.tracking.carrier import USUAL_ATTITUDE
from companion.tracking.compass import ErrorSet, Misalignment, Seen
from companion.tracking.relative import ErrorBounds, Relative
from companion.tracking.rotations import angle_between_rad, rotation, rotation_angle_rad
from companion.tracking.sightings import Sightings, possible
from companion.values import Cap, Carrier, FloatArray, Notice, Reason, Refuted, Severity, angle_rad

UPDATE_NS: Final = 190_000_000  # least time between two estimates of the attitude's error
FRESH_NS: Final = 1_000_000_000  # age of a UAV's sightings beyond which they say nothing
FORGOTTEN_NS: Final = 10_000_000_000  # age of sightings beyond which nothing follows from them
PERSISTENT_NS: Final = 1_000_000_000
"""Time for which a UAV must be seen elsewhere than it reports until its position is refuted."""
RESTORED_NS: Final = 5_000_000_000
"""Time for which evidence must confine the error to a refuted bound until that is assumed again."""
RAISED: Final = 1.25  # multiple of a refuted bound, and of a proven error, that is assumed then
WIDEST_RAD: Final = math.radians(30.0)  # largest error of reported attitudes that is considered


class ArrayCompass:
    """Error of the carrier's reported attitudes, and UAVs whose reported positions are false.

    uavs       what the array saw of each UAV
    bound_rad  bound on the error by the settings, or larger if evidence refuted it
    """

    def __init__(self, settings: ObservationSettings, uavs: SightedUavs, bound_rad: float) -> None:
        self._settings = settings
        self._drift_radps = math.radians(settings.drift_max_degps)
        self._uavs = uavs
        self._raised_rad = 0.0
        self._raised_by = 0  # UAVs whose directions refuted the bound
        self._holds_since_ns: int | None = None  # since when it holds by at least as many
        self.bound_rad = bound_rad
        self._by_evidence = ErrorSet.within(WIDEST_RAD)
        self._updated: tuple[int, FloatArray] | None = None  # when, and body_from_local
        self._tolerates = 0
        self.observed = 0  # UAVs that confined the error at the last update
        self.error: Misalignment | None = None  # None: nothing is known but the bound

    def forget(self) -> None:
        """Forget the error: the reported attitude has jumped."""
        self._by_evidence, self.error = ErrorSet.within(WIDEST_RAD), None
        self._updated = None

    @property
    def largest_rad(self) -> float:
        """Largest angle of the error of reported attitudes."""
        return self.bound_rad if self.error is None else min(self.error.largest_rad, self.bound_rad)

    @property
    def turning_rad(self) -> float:
        """Largest part of that error that turns with the carrier: it may cancel the rest now.

        Both parts together are at most ``bound_rad``, and differ by at most ``largest_rad``.
        """
        return (self.bound_rad + self.largest_rad) / 2

    @property
    def bounds(self) -> ErrorBounds:
        """Bounds on the error of reported attitudes."""
        return ErrorBounds(self.largest_rad, self.turning_rad)

    # --- the attitude's error ---------------------------------------------------------------

    def update(self, now_ns: int, carrier: Carrier, bound_rad: float) -> list[Notice | Refuted]:
        """Confine the error of the reported attitude by what was seen of all UAVs.

        carrier    the reported pose
        bound_rad  bound on the error of reported attitudes by the settings
        """
        if self._updated is not None and now_ns - self._updated[0] < UPDATE_NS:
            return []
        self.bound_rad = max(bound_rad, self._raised_rad)
        seen = self._seen(now_ns)
        self.observed = len(seen)
        tolerates = self._settings.false_uavs if len(seen) >= compass.MAJORITY else 0
        if seen and tolerates != self._tolerates:
            self._tolerates = tolerates  # a set by fewer UAVs may be wrong by one false position
            self.forget()
        known = self._by_evidence
        if self._updated is not None:
            before_ns, before = self._updated
            turned = angle_between_rad(before, carrier.body_from_local)
            drifted = self._drift_radps * (now_ns - before_ns) * 1e-9
            known = known.grown(drifted + turned * self.turning_rad)
        self._updated = now_ns, carrier.body_from_local
        self._by_evidence = self._confined(known, seen)
        self._uavs.likely.solve()
        found: list[Notice | Refuted] = [*self._judge(now_ns, seen)]
        found += self._bounded(now_ns, self._least_rad(seen))
        self._restore(now_ns, bound_rad)
        return found

    @property
    def is_raised(self) -> bool:
        """Whether evidence refuted the bound by the settings, and has not confirmed it since."""
        return self._raised_rad > 0.0

    def _restore(self, now_ns: int, bound_rad: float) -> None:
        """Assume the bound by the settings again once evidence confines the error to it."""
        is_small = self.error is not None and self.error.largest_rad <= bound_rad
        if not (self._raised_rad and is_small and self.observed >= self._raised_by):
            self._holds_since_ns = None
        elif self._holds_since_ns is None:
            self._holds_since_ns = now_ns
        elif now_ns - self._holds_since_ns >= RESTORED_NS:
            self._raised_rad = 0.0

    def _least_rad(self, seen: Sequence[Seen]) -> float:
        """Return the least error that evidence proves, if no more UAVs are false than may be."""
        least = sorted(
            angle_rad(one.reported.center, one.seen.center)
            - one.reported.radius_rad
            - one.seen.radius_rad
            for one in seen
        )
        return least[-1 - self._tolerates] if len(least) > self._tolerates else 0.0

    def _seen(self, now_ns: int) -> list[Seen]:
        fresh = dict[str, tuple[Sightings, Relative]]()
        for uav, record in self._uavs:
            sightings, latest = record.sightings, record.latest
            if sightings is None or latest is None or now_ns - sightings.t_ns > FRESH_NS:
                if sightings is not None and now_ns - sightings.t_ns > FORGOTTEN_NS:
                    record.sightings, record.contradicted_ns, record.is_refuted = None, None, False
                continue
            if sightings.is_confirmed:
                fresh[uav] = sightings, latest[0]
        caps = possible(
            [sightings.caps for sightings, _ in fresh.values()], self._settings.outliers
        )
        found, turning_rad = [], self.turning_rad
        for (uav, (sightings, near)), cap in zip(fresh.items(), caps, strict=True):
            if cap is None:
                self._uavs.forget_directions(uav)
                continue
            aged_s = abs(now_ns - sightings.t_ns) * 1e-9
            changed = self._drift_radps * aged_s + near.turned_rad(aged_s) * turning_rad
            radius = min(cap.radius_rad + changed, math.pi)
            found.append(Seen(uav, near.reported, Cap(cap.center, radius)))
        return found

    def _confined(self, known: ErrorSet, seen: Sequence[Seen]) -> ErrorSet:
        """Return the errors that evidence allows; if that excludes all known ones, it alone."""
        if not seen:
            return known
        for start in (known, ErrorSet.within(WIDEST_RAD)):
            cut = compass.refined(start, seen, self._tolerates)
            if cut is not None:
                return cut
        return ErrorSet.within(WIDEST_RAD)

    def _judge(self, now_ns: int, seen: Sequence[Seen]) -> list[Notice]:
        """Find UAVs that are seen elsewhere than they report, whatever the attitude's error."""
        error = self._by_evidence.misalignment()
        apart = {one.uav for one in seen if compass.contradicts(error, one)}
        if len(apart) > self._tolerates:  # more than may be false: the set is wrong
            self._by_evidence = ErrorSet.within(WIDEST_RAD)
            apart = set()
        said = []
        for one in seen:
            record = self._uavs.get(one.uav)
            assert record is not None
            if one.uav in apart:
                record.agrees_ns = None
                since_ns = record.contradicted_ns or now_ns
                record.contradicted_ns = since_ns
                if not record.is_refuted and now_ns - since_ns >= PERSISTENT_NS:
                    record.is_refuted = True
                    said.append(_refuted(now_ns, one, error))
                continue
            since_ns = record.agrees_ns or now_ns
            record.agrees_ns, record.contradicted_ns = since_ns, None
            if record.is_refuted and now_ns - since_ns >= PERSISTENT_NS:
                record.is_refuted = False
                said.append(_agrees_again(now_ns, one.uav))
        return said

    def _bounded(self, now_ns: int, least_rad: float) -> list[Refuted]:
        """Set the error within the bound by the settings, which is raised if it is refuted.

        ``least_rad`` is the least error that evidence proves.
        """
        limit_rad = self.bound_rad
        if least_rad <= limit_rad:
            self.error = self._by_evidence.within_ball(limit_rad)
            if self.error is not None:
                return []
        found = self._by_evidence.misalignment()
        center_rad = rotation_angle_rad(found.center)
        least_rad = max(least_rad, center_rad - found.bound_rad, limit_rad)
        self.bound_rad = self._raised_rad = RAISED * least_rad
        self._raised_by = self.observed
        self.error = self._by_evidence.within_ball(self.bound_rad) or found
        return [
            Refuted(
                t_ns=now_ns,
                uav=ARRAY,
                setting=ATTITUDE_BOUND,
                limit=math.degrees(limit_rad),
                proven=math.degrees(least_rad),
                raised_to=math.degrees(self._raised_rad),
            )
        ]

    # --- looks ------------------------------------------------------------------------------

    def error_at(self, carrier: Carrier) -> Misalignment:
        """Return the error of the reported attitude at the time of a pose."""
        if self.error is None or self._updated is None:
            return Misalignment(np.eye(3), self.bound_rad)
        updated_ns, before = self._updated
        drifted = self._drift_radps * abs(carrier.valid_at_ns - updated_ns) * 1e-9
        turned = angle_between_rad(before, carrier.body_from_local)
        grown = self.error.bound_rad + drifted + turned * self.turning_rad
        if grown >= self.bound_rad:
            return Misalignment(np.eye(3), self.bound_rad)
        return Misalignment(self.error.center, grown)

    def looks(self, uavs: Iterable[str], carrier: Carrier) -> Looks:
        """Return a snapshot of what was seen of UAVs, without those of which nothing was.

        carrier  the reported pose
        """
        each = {
            uav: Look(record.sightings, record.pending, record.is_refuted)
            for uav in uavs
            if (record := self._uavs.get(uav)) is not None
            and (record.sightings is not None or record.pending)
        }
        return Looks(
            each=each,
            error=self.error_at(carrier),
            bounds=self.bounds,
            likely=rotation(self._uavs.likely.vector_rad(carrier.body_from_local)),
        )

    def corrected(self, carrier: Carrier) -> Carrier:
        """Return the reported pose of the array with its error corrected, as far as it is known."""
        if self.error is None:
            return carrier
        error = self.error_at(carrier)
        bound_rad = min(error.bound_rad + carrier.extrapolation_rad, math.pi)
        if bound_rad == carrier.attitude_bound_rad:
            return carrier
        return replace(
            carrier,
            body_from_local=carrier.body_from_local @ error.center,
            attitude_bound_rad=bound_rad,
            attitude_p95_rad=USUAL_ATTITUDE * error.bound_rad,
        )

    @property
    def refuted(self) -> list[str]:
        """UAVs whose reported position the array refutes."""
        return [uav for uav, record in self._uavs if record.is_refuted]


def _refuted(now_ns: int, one: Seen, error: Misalignment) -> Notice:
    expected = error.center @ one.reported.center
    off = math.degrees(angle_rad(expected, one.seen.center))
    text = (
        f"{one.uav}: the array sees it {off:.1f}° from its reported position"
        f" ({Reason.CONTRADICTED_BY_ARRAY}); check it for GNSS spoofing, a forged sender or a wrong"
        " datum"
    )
    return Notice(t_ns=now_ns, severity=Severity.ERROR, subject=one.uav, text=text)


def _agrees_again(now_ns: int, uav: str) -> Notice:
    text = f"{uav}: the array sees it again where it reports to be"
    return Notice(t_ns=now_ns, severity=Severity.INFO, subject=uav, text=text)
