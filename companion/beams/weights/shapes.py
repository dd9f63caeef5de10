"""Phases over the aperture for a beam of a given width, interpolated from tables.

Each element has its own amplifier, so all radiate equal power and only their phases shape the beam.
Widths are in natural beams: an angle e across an aperture D is w = e D / wavelength. The tables
were optimised offline (``docs/make_beam_shapes.py``) for 64 elements on a line and 16 x 16 in a
square; with positions in apertures from the middle, they apply to any number. The square's 16 x 16
grid is too coarse for wide beams: there a plane uses the sum of two lines. See docs/math.md 5.5.
"""

import functools
import io
import math
from importlib import resources
from typing import Final, NamedTuple

import numpy as np

from companion.beams.array.geometry import Array
from companion.values import FloatArray, IntArray

TABLES: Final = "shapes.npz"
CORNERS: Final = np.indices((2, 2, 2)).reshape(3, 8).T  # the corners (8, 3) of a cell of three axes
WIDEST_PER_ELEMENT: Final = 0.375
"""Widest beam per element, in natural widths; elements cannot shape a wider one."""
LOSS_PER_MISSING_DB: Final = 2.0
"""Additional loss in dB, accepted for each dB by which a floor misses the useful gain."""
SPARE_DB: Final = 2.5
"""Margin of a floor over the useful gain, dB: nulls and points between samples reduce it."""
LINE_TRANSITION_WIDTHS: Final = (3.8, 4.8)
"""Start and end of the blend from square to line tables, in natural widths of a planar beam."""
LEAST_SHARE: Final = 1 / 16
"""Least ratio of a planar beam's widths on its two axes that its shapes follow."""


class Shapes(NamedTuple):
    """Tables of phases for one kind of aperture; phases are psi over it, times 2 pi w in radians.

    places    (n,), positions of the phases, in apertures from the middle; on each axis of a square
    least_db  (W,), that gain over the number of elements, at the least: losses count from there
    losses    (L,), loss of the floor over the cone from the largest least gain, dB

    Widths, losses, cones and ratios are natural logarithms; all but the losses are evenly spaced.
    """

    places: FloatArray
    widths: FloatArray  # (W,), ascending
    guaranteed: FloatArray  # (W, K), phases of the largest least gain within the width
    least_db: FloatArray
    losses: FloatArray
    cones: FloatArray  # (C,), ascending
    ratios: FloatArray  # (R,), the cone's width over the likely one, ascending from 1
    likely: FloatArray  # (L C R, K), phases of the largest mean likely gain above that floor
    first: FloatArray  # (3, 1), start of the axes: 0 for losses, by number; cones; ratios
    knots_per_unit: FloatArray  # (3, 1), 1 for losses; cones; ratios
    last: IntArray  # (3, 1), the last but one of each
    strides: IntArray  # (3,), rows of ``likely`` from one of each to the next
    corners: IntArray  # (8,), rows from the first to all corners of a cell; the ratio runs fastest


