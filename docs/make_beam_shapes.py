"""Makes ``companion/beams/weights/shapes.npz``: phases over an aperture that shape a beam.

    python docs/make_beam_shapes.py            makes the tables, some minutes on one core
    python docs/make_beam_shapes.py --check    prints them beside the optima of their kind

One amplifier feeds each element, so all elements radiate alike and only their phases shape the
beam. A table holds phase functions psi over the normalised aperture of a line or a square, and the
phase at place x for a width w is 2 pi w psi(x). Widths are in natural beams: an angle e across an
aperture D is w = e D / wavelength. There are two tables of each kind:

    sure    over w: the least gain within w is the greatest
    likely  over the cone c, the ratio of the likely error to it, and a loss: the mean of the gain
            in dB, for a normal error whose 95th percentile is the likely width, is the greatest,
            while within c the gain is nowhere below what ``sure`` has there by more than the loss

All entries of a table are found at once, with the places between them in the sum that is made
best: what is interpolated is then as good as what is stored. The gain of an array is |a^T f|^2 /
|f|^2, in which a table for 64 elements serves 16 and 256.

The reference with amplitudes free (``most_with_amplitudes``) is exact: the gain towards u is a
non-negative trigonometric polynomial in its autocorrelation r, r_0 = 1, and every such polynomial
is the gain of some weights (Fejer and Riesz): the greatest least gain is a linear programme.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.optimize import minimize

Array = np.ndarray[Any, Any]
OUT = Path(__file__).parent.parent / "companion" / "beams" / "weights" / "shapes.npz"
PLANS = (
    ("line", 2 ** (-np.arange(16) / 3), (3.0, 5.0, 7.0, 10.0, 14.0), 450),
    ("square", 2.0 ** -np.arange(5), (3.0, 8.0), 100),
)
"""Kinds of apertures: ratios of the likely width to the cone, losses, and rounds at the end."""
P95 = 1.96
LEAST_WIDTH = 0.25


# --- apertures ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """A line of 64."""

    size: int = 64
    reaches: float = 24.0

    @property
    def places(self) -> Array:
        """Places of the table's phases, (K, 1), in apertures from the middle."""
        return _places(self.size)[:, np.newaxis]

    @property
    def even(self) -> Array:
        """Phases of the table (K, J) from those that are free where it is even."""
        return _mirrored(self.size)

    def of(self, elements: int) -> tuple[Array, Array]:
        """Phases of a line of so many elements from the table's, and their places (M, 1)."""
        places = _places(elements)
        return _interpolation(_places(self.size), places), places[:, np.newaxis]

    def points(self, width: float, finer: float = 8.0, half: bool = False) -> Array:
        """Places (P, 1) within a width; those to one side only for what is even."""
        side = np.linspace(0, width, max(10, int(np.ceil(width * finer)) + 1))[:, np.newaxis]
        return side if half else np.concatenate([-side[:0:-1], side])


@dataclass(frozen=True)
class Square:
    """A square of 16 x 16."""

    size: int = 16
    reaches: float = 5.0

    @property
    def places(self) -> Array:
        """Places of the table's phases, (K, 2), in apertures from the middle."""
        return _pairs(_places(self.size))

    @property
    def even(self) -> Array:
        """Phases of the table (K, J) from those that are free where it is even on both axes."""
        return np.kron(_mirrored(self.size), _mirrored(self.size))

    def of(self, elements: int) -> tuple[Array, Array]:
        """Phases of elements x elements from the table's, and their places (M, 2)."""
        along = _interpolation(_places(self.size), _places(elements))
        return np.kron(along, along), _pairs(_places(elements))

    def points(self, width: float, finer: float = 6.0, half: bool = False) -> Array:
        """Places (P, 2) within a disc; those of a quarter only for what is even."""
        whole, found = (np.pi / 2 if half else 2 * np.pi), [np.zeros((1, 2))]
        for radius in np.linspace(0, width, max(5, int(np.ceil(width * finer)) + 1))[1:]:
            turns = np.linspace(0, whole, max(5, int(np.ceil(radius * finer * whole)) + 1))
            found.append(radius * np.stack([np.cos(turns), np.sin(turns)], axis=1))
        return np.concatenate(found)


def _places(count: int) -> Array:
    return (np.arange(count) - (count - 1) / 2) / count


