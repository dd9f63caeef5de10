"""Beams widened to cover the likely error, or the guaranteed bound.

A UAV is likely within one angle of its predicted direction, and certainly within another one, its
pointing bound. The phases of ``shapes`` shape a beam for the likely angle with a floor within the
bound, or for the bound alone. The beams of other UAVs also have nulls at points around each UAV
(``nulls``). See docs/math.md 5.5.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array.geometry import Array
from companion.beams.array.steering import phasors, steering_matrix
from companion.beams.weights import cones, shapes
from companion.beams.weights.cones import ApertureCones, ConeSamples
from companion.values import BoolArray, ComplexArray, FloatArray, IntArray, Widen

WIDEST_RAD: Final = np.pi / 2  # angle beyond which beams are not widened further
NULLED_AT: Final = 0.7
"""Angle from a UAV's predicted direction to the nulled points around it, in likely angles."""
LEAST_RAD: Final = 1e-6  # likely angle below which no points around a UAV are nulled
BROADENED: Final = 0.9
"""Ratio to the sharp beam's gain in the middle below which a beam counts as broadened."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DirectionErrors:
    """Likely errors and bounds of N directions."""

    likely_rad: FloatArray  # (N,), the angle within which the UAV usually is
    bounds_rad: FloatArray  # (N,), the bound on the angle; 0: unbounded, ignored
    floor_db: float = 2.9  # least gain of a likely beam within the bound, where possible
    worth_db: float = 0.0  # least useful gain


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """Widened beams of B of N users, and the nulls of all.

    owners     (B,), the user of each beam, ascending: usually all
    each       K, the number of points per user
    points     (M, N K), steering vectors, K per user in the order of the users: the predicted
               direction, then those around it that are nulled as well
    outside    (N K, B), distance of each point outside each owner's cone, natural widths; 0 within
    """

    owners: IntArray
    each: int
    beams: ComplexArray  # (M, B), the shaped beams by themselves
    powers: FloatArray  # (B,), squared lengths of these beams
    broadened: BoolArray  # (B,), which of them are broadened
    points: ComplexArray
    lengths: FloatArray  # (N K,), squared lengths of the points S
    crossed: ComplexArray  # (N K, B), S^T S*, its columns for the owners' predicted directions
    gram: ComplexArray | None  # (N K, N K), S^T S*; None where no more than that is needed
    reached: ComplexArray  # (N K, B), fields of the beams at the points
    outside: FloatArray
    cones: ConeSamples  # samples for the least gain of each beam
    worth: float  # least useful gain

    @property
    def centres(self) -> ComplexArray:
        """Steering vectors (M, N) of the predicted directions: A."""
        return self.points[:, :: self.each]

    def of(self, users: IntArray) -> "Spread":
        """Return the part for some of the users, in the given order; all must have beams."""
        if len(users) == self.beams.shape[1]:
            return self
        rows = (users[:, np.newaxis] * self.each + np.arange(self.each)).ravel()
        return Spread(
            owners=np.arange(len(users)),
            each=self.each,
            beams=self.beams[:, users],
            powers=self.powers[users],
            broadened=self.broadened[users],
            points=self.points[:, rows],
            lengths=self.lengths[rows],
            crossed=self.crossed[np.ix_(rows, users)],
            gram=None if self.gram is None else self.gram[np.ix_(rows, rows)],
            reached=self.reached[np.ix_(rows, users)],
            outside=self.outside[np.ix_(rows, users)],
            cones=self.cones.of(users),
            worth=self.worth,
        )


def spread(
    array: Array,
    directions: FloatArray,
    known: DirectionErrors,
    widen: Widen,
    only: int | None = None,
) -> Spread | None:
    """Widen beams for unit directions (N, 3) in the array frame; None without widening.

    ``only`` is the one user whose beam is made; None: all have beams.
    """
    if widen is Widen.NO:
        return None
    across = shapes.aperture(array)
    angles_rad = np.minimum(np.array([known.bounds_rad, known.likely_rad]), WIDEST_RAD)
    seen = cones.cones_on_aperture(across, directions, angles_rad)
    around = _around(array, across, directions, seen.seen[:, :1], angles_rad[1])
    each = around.shape[1]
    around = around.reshape(-1, 3)
    points = steering_matrix(array, around)
    owners, centres = np.arange(len(directions)), points[:, ::each]
    gram: ComplexArray | None = None
    if only is None:
        gram = points.T @ points.conj()
        lengths, crossed = gram.diagonal().real, gram[:, ::each]
    else:
        owners, seen, directions = owners[[only]], seen.of([only]), directions[[only]]
        centres = centres[:, [only]]
        if points.shape[1] <= len(points):
            gram = points.T @ points.conj()
        lengths, crossed = np.vecdot(points.T, points.T).real, points.T @ centres.conj()
    if widen is Widen.LIKELY:
        cone, usual = seen.furthest * (across.lengths_m / array.wavelength_m)
        phases = shapes.phases_rad(across, cone, usual, known.floor_db, known.worth_db)
    else:
        phases = _for_the_bound_rad(array, across, seen)
    turned = phasors(phases).T
    beams = centres.conj() * turned
    return Spread(
        owners=owners,
        each=each,
        beams=beams,
        powers=lengths[owners * each],  # phases alone shape a beam
        broadened=np.abs(turned.sum(axis=0) / array.size) ** 2 < BROADENED,
        points=points,
        lengths=lengths,
        crossed=crossed,
        gram=gram,
        reached=points.T @ beams,
        outside=cones.outside(across, seen, around, array.wavelength_m),
        cones=cones.cones(array, across, directions, seen, centres),
        worth=10 ** (known.worth_db / 10),
    )


def _for_the_bound_rad(array: Array, across: shapes.Aperture, seen: ApertureCones) -> FloatArray:
    """Return phases (N, M) for the bound alone: each beam points at the middle of its interval."""
    shaped = shapes.phases_rad(across, seen.halves[0] * across.lengths_m / array.wavelength_m, None)
    aside = (seen.middles[0] - seen.seen) @ (array.centred_m @ across.axes.T).T
    found: FloatArray = shaped - array.wavenumber_radpm * aside
    return found


def power_gains(steering: ComplexArray, weights: ComplexArray) -> FloatArray:
    """Return the gain of each column towards its own direction, |a^T f|^2 / |f|^2, (N,).

    0 for a zero column.
    """
    towards = np.vecdot(steering.conj().T, weights.T)
    power = np.vecdot(weights.T, weights.T).real
    gains: FloatArray = (towards.real**2 + towards.imag**2) / np.maximum(power, 1e-300)
    return gains


def _around(
    array: Array,
    across: shapes.Aperture,
    directions: FloatArray,
    along: FloatArray,
    likely_rad: FloatArray,
) -> FloatArray:
    """Return directions (N, K, 3): each user's own, then points about it on each array axis.

    ``along`` (N, 1) are the cosines of the directions to the first axis. Each point needs a null,
    so none are added if the array lacks degrees of freedom.
    """
    users, axes = len(directions), across.axes
    spare = (array.size - users) // users if users > 1 else 0
    if spare < 2 * len(axes) or not likely_rad.max() > LEAST_RAD:
        return directions[:, np.newaxis]
    turned_rad = NULLED_AT * likely_rad[:, np.newaxis]
    first = axes[0] - along * directions
    first /= np.maximum(np.sqrt(np.maximum(1.0 - along * along, 0.0)), 1e-9)
    sides = [first] if len(axes) == 1 else [first, np.cross(directions, first)]
    level, aside = np.cos(turned_rad) * directions, np.sin(turned_rad)
    found: FloatArray = np.empty((users, 1 + 2 * len(sides), 3))
    found[:, 0] = directions
    for i, side in enumerate(sides):
        swung = aside * side
        found[:, 1 + 2 * i], found[:, 2 + 2 * i] = level + swung, level - swung
    return found
