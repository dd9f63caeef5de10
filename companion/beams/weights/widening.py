"""Main lobes and nulls as wide as the uncertainty of the directions.

A UAV lies within its pointing bound of where it is predicted. A sharper beam may miss it, so its
main lobe is broadened. On lines seen from the side, a quadratic phase over the aperture makes each
part of the array look in another direction within the bound (a defocused, or spoiled, beam).
Elsewhere only a part of the array serves, so small that within the bound its elements stay in
phase. Nulls are widened by nulling points around the predicted direction as well, softly: points
that stand in the way of serving another UAV count less.

With D the width of the aperture across the line of sight, a bound e is w = e D / wavelength wide in
natural beams; the natural half-power beam has w = 0.44. See docs/math.md 5.5.

Over 300 lines: one subject: beams as wide as a bound, and nulls as wide.
"""

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.values import BoolArray, ComplexArray, FloatArray, IntArray

WIDEST_RAD: Final = np.pi / 3
"""Bound beyond which neither beams nor nulls are widened further."""

WIDTHS: Final = np.array(
    [0.443, 0.5, 0.6, 0.7, 1.0, 1.25, 1.5, 1.75, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0, 10.0]
)
"""Bounds in natural widths at which ``CURVATURES_RAD`` was found."""
CURVATURES_RAD: Final = np.array(
    [0.0, 2.05, 2.7, 3.45, 3.45, 3.7, 4.3, 6.95, 6.95, 7.05, 7.55, 9.6, 10.15, 12.45, 16.65, 19.0]
)
"""Phase at the ends of the aperture of a uniform line that makes the least gain over ±w greatest.

Found by a search over 0 to 60 rad among those whose gain stays within 3 dB of its peak there.
"""

NULL_SPACING: Final = 0.7
"""Natural widths between nulled points: nulls further apart do not join up."""
FEWEST_WIDTHS: Final = 0.02
"""Bound in natural widths below which nothing is widened."""
MOST_RINGS: Final = 3
"""Most rings, or pairs, of points around a predicted direction."""
MOST_POINTS: Final = 96
"""Most nulled points of all users together.

Each point is a null, so there are never more than the array has degrees of freedom to spare.
"""
SOFT_LOADINGS: Final = (0.01, 0.1, 1.0, 10.0)
"""Loadings tried for the points around, relative to their power.

The first gives the deepest nulls.
"""
TOO_CLOSE: Final = 0.5
"""Correlation (amplitude) with another UAV's vector above which a point is left un-nulled."""
DEEP: Final = 1 / 3
"""Ratio of depth to width, in phase over the bound, above which a quadratic phase is not used."""
MOST_DEFOCUSED: Final = 0.27
"""Natural widths per element above which a quadratic phase is not used, because it leaves gaps.

It is 30 degrees at a spacing of half a wavelength.
"""
MOST_CENTRES: Final = 64
"""Elements tried as the middle of the part that serves."""
UNUSED: Final = 1e9
"""Loading under which a point has no weight at all."""


@dataclass(frozen=True, slots=True)
class Spread:
    """How to widen the beams and nulls of N users.

    beams      (M, N), the broadened beams by themselves
    broadened  (N,), which of them are broadened
    points     (M, N K), steering vectors, K per user in the order of the users: the predicted
               direction, then those around it that are to be nulled as well
    usable     (N K,), which points may be nulled
    gram       (N K, N K), S^T S* of the points S
    reached    (N K, N), what the beams radiate to the points
    """

    beams: ComplexArray
    broadened: BoolArray
    points: ComplexArray
    usable: BoolArray
    gram: ComplexArray
    reached: ComplexArray

    @property
    def each(self) -> int:
        """K, the points of a user."""
        return len(self.usable) // int(self.beams.shape[1])

    @property
    def centres(self) -> ComplexArray:
        """Steering vectors (M, N) of the predicted directions: A."""
        return self.points[:, :: self.each]

    def of(self, users: IntArray) -> "Spread":
        """The part that concerns some of the users, in their order."""
        if len(users) == self.beams.shape[1]:
            return self
        rows = (users[:, np.newaxis] * self.each + np.arange(self.each)).ravel()
        return Spread(
            self.beams[:, users],
            self.broadened[users],
            self.points[:, rows],
            self.usable[rows],
            self.gram[np.ix_(rows, rows)],
            self.reached[np.ix_(rows, users)],
        )


