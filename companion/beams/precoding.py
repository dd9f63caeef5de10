"""Weights from steering vectors: zero forcing, and what is done where it costs too much.

UAV i receives y_i = h_i a(u_i)^T F s + noise. With A = [a(u_1) ... a(u_N)], (M, N),

    zero forcing (ZF)        F = A* (A^T A*)^-1           A^T F = I
    regularised (RZF)        F = A* (A^T A* + x I)^-1 D   D: so that A^T F has a unit diagonal
    maximum ratio (MRT)      F = A* D

(The published channel has a^H beside this F, which points elsewhere: one of the two must be
conjugated.) RZF is ZF at x = 0 and tends to MRT as x grows.

What zero forcing costs user i is known from the inverse alone: its gain falls from |a_i|^2 to
1 / [(A^T A*)^-1]_ii. Past ``loss_limit_db`` for any user, or past a condition number of A, the
policy decides: load the matrix by the least x at which no user loses more (the loss of each falls
with x, see ``_least_loading``), serve groups in turns, or leave out the lowest priorities. A
mirror image of a line array, or two UAVs behind one another, is where that happens.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams import grouping, zero_forcing
from companion.beams.widening import SOFT_LOADINGS, Spread, nulled, power_gains, widen_nulls
from companion.values import ComplexArray, FloatArray, IntArray, Method, Normalisation, Policy


@dataclass(frozen=True, slots=True)
class Precoder:
    """Settings. ``regularisation`` is x/M where RZF itself is the method; ``priority`` names UAVs
    in descending order, those not named follow as they come; ``widen``: main lobes and nulls are
    as wide as what is known of the directions."""

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
    """Weights (M, K) for the ``served`` users (K,), how they were made, and what it costs.

    ``groups`` (K,) is each one's turn; ``condition_number`` that of A, the worst of the groups
    (None without users); ``dropped`` says why a user is not served.
    """

    weights: ComplexArray
    method: Method
    normalisation: Normalisation
    condition_number: float | None
    served: IntArray
    groups: IntArray
    dropped: dict[int, str]


LOADINGS: Final = np.logspace(-6, 6, 49)
"""Where ``_least_loading`` looks, in mean eigenvalues; beyond the last it is MRT to 1e-6."""


def precode(
    steering: ComplexArray,
    settings: Precoder,
    spread: Spread | None = None,
    priorities: Sequence[int] | None = None,
) -> Precoding:
    """Weights for a steering matrix (M, N).

    ``spread`` widens main lobes and nulls; ``priorities`` are the users in descending priority
    (None: as they come). Raises ``ValueError`` for a steering vector that is not finite or is 0.
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
            return _columns(steering, settings, spread, np.sort(np.array(some))).fit

        if settings.policy is Policy.GROUP:
            groups = grouping.semi_orthogonal(steering, order, fits)
        else:
            groups = [grouping.without_the_lowest(order, fits)]
            lost_db = f"{plain.zero_forcing_loss_db:.0f} dB"
            why = f"too close to one of higher priority: to tell all apart would cost {lost_db}"
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
    """Columns with unit response for some users. ``fit``: by the method that was asked for;
    ``zero_forcing_loss_db``: what plain zero forcing costs the worst of them."""

    weights: ComplexArray
    method: Method
    condition_number: float
    fit: bool = True
    zero_forcing_loss_db: float = 0.0


def _columns(
    steering: ComplexArray, settings: Precoder, spread: Spread | None, users: IntArray
) -> _Columns:
    a = steering if len(users) == steering.shape[1] else steering[:, users]
    gram = a.T @ a.conj()
    condition = _condition_number(np.linalg.eigvalsh(gram).astype(np.float64, copy=False))
    wide = None if spread is None else spread.of(users)
    match settings.method:
        case Method.MATCHED:
            own = a.conj() if wide is None else wide.beams
            return _Columns(_unit_response(a, own), Method.MATCHED, condition)
        case Method.REGULARISED:
            found = _loaded(a, gram, wide, settings.regularisation * len(a), settings)
            return _Columns(found, Method.REGULARISED, condition)
        case Method.ZERO_FORCING:
            return _zero_forcing(a, gram, condition, wide, settings)