def _pairs(places: Array) -> Array:
    return np.stack(np.meshgrid(places, places, indexing="ij"), axis=2).reshape(-1, 2)


def _mirrored(count: int) -> Array:
    """What is even (count, count / 2) from its half, the middle first."""
    half = count // 2
    return np.concatenate([np.eye(half)[::-1], np.eye(half)])


def _interpolation(knots: Array, places: Array) -> Array:
    """Linear interpolation as a matrix, onward beyond the ends."""
    at = np.clip(np.searchsorted(knots, places) - 1, 0, len(knots) - 2)
    share = (places - knots[at]) / (knots[at + 1] - knots[at])
    rows = np.zeros((len(places), len(knots)))
    rows[np.arange(len(places)), at] += 1 - share
    rows[np.arange(len(places)), at + 1] += share
    return rows


def response(points: Array, places: Array) -> Array:
    """What elements at places (M, D) radiate to points (P, D), by unit weights: (P, M)."""
    return np.exp(2j * np.pi * points @ places.T)


Aperture = Line | Square


# --- the search ---------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Term:
    """One place in a table that is judged, and how.

    share    entries of the table, and what part each has in the phases
    width    2 pi times the width that phases are scaled by
    phases   phases of the elements from those of the table
    response of the elements at the points
    size     number of elements
    mean     shares of the points in the mean gain; None: the least gain is what counts
    floor    least gain at each point, as a power ratio; 0 where there is none
    """

    share: tuple[tuple[int, float], ...]
    width: float
    phases: Array
    response: Array
    size: int
    mean: Array | None = None
    floor: Array | None = None


def _judged(term: Term, table: Array, sharpness: float) -> tuple[float, Array]:
    """What is to be made small, and its slope by the phases psi of this term."""
    psi = sum(part * table[entry] for entry, part in term.share)
    radiated = np.exp(1j * term.width * (term.phases @ psi))
    field = term.response @ radiated
    gain = (field.real**2 + field.imag**2) / term.size + 1e-6
    if term.mean is None or term.floor is None:
        steep = -sharpness * np.log(gain)
        top = steep.max()
        parts = np.exp(steep - top)
        cost = (top + np.log(parts.mean())) / sharpness
        slope = -(parts / parts.sum()) / gain
    else:
        short = np.maximum(np.log(np.maximum(term.floor, 1e-9) / gain), 0.0)
        weight = 10.0 * sharpness / max(1, int((term.floor > 0).sum()))
        cost = -term.mean @ np.log(gain) + weight * float(short @ short)
        slope = -(term.mean + 2 * weight * short) / gain
    by_phase = 2 * np.real((field.conj() * slope) @ term.response * (1j * radiated)) / term.size
    return float(cost), term.width * (by_phase @ term.phases)


def searched(terms: Sequence[Term], begin: Array, rounds: Sequence[tuple[float, int]]) -> Array:
    """The table (entries, parameters) that makes all terms best together, from a beginning."""

    def cost(flat: Array, sharpness: float) -> tuple[float, Array]:
        table = flat.reshape(begin.shape)
        slopes, total = np.zeros_like(table), 0.0
        for term in terms:
            one, slope = _judged(term, table, sharpness)
            total += one
            for entry, part in term.share:
                slopes[entry] += part * slope
        return total, slopes.ravel()

    flat = begin.ravel()
    for sharpness, most in rounds:
        limits = {"maxiter": most, "maxcor": 20}
        flat = minimize(cost, flat, (sharpness,), jac=True, method="L-BFGS-B", options=limits).x
    return flat.reshape(begin.shape)


def _bowl(aperture: Aperture) -> Array:
    """The phases of a quadratic, by which each part looks elsewhere: where the search begins."""
    return 0.9 * (aperture.places**2).sum(axis=1)


def _core(aperture: Aperture, ratio: float, edge: float) -> Array:
    """A core that looks at the likely part, and edges that look at the rest of the cone."""
    middle = max(edge * (1 - ratio), 1e-3)
    x = np.minimum(np.linalg.norm(aperture.places, axis=1), 0.5)
    beyond = x - middle
    outer = ratio * middle / 2 + ratio * beyond + (1 - ratio) * beyond**2 / (2 * (0.5 - middle))
    return np.where(beyond < 0, ratio * x**2 / (2 * middle), outer)


