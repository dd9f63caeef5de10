"""The observer design as a linear matrix inequality, by CVXPY and Clarabel.

The general case, and the independent proof of the closed forms in ``design``. For

    x+ = A x + B w,   y = C x + D w,   e+ = (A - L C) e + (L D - B) w

find P > 0, Z and the smallest mu, for a fixed alpha in (0, 1), with L = P^-1 Z, such that

    [ (1-a) P      0       (P A - Z C)^T ]
    [    0        a I      (Z D - P B)^T ]  >= 0       [ P  H^T  ]
    [ P A - Z C  Z D - P B       P       ]             [ H  mu I ]  >= 0

Then |H e| <= sqrt(mu) sup|w| from e = 0, and in the limit from anywhere. Source: Mohammadi,
Rahmati and Malik, with the sign of the last block put right (printed +P, which is infeasible).

Only this module imports cvxpy, which takes more than a second to load, and only commands that
design import this module.
"""

from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from companion.values import FloatArray


class LmiError(RuntimeError):
    """The solver did not give a solution that its own certificate confirms."""


@dataclass(frozen=True, slots=True)
class LmiSolution:
    """A design that was checked: ``margin`` is the smallest eigenvalue of both LMIs, scaled."""

    gain: FloatArray
    lyapunov: FloatArray
    mu: float
    margin: float


def solve(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, h: FloatArray, alpha: float
) -> LmiSolution:
    """The gain with the smallest mu. Shapes: A (n,n), B (n,m), C (r,n), D (r,m), H (k,n).

    Raises ``ValueError`` for an alpha outside (0, 1), ``LmiError`` where the solver fails or its
    answer does not pass the eigenvalue check.
    """
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"alpha lies strictly between 0 and 1, not {alpha}")
    plant = (a, b, c, d, h)
    scale = float(np.abs(b).max()) or 1.0  # the unit of time: mu goes with its square
    b, d = b / scale, d / scale
    (n, m), r, k = b.shape, c.shape[0], h.shape[0]
    p = cp.Variable((n, n), symmetric=True)
    z = cp.Variable((n, r))
    mu = cp.Variable(nonneg=True)
    left, right = p @ a - z @ c, z @ d - p @ b
    decay = cp.bmat(
        [
            [(1 - alpha) * p, np.zeros((n, m)), left.T],
            [np.zeros((m, n)), alpha * np.eye(m), right.T],
            [left, right, p],
        ]
    )
    output = cp.bmat([[p, h.T], [h, mu * np.eye(k)]])
    problem = cp.Problem(cp.Minimize(mu), [_symmetric(decay) >> 0, _symmetric(output) >> 0])
    try:
        problem.solve(solver=cp.CLARABEL)
    except cp.SolverError as failure:
        raise LmiError(f"the solver failed: {failure}") from failure
    if problem.status != cp.OPTIMAL or p.value is None or z.value is None:
        raise LmiError(f"the solver's answer is {problem.status}")
    return _certified(
        p.value / scale**2, z.value / scale**2, float(mu.value) * scale**2, plant, alpha
    )


def _symmetric(matrix: cp.Expression) -> cp.Expression:
    return (matrix + matrix.T) / 2


def _certified(
    p: FloatArray,
    z: FloatArray,
    mu: float,
    plant: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray],
    alpha: float,
) -> LmiSolution:
    """Check the solver's answer by eigenvalues in numpy alone."""
    if np.linalg.eigvalsh(p)[0] <= 0:
        raise LmiError("the solver's P is not positive definite")
    gain: FloatArray = np.linalg.solve(p, z).astype(float)
    margin = lmi_margin(p, gain, mu, plant, alpha)
    if margin < -1e-6:
        raise LmiError(f"the solver's answer fails its certificate: margin {margin:.2e}")
    return LmiSolution(gain, p, mu, margin)


def lmi_margin(
    p: FloatArray,
    gain: FloatArray,
    mu: float,
    plant: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray],
    alpha: float,
) -> float:
    """Smallest eigenvalue of both LMIs at (P, L, mu), scaled by congruence so that P is I."""
    a, b, c, d, h = plant
    scale = np.linalg.cholesky(p).T  # P = scale^T scale; e in the scaled frame is scale e
    left = scale @ np.linalg.solve(scale.T, (a - gain @ c).T).T
    right = scale @ (gain @ d - b)
    n, m = right.shape
    decay = np.block(
        [
            [(1 - alpha) * np.eye(n), np.zeros((n, m)), left.T],
            [np.zeros((m, n)), alpha * np.eye(m), right.T],
            [left, right, np.eye(n)],
        ]
    )
    scaled_h = np.linalg.solve(scale.T, h.T).T
    k = h.shape[0]
    output = np.block([[np.eye(n), scaled_h.T], [scaled_h, mu * np.eye(k)]])
    return float(min(np.linalg.eigvalsh(decay)[0], np.linalg.eigvalsh(output)[0]))
