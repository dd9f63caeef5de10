"""Weights from steering vectors: zero forcing, and what is done when it is ill-conditioned.

UAV i receives y_i = h_i a(u_i)^T F s + noise. With A = [a(u_1) ... a(u_N)], (M, N),

    zero forcing       F = A* (A^T A*)^-1           A^T F = I
    regularised        F = A* (A^T A* + x I)^-1     (RZF)

(The published channel has a^H beside this F, which points elsewhere: one of the two must be
conjugated.) Both are solved by Cholesky. The condition number of A in the 2-norm is known at
every update; past a limit zero forcing would spend its power on telling apart what the array
cannot, and the regularised weights are used and marked.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import zposv

from companion.values import ComplexArray, FloatArray, Method


@dataclass(frozen=True, slots=True)
class Precoder:
    """Settings: the largest condition number at which plain zero forcing is used, and x/M."""

    condition_limit: float = 10.0
    regularisation: float = 0.01


@dataclass(frozen=True, slots=True)
class Precoding:
    """Weights (M, N), how they were made, and the condition number of A (None without users)."""

    weights: ComplexArray
    method: Method
    condition_number: float | None


def precode(steering: ComplexArray, settings: Precoder) -> Precoding:
    """Zero-forcing weights for a steering matrix (M, N), or regularised ones past the limit."""
    size, users = steering.shape
    if users == 0:
        return Precoding(np.empty((size, 0), dtype=complex), Method.ZERO_FORCING, None)
    gram = steering.T @ steering.conj()
    if not np.isfinite(gram).all():
        raise ValueError("a steering vector holds what is not a number")
    condition = _condition_number(gram)
    if condition <= settings.condition_limit:
        solved = _solve(gram, steering)
        if solved is not None:
            return Precoding(solved, Method.ZERO_FORCING, condition)
    loaded = gram + settings.regularisation * size * np.eye(users)
    solved = _solve(loaded, steering)
    if solved is None:
        raise ValueError("the regularised matrix is not positive definite")
    return Precoding(solved, Method.REGULARISED, condition)


def _condition_number(gram: ComplexArray) -> float:
    """cond(A), from the eigenvalues of A^T A*.

    Finite always: past about 1e7 rounding hides the smallest eigenvalue and the figure stays there.
    """
    if len(gram) == 1:
        return 1.0
    least, *_, most = np.linalg.eigvalsh(gram)
    return float(np.sqrt(most / max(least, most * len(gram) * np.finfo(float).eps)))


def _solve(gram: ComplexArray, steering: ComplexArray) -> ComplexArray | None:
    """A* gram^-1, as the transpose of gram^-T A^H; None where gram is not positive definite."""
    _, solution, info = zposv(gram.T, steering.conj().T)
    return np.ascontiguousarray(solution.T) if info == 0 else None


def gain_db(steering: ComplexArray, weights: ComplexArray) -> FloatArray:
    """Array gain of each column towards its own direction, |a^T f|^2 / |f|^2, in dB, (N,)."""
    towards = np.abs(np.einsum("mn,mn->n", steering, weights)) ** 2
    gains: FloatArray = 10 * np.log10(towards / np.sum(np.abs(weights) ** 2, axis=0))
    return gains