def _sizes(aperture: Aperture) -> tuple[int, ...]:
    return (64, 16, 256) if isinstance(aperture, Line) else (16, 8)


def make_sure(aperture: Aperture, widths: Array) -> Array:
    """The table of greatest least gains, (W, K).

    Even phases are searched for first. About one natural width it is better to turn one end of the
    aperture round, which is not even. From what is even no slope leads away from it: a little
    noise does, which pays up to 1.5 widths. What is best all in all is kept.
    """
    even, logs = aperture.even, np.log(widths)
    grown = np.outer(np.clip(widths / 0.9, 0.05, 1.0), np.linalg.pinv(even) @ _bowl(aperture))
    terms = _sure_terms(aperture, widths, even)
    found = searched(terms, grown, ((2, 120), (8, 250), (30, 400), (80, 800))) @ even.T
    begin = found.copy()
    turned = (logs > np.log(0.53)) & (logs < np.log(0.93))
    ends = np.pi * (aperture.places > 0.336).sum(axis=1)
    begin[turned] = ends / (2 * np.pi * widths[turned, np.newaxis])
    terms = _sure_terms(aperture, widths, np.eye(len(aperture.places)))
    tried = [searched(terms, one, ((30, 250), (80, 500))) for one in (found, begin)]
    for seed in range(1, 7):
        noise = np.random.default_rng(seed).normal(0.0, 0.05, found.shape)
        noise /= widths[:, np.newaxis]
        stirred = searched(terms, tried[0] + noise, ((10, 100), (30, 250), (80, 600)))
        tried.append(np.where(widths[:, np.newaxis] < 1.5, stirred, tried[0]))
    costs = [sum(_judged(term, one, 80.0)[0] for term in terms) for one in tried]
    print("  even, an end turned, stirred:", *(f"{cost:.2f}" for cost in costs), flush=True)
    return tried[int(np.argmin(costs))]


def _sure_terms(aperture: Aperture, widths: Array, free: Array) -> list[Term]:
    """What is judged of least gains: places in the table, for several numbers of elements."""
    logs, terms = np.log(widths), []
    steps = np.arange(0, len(widths) - 1 + 1e-9, 1 / 3)
    is_even = free.shape[1] < free.shape[0]
    for elements in _sizes(aperture):
        phases, places = aperture.of(elements)
        most = 0.5 * elements if elements == aperture.size else min(0.4 * elements, 10.0)
        for width in np.exp(np.interp(steps, np.arange(len(widths)), logs)):
            if width > most:
                continue
            at = min(int(np.searchsorted(logs, np.log(width), "right")) - 1, len(widths) - 2)
            part = (np.log(width) - logs[at]) / (logs[at + 1] - logs[at])
            share = ((at, 1 - part), (at + 1, part))
            seen = response(aperture.points(width, half=is_even), places)
            terms.append(
                Term(
                    share=share,
                    width=2 * np.pi * width,
                    phases=phases @ free,
                    response=seen,
                    size=len(places),
                )
            )
    return terms