def spread(array: Array, directions: FloatArray, bounds_rad: FloatArray) -> Spread | None:
    """How to widen for unit directions (N, 3) in the array frame with bounds (N,), radians.

    None where all are known sharply enough.
    """
    bounds = np.minimum(bounds_rad, WIDEST_RAD)
    axes, apertures_m = _apertures(array, directions)
    widths = bounds[:, np.newaxis] * apertures_m / array.wavelength_m
    along = np.einsum("nk,kl,nl->n", directions, array.variance_m2, directions)
    depths = np.sqrt(12 * np.maximum(along, 0.0)) * (1 - np.cos(bounds)) / array.wavelength_m
    broadened: BoolArray = np.maximum(widths.max(axis=1), depths) > WIDTHS[0]
    if not (broadened.any() or (widths > FEWEST_WIDTHS).any()):
        return None
    around = _around(directions, bounds, axes, widths, array.size)
    each = around.shape[1]
    points = steering_matrix(array, around.reshape(-1, 3))
    gram = points.T @ points.conj()
    beams, reached = points[:, ::each].conj(), gram[:, ::each]
    if broadened.any():
        in_part = broadened & ~_defocuses(array, widths.max(axis=1), depths)
        phases_rad = _defocus_rad(array, axes, apertures_m, widths)
        beams *= np.exp(1j * np.where(in_part, 0.0, phases_rad))
        if in_part.any():
            shown = (directions[in_part], bounds[in_part], beams[:, in_part])
            beams[:, in_part] *= _parts(array, *shown)
        reached = points.T @ beams
    usable = _usable(gram, around, directions, bounds)
    return Spread(beams, broadened, points, usable, gram, reached)


def widen_nulls(
    spread: Spread,
    loading: float | FloatArray,
    centred: ComplexArray,
    least_gains: FloatArray,
    softnesses: tuple[float, ...] = SOFT_LOADINGS,
) -> ComplexArray:
    """Beams (M, N) that null the points around the other UAVs as well, as deeply as possible.

    spread       how to widen
    loading      as for ``nulled``
    centred      (M, N), the beams that null the predicted directions alone, with this loading
    least_gains  (N,), gains below which no user may fall, if it was not below before
    softnesses   loadings of the points around, tried in this order
    """
    if spread.each == 1:
        return centred
    least = np.minimum(least_gains, power_gains(spread.centres, centred)) * (1 - 1e-9)
    for soft in softnesses:
        found = nulled(spread, loading, soft)
        if (power_gains(spread.centres, found) >= least).all():
            return found
    return centred


def nulled(spread: Spread, loading: float | FloatArray, soft: float | None = None) -> ComplexArray:
    """The broadened beams (M, N), less what of them reaches the other UAVs.

    f_i = g_i - S* (S^T S* + X)^-1 r_i over the directions S of all, where r_i is what g_i radiates
    to the others, and 0 to its own, where the beam is to stay as it is. X is ``loading`` at the
    predicted directions (0: exact; a number, or (N,)) and ``soft`` times their power at the points
    around them (None: these are left out). This is linear least squares with weights 1/X. Sharp
    beams without points around come out as ZF and RZF, except for their lengths. See docs/math.md
    5.5.
    """
    users, each = spread.beams.shape[1], spread.each
    points, gram, reached = spread.points, spread.gram, spread.reached
    if soft is None:
        points, gram, reached, each = points[:, ::each], gram[::each, ::each], reached[::each], 1
        loads = np.broadcast_to(loading, users)
    else:
        power = gram.diagonal().real
        # A point to which the array radiates nothing is a row of zeros: its power loads nothing.
        loads = np.where(spread.usable, soft * power, UNUSED * power.max())
        loads[::each] = loading
    by_user = np.arange(users)
    by_other = reached.reshape(users, each, users).copy()
    by_other[by_user, :, by_user] = 0.0
    others = by_other.reshape(-1, users)
    weights: ComplexArray
    if len(loads) > len(points) and (loads > 0).all():
        # More directions than elements: the smaller matrix, by S* (G + X)^-1 = (S* X^-1 S^T + 1)^-1
        # S* X^-1.
        scaled = points.conj() / loads
        few = scaled @ points.T
        few.flat[:: len(few) + 1] += 1.0
        weights = spread.beams - np.linalg.solve(few, scaled @ others)
    else:
        loaded = gram.copy()
        loaded.flat[:: len(loaded) + 1] += loads
        weights = spread.beams - points.conj() @ np.linalg.solve(loaded, others)
    return weights


