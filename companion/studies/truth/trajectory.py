"""Trajectory: positions and velocities at ascending times, with interpolation."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from companion.values import FloatArray

Times = NDArray[np.int64]
Kind = Literal["SIM_STATE", "SIMSTATE", "reports"]

GAP_NS: Final = 2_500_000_000
"""Longest gap between two points of a trajectory that is interpolated."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Trajectory:
    """Positions and velocities, (N, 3), local frame, at ascending times (N,).

    ``ned_from_body`` are attitudes (N, 4), quaternions w, x, y, z; zeros for an unknown attitude,
    None if all are unknown.
    """

    kind: Kind
    t_ns: Times
    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray
    ned_from_body: FloatArray | None = None

    def at(self, t_ns: Times) -> tuple[FloatArray, FloatArray]:
        """Return position and velocity (K, 3) at times (K,), by cubic Hermite; NaN if unknown."""
        if len(self.t_ns) < 2:
            return np.full((len(t_ns), 3), np.nan), np.full((len(t_ns), 3), np.nan)
        after = np.clip(np.searchsorted(self.t_ns, t_ns, side="right"), 1, len(self.t_ns) - 1)
        before = after - 1
        span_ns = self.t_ns[after] - self.t_ns[before]
        known = (t_ns >= self.t_ns[before]) & (t_ns <= self.t_ns[after]) & (span_ns <= GAP_NS)
        span_s = span_ns[:, None] * 1e-9
        s = ((t_ns - self.t_ns[before]) / span_ns)[:, None]
        p0, p1 = self.position_ned_m[before], self.position_ned_m[after]
        v0, v1 = self.velocity_ned_mps[before] * span_s, self.velocity_ned_mps[after] * span_s
        bend, twist = 3 * (p1 - p0) - 2 * v0 - v1, 2 * (p0 - p1) + v0 + v1
        position = p0 + s * (v0 + s * (bend + s * twist))
        velocity = (v0 + s * (2 * bend + s * 3 * twist)) / span_s
        position[~known] = velocity[~known] = np.nan
        return position, velocity


def ascending(
    kind: Kind,
    t_ns: Times,
    position_ned_m: FloatArray,
    velocity_ned_mps: FloatArray,
    ned_from_body: FloatArray | None = None,
) -> Trajectory:
    """Return a trajectory sorted by time without repeated times.

    A NaN velocity is replaced by the mean velocity between the neighbours.
    """
    times, rows = np.unique(t_ns, return_index=True)
    position, velocity = position_ned_m[rows], velocity_ned_mps[rows]
    if len(times) > 1 and np.isnan(velocity).any():
        between = np.gradient(position, (times - times[0]) * 1e-9, axis=0)
        velocity = np.where(np.isnan(velocity), between, velocity)
    turned = None if ned_from_body is None else ned_from_body[rows]
    return Trajectory(
        kind=kind,
        t_ns=times,
        position_ned_m=position,
        velocity_ned_mps=velocity,
        ned_from_body=turned,
    )
