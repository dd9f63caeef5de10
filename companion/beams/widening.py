"""Beams no narrower than what is known of their targets, and nulls as wide.

A UAV lies within its pointing bound of where it is predicted. A beam sharper than that misses it,
so its main lobe is broadened: a quadratic phase over the aperture makes each part of the array
look in another direction within the bound (the defocused, or spoiled, beam). Nulls are widened by
nulling points around the predicted direction as well, softly: those that stand in the way of
serving another UAV count less.

In terms of the aperture's width D across the line of sight, a bound e is w = e D / wavelength wide
in natural beams; the natural half-power beam has w = 0.44.
"""

import functools
import itertools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg.lapack import zgesv

from companion.beams.arrays import Array
from companion.beams.steering import steering_matrix
from companion.values import ComplexArray, FloatArray, IntArray

WIDEST_RAD: Final = np.pi / 3
"""Farther than this neither beams nor nulls are widened."""

WIDTHS: Final = np.array(
    [0.443, 0.5, 0.6, 0.7, 1.0, 1.25, 1.5, 1.75, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0, 10.0]
)
CURVATURES_RAD: Final = np.array(
    [0.0, 2.05, 2.7, 3.45, 3.45, 3.7, 4.3, 6.95, 6.95, 7.05, 7.55, 9.6, 10.15, 12.45, 16.65, 19.0]
)
"""For a uniform line, the phase at the ends of the aperture that makes the least gain over +-w the
greatest, among those whose gain stays within 3 dB of its peak there (a search over 0 to 60 rad)."""

NULL_SPACING: Final = 0.7
FEWEST_WIDTHS: Final = 0.02
MOST_RINGS: Final = 4
MOST_RINGS_IN_SPACE: Final = 2
MOST_POINTS: Final = 96
"""In all, and never more than the array has degrees of freedom to spare: each is a null."""
SOFT_LOADINGS: Final = (0.01, 0.1, 1.0, 10.0)
TOO_CLOSE: Final = 0.5


@dataclass(frozen=True, slots=True)
class Spread:
    """What widening needs to know: ``beams`` (M, N) are the broadened beams by themselves, where
    ``broadened`` (N,); ``points`` (M, P) the steering vectors to be nulled beside the predicted
    ones, around user ``owners`` (P,)."""

    beams: ComplexArray
    broadened: FloatArray
    points: ComplexArray
    owners: IntArray

    def of(self, users: IntArray) -> "Spread":
        """What concerns some of the users, in their order."""
        if len(users) == self.beams.shape[1]:
            return self
        where = {int(user): place for place, user in enumerate(users)}
        mine = [p for p, owner in enumerate(self.owners.tolist()) if owner in where]
        owners = np.array([where[int(self.owners[p])] for p in mine], dtype=np.int64)
        return Spread(self.beams[:, users], self.broadened[users], self.points[:, mine], owners)


def spread(
    array: Array, steering: ComplexArray, directions: FloatArray, bounds_rad: FloatArray
) -> Spread | None:
    """How to widen for unit directions (N, 3) in the array frame, each known to its bound (N,).

    ``steering`` (M, N) is that of the directions. None where all are known sharply enough.
    """
    bounds = np.minimum(bounds_rad, WIDEST_RAD)
    axes, apertures_m = _apertures(array, directions)
    widths = bounds[:, np.newaxis] * apertures_m / array.wavelength_m
    if not (widths > FEWEST_WIDTHS).any():
        return None
    broadened = widths.max(axis=1) > WIDTHS[0]
    beams = steering.conj()
    if broadened.any():
        beams *= np.exp(1j * _defocus_rad(array, axes, apertures_m, widths))
    around, owners = _around(directions, bounds, axes, widths, array.size)
    points = steering_matrix(array, around)
    clear = _clear(points, around, owners, steering, directions, bounds)
    return Spread(beams, broadened, points[:, clear], owners[clear])


def widen_nulls(
    steering: ComplexArray,
    spread: Spread,
    loading: float,
    centred: ComplexArray,
    least_gains: FloatArray,
) -> ComplexArray:
    """Beams (M, N) that null the points around the other UAVs as well, as deeply as may be.

    ``centred`` are those that null the predicted directions alone, with the same ``loading``. No
    user's gain falls below ``least_gains`` (N,), if it did not before.
    """
    if not len(spread.owners):
        return centred
    least = np.minimum(least_gains, power_gains(steering, centred))
    for soft in SOFT_LOADINGS:
        found = nulled(steering, spread, loading, soft)
        if (power_gains(steering, found) >= least * (1 - 1e-9)).all():
            return found
    return centred


def nulled(
    steering: ComplexArray, spread: Spread, loading: float, soft: float | None = None
) -> ComplexArray:
    """The broadened beams (M, N), less what of them reaches the other UAVs.

    f_i = g_i - S* (S^T S* + X)^-1 S^T g_i over the directions S of all others than i: X is
    ``loading`` at the predicted ones (0: nulled exactly), ``soft`` times their power at the points
    around them (None: these are left out).

    One inverse over the points of all serves every user: that of a submatrix follows from it by
    its Schur complement. Linear least squares with weights 1/X; exact where X is 0.
    """
    users = steering.shape[1]
    points, loads, begins = steering, np.full(users, loading), np.arange(users + 1)
    if soft is not None:
        # User by user, the predicted direction first: each has its own block.
        order = np.argsort(np.concatenate([np.arange(users), spread.owners]), kind="stable")
        points = np.concatenate([steering, spread.points], axis=1)[:, order]
        power = np.einsum("mp,mp->p", spread.points, spread.points.conj()).real
        loads = np.concatenate([loads, soft * power])[order]
        begins = np.searchsorted(spread.owners, begins) + begins
    gram = points.T @ points.conj()
    gram.flat[:: len(gram) + 1] += loads
    inverse = np.linalg.inv(gram)
    blocks = [slice(begin, end) for begin, end in itertools.pairwise(begins.tolist())]
    reached = points.T @ spread.beams
    for user, own in enumerate(blocks):
        reached[own, user] = 0.0
    found = inverse @ reached
    for user, own in enumerate(blocks):
        _, _, held, _ = zgesv(inverse[own, own], found[own, user])
        found[:, user] -= inverse[:, own] @ held
    weights: ComplexArray = spread.beams - points.conj() @ found
    return weights


