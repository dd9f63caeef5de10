"""Bounds on the errors of a report, from stated accuracies or, for relayed aircraft, their kind."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

from companion.values import (
    FIX_3D,
    RELAYED_TIME_ERROR_S,
    Accuracy,
    AltitudeDatum,
    GnssStatus,
    ReportNoise,
    Vector,
)

QUANTISATION: Final = 0.02
"""Least noise bound, m and m/s, however good the stated accuracy is.

GLOBAL_POSITION_INT has steps of 1.1 cm and 1 cm/s.
"""
LEAST_ACCURACY_M: Final = {4: 0.2, 5: 0.1, 6: 0.01, 7: 0.01, 8: 0.01}
"""Best credible accuracy by GPS_FIX_TYPE: differential, RTK float and fixed, static, PPP. Some
receivers state a millimetre if they do not know their accuracy."""
PLAIN_ACCURACY_M: Final = 0.3  # best credible accuracy of any other fix
ADSB_NOISE_M: Final = 100.0
"""Default bound on the position error of an ADS-B report, metres.

The bound exceeds what most transponders guarantee (NACp 8: 93 m) and the steps of pressure
altitude.
"""
ADSB_VELOCITY_NOISE_MPS: Final = 10.0  # bound on the velocity error of an ADS-B report (NACv 1)
OVERTAKEN_NS: Final = 10_000_000_000  # time for which a replaced statement is kept
STATEMENTS_MAX: Final = 64  # most of them
STATED_NS: Final = 10_000_000_000
"""Time after which what a vehicle states of itself, and does not repeat, lowers no bound.

Autopilots repeat what they report, ArduPilot once a second and more. The receiver may have changed
since, and what was forged before the vehicle appeared would count for ever.
"""
FORGOTTEN_NS: Final = 60_000_000_000
"""Time after which a statement of a receiver that it does not repeat is ignored altogether."""
DEAD_RECKONING_MPS2: Final = 0.5
"""Largest error of the acceleration that an autopilot integrates without a fix.

A tilt error of 3 degrees has this effect, and an accelerometer error of 0.05 g.
"""
SETTLED_NS: Final = 5_000_000_000
"""Time in which an autopilot's position follows its receiver's, after a loss of the fix too."""
GEOID_M: Final = 107.0
"""Largest distance between the ellipsoid and mean sea level (EGM96: -107 to 86 m).

