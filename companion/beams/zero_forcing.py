"""Zero-forcing weights at the speed of BLAS and LAPACK: in full, and by border update.

With A = [a(u_1) ... a(u_N)], (M, N), and UAV i receiving a(u_i)^T F s:

    F = A* H,  H = (A^T A*)^-1        A^T F = I        (MATH: array, steering, weights)

The diagonal of H says what zero forcing costs. The array gain of column i of F is 1 / H_ii, that
of a beam for this user alone |a_i|^2; their ratio, the loss factor |a_i|^2 H_ii, is at least 1
and stays the same when columns are scaled. Times the machine's precision it is about how far
A^T F is from I, as rounding in Cholesky scales with the columns too (Demmel, "On floating-point
errors in Cholesky", LAPACK working note 14, 1989). So it also decides whether there is an answer.

Centro-symmetric arrays: if elements m and m' mirror each other through the centroid p and radiate
alike, a_m a_m' = g^2 exp(2j k p.u). Without the phase factor exp(j k p.u) of its column, A has
conjugate numbers in rows m and m', and A^T A* = 2 C^T C is real, where C holds the real and the
imaginary parts of one row of each pair: a quarter of the arithmetic (Lee, "Centrohermitian and
skew-centrohermitian matrices", Linear Algebra and its Applications 29, 1980; Haardt and Nossek,
"Unitary ESPRIT", IEEE Transactions on Signal Processing 43, 1995).

Border update: if one column of A moves, A^T A* loses a border and gains another, which changes F
and H by matrices of rank two: O(M N) instead of O(M N^2).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg.blas import dsymm, dsyrk, dznrm2, zdotc, zgemm, zgemv, zherk
from scipy.linalg.lapack import dpotrf, dpotri, zposv

from companion.beams.arrays import Array
from companion.values import ComplexArray, FloatArray, IntArray

EPSILON: Final = float(np.finfo(float).eps)
MOST_LOSS: Final = 1e12
"""No answer where the loss factors of all users add up to this, 120 dB: rounding has eaten it."""
REAL_FORM_PAYS: Final = 40_000
"""M N (N - 8) from which on less arithmetic outweighs the way to real numbers and back: measured.
"""
MOST_DRIFT: Final = 1e-9
"""How far border updates may push A^T F from I before there is a full solution again."""
SYMMETRY_TOLERANCE: Final = 1e-6
"""How far A^T F may be from I, over the sum of the loss factors, where the weights of half of the
elements were mirrored for the other half."""


@dataclass(frozen=True, slots=True, eq=False)
class Symmetry:
    """How the elements of an array pair up through its centroid.

    ``order`` (M,) lists the elements so that the m-th mirrors the m-th from the end; ``place`` is
    its inverse. Both are None where the elements stand so already (a ULA, a URA).
    """

    size: int
    order: IntArray | None
    place: IntArray | None

    @classmethod
    def of(cls, array: Array) -> "Symmetry | None":
        """None for an array without the symmetry, or with elements that face different ways."""
        partners, every = array.partners, np.arange(array.size)
        if partners is None or not np.array_equal(partners[partners], every):
            return None
        if np.array_equal(partners, every[::-1]):
            return cls(array.size, None, None)
        first = every[every < partners]
        order = np.concatenate([first, every[every == partners], partners[first][::-1]])
        return cls(array.size, order, np.argsort(order))

    @property
    def half(self) -> int:
        """How many rows are enough: one of each pair, and that of an element at the centroid."""
        return (self.size + 1) // 2

    def take(self, steering: ComplexArray, out: ComplexArray) -> ComplexArray:
        """The rows of one half without the phase factors of the columns, to ``out`` (N, half).

        An element at the centroid has no partner and counts half: divided by sqrt(2). Returns
        the conjugates of the phase factors, (N,), of one sign or the other.
        """
        half = self.half
        if self.order is None:
            rows, partner = steering[:half], steering[self.size - half]
        else:
            rows, partner = steering[self.order[:half]], steering[self.order[self.size - half]]
        root = np.sqrt(rows[-1] * partner)
        phases: ComplexArray = np.conjugate(root) / np.abs(root)
        np.multiply(rows.T, phases[:, np.newaxis], out)
        if self.size % 2:
            out[:, -1] *= math.sqrt(0.5)
        return phases

    def put(self, halves: ComplexArray, phases: ComplexArray, out: ComplexArray) -> None:
        """F (M, N) from what ``take`` gave, times the real H, (N, half), which is used up."""
        half = self.half
        if self.size % 2:
            halves[:, -1] *= math.sqrt(2.0)
        ordered = out.T if self.order is None else np.empty(out.shape[::-1], dtype=complex)
        np.multiply(halves, phases[:, np.newaxis], ordered[:, ::-1][:, :half])
        np.conjugate(halves, halves)
        np.multiply(halves, phases[:, np.newaxis], ordered[:, :half])
        if self.place is not None:
            # Elements stand as they should by construction; without `clip` there is a buffer.
            np.take(ordered, self.place, axis=1, out=out.T, mode="clip")


class Solved(NamedTuple):
    """Zero-forcing weights and what they cost. (A tuple: made faster than a dataclass.)

    ``weights`` F (M, N), complex128, in Fortran order: those of one user lie together.
    ``loss_factors`` (N,): power gain of a beam for this user alone, over that of its column of F.
    ``power`` (N,): |a_i|^2, the array gain of the beam for this user alone.
    ``inverse`` (N, N): H; or, where ``phases`` p (N,) is not None, the real H_ij / (p*_i p_j) in
    the upper triangle; what is below is not to be read.
    """

    weights: ComplexArray
    loss_factors: FloatArray
    power: FloatArray
    inverse: ComplexArray | FloatArray
    phases: ComplexArray | None = None

    @property
    def gains(self) -> FloatArray:
        """Array gain of each column towards its own user, 1 / H_ii, (N,)."""
        return self.power / self.loss_factors

    @property
    def condition_bound(self) -> float | None:
        """The 2-norm condition number of A at most, sqrt(trace(H^-1) trace(H)); None without users.

        It is at most N times too large.
        """
        if len(self.power) == 0:
            return None
        return math.sqrt(self.power.sum() * (self.loss_factors / self.power).sum())

    def condition_number(self) -> float | None:
        """The 2-norm condition number of A, from the eigenvalues of H; None without users.

        O(N^3), so only when asked for. Finite always: past about 1e7 rounding hides the least
        eigenvalue, and the figure stays there.
        """
        if len(self.power) == 0:
            return None
        values = np.linalg.eigvalsh(self.inverse, UPLO="U")
        least, most = float(values[0]), float(values[-1])
        return math.sqrt(most / max(least, most * len(values) * EPSILON))


def solve(
    steering: ComplexArray, symmetry: Symmetry | None = None, out: ComplexArray | None = None
) -> Solved | None:
    """Zero-forcing weights for a steering matrix A, (M, N), complex128.

    ``symmetry`` is that of the array, if it has one: it is used where it makes the work shorter.
    C order is the fast one without symmetry, Fortran order with it; the other costs a copy.
    ``out`` (M, N), in Fortran order, is where the weights go, None: new memory.

    None where there is no answer: more users than elements, a column of zeros, or columns so
    nearly dependent that their loss factors pass ``MOST_LOSS``. ``ValueError`` for numbers that
    are not finite and for a matrix that lacks the symmetry.
    """
    size, users = steering.shape
    if not 0 < users <= size:
        return _unsolved(steering)
    if symmetry is not None and size * users * (users - 8) > REAL_FORM_PAYS:
        return _solve_real(steering, symmetry, out)
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
    weights = zgemm(1.0, transposed, inverse, 0.0, None, 2)
    if out is not None:
        out[...] = weights
        weights = out
    return Solved(weights, power * diagonal, power, inverse)


@lru_cache(maxsize=8)
def _identity(users: int) -> ComplexArray:
    identity = np.asfortranarray(np.eye(users, dtype=complex))
    identity.setflags(write=False)
    return identity


@np.errstate(invalid="ignore", divide="ignore")  # what is not finite is refused in the end
def _solve_real(
    steering: ComplexArray, symmetry: Symmetry, out: ComplexArray | None
) -> Solved | None:
    """For a centro-symmetric array.

    A half column in memory is real, imaginary, real, ...: a column of C as it stands, as the
    order of the rows of C does not matter.
    """
    size, users = steering.shape
    if size != symmetry.size:
        raise ValueError(f"a steering matrix of {size} rows is not of {symmetry.size} elements")
    halves = np.empty((users, symmetry.half), dtype=complex)
    phases = symmetry.take(steering, halves)
    real = halves.view(float).T
    gram = dsyrk(2.0, real, 0.0, None, 1)
    factor, info = dpotrf(gram, 0, 0)
    if info:
        return _unsolved(steering)
    inverse, _ = dpotri(factor, 0, 1)
    power, diagonal = gram.diagonal(), inverse.diagonal()
    total = power.dot(diagonal)
    if not total < MOST_LOSS:
        return _unsolved(steering)
    halves = dsymm(1.0, inverse, real, 0.0, None, 1).T.view(complex)
    if out is None:
        out = np.empty((users, size), dtype=complex).T
    symmetry.put(halves, phases, out)
    response = out[:, 0] @ steering
    response[0] -= 1
    if not dznrm2(response) < SYMMETRY_TOLERANCE * total:
        _insist_on_finite(steering)
        raise ValueError("the steering matrix lacks the symmetry of the array")
    return Solved(out, power * diagonal, power, inverse, phases)


def _unsolved(steering: ComplexArray) -> Solved | None:
    """What to answer where Cholesky has no answer, or nothing to solve."""
    _insist_on_finite(steering)
    if steering.shape[1]:
        return None
    return Solved(np.empty_like(steering), np.empty(0), np.empty(0), np.empty((0, 0)))


def _insist_on_finite(steering: ComplexArray) -> None:
    if not np.isfinite(steering).all():
        raise ValueError("a steering vector holds what is not a finite number")


class ZeroForcing:
    """Zero-forcing weights of users of whom one or a few move at a time.

    Holds A, and F above H in one matrix, so that one pass over memory updates both.
    ``border_updates`` counts the columns replaced so since the last full solution.
    """

    def __init__(self, steering: ComplexArray, symmetry: Symmetry | None = None) -> None:
        """Copies A (M, N) and solves in full. Errors as of ``solve``."""
        size, users = steering.shape
        self._steering: ComplexArray = np.array(steering, dtype=complex, order="F")
        self._symmetry = symmetry
        self._both: ComplexArray = np.empty((users, size + users), dtype=complex).T
        self._weights, self._inverse = self._both[:size], self._both[size:]
        self._left: ComplexArray = np.empty((2, size + users), dtype=complex).T
        self._right: ComplexArray = np.empty((2, users), dtype=complex).T
        self._power, self._losses = np.empty(users), np.empty(users)
        self._loss = self._rounding = 0.0
        self.border_updates = 0
        self._found = self._solve()

    @property
    def found(self) -> Solved | None:
        """The latest answer; None where there is none."""
        return self._found

    def update(self, columns: Sequence[int], vectors: ComplexArray) -> Solved | None:
        """Replace columns of A by those of ``vectors`` (M, len(columns)); the new answer.

        By border update if that is less work and rounding has not piled up, else in full. None
        and errors as of ``solve``: A has its new columns even then, and the next update
        solves in full. ``weights`` and ``inverse`` are views that the next update writes to: copy
        them to keep them. ``ValueError`` for columns that A does not have.
        """
        size, users = self._steering.shape
        if vectors.shape != (size, len(columns)):
            raise ValueError(f"{len(columns)} columns of {size} numbers, not {vectors.shape}")
        if not all(0 <= column < users for column in columns):
            raise ValueError(f"columns are numbered from 0 to {users - 1}, not {list(columns)}")
        border = self._found is not None and border_pays(len(columns), users, self._symmetry)
        self._found = None
        for column, vector in zip(columns, vectors.T, strict=True):
            self._steering[:, column] = vector
            border = border and self._replace(column)
        self._found = self._handed_out() if border else self._solve()
        return self._found

    def _replace(self, n: int) -> bool:
        """Border update for column n of A, a; False, with all in disorder, where it is not safe.

        Let h be column n of H. H without user n is H1 = H - h h^H / H_nn, zero in row and column
        n. With g = A^T a*, t = H1 g and s = g_n - g^H t, the power of a outside the span of the
        other columns, the new H is H1 + t t^H / s but for its n-th row and column, which are -t/s
        and 1/s; t_n = -1 puts them there. In the same way the new F is F1 - r t^H / s with
        F1 = F - F_n h^H / H_nn and r = a* - F1 g.
        """
        size, both = len(self._steering), self._both
        old, new = self._left.T
        old[:] = both[:, n]
        h = old[size:]
        h_nn = float(h[n].real)
        np.conjugate(self._steering[:, n], new[:size])
        new[size:] = 0.0
        g = zgemv(1.0, self._steering, new[:size], 0.0, None, 0, 1, 0, 1, 1)
        g_n = complex(g[n])
        g[n] = g_n - zdotc(h, g) / h_nn  # so that F g is F1 g, and H g is H1 g
        zgemv(-1.0, both, g, 1.0, new, 0, 1, 0, 1, 0, 1)  # r above -t
        t = new[size:]
        s = g_n.real + zdotc(g, t).real
        if not g_n.real < s * MOST_LOSS:  # nor if it is not a number
            return False
        t[n] = 1.0
        np.multiply(h, 1 / h_nn, self._right[:, 0])
        np.multiply(t, -1 / s, self._right[:, 1])
        zgemm(-1.0, self._left, self._right, 1.0, both, 0, 2, 1)
        self._power[n] = g_n.real
        self.border_updates += 1
        return self._drift(self._power * self._inverse.diagonal().real) < MOST_DRIFT

    def _drift(self, losses: FloatArray) -> float:
        """Take in the loss factors after a border update; about how far A^T F is from I, at most.

        H after some updates is the inverse of a Gram matrix that is off by rounding: by the
        machine's precision times the loss factors that each update began and ended with. What
        that makes of A^T F is larger by the loss factors of now.
        """
        before, self._loss = self._loss, math.sqrt(losses.dot(losses))
        self._losses = losses
        self._rounding += (before + self._loss) * EPSILON
        return self._rounding * self._loss

    def _handed_out(self) -> Solved:
        return Solved(self._weights, self._losses, self._power.copy(), self._inverse)

    def _solve(self) -> Solved | None:
        found = solve(self._steering, self._symmetry, self._weights)
        if found is None:
            return None
        if found.phases is None:
            self._inverse[...] = found.inverse
        else:
            whole = np.triu(found.inverse) + np.triu(found.inverse, 1).T
            np.multiply(whole, found.phases, self._inverse)
            self._inverse *= found.phases.conj()[:, np.newaxis]
        self._power[:] = found.power
        self._drift(found.loss_factors)
        self._rounding = 0.0
        self.border_updates = 0
        return self._handed_out()


def border_pays(columns: int, users: int, symmetry: Symmetry | None) -> bool:
    """Whether to replace so many columns one by one takes less time than a full solution.

    A rule of thumb from measurements of 16 to 1024 elements: the ratio of the two hardly depends
    on their number.
    """
    return columns * (6 if symmetry is None else 8) <= users
