"""Gains of the kinematic model: position and velocity, with bounded acceleration unknown.

Per axis, x = [p; v], over an interval T from one report to the next,

    x+ = A x + g,   A(T) = [1 T; 0 1],   g = int_0^T [T - s; 1] a(s) ds,   |a| <= a_max
    y  = C x + n,   C = I, or [1 0] for a sender without velocity,   |n_p| <= N_p, |n_v| <= N_v
    x^+ = A (x^ + M (y - C x^)),   L = A M;      e+ = (A - L C) e + L n - g

The acceleration may change within the interval, so g is not a multiple of [T^2/2; T]: switching
half way moves p by a T^2/4 and v not at all. By the Cauchy-Schwarz inequality, though,

    g = a_max B w,   B = [T^2/2  T^2/sqrt(12); T  0],   |w| <= 1

because B B^T T^-1 is the Gramian of the integral. It covers every a(s), at a cost of 15 % in p.
With one P for all T (``lmi.solve_common``; one channel each for w, n_p and n_v), the set
{e : e^T P e <= 1} is invariant for any order of the intervals; ``verify`` proves it again by
eigenvalues alone. The running bound (``observers.kinematic``) is interval arithmetic with
the exact |g_p| <= a T^2/2, |g_v| <= a T. See docs/math.md 4.

Everything holds for norms of 3-vectors too, since the axes share P and L. Time is an argument, a
design is a value.
"""

import json
import math
from bisect import bisect_right
from dataclasses import asdict, dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from companion.values import FloatArray, UserError

FORMAT: Final = "kinematic-design-1"
LARGEST: Final = 1 << 20  # most characters of a design; the program's own has 4500
NUMBER_MAX: Final = 1e30
"""Largest number accepted in a design; the shortest interval accepted is its inverse."""
CHECKS_PER_STEP: Final = 5  # intervals that verify checks per step of the design's grid


class DesignError(UserError):
    """Error of a design that cannot be read, or that its own certificate does not confirm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KinematicDesign:
    """Gains of the kinematic model over a grid of intervals, with their certificate.

        velocity_noise_mps  bound on the error of a reported velocity; None: not reported
        corrections         M at each interval, row by row: m11, m12, m21, m22 if velocity is
                            reported, else m11, m21
        multipliers         at each interval, of acceleration, position noise and (if reported)
                            velocity noise; they sum to alpha

    The fields are plain numbers, so that a design can be compared, hashed and serialised.
    """

    acceleration_mps2: float  # bound on the acceleration
    position_noise_m: float  # bound on the error of a reported position
    velocity_noise_mps: float | None
    dt_s: tuple[float, ...]  # (K,) intervals, ascending
    corrections: tuple[tuple[float, ...], ...]
    lyapunov: tuple[float, float, float]  # P as p11, p12, p22
    multipliers: tuple[tuple[float, ...], ...]
    margin: float  # result of verify when the design was computed
    provenance: str  # how the design was computed

    @property
    def has_velocity(self) -> bool:
        return self.velocity_noise_mps is not None

    @property
    def alphas(self) -> FloatArray:
        return np.asarray(np.sum(self.multipliers, axis=1))

    @property
    def p(self) -> FloatArray:
        p11, p12, p22 = self.lyapunov
        return np.array([[p11, p12], [p12, p22]])

    @property
    def gains(self) -> FloatArray:
        m = np.reshape(np.array(self.corrections), (len(self.dt_s), 2, -1))
        return np.asarray(_transitions(np.array(self.dt_s)) @ m)

    def to_json(self) -> str:
        """Serialise the design for ``from_json``."""
        lines = {"format": FORMAT, **asdict(self)}.items()
        return (
            "{\n" + ",\n".join(f' "{key}": {json.dumps(value)}' for key, value in lines) + "\n}\n"
        )

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Parse and verify a design. Raises ``DesignError``, which names the fault."""
        if len(text) > LARGEST:
            raise DesignError("not a kinematic design: too large")
        try:
            given: dict[str, Any] = json.loads(text)
            if given.pop("format", None) != FORMAT:
                raise DesignError(f"format of the design is not {FORMAT!r}")
            for table in ("corrections", "multipliers"):
                given[table] = tuple(tuple(map(float, row)) for row in given[table])
            for row in ("dt_s", "lyapunov"):
                given[row] = tuple(map(float, given[row]))
            for number in ("acceleration_mps2", "position_noise_m", "margin"):
                given[number] = float(given[number])
            if given["velocity_noise_mps"] is not None:
                given["velocity_noise_mps"] = float(given["velocity_noise_mps"])
            design = cls(**given)
        except DesignError:
            raise
        except RecursionError as error:
            raise DesignError("not a kinematic design: nested too deeply") from error
        except KeyError as error:
            raise DesignError(f"not a kinematic design: {error.args[0]} is missing") from error
        except (TypeError, AttributeError, ValueError, OverflowError) as error:
            raise DesignError(
                "not a kinematic design: a value has the wrong type or size;"
                " give a file written by `companion design --out`"
            ) from error
        verify(design)
        return design