def power_gains(steering: ComplexArray, weights: ComplexArray) -> FloatArray:
    """Array gain of each column towards its own direction, |a^T f|^2 / |f|^2, (N,)."""
    towards = np.abs(np.einsum("mn,mn->n", steering, weights)) ** 2
    gains: FloatArray = towards / np.sum(np.abs(weights) ** 2, axis=0)
    return gains


def _apertures(array: Array, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Principal axes of the array across each line of sight, (N, 3, 2), the longer one first, and
    their widths (N, 2) in metres: those of uniform lines with the same variance."""
    across = np.eye(3) - directions[:, :, np.newaxis] * directions[:, np.newaxis, :]
    values, vectors = np.linalg.eigh(across @ array.variance_m2 @ across)
    widths_m = np.sqrt(12 * np.maximum(values[:, :0:-1], 0.0))
    return vectors[:, :, :0:-1], widths_m


def _defocus_rad(
    array: Array, axes: FloatArray, apertures_m: FloatArray, widths: FloatArray
) -> FloatArray:
    """Quadratic phase (M, N) over the aperture, for bounds in natural widths (N, 2)."""
    ends_rad = np.interp(widths, WIDTHS, CURVATURES_RAD)
    ends_rad = np.where(widths > WIDTHS[-1], CURVATURES_RAD[-1] / WIDTHS[-1] * widths, ends_rad)
    # A narrow axis has no curvature: its beam is wider than any bound.
    scale = np.where(ends_rad > 0, 2 / np.maximum(apertures_m, 1e-9 * array.wavelength_m), 0.0)
    along = np.tensordot(array.centred_m, axes, (1, 1)) * scale
    phase: FloatArray = np.einsum("mna,na->mn", along**2, ends_rad)
    return phase


def _around(
    directions: FloatArray,
    bounds_rad: FloatArray,
    axes: FloatArray,
    widths: FloatArray,
    elements: int,
) -> tuple[FloatArray, IntArray]:
    """Directions (P, 3) within the bound around each user's, and whose they are (P,), in order.

    A line array sees one angle: points to both sides. Others: rings of 6, 12, ... points, or two
    points across the longer axis where there are too many users for a ring.
    """
    users = len(directions)
    each = min(MOST_POINTS, elements - users) // users if users > 1 else 0
    tangents, owners = [np.empty((0, 3))], [0] * 0
    for user in range(users if each >= 2 else 0):
        longest, other = widths[user].tolist()
        if longest > FEWEST_WIDTHS:
            rings = max(1, math.ceil(longest / NULL_SPACING))
            on_axes = _pattern(rings, each, in_space=other > FEWEST_WIDTHS)
            tangents.append(on_axes @ axes[user].T)
            owners += [user] * len(on_axes)
    tangent, whose = np.concatenate(tangents), np.array(owners, dtype=np.int64)
    length = np.sqrt(np.einsum("pk,pk->p", tangent, tangent))[:, np.newaxis]
    turned_rad = bounds_rad[whose, np.newaxis] * length
    around = np.cos(turned_rad) * directions[whose] + np.sin(turned_rad) * tangent / length
    return around, whose


@functools.cache
def _pattern(rings: int, most: int, *, in_space: bool) -> FloatArray:
    """Points (n, 2) in the unit disc, or on its first axis: at most ``most`` of them."""
    if in_space and most >= 6:
        rings = 2 if rings >= MOST_RINGS_IN_SPACE and most >= 18 else 1
        points = [
            (ring / rings * math.cos(angle), ring / rings * math.sin(angle))
            for ring in range(1, rings + 1)
            for angle in (math.pi / (3 * ring) * k for k in range(6 * ring))
        ]
    else:
        rings = min(rings, MOST_RINGS, most // 2)
        points = [(side * ring / rings, 0.0) for ring in range(1, rings + 1) for side in (1, -1)]
    return np.array(points)


def _clear(
    points: ComplexArray,
    around: FloatArray,
    owners: IntArray,
    steering: ComplexArray,
    directions: FloatArray,
    bounds_rad: FloatArray,
) -> IntArray:
    """Points that can be nulled: not what another UAV must be served by, in its bound or so near
    to it that the array can hardly tell them apart."""
    power = np.sum(np.abs(points) ** 2, axis=0)
    alike = np.abs(points.T @ steering.conj()) ** 2
    alike /= np.maximum(np.outer(power, np.sum(np.abs(steering) ** 2, axis=0)), 1e-300)
    inside = around @ directions.T > np.cos(bounds_rad)
    others = owners[:, np.newaxis] != np.arange(len(directions))
    blocked = (others & (inside | (alike > TOO_CLOSE**2))).any(axis=1)
    return np.flatnonzero(~blocked & (power > 1e-12))