def make_likely(
    aperture: Aperture,
    cones: Array,
    *,
    ratios: Array,
    floors: Array,
    wider: Array | None,
    most: int,
    along: bool = True,
) -> Array:
    """The table (C, R, J) of greatest means over a floor (C,), power ratios, by its even half.

    A column of one ratio is made after the other, from several beginnings: the column before where
    ``along``, and that of another loss, ``wider`` (C, R, J). Then all are made together.
    """
    inner = np.linalg.pinv(aperture.even)
    columns: list[Array] = []
    grows = np.clip(cones / 0.9, 0.05, 1.0)
    for column, ratio in enumerate(ratios):
        terms = _likely_terms(aperture, cones, ratios[column : column + 1], floors)
        begins = columns[-1:] if along else []
        if wider is None:
            edges = (0.25, 0.33, 0.4)
            begins += [np.outer(grows, inner @ _core(aperture, ratio, edge)) for edge in edges]
        else:
            begins.append(wider[:, column])
        rounds = ((0.3, 60), (3, 120), (30, 150)) if wider is None else ((3, 100), (30, 150))
        made = [searched(terms, begin, rounds) for begin in begins]
        costs = [sum(_judged(term, one, 100.0)[0] for term in terms) for one in made]
        columns.append(made[int(np.argmin(costs))])
    table = np.stack(columns, axis=1)
    terms = _likely_terms(aperture, cones, ratios, floors)
    flat = table.reshape(-1, table.shape[2])
    rounds = ((10, 100), (30, 150), (100, most), (300, most // 2))
    return searched(terms, flat, rounds).reshape(table.shape)


def _likely_terms(aperture: Aperture, cones: Array, ratios: Array, floors: Array) -> list[Term]:
    """What is judged of some ratios: each entry, and each place in the middle between entries."""
    phases, places = aperture.of(aperture.size)
    phases = phases @ aperture.even
    logs, terms = np.log(cones), []
    for c in np.arange(0, len(cones) - 1 + 1e-9, 0.5):
        for r in np.arange(0, len(ratios) - 1 + 1e-9, 0.5):
            i, j = min(int(c), len(cones) - 2), max(min(int(r), len(ratios) - 2), 0)
            a, b = c - i, r - j
            corners = tuple(
                ((i + m) * len(ratios) + j + n, part)
                for m in (0, 1)
                for n in (0, 1)
                if (part := (a if m else 1 - a) * (b if n else 1 - b)) > 0
            )
            cone = float(np.exp((1 - a) * logs[i] + a * logs[i + 1]))
            beyond = ratios[min(j + 1, len(ratios) - 1)]
            likely = cone * float(ratios[j] ** (1 - b) * beyond**b)
            floor = float(floors[i] ** (1 - a) * floors[i + 1] ** a)
            points, shares = _weighed(aperture, cone, likely)
            seen = response(points, places)
            under = np.full(len(points), floor)
            terms.append(
                Term(
                    share=corners,
                    width=2 * np.pi * cone,
                    phases=phases,
                    response=seen,
                    size=len(places),
                    mean=shares,
                    floor=under,
                )
            )
    return terms


def _weighed(aperture: Aperture, cone: float, likely: float) -> tuple[Array, Array]:
    """Points of one side within a cone, denser where the UAV likely is, and how likely each is."""
    fine = max(8.0, 10 / likely)
    points = np.concatenate(
        [aperture.points(min(1.3 * likely, cone), fine, True), aperture.points(cone, 7.0, True)]
    )
    off = np.round(np.linalg.norm(points, axis=1), 9)
    rings, at, counts = np.unique(off, return_inverse=True, return_counts=True)
    edges = np.concatenate([[0.0], (rings[1:] + rings[:-1]) / 2, [rings[-1]]])
    whole = np.diff(edges) if isinstance(aperture, Line) else np.diff(edges**2)
    shares = np.exp(-0.5 * (off / (likely / P95)) ** 2) * (whole / counts)[at]
    return points, shares / shares.sum()


# --- what a table has ---------------------------------------------------------------------------


def least_db(aperture: Aperture, psi: Array, width: float, elements: int) -> float:
    """The least gain within a width, dB."""
    phases, places = aperture.of(elements)
    radiated = np.exp(2j * np.pi * width * (phases @ psi))
    field = response(aperture.points(width, 20.0), places) @ radiated
    return 10 * float(np.log10((np.abs(field) ** 2).min() / len(places)))


def most_with_amplitudes_db(width: float, elements: int) -> float:
    """The greatest least gain within a width that a line of elements can have with any weights."""
    u = np.union1d(np.linspace(0, elements / 2, 8 * elements + 1), np.linspace(0, width, 200))
    cosines = 2 * np.cos(2 * np.pi * np.outer(u, np.arange(1, elements)) / elements)
    r, least = cp.Variable(elements - 1), cp.Variable()
    gain = 1 + cosines @ r
    cp.Problem(cp.Maximize(least), [gain[u <= width] >= least, gain >= 0]).solve(solver=cp.CLARABEL)
    return 10 * float(np.log10(least.value))


def most_with_phases_db(aperture: Aperture, width: float, elements: int, tries: int = 30) -> float:
    """The best least gain that a search over the phases of one array alone finds, dB."""
    rng = np.random.default_rng(1)
    _, places = aperture.of(elements)
    own, fine = np.eye(len(places)), response(aperture.points(width, 20.0), places)
    seen = response(aperture.points(width, 10.0), places)
    best = -np.inf
    for number in range(tries):
        bend = rng.uniform(0.0, 1.3, places.shape[1]) * (1 if number % 2 else rng.choice([-1, 1]))
        begin = 2 * np.pi * width * (places**2 @ bend)
        begin += rng.standard_normal(len(places)) * (0.3 if number % 3 else 0.02)
        term = Term(share=((0, 1.0),), width=1.0, phases=own, response=seen, size=len(places))
        rounds = ((2, 100), (8, 150), (30, 200), (100, 300))
        found = searched([term], begin[np.newaxis], rounds)
        field = fine @ np.exp(1j * found[0])
        best = max(best, 10 * float(np.log10((np.abs(field) ** 2).min() / len(places))))
    return best


def interpolated(widths: Array, table: Array, width: float) -> Array:
    """The entry of a width between those of a table over widths."""
    at = min(max(int(np.searchsorted(widths, width, "right")) - 1, 0), len(widths) - 2)
    part = np.log(width / widths[at]) / np.log(widths[at + 1] / widths[at])
    return (1 - part) * table[at] + part * table[at + 1]


def check() -> None:
    """Print the tables beside the optima of their kind."""
    held = np.load(OUT)
    for name, aperture in (("line", Line()), ("square", Square())):
        widths, table = held[f"{name}_widths"], held[f"{name}_sure"]
        for elements in _sizes(aperture):
            for width in (0.25, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0):
                if width > min(elements / 2.5, aperture.reaches):
                    continue
                ours = least_db(aperture, interpolated(widths, table, width), width, elements)
                tries = 30 if elements <= 64 and name == "line" else 6
                alone = most_with_phases_db(aperture, width, elements, tries)
                said = (
                    f"{name} of {elements}, w = {width:5}: {ours:6.2f} dB, {ours - alone:+.2f} on"
                )
                said += " a search over phases"
                if name == "line" and elements <= 64:
                    said += f", {ours - most_with_amplitudes_db(width, elements):+.2f} on all"
                print(said, flush=True)


def main() -> None:
    """Make the tables, or print them."""
    if "--check" in sys.argv:
        check()
        return
    made: dict[str, Array] = {}
    for name, ratios, losses_db, most in PLANS:
        aperture = Line() if name == "line" else Square()
        octaves = float(np.log2(aperture.reaches / LEAST_WIDTH))
        widths = LEAST_WIDTH * 2 ** np.linspace(0, octaves, round(octaves * 6) + 1)
        sure = make_sure(aperture, widths)
        print(name, "sure", flush=True)
        cones = LEAST_WIDTH * 2 ** np.linspace(0, octaves, round(octaves * 3) + 1)
        least = [
            least_db(aperture, interpolated(widths, sure, cone), cone, aperture.size)
            for cone in np.minimum(cones, 0.9 * aperture.reaches)
        ]
        floors = [10 ** ((np.array(least) - loss_db) / 10) for loss_db in losses_db]
        likely: list[Array] = []
        for floor in floors:
            wider = likely[-1] if likely else None
            likely.append(
                make_likely(aperture, cones, ratios=ratios, floors=floor, wider=wider, most=most)
            )
            print(name, "likely", len(likely), flush=True)
        if name == "line":
            # What is between two losses is the mean of their phases, which must be of one kind: the
            # first, which began from nothing, is made once more from the second. (A square's are.)
            likely[0] = make_likely(
                aperture,
                cones,
                ratios=ratios,
                floors=floors[0],
                wider=likely[1],
                most=most,
                along=False,
            )
        # 5e-4 of the phase, which is at most some 30 rad, is all that half precision costs.
        made |= {
            f"{name}_widths": widths, f"{name}_sure": sure.astype(np.float32),
            f"{name}_least_db": np.array([
                least_db(aperture, interpolated(widths, sure, width), width, aperture.size)
                - 10 * np.log10(aperture.size ** aperture.places.shape[1])
                for width in widths
            ]),
            f"{name}_cones": cones, f"{name}_ratios": ratios, f"{name}_losses_db": losses_db,
            f"{name}_likely": np.array(likely).astype(np.float16),
        }  # fmt: skip
        np.savez_compressed(OUT, **made)


if __name__ == "__main__":
    main()
