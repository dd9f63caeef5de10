"""Bound on a carrier's reported attitudes, from all that the carrier sends about their error.

Each kind of evidence has its worth as a bound in docs/math.md 5.3. A contradiction between two of
them raises the bound so that it holds whichever is right.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from companion.tracking.carrier import body_from_ned, reported_bound_rad
from companion.tracking.noise import STATED_NS
from companion.tracking.rotations import rotation_angle_rad
from companion.values import (
    Attitude,
    AttitudeEvidence,
    EstimatorStatus,
    FloatArray,
    GnssHeading,
    StatedAttitude,
)

KEPT_NS: Final = 5_000_000_000
"""Time for which a statement counts beside newer ones of the same kind over other links."""
LAG_S: Final = 0.5
"""Largest difference between the delays of an attitude and of what it is compared with.

Receivers with two antennas compute a heading in 0.1 to 0.4 s.
"""
APART_MAX_S: Final = 1.0  # longest time since the newest attitude for a comparison
RATES_MAX: Final = 512  # attitudes whose rates are kept for a comparison
HEADING_LEAST_RAD: Final = math.radians(1.0)  # least standard deviation of a GNSS heading
HEADING_UNSTATED_RAD: Final = math.radians(5.0)
"""The same if the receiver states none: what ArduPilot's estimator assumes at least."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeAssumptions:
    """Assumptions about the error of reported attitudes.

    bound_rad         largest error, mounting of the array included
    factor            bound as a multiple of a stated standard deviation
    follows_accuracy  whether a stated covariance may also lower the bound
    mount_rad         largest error of the mounting, added to a covariance that does
    """

    bound_rad: float
    factor: float
    follows_accuracy: bool
    mount_rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Worth:
    """What a statement demands: a least bound, and the bound that it states; None: states none.

    ``is_conclusive`` is False for a comparison that agrees, but might not if the carrier had not
    turned meanwhile: a contradiction before it then remains.
    """

    t_ns: int
    least_rad: float
    stated_rad: float | None = None
    is_conclusive: bool = True


