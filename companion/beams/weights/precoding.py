"""Weights from steering vectors: zero forcing, and what is done where it costs too much.

UAV i receives y_i = h_i a(u_i)^T F s + noise. With A = [a(u_1) ... a(u_N)], (M, N),

    zero forcing (ZF)        F = A* (A^T A*)^-1           A^T F = I
    regularised (RZF)        F = A* (A^T A* + x I)^-1 D   D: so that A^T F has a unit diagonal
    maximum ratio (MRT)      F = A* D

RZF is ZF at x = 0 and tends to MRT as x grows. (The published channel has a^H beside this F, which
points elsewhere: one of the two must be conjugated; docs/math.md 8.4.)

The inverse alone says what zero forcing costs user i: its gain falls from |a_i|^2 to 1 / [(A^T
A*)^-1]_ii. Past ``loss_limit_db`` for any user, or past a condition number of A, the policy
decides: load the matrix by the least x at which no user loses more (each loss falls with x, see
``_least_loading``), serve groups in turns, or leave out the lowest priorities. This is judged with
the columns of A scaled to one length, since a weak element pattern is not closeness. It happens at
mirror images about a line array, or with two UAVs behind one another. See docs/math.md 7.

Over 300 lines: the ways of making weights fall back on one another.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from companion.beams.weights import grouping, zero_forcing
from companion.beams.weights.widening import SOFT_LOADINGS, Spread, nulled, power_gains, widen_nulls
from companion.values import ComplexArray, FloatArray, IntArray, Method, Normalisation, Policy


@dataclass(frozen=True, slots=True)
class Precoder:
    """How weights are made.

    method           zero forcing, regularised or maximum ratio
    policy           what is done where zero forcing costs too much
    loss_limit_db    most that it may cost any user
    condition_limit  largest condition number of A, with columns of one length
    regularisation   x / M where RZF itself is the method
    normalisation    how the columns are scaled
    priority         names of UAVs in descending order; those not named follow as they come
    widen            make main lobes and nulls as wide as the pointing bounds
    """

    method: Method = Method.ZERO_FORCING
    policy: Policy = Policy.REGULARISE
    loss_limit_db: float = 3.0
    condition_limit: float = 100.0
    regularisation: float = 0.01
    normalisation: Normalisation = Normalisation.UNIT_RESPONSE
    priority: tuple[str, ...] = ()
    widen: bool = True


@dataclass(frozen=True, slots=True)
class Precoding:
    """Weights for the K users that are served, and what they cost.

    ``condition_number`` is that of A with columns of one length, the largest over the groups; None
    without users.
    """

    weights: ComplexArray  # F, (M, K)
    method: Method  # the least exact one of the groups
    normalisation: Normalisation
    condition_number: float | None
    served: IntArray  # (K,), indices of the users served
    groups: IntArray  # (K,), the turn of each
    dropped: dict[int, str]  # why a user is not served, by index


LEAST_LOADING: Final = 1e-12
"""Least loading where RZF itself is the method, as a share of the trace of the Gram matrix."""
LEAST_WIDE_LOADING: Final = 1e-6
"""The same for broadened beams, of which rounding alone may be left with less."""
ROUNDING: Final = 1e-11
"""Response to another user, over that to the own user, above which it is removed."""
LOADINGS: Final = np.logspace(-6, 6, 49)
"""Loadings tried by ``_least_loading``, in mean eigenvalues; beyond the last it is MRT to 1e-6."""


def precode(
    steering: ComplexArray,
    settings: Precoder,
    spread: Spread | None = None,
    priorities: Sequence[int] | None = None,
) -> Precoding:
    """Weights for a steering matrix (M, N).

        steering    A, one steering vector per column
        settings    how weights are made
        spread      how main lobes and nulls are widened; None: not at all
        priorities  users in descending priority; None: as they come

    Raises ``ValueError`` for a steering vector that is not finite or is 0.
    """
    size, users = steering.shape
    power = np.einsum("mn,mn->n", steering.real, steering.real)
    power += np.einsum("mn,mn->n", steering.imag, steering.imag)
    if not (np.isfinite(power).all() and (power > 0).all()):
        raise ValueError("a steering vector is 0, or holds what is not a number")
    everyone = np.arange(users)
    turns, dropped = np.zeros(users, dtype=np.int64), dict[int, str]()
    if users == 0:
        nothing: ComplexArray = np.empty((size, 0), dtype=complex)
        return Precoding(
            nothing, settings.method, settings.normalisation, None, everyone, turns, {}
        )
    plain = _columns(steering, settings, spread, everyone)
    groups, made = [everyone], [plain]
    if not plain.fit and settings.policy is not Policy.REGULARISE:
        order = list(range(users)) if priorities is None else list(priorities)

        def fits(some: Sequence[int]) -> bool:
            return _fits(steering, settings, spread, np.sort(np.array(some)))

        if settings.policy is Policy.GROUP:
            groups = grouping.semi_orthogonal(steering, order, fits)
        else:
            groups = [grouping.without_the_lowest(order, fits)]
            lost_db = plain.zero_forcing_loss_db
            cost = f"cost {lost_db:.0f} dB" if np.isfinite(lost_db) else "pass the limits"
            why = f"too close to one of higher priority: to tell all apart would {cost}"
            dropped = dict.fromkeys(set(order).difference(groups[0].tolist()), why)
        made = [_columns(steering, settings, spread, group) for group in groups]
    served = np.sort(np.concatenate(groups))
    weights: ComplexArray = np.empty((size, len(served)), dtype=complex)
    for turn, (group, one) in enumerate(zip(groups, made, strict=True)):
        turns[group] = turn
        weights[:, np.searchsorted(served, group)] = one.weights
    method = max((one.method for one in made), key=_METHODS.index)
    condition = max(one.condition_number for one in made)
    _normalise(weights, settings.normalisation, turns[served])
    return Precoding(
        weights, method, settings.normalisation, condition, served, turns[served], dropped
    )


_METHODS: Final = (Method.ZERO_FORCING, Method.REGULARISED, Method.MATCHED)


@dataclass(frozen=True, slots=True)
class _Columns:
    """Columns with unit response for some users.

    fit                   True if they were made by the method asked for, within its limits
    zero_forcing_loss_db  what plain zero forcing costs the worst of them
    """

    weights: ComplexArray
    method: Method
    condition_number: float
    fit: bool = True
    zero_forcing_loss_db: float = 0.0


def _columns(
    steering: ComplexArray, settings: Precoder, spread: Spread | None, users: IntArray
) -> _Columns:
    a = steering if len(users) == steering.shape[1] else steering[:, users]
    lengths = np.linalg.norm(a, axis=0)
    even: ComplexArray = a / lengths
    gram = even.T @ even.conj()
    condition = _condition_number(even, gram)
    wide = None if spread is None else spread.of(users)
    match settings.method:
        case Method.MATCHED:
            own = a.conj() if wide is None else wide.beams
            return _Columns(_unit_response(a, own), Method.MATCHED, condition)
        case Method.REGULARISED:
            gram = a.T @ a.conj()
            least = LEAST_LOADING if wide is None else LEAST_WIDE_LOADING
            loading = max(settings.regularisation * len(a), least * float(gram.trace().real))
            if wide is None:
                found = _loaded(a, gram, loading)
            else:
                centred = nulled(wide, loading)
                keep = power_gains(a, wide.beams) * 10 ** (-settings.loss_limit_db / 10)
                found = widen_nulls(wide, loading, centred, keep)
            return _Columns(_unit_response(a, found), Method.REGULARISED, condition)
        case Method.ZERO_FORCING:
            made = _zero_forcing(even, gram, condition, wide, settings)
            return replace(made, weights=made.weights / lengths)


def _fits(
    steering: ComplexArray, settings: Precoder, spread: Spread | None, users: IntArray
) -> bool:
    """Whether zero forcing of the predicted directions alone is within the limits.

    Judged as in ``_columns``, but without the cost of wide nulls and without making other weights.
    """
    a = steering[:, users]
    even: ComplexArray = a / np.linalg.norm(a, axis=0)
    if _condition_number(even, even.T @ even.conj()) > settings.condition_limit:
        return False
    if spread is None:
        solved = zero_forcing.solve(even)
        return solved is not None and _db(solved.loss_factors.max()) <= settings.loss_limit_db
    wide = spread.of(users)
    kept = power_gains(wide.centres, nulled(wide, 0.0))
    return _lost_db(power_gains(wide.centres, wide.beams), kept) <= settings.loss_limit_db


def _zero_forcing(
    a: ComplexArray,
    gram: ComplexArray,
    condition: float,
    wide: Spread | None,
    settings: Precoder,
) -> _Columns:
    """Zero forcing where its cost is within the limits, else the least loading that is.

    The columns of ``a`` (M, N) have unit length.
    """
    lost_db = np.inf
    if condition <= settings.condition_limit:
        if wide is None:
            solved = zero_forcing.solve(a)
            lost_db = np.inf if solved is None else _db(solved.loss_factors.max())
            if solved is not None and lost_db <= settings.loss_limit_db:
                return _Columns(solved.weights, Method.ZERO_FORCING, condition, True, lost_db)
        else:
            found, lost_db = _wide_zero_forcing(wide, settings)
            if lost_db <= settings.loss_limit_db:
                exact = _unit_response(a, _exactly(a, found))
                return _Columns(exact, Method.ZERO_FORCING, condition, True, lost_db)
    loading = _least_loading(a, gram, settings)
    found = _loaded(a, gram, loading) if wide is None else _wide_loaded(wide, loading, settings)
    return _Columns(_unit_response(a, found), Method.REGULARISED, condition, False, lost_db)


def _wide_zero_forcing(wide: Spread, settings: Precoder) -> tuple[ComplexArray, float]:
    """Broadened beams that null the others exactly, and what that costs the worst of them, dB."""
    alone = power_gains(wide.centres, wide.beams)
    least = alone * 10 ** (-settings.loss_limit_db / 10)
    for soft in SOFT_LOADINGS[:2]:
        found = nulled(wide, 0.0, soft)
        kept = power_gains(wide.centres, found)
        if (kept >= least).all():
            return found, _lost_db(alone, kept)
    centred = nulled(wide, 0.0)
    kept = power_gains(wide.centres, centred)
    if (kept >= least).all():
        centred = widen_nulls(wide, 0.0, centred, least, SOFT_LOADINGS[2:])
    return centred, _lost_db(alone, kept)


def _wide_loaded(wide: Spread, loading: float, settings: Precoder) -> ComplexArray:
    """Broadened beams, loaded enough that none loses more than the limit against itself alone.

    The load is a multiple of each one's power, at least ``loading``.
    """
    power = np.einsum("mn,mn->n", wide.centres, wide.centres.conj()).real
    least = power_gains(wide.centres, wide.beams) * 10 ** (-settings.loss_limit_db / 10)

    def keeps(centred: ComplexArray) -> bool:
        return bool((power_gains(wide.centres, centred) >= least).all())

    centred, too_little = nulled(wide, loading * power), loading
    while loading < LOADINGS[-1] and not keeps(centred):
        too_little, loading = loading, 8.0 * loading
        centred = nulled(wide, loading * power)
    for _ in range(3 if loading > too_little else 0):
        between = math.sqrt(too_little * loading)
        tried = nulled(wide, between * power)
        if keeps(tried):
            loading, centred = between, tried
        else:
            too_little = between
    return widen_nulls(wide, loading * power, centred, least)


def _exactly(a: ComplexArray, found: ComplexArray) -> ComplexArray:
    """Beams without the residual that nulled points beside the others may have left by rounding."""
    stray = a.T @ found
    own = np.abs(stray.diagonal())
    np.fill_diagonal(stray, 0.0)
    if (np.abs(stray) <= ROUNDING * own).all():
        return found
    solved = zero_forcing.solve(a)
    if solved is None:
        return found
    exact: ComplexArray = found - solved.weights @ stray
    return exact


def _lost_db(alone: FloatArray, kept: FloatArray) -> float:
    """Gain that the worst user loses against its beam alone, dB; infinite where it loses all."""
    worst = float((kept / alone).min())
    return -_db(worst) if worst > 0 else np.inf


def _unit_response(a: ComplexArray, weights: ComplexArray) -> ComplexArray:
    """Columns scaled so that each UAV receives 1 from its own."""
    scaled: ComplexArray = weights / np.einsum("mn,mn->n", a, weights)
    return scaled


def _db(power_ratio: float) -> float:
    return 10 * float(np.log10(power_ratio))


def _loaded(a: ComplexArray, gram: ComplexArray, loading: float) -> ComplexArray:
    """A* (A^T A* + x I)^-1, by the smaller of the two matrices that can be inverted for it."""
    if len(gram) <= len(a):
        found: ComplexArray = a.conj() @ np.linalg.inv(gram + loading * np.eye(len(gram)))
        return found
    outer = a.conj() @ a.T
    few: ComplexArray = np.linalg.inv(outer + loading * np.eye(len(a))) @ a.conj()
    return few


def _condition_number(a: ComplexArray, gram: ComplexArray) -> float:
    """cond(A) in the 2-norm, from the eigenvalues of A^T A*.

    Always finite: past about 1e7 rounding hides the smallest eigenvalue, and the result stays
    there. With more users than elements the smallest is 0, and the result is that of rounding
    alone.
    """
    rounding = len(gram) * float(np.finfo(float).eps)
    if len(gram) > len(a):
        return 1.0 / math.sqrt(rounding)
    eigenvalues = np.linalg.eigvalsh(gram)
    least, most = eigenvalues[0], eigenvalues[-1]
    return float(np.sqrt(most / max(least, most * rounding)))


def _spectrum(a: ComplexArray, gram: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues l of A^T A*, ascending, and their shares in each user's column, |v_ik|^2 l_k.

    Computed from the smaller of A^T A* and A* A^T, whose eigenvalues are the same but for zeros,
    which have no part in any column: v_k sqrt(l_k) = A^T u_k.
    """
    if len(gram) <= len(a):
        values, vectors = np.linalg.eigh(gram)
        values = np.maximum(values, 0.0)
        return values, np.abs(vectors) ** 2 * values
    values, vectors = np.linalg.eigh(a.conj() @ a.T)
    return np.maximum(values, 0.0), np.abs(a.T @ vectors) ** 2