def power_gains(steering: ComplexArray, weights: ComplexArray) -> FloatArray:
    """Array gain of each column towards its own direction, |a^T f|^2 / |f|^2, (N,).

    0 for a zero column.
    """
    towards = np.einsum("mn,mn->n", steering, weights)
    power = np.einsum("mn,mn->n", weights, weights.conj()).real
    gains: FloatArray = (towards.real**2 + towards.imag**2) / np.maximum(power, 1e-300)
    return gains


def _apertures(array: Array, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Principal axes of the array across each line of sight, and its widths along them.

    Returns axes (N, 2, 3), the longer one first, and widths (N, 2) in metres: those of uniform
    lines with the same variance.
    """
    if array.axis is not None:
        along = directions @ array.axis
        seen = array.axis - along[:, np.newaxis] * directions
        length = np.sqrt(np.maximum(1 - along**2, 1e-30))
        axes = np.zeros((len(directions), 2, 3))
        axes[:, 0] = seen / length[:, np.newaxis]
        widths_m = np.zeros((len(directions), 2))
        widths_m[:, 0] = math.sqrt(12 * array.variance_m2.trace()) * length
        return axes, widths_m
    across = np.eye(3) - directions[:, :, np.newaxis] * directions[:, np.newaxis, :]
    values, vectors = np.linalg.eigh(across @ array.variance_m2 @ across)
    widths_m = np.sqrt(12 * np.maximum(values[:, :0:-1], 0.0))
    return vectors[:, :, :0:-1].transpose(0, 2, 1), widths_m


def _defocus_rad(
    array: Array, axes: FloatArray, apertures_m: FloatArray, widths: FloatArray
) -> FloatArray:
    """Quadratic phase (M, N) over the aperture, for bounds in natural widths (N, 2)."""
    ends_rad = np.interp(widths, WIDTHS, CURVATURES_RAD)
    beyond = CURVATURES_RAD[-1] / WIDTHS[-1] * widths
    ends_rad = np.where(widths > WIDTHS[-1], beyond, ends_rad)
    # A narrow axis has no curvature: its beam is wider than any bound.
    scale = np.sqrt(ends_rad) * 2 / np.maximum(apertures_m, 1e-9 * array.wavelength_m)
    along = array.centred_m @ (axes * scale[:, :, np.newaxis]).reshape(-1, 3).T
    along *= along
    phase: FloatArray = along[:, ::2] + along[:, 1::2]
    return phase


def _defocuses(array: Array, widths: FloatArray, depths: FloatArray) -> BoolArray:
    """Where a quadratic phase is used (N,): on lines seen from the side.

    Across a plane each axis spoils what the other has. Around a circle the phase is the same
    everywhere, or its parts cancel in the middle.
    """
    dense: BoolArray = widths <= MOST_DEFOCUSED * array.size
    return dense & (depths <= DEEP * widths) & (array.axis is not None)


def _parts(
    array: Array, directions: FloatArray, bounds_rad: FloatArray, beams: ComplexArray
) -> BoolArray:
    """For each user, the strongest part (M, N) of the array in which nothing cancels within the
    bound.

    A part is the elements so near to one of them that, within the bound, no phase turns against its
    by more than at the ends of a natural half-power beam.
    """
    placed = array.centred_m / array.wavelength_m
    centres = np.arange(0, array.size, -(-array.size // MOST_CENTRES))
    apart = np.sum((placed[centres, np.newaxis] - placed) ** 2, axis=2)
    found = np.empty(beams.shape, dtype=bool)
    for user, bound_rad in enumerate(bounds_rad.tolist()):
        power = np.abs(beams[:, user]) ** 2
        depth = placed @ directions[user]
        deep = np.abs(depth[centres, np.newaxis] - depth)
        aside = np.sqrt(np.maximum(apart - deep**2, 0.0))
        near = aside * math.sin(bound_rad) + deep * (1 - math.cos(bound_rad)) <= WIDTHS[0] / 2
        powers = near @ power
        strongest = near[np.argmax(powers)]
        alone = np.arange(array.size) == np.argmax(power)  # where no centre sees the user
        found[:, user] = strongest if powers.max() > power.max() else alone
    return found


def _around(
    directions: FloatArray,
    bounds_rad: FloatArray,
    axes: FloatArray,
    widths: FloatArray,
    elements: int,
) -> FloatArray:
    """Directions (N, K, 3): each user's own, then those within its bound around it.

    A line array sees one angle: its points lie to both sides. Others have rings of 6, 12, ...
    points, or points across the longer axis where there are too many users for a ring.
    """
    users = len(directions)
    most = min(MOST_POINTS, elements - users) // users if users > 1 else 0
    if most < 2:
        return directions[:, np.newaxis]
    rings = max(1, math.ceil(float(widths.max()) / NULL_SPACING))
    disc, radii = _pattern(rings, most, in_space=bool((widths[:, 1] > FEWEST_WIDTHS).any()))
    turned_rad = bounds_rad[:, np.newaxis] * radii
    aside = (np.sin(turned_rad) / np.maximum(radii, 1e-300))[:, :, np.newaxis] * (disc @ axes)
    return np.cos(turned_rad)[:, :, np.newaxis] * directions[:, np.newaxis] + aside


@functools.cache
def _pattern(rings: int, most: int, *, in_space: bool) -> tuple[FloatArray, FloatArray]:
    """The middle of the unit disc and points around it, (K, 2), and their distances from it, (K,).

    At most ``most`` points are in the disc, or on its first axis only unless ``in_space``.
    """
    if in_space and most >= 6:
        rings = 2 if rings >= 2 and most >= 18 else 1
        points = [
            (ring / rings * math.cos(angle), ring / rings * math.sin(angle))
            for ring in range(1, rings + 1)
            for angle in (math.pi / (3 * ring) * k for k in range(6 * ring))
        ]
    else:
        rings = min(rings, MOST_RINGS, most // 2)
        points = [(side * ring / rings, 0.0) for ring in range(1, rings + 1) for side in (1, -1)]
    disc = np.array([(0.0, 0.0), *points])
    return disc, np.hypot(*disc.T)


def _usable(
    gram: ComplexArray, around: FloatArray, directions: FloatArray, bounds_rad: FloatArray
) -> BoolArray:
    """Points (N K,) that may be nulled.

    Left out are points by which another UAV must be served (in its bound, or so near that the array
    can hardly tell them apart), and points to which the array radiates nothing.
    """
    users, each = around.shape[:2]
    power = gram.diagonal().real
    alike = np.abs(gram[:, ::each]) ** 2 > TOO_CLOSE**2 * np.outer(power, power[::each])
    inside = around.reshape(-1, 3) @ directions.T > np.cos(bounds_rad)
    blocked = (alike | inside).reshape(users, each, users)
    blocked[np.arange(users), :, np.arange(users)] = False
    usable: BoolArray = ~blocked.any(axis=2).ravel() & (power > 1e-12 * power.max())
    return usable