def transition(dt_s: float) -> FloatArray:
    """Return A(T) (2, 2): position and velocity T seconds later, without acceleration."""
    return np.array([[1.0, dt_s], [0.0, 1.0]])


def _transitions(dt_s: FloatArray) -> FloatArray:
    a = np.tile(np.eye(2), (len(dt_s), 1, 1))
    a[:, 0, 1] = dt_s
    return a


def inputs(
    dt_s: float, acceleration_mps2: float, position_noise_m: float, velocity_noise_mps: float | None
) -> tuple[FloatArray, FloatArray, tuple[int, ...]]:
    """Return input matrices B (2, m) and D (r, m), and the widths of the channels of w.

    These are arguments of ``lmi.Sampling``. The first channel has two columns, for acceleration
    that varies within the interval; then one column for each noise. ``velocity_noise_mps=None``:
    velocity is not reported, r = 1.
    """
    r = 1 if velocity_noise_mps is None else 2
    a, t = acceleration_mps2, dt_s
    b = np.zeros((2, 2 + r))
    b[:, :2] = [[a * t * t / 2, a * t * t / math.sqrt(12)], [a * t, 0.0]]
    d = np.zeros((r, 2 + r))
    d[0, 2] = position_noise_m
    if velocity_noise_mps is not None:
        d[1, 3] = velocity_noise_mps
    return b, d, (2, *[1] * r)


def correction(design: KinematicDesign, dt_s: float) -> tuple[float, ...]:
    """Return M(T), row by row: linear between the grid's intervals, constant outside them.

    Beyond the ends the running bound still holds; the invariant set is not certified there.
    """
    grid, table = design.dt_s, design.corrections
    if dt_s <= grid[0]:
        return table[0]
    if dt_s >= grid[-1]:
        return table[-1]
    i = bisect_right(grid, dt_s)
    f = (dt_s - grid[i - 1]) / (grid[i] - grid[i - 1])
    return tuple([x + f * (y - x) for x, y in zip(table[i - 1], table[i], strict=True)])


def gain(design: KinematicDesign, dt_s: float) -> FloatArray:
    """Return L(T) = A(T) M(T), (2, 2), or (2, 1) without velocity; entries in 1, s and 1/s."""
    m = np.array(correction(design, dt_s)).reshape(2, -1)
    found: FloatArray = transition(dt_s) @ m
    return found


# --- the certificate ----------------------------------------------------------------------------


def verify(design: KinematicDesign) -> float:
    """Return the smallest eigenvalue of the LMIs over a finer grid than the design's.

    P is scaled to I. Raises ``DesignError`` if the eigenvalue is negative, so that invariance is
    not proven, or if the design is malformed. The computation is batched and takes a few
    milliseconds.
    """
    _check(design)
    nodes = np.arange(len(design.dt_s))
    at = np.linspace(0, nodes[-1], CHECKS_PER_STEP * nodes[-1] + 1)

    def between(rows: ArrayLike) -> FloatArray:
        columns = np.asarray(rows, dtype=float).T
        return np.array([np.interp(at, nodes, column) for column in columns]).T

    dt_s = np.interp(at, nodes, design.dt_s)
    # Between nodes, grid and table are both linear, so M equals the result of ``correction``.
    m = between(design.corrections).reshape(len(at), 2, -1)
    margin = float(np.min(_margins(design, dt_s, m, between(design.multipliers))))
    if not margin >= 0:
        raise DesignError(f"design fails its certificate: margin {margin:.2e} is negative")
    return margin