def _least_loading(a: ComplexArray, gram: ComplexArray, settings: Precoder) -> float:
    """The least x at which no user's loss and no condition number is beyond its limit.

    With A^T A* = V diag(l) V^H and w_k = |v_ik|^2 l_k, the gain of user i over that of its own beam
    is (sum w y)^2 / (sum w . sum w y^2), y_k = 1/(l_k + x). Its derivative in x has the sign of
    (sum w y^3)(sum w y) - (sum w y^2)^2, which is never negative (Cauchy-Schwarz): the loss falls
    with x, towards none. The least x is therefore found on a grid, and then on a finer one.
    """
    values, shares = _spectrum(a, gram)
    scale = float(values.sum()) / len(gram)
    wanted = 10 ** (-settings.loss_limit_db / 10)
    square = settings.condition_limit**2
    smallest = values[0] if len(gram) <= len(a) else 0.0
    least = max((values[-1] - square * smallest) / (square - 1), 1e-12 * scale)

    def kept(loadings: FloatArray) -> FloatArray:
        """The worst user's share of its own beam's gain, for each loading."""
        y = 1.0 / (values[:, np.newaxis] + loadings)
        own = shares @ y
        worst: FloatArray = (own**2 / (shares.sum(axis=1)[:, np.newaxis] * (shares @ y**2))).min(0)
        return worst

    loadings = scale * LOADINGS
    enough = kept(loadings) >= wanted
    first = int(np.argmax(enough)) if enough.any() else len(loadings) - 1
    low, high = loadings[max(first - 1, 0)], loadings[first]
    fine = np.linspace(low, high, 33)
    found = fine[int(np.argmax(kept(fine) >= wanted))] if enough.any() else high
    return float(max(found, least))


def _normalise(weights: ComplexArray, how: Normalisation, turns: IntArray) -> None:
    """Scale columns of unit response in place; the columns of one turn share one factor."""
    if how is Normalisation.UNIT_RESPONSE:
        return
    if how is Normalisation.STREAM:
        weights /= np.linalg.norm(weights, axis=0)
        return
    for turn in range(int(turns.max()) + 1):
        columns = turns == turn
        power = np.abs(weights[:, columns]) ** 2
        if how is Normalisation.TOTAL:
            weights[:, columns] /= np.sqrt(power.sum())
        else:
            weights[:, columns] /= np.sqrt(power.sum(axis=1).max() * len(weights))


def gain_db(steering: ComplexArray, weights: ComplexArray) -> FloatArray:
    """Array gain of each column towards its own direction, |a^T f|^2 / |f|^2, in dB, (N,)."""
    gains: FloatArray = 10 * np.log10(power_gains(steering, weights))
    return gains
