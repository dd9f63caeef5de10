"""Limits of an aircraft: assumed by its type, and raised when its reports refute them.

The bounds assume a largest speed and a largest acceleration. Two reported velocities prove a mean
acceleration between them of at least (|v2 - v1| - n1 - n2) / T, with n their noise. If that exceeds
the limit, the assumption is refuted: the limit of this aircraft is raised at once, and decays over
minutes. See docs/math.md 5.6.
"""

import math
from array import array
from bisect import bisect_right
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from companion.values import Fix, Limits, LimitSource, Refuted

RAISED: Final = 1.5  # multiple of the proven value that is assumed from then on
DECAY_S: Final = 120.0  # time constant with which a raised limit decays
MAX_PLAUSIBLE_RATIO: Final = 6.0
"""Multiple of a limit above which a proof is rejected: the report is wrong, not the limit."""
PAIR_SPANS_S: Final = (0.001, 0.2, 0.5, 1.0, 2.0)
"""Least times between two velocities that are compared: adjacent ones, and older ones."""
_PAIRS_NS: Final = tuple(round(least_s * 1e9) for least_s in PAIR_SPANS_S)
_KEPT: Final = 64
_NUMBERS: Final = 5  # kept of a report's velocity


class Airframe(StrEnum):
    """Kind of aircraft, which determines its assumed limits."""

    COPTER = "copter"
    AEROPLANE = "aeroplane"
    VTOL = "vtol"
    HELICOPTER = "helicopter"
    ROVER = "rover"
    UNKNOWN = "unknown"
    ADSB = "adsb"


ANY_LAG_S: Final = (0.0, 0.06)  # lag of an unknown autopilot


@dataclass(frozen=True, slots=True, kw_only=True)
class AirframeLimits:
    """Assumed limits of a kind of aircraft.

    speed_mps, acceleration_mps2
                largest values, norms of 3-vectors
    lag_s       least and largest age of a reported position at its stamp; negative: the position is
                extrapolated
    turn_degps2
                largest angular acceleration, norm about the body's axes
    """

    speed_mps: float
    acceleration_mps2: float
    lag_s: tuple[float, float] = ANY_LAG_S
    turn_degps2: float


LIMITS: Final = {
    Airframe.COPTER: AirframeLimits(speed_mps=60.0, acceleration_mps2=4.0, turn_degps2=180.0),
    Airframe.AEROPLANE: AirframeLimits(speed_mps=80.0, acceleration_mps2=16.0, turn_degps2=720.0),
    Airframe.VTOL: AirframeLimits(speed_mps=80.0, acceleration_mps2=16.0, turn_degps2=720.0),
    Airframe.HELICOPTER: AirframeLimits(speed_mps=80.0, acceleration_mps2=8.0, turn_degps2=180.0),
    Airframe.ROVER: AirframeLimits(speed_mps=40.0, acceleration_mps2=5.0, turn_degps2=90.0),
    Airframe.UNKNOWN: AirframeLimits(speed_mps=80.0, acceleration_mps2=16.0, turn_degps2=270.0),
    Airframe.ADSB: AirframeLimits(
        speed_mps=400.0, acceleration_mps2=16.0, lag_s=(0.0, 0.0), turn_degps2=720.0
    ),
}
"""Assumed limits by kind of aircraft, from real and simulated logs: docs/field-notes.md 1."""
ARDUPILOT_LAG_S: Final = {Airframe.COPTER: (0.019, 0.040), Airframe.AEROPLANE: (-0.033, -0.019)}
ARDUPILOT_ANY_LAG_S: Final = (-0.033, 0.040)
"""Lag of ArduPilot's positions, any aircraft: copters and aeroplanes differ in its sign."""
RECEIVER_LAG_S: Final = (0.0, 0.5)
"""Lag of positions that are their GNSS receiver's, stamped when they are sent.

INAV and Betaflight send such positions, and state a generic autopilot (docs/field-notes.md 1).
"""

_GENERIC: Final = 0  # MAV_AUTOPILOT_GENERIC
_ARDUPILOT: Final = 3  # MAV_AUTOPILOT_ARDUPILOTMEGA
_AIRFRAMES: Final = {
    **dict.fromkeys((2, 3, 13, 14, 15, 29, 35, 43), Airframe.COPTER),
    **dict.fromkeys((1, 16, 28), Airframe.AEROPLANE),
    **dict.fromkeys(range(19, 26), Airframe.VTOL),
    4: Airframe.HELICOPTER,
    **dict.fromkeys((10, 11, 12), Airframe.ROVER),
}


def airframe(mav_type: int | None) -> Airframe:
    """Return the kind of aircraft by MAV_TYPE (minimal.xml) of its heartbeat.

    A type of None is one that was not received.
    """
    return Airframe.UNKNOWN if mav_type is None else _AIRFRAMES.get(mav_type, Airframe.UNKNOWN)


