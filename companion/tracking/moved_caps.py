"""Caps of directions in which the array sees a UAV, and how they follow its motion.

See docs/math.md 5.7.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.values import Cap, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """Motion of a UAV relative to the array between two times, with its bounds.

    moved_ned_m       predicted displacement, (3,), local frame
    error_m           bound on the error of that displacement
    range_m           predicted range at the earlier time
    range_error_m     bound on the error of that range, and of the later one
    misalignment_rad  bound on the error of the reported attitude, as an angle
    turned_rad        bound on the change of that error between the times
    """

    moved_ned_m: FloatArray
    error_m: float
    range_m: float
    range_error_m: float
    misalignment_rad: float
    turned_rad: float

    @property
    def growth(self) -> tuple[float, float] | None:
        """By what the chord of a cap's radius is multiplied, and then its radius increased, rad.

        With r the true and r' the predicted range, the true direction becomes that of r s + W d +
        e, and the centre that of r' c + d: W is the misalignment and e the error of the
        displacement d. None: the direction may become any.
        """
        way_m = math.sqrt(self.moved_ned_m @ self.moved_ned_m)
        least_m = self.range_m - self.range_error_m - way_m - self.error_m
        if least_m <= 0.0:
            return None
        off_m = self.error_m + way_m * (self.misalignment_rad + self.range_error_m / self.range_m)
        if off_m >= least_m:
            return None
        grown_rad = math.asin(off_m / least_m) + self.turned_rad
        return self.range_m / (self.range_m - way_m), grown_rad


class Caps(NamedTuple):
    """Caps of possible directions: centres (K, 3), oldest first, and radii (K,)."""

    centers: FloatArray
    radii_rad: FloatArray

    @classmethod
    def of(cls, cap: Cap) -> "Caps":
        """Return one cap."""
        return cls(cap.center[np.newaxis], np.array([cap.radius_rad]))

    def without_newest(self, count: int) -> "Caps":
        """Return the caps without the newest ones."""
        kept = max(0, len(self.radii_rad) - count)
        return Caps(self.centers[:kept], self.radii_rad[:kept])


def moved_caps(parts: Sequence[Caps], motions: Sequence[Motion]) -> Caps:
    """Return the caps of all parts, each part after its motion."""
    rows = []
    for motion in motions:
        growth = motion.growth
        if growth is None:
            rows.append((1.0, 0.0, 0.0, 0.0, 0.0, math.pi))
        else:
            rows.append((motion.range_m, *motion.moved_ned_m.tolist(), *growth))
    table = np.array(rows)
    if len(rows) > 1:
        table = table.repeat([len(part.radii_rad) for part in parts], axis=0)
    centers, radii = parts[0]
    if len(parts) > 1:
        centers = np.concatenate([part.centers for part in parts])
        radii = np.concatenate([part.radii_rad for part in parts])
    later = centers * table[:, :1] + table[:, 1:4]
    later /= np.sqrt(np.vecdot(later, later))[:, np.newaxis]
    chords = table[:, 4] * np.sin(np.minimum(radii, math.pi) / 2.0)
    spread = 2.0 * np.arcsin(np.minimum(1.0, chords)) + table[:, 5]
    return Caps(later, np.minimum(spread, math.pi))