Heights above the ellipsoid are compared with telemetry's, which are above mean sea level. If the
geoid height is unknown, heights are not converted, and may be off by this much.
"""


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """Settings of how noise bounds are derived.

    default  bounds without better information
    factor   multiple of a stated accuracy (a standard deviation or 68 % radius, as receivers state
             it) that is used as a bound; None: stated accuracies are ignored
    """

    default: ReportNoise
    factor: float | None


def reported(status: GnssStatus, settings: NoiseSettings) -> ReportNoise:
    """Return the noise bounds from GPS_RAW_INT, with defaults for fields that are not sent."""
    default, factor = settings.default, settings.factor
    if factor is None or status.fix_type < FIX_3D:  # without a fix, accuracies are old ones
        return default
    least_m = LEAST_ACCURACY_M.get(status.fix_type, PLAIN_ACCURACY_M)
    horizontal_m = _bound(status.h_acc_m, factor, default.horizontal_m, least_m)
    vertical_m = _bound(status.v_acc_m, factor, default.vertical_m, least_m)
    return ReportNoise(
        horizontal_m=horizontal_m,
        vertical_m=vertical_m,
        position_m=math.hypot(horizontal_m, vertical_m),
        velocity_mps=_bound(status.vel_acc_mps, factor, default.velocity_mps),
    )


def dead_reckoned(known: ReportNoise, seconds: float) -> ReportNoise:
    """Return the bounds of a report by dead reckoning, ``seconds`` after the last GNSS fix.

    The autopilot integrates its accelerometers; its height is the barometer's.
    """
    drift_m = DEAD_RECKONING_MPS2 / 2 * seconds * seconds
    return known._replace(
        horizontal_m=known.horizontal_m + drift_m,
        position_m=known.position_m + drift_m,
        velocity_mps=known.velocity_mps + DEAD_RECKONING_MPS2 * seconds,
    )


class StatedNoise:
    """Noise bounds that a receiver has stated, by when each statement arrived.

    Statements and reports overtake each other. The statement in force when a report was made is
    the newest one before that time, or one that arrived since. One that is better than those
    before it counts ``SETTLED_NS`` later: so long may the autopilot's position take to follow.
    ``default`` is in force before the first, and ``FORGOTTEN_NS`` after the newest; from
    ``STATED_NS`` on, the larger of the two.
    """

    __slots__ = ("_default", "_earlier", "_in_force", "_newest", "_newest_ns")

    def __init__(self, default: ReportNoise) -> None:
        self._default = self._newest = self._in_force = default
        self._newest_ns = 0
        self._earlier: deque[tuple[int, ReportNoise, ReportNoise]] = deque()
        """Statements that were replaced: when, what they stated, and what was in force."""

    def add(self, arrival_ns: int, stated: ReportNoise, *, is_newest: bool = True) -> None:
        """Add a statement in order of arrival; ``is_newest`` is False if it was overtaken."""
        if not is_newest:
            one, other = self._newest, self._in_force
            self._replaced(arrival_ns, _larger(one, stated), _larger(other, stated))
            return
        before = self._newest if self._newest_ns else stated  # the default is no statement
        in_force = _larger(stated, before)
        for until_ns, replaced, _ in reversed(self._earlier):
            if until_ns < arrival_ns - SETTLED_NS:
                break
            in_force = _larger(in_force, replaced)
        if stated != self._newest or in_force != self._in_force:
            self._replaced(arrival_ns, before, self._in_force)
        self._newest, self._in_force, self._newest_ns = stated, in_force, arrival_ns

    def _replaced(self, at_ns: int, stated: ReportNoise, in_force: ReportNoise) -> None:
        """Note what was replaced; the oldest of too many is merged with the next."""
        earlier = self._earlier
        while earlier and at_ns - earlier[0][0] > OVERTAKEN_NS:
            earlier.popleft()
        if len(earlier) >= STATEMENTS_MAX:
            _, oldest, oldest_in_force = earlier.popleft()
            until_ns, next_stated, next_in_force = earlier[0]
            in_force_then = _larger(next_in_force, oldest_in_force)
            earlier[0] = until_ns, _larger(next_stated, oldest), in_force_then
        earlier.append((at_ns, stated, in_force))

    def since(self, made_ns: int) -> ReportNoise:
        """Return bounds for a report that was made no earlier than this.

        They are the largest of all statements that may have been in force when it was made.
        """
        found, age_ns = self._in_force, made_ns - self._newest_ns
        if age_ns > STATED_NS:
            found = self._default if age_ns > FORGOTTEN_NS else _larger(found, self._default)
        for until_ns, _, in_force in reversed(self._earlier):
            if until_ns < made_ns:
                break
            found = _larger(found, in_force)
        return found


def _larger(one: ReportNoise, other: ReportNoise) -> ReportNoise:
    """Return the larger bound of each kind."""
    if one == other:
        return one
    return ReportNoise(
        horizontal_m=max(one.horizontal_m, other.horizontal_m),
        vertical_m=max(one.vertical_m, other.vertical_m),
        position_m=max(one.position_m, other.position_m),
        velocity_mps=max(one.velocity_mps, other.velocity_mps),
    )


def _bound(accuracy: float | None, factor: float, default: float, least: float = 0.0) -> float:
    return default if accuracy is None else max(QUANTISATION, factor * accuracy, factor * least)


def relayed(
    velocity_ned_mps: Vector | None,
    alt_age_s: float,
    *,
    speed_max_mps: float,
    accuracy: Accuracy | None = None,
    datum: AltitudeDatum | None = None,
    factor: float | None = None,
    geoid_error_m: float = 0.0,
) -> ReportNoise:
    """Return the noise bounds of a relayed aircraft's report.

        accuracy  stated by the aircraft; unknown fields get the defaults of ADS-B
        datum     of its height: a stated accuracy does not apply to pressure altitude
        factor    multiple of a stated accuracy that is used as a bound; None: it is ignored
        geoid_error_m
                  largest error of a height that was converted to mean sea level

    The uncertainty of the report's time adds the distance flown in that time, and an altitude that
    was true ``alt_age_s`` apart adds the distance climbed in that time.
    """
    known = Accuracy() if accuracy is None or factor is None else accuracy
    time_s = known.time_s
    if time_s is None:  # or ignored, but never to make the bound smaller
        time_s = max(RELAYED_TIME_ERROR_S, (accuracy and accuracy.time_s) or 0.0)
    way_m = time_s * (speed_max_mps if velocity_ned_mps is None else math.hypot(*velocity_ned_mps))
    horizontal_m = _bound(known.horizontal_m, factor or 0.0, ADSB_NOISE_M) + way_m
    height_m = ADSB_NOISE_M
    if datum in (AltitudeDatum.GEOMETRIC, AltitudeDatum.MSL):
        geoid_m = GEOID_M if datum is AltitudeDatum.GEOMETRIC else geoid_error_m
        height_m = geoid_m + _bound(known.vertical_m, factor or 0.0, ADSB_NOISE_M)
    vertical_m = height_m + way_m + alt_age_s * speed_max_mps
    velocity_mps = _bound(known.velocity_mps, factor or 0.0, ADSB_VELOCITY_NOISE_MPS)
    return ReportNoise(
        horizontal_m=horizontal_m,
        vertical_m=vertical_m,
        position_m=math.hypot(horizontal_m, vertical_m),
        velocity_mps=velocity_mps,
    )
