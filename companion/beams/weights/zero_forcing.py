"""Zero-forcing weights by BLAS and LAPACK, and what they cost.

With A = [a(u_1) ... a(u_N)], (M, N), and UAV i receiving a(u_i)^T F s (docs/math.md 7):

    F = A* H,  H = (A^T A*)^-1        A^T F = I        paper eq. (7)

The diagonal of H says what zero forcing costs. The array gain of column i of F is 1 / H_ii, that of
a beam for this user alone |a_i|^2; their ratio, the loss factor |a_i|^2 H_ii, is at least 1 and
stays the same when columns are scaled. Times the machine's precision it is about how far A^T F is
from I, as rounding in Cholesky scales with the columns too (Demmel, "On floating-point errors in
Cholesky", LAPACK working note 14, 1989). It therefore also decides whether there is an answer.
"""

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from companion.beams.weights.lapack import zgemm, zherk, zposv
from companion.values import ComplexArray, FloatArray

MOST_LOSS: Final = 1e12
"""Sum of all loss factors above which there is no answer: 120 dB, where rounding dominates."""


class ZeroForcingSolution(NamedTuple):
    """Zero-forcing weights and what they cost. A tuple, because it is made faster than a dataclass.

    weights       F (M, N), complex128, in Fortran order: those of one user lie together
    loss_factors  (N,), power gain of a beam for this user alone over that of its column of F
    """

    weights: ComplexArray
    loss_factors: FloatArray


def solve(steering: ComplexArray) -> ZeroForcingSolution | None:
    """Zero-forcing weights for a steering matrix A, (M, N), complex128; C order is the fast one.

    None where there is no answer: more users than elements, a column of zeros, or columns so nearly
    dependent that their loss factors pass ``MOST_LOSS``. Raises ``ValueError`` for numbers that are
    not finite.
    """
    size, users = steering.shape
    if not 0 < users <= size:
        return _unsolved(steering)
    # At 64 x 4 the calls are the cost: they are few, with arguments by position. A in C order is,
    # to BLAS, A^T in Fortran order, of which it takes the conjugate on its way.
    if not steering.flags.c_contiguous:
        steering = np.ascontiguousarray(steering)
    transposed = steering.T
    gram = zherk(1.0, transposed)
    _, inverse, info = zposv(gram, _identity(users))
    power, diagonal = gram.diagonal().real, inverse.diagonal().real
    if info or not power.dot(diagonal) < MOST_LOSS:
        return _unsolved(steering)
    return ZeroForcingSolution(zgemm(1.0, transposed, inverse, trans_a=2), power * diagonal)


@lru_cache(maxsize=8)
def _identity(users: int) -> ComplexArray:
    identity = np.asfortranarray(np.eye(users, dtype=complex))
    identity.setflags(write=False)
    return identity


def _unsolved(steering: ComplexArray) -> ZeroForcingSolution | None:
    """The answer where Cholesky has none, or where there are no users."""
    if not np.isfinite(steering).all():
        raise ValueError("a steering vector holds what is not a finite number")
    return None if steering.shape[1] else ZeroForcingSolution(np.empty_like(steering), np.empty(0))