@functools.cache
def _table(name: str) -> Shapes:
    count, axes = (64, 1) if name == "line" else (16, 2)
    even = _even(count) if axes == 1 else np.kron(_even(count), _even(count))
    file = resources.files(__package__) / TABLES
    with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as held:
        counts = [len(held[f"{name}_{axis}"]) for axis in ("losses_db", "cones", "ratios")]
        strides = np.array([counts[1] * counts[2], counts[2], 1])
        cones, ratios = np.log(held[f"{name}_cones"]), -np.log(held[f"{name}_ratios"])
        lengths = np.array([counts[0] - 1, cones[-1] - cones[0], ratios[-1] - ratios[0]])
        return Shapes(
            places=(np.arange(count) - (count - 1) / 2) / count,
            widths=np.log(held[f"{name}_widths"]),
            guaranteed=held[f"{name}_sure"].astype(float),
            least_db=held[f"{name}_least_db"],
            losses=np.log(held[f"{name}_losses_db"]),
            cones=cones,
            ratios=ratios,
            likely=held[f"{name}_likely"].astype(float).reshape(-1, count**axes // 2**axes)
            @ even.T,
            first=np.array([[0.0], [cones[0]], [ratios[0]]]),
            knots_per_unit=((np.array(counts) - 1) / lengths)[:, np.newaxis],
            last=np.array(counts)[:, np.newaxis] - 2,
            strides=strides,
            corners=CORNERS @ strides,
        )


def _even(count: int) -> FloatArray:
    """Return the matrix (count, count / 2) that mirrors half of an even function, middle first."""
    half = count // 2
    return np.concatenate([np.eye(half)[::-1], np.eye(half)])


class Aperture(NamedTuple):
    """Array as the shape tables see it: a line, or a plane with two axes.

    knots      (K, M), interpolation from a line's table to its elements; empty for a plane
    """

    shapes: Shapes  # the tables
    axes: FloatArray  # (D, 3), the line, or the two axes of the plane, array frame
    lengths_m: FloatArray  # (D,), those of uniform apertures with the same variance
    natural_rad: float  # natural width of the longer axis
    most: FloatArray  # (D,), the widest possible beam in natural widths, by the element spacing
    placed: FloatArray  # (M, D), the elements in apertures from the middle
    knots: FloatArray


@functools.lru_cache(maxsize=8)
def aperture(array: Array) -> Aperture:
    """Return the aperture of an array; cached by array."""
    counts = np.array([array.size]) if array.axis is not None else np.full(2, array.size**0.5)
    if array.grid is not None:
        axes = np.eye(3)[[place for place in (1, 2) if array.grid[2 - place] > 1] or [1]]
        counts = np.array([max(array.grid)] if len(axes) == 1 else array.grid[::-1])
    elif array.axis is not None:
        axes = array.axis[np.newaxis]
    else:
        axes = np.linalg.eigh(array.variance_m2)[1].T[:0:-1]
    variances = np.einsum("dk,kl,dl->d", axes, array.variance_m2, axes)
    # n points one step apart have the variance of a continuous line of sqrt(n^2 - 1) steps.
    longer = counts / np.sqrt(np.maximum(counts**2 - 1.0, 1e-9))
    lengths_m = np.sqrt(12 * np.maximum(variances, 0.0)) * np.where(counts > 1, longer, 0.0)
    placed = array.centred_m @ axes.T / np.maximum(lengths_m, 1e-300)
    shapes = _table("line" if len(axes) == 1 else "square")
    knots = np.zeros((len(shapes.places), array.size if len(axes) == 1 else 0))
    if len(axes) == 1:
        before, share = _between(shapes.places, placed[:, 0])
        knots[before, np.arange(array.size)] = 1 - share
        knots[before + 1, np.arange(array.size)] = share
    return Aperture(
        shapes=shapes,
        axes=axes,
        lengths_m=lengths_m,
        natural_rad=array.wavelength_m / max(float(lengths_m.max()), 1e-9),
        most=WIDEST_PER_ELEMENT * counts,
        placed=placed,
        knots=knots,
    )


def phases_rad(
    across: Aperture,
    cones: FloatArray,
    likely: FloatArray | None,
    floor_db: float = 0.0,
    worth_db: float = 0.0,
) -> FloatArray:
    """Return the phases (N, M) that shape N beams.

        across    the aperture
        cones     (N, D), widths of the bound on each axis
        likely    (N, D), widths of the likely error; None: only the bound counts
        floor_db  least gain wanted over the cone, over an isotropic element; not above the best
                  possible gain less the least of ``losses``
        worth_db  least useful gain: a floor below it is given up

    The phases are continuous in all arguments, and 0 where the widths are 0.
    """
    cones = np.minimum(cones, across.most)
    width = cones.max(axis=1)
    shapes = across.shapes
    within = None if likely is None else np.minimum(likely, cones)
    if len(across.axes) == 1:
        (psi,) = _psi(
            shapes, cones, within, elements=len(across.placed), floor_db=floor_db, worth_db=worth_db
        )
        return np.asarray(2 * np.pi * cones * (psi @ across.knots))
    far = np.interp(np.log(np.maximum(width, 1e-9)), np.log(LINE_TRANSITION_WIDTHS), (0.0, 1.0))[
        :, np.newaxis
    ]
    found = np.zeros((len(cones), len(across.placed)))
    if (far < 1).any():
        usual = None if within is None else within.max(axis=1, keepdims=True)
        (psi,) = _psi(
            shapes,
            width[:, np.newaxis],
            usual,
            elements=len(across.placed),
            floor_db=floor_db,
            worth_db=worth_db,
        )
        shares = cones / np.maximum(width, 1e-300)[:, np.newaxis]
        shares = np.sqrt(np.maximum(shares, LEAST_SHARE))
        square = _on_square(shapes, psi, across.placed * shares[:, np.newaxis])
        found += (1 - far) * width[:, np.newaxis] * square
    if far.any():
        line = _table("line")
        # A product of lines would pay for a floor on both axes, which is more than it is worth.
        each = _psi(
            line, cones, within, elements=len(across.placed), floor_db=-math.inf, worth_db=worth_db
        )
        sides = [_on_line(line, one, across.placed[:, d]) for d, one in enumerate(each)]
        found += far * sum(cones[:, d, np.newaxis] * side for d, side in enumerate(sides))
    return np.asarray(2 * np.pi * found)


def _psi(
    shapes: Shapes,
    cones: FloatArray,
    likely: FloatArray | None,
    *,
    elements: int,
    floor_db: float,
    worth_db: float,
) -> list[FloatArray]:
    """Return the table's phases psi (N, K) for each column of widths (N, D), to be summed."""
    columns = range(cones.shape[1])
    wide = np.log(np.maximum(cones, 1e-300))
    if likely is None:
        return [_guaranteed_phases(shapes, wide[:, d]) for d in columns]
    narrow = np.log(np.maximum(likely, 1e-300))
    best_db = np.interp(wide, shapes.widths, shapes.least_db).sum(axis=1)
    best_db += 10 * math.log10(elements)
    least_db = len(columns) * math.exp(shapes.losses[0])
    lacking_db = np.maximum(worth_db + SPARE_DB + least_db - best_db, 0.0)
    loss_db = np.maximum(best_db - floor_db, least_db) + LOSS_PER_MISSING_DB * lacking_db
    numbers = np.arange(len(shapes.losses))
    losses = np.interp(np.log(loss_db / len(columns)), shapes.losses, numbers)
    return [_likely_phases(shapes, losses, wide[:, d], narrow[:, d]) for d in columns]


def _between(knots: FloatArray, at: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the (ascending) knot before each point, and the next knot's weight; extrapolated."""
    before = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    return before, (at - knots[before]) / (knots[before + 1] - knots[before])


def _guaranteed_phases(shapes: Shapes, widths: FloatArray) -> FloatArray:
    """Return the phases (N, K) of the largest least gain; widths (N,) as logarithms."""
    last = len(shapes.widths) - 1
    places = (widths - shapes.widths[0]) * (last / (shapes.widths[-1] - shapes.widths[0]))
    places = np.minimum(np.maximum(places, 0.0), last)
    before = np.minimum(places.astype(np.int64), last - 1)
    part = (places - before)[:, np.newaxis]
    found: FloatArray = (1 - part) * shapes.guaranteed[before] + part * shapes.guaranteed[
        before + 1
    ]
    return found


def _likely_phases(
    shapes: Shapes, losses: FloatArray, cones: FloatArray, likely: FloatArray
) -> FloatArray:
    """Return the phases (N, K) of the largest likely gain.

    Cones and likely widths (N,) are logarithms; losses (N,) are places on their axis, in knots.
    """
    places: FloatArray = np.empty((3, len(losses)))
    places[0], places[1] = losses, cones
    np.subtract(cones, likely, out=places[2])
    places = (places - shapes.first) * shapes.knots_per_unit
    places = np.minimum(np.maximum(places, 0.0), shapes.last + 1)
    before = np.minimum(places.astype(np.int64), shapes.last)
    # The eight corners of each cell, and their shares.
    share: FloatArray = np.empty((2, *places.shape))
    np.subtract(places, before, out=share[1])
    np.subtract(1.0, share[1], out=share[0])
    shares = share[:, np.newaxis, np.newaxis, 0] * share[:, np.newaxis, 1] * share[:, 2]
    corners = (shapes.strides @ before)[:, np.newaxis] + shapes.corners
    phases = shares.reshape(8, -1).T[:, np.newaxis] @ shapes.likely[corners]
    return np.asarray(phases[:, 0])


def _on_line(shapes: Shapes, psi: FloatArray, placed: FloatArray) -> FloatArray:
    """Interpolate phases psi (N, n) of a line linearly at points (M,)."""
    before, share = _between(shapes.places, placed)
    found: FloatArray = (1 - share) * psi[:, before] + share * psi[:, before + 1]
    return found


def _on_square(shapes: Shapes, psi: FloatArray, placed: FloatArray) -> FloatArray:
    """Interpolate phases psi (N, n n) of a square bilinearly at points (N, M, 2)."""
    users, count = np.arange(len(psi))[:, np.newaxis], len(shapes.places)
    grid = psi.reshape(-1, count, count)
    (i, j), (a, b) = zip(*(_between(shapes.places, placed[:, :, d]) for d in (0, 1)), strict=True)
    before = (1 - b) * grid[users, i, j] + b * grid[users, i, j + 1]
    after = (1 - b) * grid[users, i + 1, j] + b * grid[users, i + 1, j + 1]
    found: FloatArray = (1 - a) * before + a * after
    return found