def _check(design: KinematicDesign) -> None:
    reports = 2 if design.has_velocity else 1
    grid = np.array(design.dt_s)
    if len(grid) < 2 or not (grid[0] > 0 and np.all(np.diff(grid) > 0) and np.isfinite(grid[-1])):
        raise DesignError("intervals of the design are not positive and ascending")
    shapes = (
        len(design.corrections) == len(design.multipliers) == len(grid)
        and {len(row) for row in design.corrections} == {2 * reports}
        and {len(row) for row in design.multipliers} == {1 + reports}
        and len(design.lyapunov) == 3
    )
    if not shapes:
        raise DesignError("tables of the design do not match its grid of intervals")
    noises = design.position_noise_m, design.velocity_noise_mps or 0.0
    bounds = np.array([design.acceleration_mps2, *noises], dtype=float)
    numbers = np.concatenate([bounds, design.lyapunov, *design.corrections, *design.multipliers])
    if not (np.all(np.isfinite(numbers)) and np.all(bounds >= 0)):
        raise DesignError("design has a negative bound or a number that is not finite")
    if grid[0] < 1 / NUMBER_MAX or max(grid[-1], np.abs(numbers).max()) > NUMBER_MAX:
        raise DesignError(f"design has a number beyond {NUMBER_MAX:.0e}, or an interval near 0")
    p11, p12, p22 = design.lyapunov
    if not (p11 > 0 and p11 * p22 > p12 * p12):
        raise DesignError("Lyapunov matrix of the design is not positive definite")


def _margins(
    design: KinematicDesign, dt_s: FloatArray, m: FloatArray, multipliers: FloatArray
) -> FloatArray:
    """Return the smallest eigenvalue per interval: dt (K,), M (K, 2, r), multipliers (K, 1 + r)."""
    r = m.shape[2]
    sizes = (design.acceleration_mps2, design.position_noise_m, design.velocity_noise_mps)
    shares = np.concatenate([multipliers[:, :1], multipliers], axis=1)  # acceleration: 2 columns
    root = np.linalg.cholesky(design.p).T
    a, gains = _transitions(dt_s), _transitions(dt_s) @ m
    left = root @ (a - gains @ np.eye(2)[:r]) @ np.linalg.inv(root)
    unit_b, d, _ = inputs(1.0, *sizes)
    b = np.tile(unit_b, (len(dt_s), 1, 1))
    b[:, 0] *= dt_s[:, None] ** 2
    b[:, 1] *= dt_s[:, None]
    right = root @ (gains @ d - b)
    n, w = 2, 2 + r
    lmi = np.zeros((len(dt_s), n + w + n, n + w + n))
    lmi[:, range(n), range(n)] = 1 - multipliers.sum(axis=1)[:, None]
    lmi[:, range(n, n + w), range(n, n + w)] = shares
    lmi[:, range(n + w, n + w + n), range(n + w, n + w + n)] = 1.0
    lmi[:, n + w :, :n] = left  # eigvalsh reads the lower triangle
    lmi[:, n + w :, n : n + w] = right
    return np.asarray(np.linalg.eigvalsh(lmi)[:, 0])


def invariant_bound(design: KinematicDesign, c: ArrayLike = (1.0, 0.0)) -> float:
    """Return sup |c^T e| over the invariant set: sqrt(c^T P^-1 c).

    c = [1, t] gives the position error t s later.
    """
    vector = np.asarray(c, dtype=float)
    return float(np.sqrt(vector @ np.linalg.solve(design.p, vector)))