def lag_s(kind: Airframe, autopilot: int | None) -> tuple[float, float]:
    """Return the least and largest lag of a position, s, by MAV_AUTOPILOT and kind of aircraft."""
    if autopilot == _ARDUPILOT:
        return ARDUPILOT_LAG_S.get(kind, ARDUPILOT_ANY_LAG_S)
    if autopilot == _GENERIC:
        return RECEIVER_LAG_S
    return LIMITS[kind].lag_s


@dataclass(slots=True)
class RaisedLimit:
    """Limit that was raised: its value, and the sender time at which it was raised."""

    to: float = 0.0
    at_ns: int = 0

    def raise_above(self, proven: float, sender_ns: int) -> float:
        """Raise the limit above a proven value; return the new limit."""
        self.to, self.at_ns = RAISED * proven, sender_ns
        return self.to

    def at(self, limit: float, sender_ns: int) -> float:
        """Return the limit that applies at a sender time."""
        if self.to <= limit:
            return limit
        faded = math.exp(-max(0, sender_ns - self.at_ns) * 1e-9 / DECAY_S)
        return limit + (self.to - limit) * faded


class Refutations:
    """Refuted limits of one UAV. ``look`` takes its reports in any order."""

    def __init__(self) -> None:
        self.speed = RaisedLimit()
        self.acceleration = RaisedLimit()
        self._times_ns: list[int] = []
        # Of these reports: velocity, its noise, and that of its time. Kept for each of thousands of
        # UAVs, so that an array replaces tuples of six times its size.
        self._velocities = array("d")

    def limits(self, base: Limits, sender_ns: int) -> Limits:
        """Return the limits that apply at a sender time."""
        if self.speed.to == self.acceleration.to == 0.0:
            return base  # never refuted
        speed = self.speed.at(base.speed_max_mps, sender_ns)
        acceleration = self.acceleration.at(base.acceleration_max_mps2, sender_ns)
        if speed == base.speed_max_mps and acceleration == base.acceleration_max_mps2:
            return base
        return Limits(speed, acceleration, LimitSource.RAISED)

    def look(self, fix: Fix) -> list[Refuted]:
        """Check a report against the limits. Raise refuted limits, and return the refutations."""
        base, velocity = fix.limits, fix.velocity_ned_mps
        if base is None or velocity is None:
            return []
        found: list[Refuted] = []
        north, east, down = velocity
        sender_ns, noise_mps = fix.sender_ns, fix.noise.velocity_mps
        speed = math.sqrt(north * north + east * east + down * down) - noise_mps
        if speed > base.speed_max_mps:
            limit = self.speed.at(base.speed_max_mps, sender_ns)
            if limit < speed < MAX_PLAUSIBLE_RATIO * base.speed_max_mps:
                found.append(self._raise(self.speed, fix, "observer.speed_max_mps", limit, speed))
        proven = self._proven(fix, north, east, down)
        if proven > base.acceleration_max_mps2:
            limit = self.acceleration.at(base.acceleration_max_mps2, sender_ns)
            if limit < proven < MAX_PLAUSIBLE_RATIO * base.acceleration_max_mps2:
                name = "observer.acceleration_max_mps2"
                found.append(self._raise(self.acceleration, fix, name, limit, proven))
        times_ns = self._times_ns
        if not times_ns or sender_ns > times_ns[-1]:
            times_ns.append(sender_ns)
            self._velocities.extend((north, east, down, noise_mps, fix.noise.time_s))
            if len(times_ns) > 2 * _KEPT:
                del times_ns[:_KEPT], self._velocities[: _NUMBERS * _KEPT]
        return found

    def _proven(self, fix: Fix, north: float, east: float, down: float) -> float:
        """Return the largest mean acceleration proven by a velocity and earlier ones, m/s²."""
        most, sender_ns = 0.0, fix.sender_ns
        own_mps, own_s = fix.noise.velocity_mps, fix.noise.time_s
        times_ns, velocities, end = self._times_ns, self._velocities, len(self._times_ns)
        for least_ns in _PAIRS_NS:
            end = bisect_right(times_ns, sender_ns - least_ns, 0, end)
            if not end:
                break
            n, e, d, noise_mps, time_s = velocities[_NUMBERS * (end - 1) : _NUMBERS * end]
            n, e, d = north - n, east - e, down - d
            changed_mps = math.sqrt(n * n + e * e + d * d) - noise_mps - own_mps
            if changed_mps <= 0.0:
                continue  # within the noise: proves nothing
            # Stamps are whole milliseconds: the interval may be one longer.
            apart_s = (sender_ns - times_ns[end - 1]) * 1e-9 + 1e-3 + time_s + own_s
            proven = changed_mps / apart_s
            most = proven if proven > most else most
        return most

    def _raise(
        self, raised: RaisedLimit, fix: Fix, setting: str, limit: float, proven: float
    ) -> Refuted:
        to = raised.raise_above(proven, fix.sender_ns)
        return Refuted(
            t_ns=fix.arrival_ns,
            uav=fix.uav,
            setting=setting,
            limit=limit,
            proven=proven,
            raised_to=to,
        )