def _zero_forcing(
    a: ComplexArray,
    gram: ComplexArray,
    condition: float,
    wide: Spread | None,
    settings: Precoder,
) -> _Columns:
    """Zero forcing where its cost is within the limits, else the least loading that is."""
    lost_db = np.inf
    if condition <= settings.condition_limit:
        if wide is None:
            solved = zero_forcing.solve(a)
            lost_db = np.inf if solved is None else _db(solved.loss_factors.max())
            if solved is not None and lost_db <= settings.loss_limit_db:
                return _Columns(solved.weights, Method.ZERO_FORCING, condition, True, lost_db)
        else:
            found, lost_db = _wide_zero_forcing(a, wide, settings)
            if lost_db <= settings.loss_limit_db:
                return _Columns(
                    _unit_response(a, found), Method.ZERO_FORCING, condition, True, lost_db
                )
    loading = _least_loading(gram, settings)
    found = _loaded(a, gram, wide, loading, settings, settings.loss_limit_db)
    return _Columns(found, Method.REGULARISED, condition, False, lost_db)


def _wide_zero_forcing(
    a: ComplexArray, wide: Spread, settings: Precoder
) -> tuple[ComplexArray, float]:
    """Broadened beams that null the others exactly, and what that costs the worst of them, dB."""
    alone = power_gains(a, wide.beams)
    found = nulled(wide, 0.0, SOFT_LOADINGS[0])
    kept = power_gains(a, found)
    least = alone * 10 ** (-settings.loss_limit_db / 10)
    if (kept < least).any():
        found = centred = nulled(wide, 0.0)
        kept = power_gains(a, centred)
        if (kept >= least).all():
            found = widen_nulls(wide, 0.0, centred, least, SOFT_LOADINGS[1:])
    return found, _db((alone / kept).max())


def _loaded(
    a: ComplexArray,
    gram: ComplexArray,
    wide: Spread | None,
    loading: float,
    settings: Precoder,
    loss_limit_db: float = np.inf,
) -> ComplexArray:
    """Regularised columns; broadened ones by more loading where they lose more than the limit."""
    if wide is None:
        return _unit_response(a, a.conj() @ np.linalg.inv(gram + loading * np.eye(len(gram))))
    least = _least_gains(a, wide, settings)
    most = float(np.diag(gram).real.max()) * LOADINGS[-1]
    centred = nulled(wide, loading)
    while loading < most and (power_gains(a, centred) < least).any() and loss_limit_db < np.inf:
        loading *= 4.0
        centred = nulled(wide, loading)
    return _unit_response(a, widen_nulls(wide, loading, centred, least))


def _least_gains(a: ComplexArray, wide: Spread, settings: Precoder) -> FloatArray:
    """What each broadened beam must keep of the gain that it has alone."""
    return power_gains(a, wide.beams) * 10 ** (-settings.loss_limit_db / 10)


def _unit_response(a: ComplexArray, weights: ComplexArray) -> ComplexArray:
    """Columns scaled so that each UAV receives 1 of its own."""
    scaled: ComplexArray = weights / np.einsum("mn,mn->n", a, weights)
    return scaled


def _db(power_ratio: float) -> float:
    return 10 * float(np.log10(power_ratio))


def _condition_number(eigenvalues: FloatArray) -> float:
    """cond(A), from the eigenvalues of A^T A*, ascending.

    Finite always: past about 1e7 rounding hides the smallest eigenvalue and the figure stays there.
    """
    least, most = eigenvalues[0], eigenvalues[-1]
    return float(np.sqrt(most / max(least, most * len(eigenvalues) * np.finfo(float).eps)))


def _least_loading(gram: ComplexArray, settings: Precoder) -> float:
    """The least x at which no user loses more than the limit and the condition is in its limit.

    With A^T A* = V diag(l) V^H and w_k = |v_ik|^2 l_k, the gain of user i over that of its own
    beam is (sum w y)^2 / (sum w . sum w y^2), y_k = 1/(l_k + x). Its derivative in x has the sign
    of (sum w y^3)(sum w y) - (sum w y^2)^2, which is never negative (Cauchy and Schwarz): the
    loss falls with x, to none. So the least x is found by bisection.
    """
    values, vectors = np.linalg.eigh(gram)
    values = np.maximum(values, 0.0)
    scale = values.mean()
    shares = np.abs(vectors) ** 2 * values
    wanted = 10 ** (-settings.loss_limit_db / 10)
    square = settings.condition_limit**2
    least = max((values[-1] - square * values[0]) / (square - 1), 1e-12 * scale)

    def kept(loadings: FloatArray) -> FloatArray:
        """The worst user's share of its own beam's gain, for each loading."""
        y = 1.0 / (values[:, np.newaxis] + loadings)
        own = shares @ y
        worst: FloatArray = (own**2 / (shares.sum(axis=1)[:, np.newaxis] * (shares @ y**2))).min(0)
        return worst

    low, high = 0.0, 0.0
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
    for turn in range(int(turns.max(initial=-1)) + 1):
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