class AttitudeTrust:
    """Bound on the error of a carrier's reported attitudes.

    ``turned`` takes each new attitude, ``add`` what else the carrier sends. Statements have no time
    stamp on the sender's clock: over another, slower link they may be older. Of each kind the worst
    of the newest over each link counts. ``bound_rad`` is the bound now, as an angle.
    """

    def __init__(self, assumed: AttitudeAssumptions) -> None:
        self._assumed = assumed
        self.bound_rad = assumed.bound_rad
        self._worth: dict[tuple[str, str], _Worth] = {}  # by kind and link
        self._newest: Attitude | None = None
        self._rates: deque[tuple[int, float]] = deque(maxlen=RATES_MAX)  # arrival, rad/s

    def clear(self) -> None:
        """Discard everything, since the carrier rebooted."""
        self._worth.clear()
        self._rates.clear()
        self._newest = None
        self.bound_rad = self._bound_rad()

    def turned(self, attitude: Attitude) -> None:
        """Process the newest attitude."""
        self._newest, rates, t_ns = attitude, self._rates, attitude.t_ns
        rates.append((t_ns, _rate_radps(attitude)))
        while t_ns - rates[0][0] > (LAG_S + APART_MAX_S) * 1e9:
            rates.popleft()
        if any(t_ns - one.t_ns > STATED_NS for one in self._worth.values()):
            self._worth = {
                key: one for key, one in self._worth.items() if t_ns - one.t_ns <= STATED_NS
            }
        self.bound_rad = self._bound_rad()

    def add(self, said: AttitudeEvidence) -> None:
        """Process what the carrier sent about the error of its attitude."""
        match said:
            case EstimatorStatus():
                kind = "status"
                least_rad = reported_bound_rad(said, 0.0)
                worth: _Worth | None = _Worth(t_ns=said.t_ns, least_rad=least_rad)
            case GnssHeading():
                kind, worth = f"gnss{said.receiver}", self._heading(said)
            case StatedAttitude():
                kind, worth = f"attitude{said.msgid}", self._attitude(said)
        if worth is None:
            return
        before = self._worth.get((kind, said.link))
        if before is not None and not worth.is_conclusive:
            worth = replace(worth, least_rad=before.least_rad)
        oldest_ns = said.t_ns - KEPT_NS
        self._worth = {
            key: one for key, one in self._worth.items() if key[0] != kind or one.t_ns > oldest_ns
        } | {(kind, said.link): worth}
        self.bound_rad = self._bound_rad()

    def _bound_rad(self) -> float:
        if not self._worth:
            return self._assumed.bound_rad
        least_rad = max(one.least_rad for one in self._worth.values())
        return min(math.pi, max(self._unopposed_rad(), least_rad))

    def _unopposed_rad(self) -> float:
        """Return the bound without contradictions; covariances lower it only while they arrive."""
        assumed = self._assumed
        stated = [one for one in self._worth.values() if one.stated_rad is not None]
        worst_rad = max((one.stated_rad or 0.0 for one in stated), default=0.0)
        newest_ns = 0 if self._newest is None else self._newest.t_ns
        is_current = all(newest_ns - one.t_ns <= KEPT_NS for one in stated)
        if stated and assumed.follows_accuracy and is_current:
            return worst_rad + assumed.mount_rad
        return max(assumed.bound_rad, worst_rad)

    # --- comparisons ------------------------------------------------------------------------

    def _turned_rad(self, newest: Attitude, t_ns: int) -> float | None:
        """Return how far the carrier may have turned between an attitude and a statement.

        None: they are too far apart to be compared.
        """
        apart_s = abs(t_ns - newest.t_ns) * 1e-9
        if apart_s > APART_MAX_S:
            return None
        since_ns = min(t_ns, newest.t_ns) - LAG_S * 1e9
        fastest = max(rate for at_ns, rate in self._rates if at_ns >= since_ns)
        return fastest * (LAG_S + apart_s)

    def _heading(self, said: GnssHeading) -> _Worth | None:
        """Compare a GNSS heading with the newest attitude; None: incomparable."""
        newest, assumed = self._newest, self._assumed
        turned_rad = None if newest is None else self._turned_rad(newest, said.t_ns)
        if newest is None or turned_rad is None:
            return None
        level = math.cos(newest.pitch_rad)
        error_rad = self._unopposed_rad()
        off_rad = error_rad + turned_rad
        if off_rad >= math.pi / 2 or math.sin(off_rad) >= level:
            return None  # the nose may point straight up or down, or have done so since
        stated_rad = said.accuracy_rad or HEADING_UNSTATED_RAD
        # A nose that is off by an angle is off by asin(sin(angle) / level) in azimuth, at most.
        error_rad = math.asin(math.sin(error_rad) / level)
        own_rad = assumed.factor * max(stated_rad, HEADING_LEAST_RAD)
        is_conclusive = turned_rad <= error_rad + own_rad
        own_rad += math.asin(math.sin(off_rad) / level) - error_rad
        apart_rad = abs(math.remainder(said.heading_rad - newest.yaw_rad, math.tau))
        if apart_rad <= error_rad + own_rad:
            return _Worth(t_ns=said.t_ns, least_rad=0.0, is_conclusive=is_conclusive)
        least_rad = min(math.pi, assumed.bound_rad + apart_rad + own_rad)
        return _Worth(t_ns=said.t_ns, least_rad=least_rad)

    def _attitude(self, said: StatedAttitude) -> _Worth:
        """Return the worth of an attitude with a covariance, which must agree with the newest."""
        newest, assumed = self._newest, self._assumed
        if said.ned_from_body is None:
            return _Worth(t_ns=said.t_ns, least_rad=math.pi)
        stated_rad = None
        if said.deviations_rad is not None:
            # An attitude error is at most the sum of those of its three successive rotations.
            stated_rad = min(math.pi, assumed.factor * sum(said.deviations_rad))
        turned_rad = None if newest is None else self._turned_rad(newest, said.t_ns)
        if newest is None or turned_rad is None:
            return _Worth(t_ns=said.t_ns, least_rad=0.0, stated_rad=stated_rad)
        own_rad = assumed.bound_rad if stated_rad is None else stated_rad
        error_rad = assumed.bound_rad
        if stated_rad is not None and assumed.follows_accuracy:
            error_rad = min(error_rad, stated_rad + assumed.mount_rad)
        is_conclusive = turned_rad <= error_rad + own_rad
        own_rad += turned_rad
        reported = body_from_ned(newest.roll_rad, newest.pitch_rad, newest.yaw_rad)
        apart_rad = rotation_angle_rad(reported @ _rotation(said.ned_from_body))
        if apart_rad <= error_rad + own_rad:
            return _Worth(
                t_ns=said.t_ns, least_rad=0.0, stated_rad=stated_rad, is_conclusive=is_conclusive
            )
        least_rad = min(math.pi, assumed.bound_rad + apart_rad + own_rad)
        return _Worth(t_ns=said.t_ns, least_rad=least_rad)


def _rate_radps(attitude: Attitude) -> float:
    return math.hypot(attitude.rollspeed_radps, attitude.pitchspeed_radps, attitude.yawspeed_radps)


def _rotation(quaternion: tuple[float, float, float, float]) -> FloatArray:
    """Return the rotation matrix (3, 3) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
