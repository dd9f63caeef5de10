"""Zero-forcing weights by BLAS and LAPACK, and their cost.

With A = [a(u_1) ... a(u_N)], (M, N), and UAV i receiving a(u_i)^T F s (docs/math.md 7):

    F = A* H,  H = (A^T A*)^-1        A^T F = I        paper eq. (7)

The diagonal of H gives the cost of zero forcing. The array gain of column i of F is 1 / H_ii, that
of a beam for this user alone |a_i|^2. Their ratio, the loss factor |a_i|^2 H_ii, is at least 1 and
invariant to the scale of columns. Times the machine precision it is about the error of A^T F, as
rounding in Cholesky scales with the columns too (Demmel, "On floating-point errors in Cholesky",
LAPACK working note 14, 1989). It therefore also decides whether a solution exists.
"""

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from companion.beams.weights.lapack import zgemm, zherk, zposv
from companion.values import ComplexArray, FloatArray

MOST_LOSS: Final = 1e12
"""Sum of all loss factors above which no solution is returned: 120 dB, where rounding dominates."""


class ZeroForcingSolution(NamedTuple):
    """Zero-forcing weights and their cost; a tuple, which is faster to create than a dataclass.

    weights       F (M, N), complex128, in Fortran order: those of one user are contiguous
    loss_factors  (N,), power gain of a beam for this user alone over that of its column of F
    """

    weights: ComplexArray
    loss_factors: FloatArray


def solve(steering: ComplexArray) -> ZeroForcingSolution | None:
    """Return zero-forcing weights for a steering matrix A, (M, N), complex128; C order is fastest.

    None without a solution: more users than elements, a column of zeros, or columns so nearly
    dependent that their loss factors pass ``MOST_LOSS``. Raises ``ValueError`` for numbers that are
    not finite.
    """
    size, users = steering.shape
    if not 0 < users <= size:
        return _unsolved(steering)
    # At 64 x 4 the calls dominate: use few, with positional arguments. BLAS sees A in C order as
    # A^T in Fortran order, and conjugates it in passing.
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
    if not np.isfinite(steering).all():
        raise ValueError("a steering vector is not finite")
    return None if steering.shape[1] else ZeroForcingSolution(np.empty_like(steering), np.empty(0))
