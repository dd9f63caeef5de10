"""Weights from steering vectors: zero forcing, and alternatives where it costs too much.

UAV i receives y_i = h_i a(u_i)^T F s + noise (docs/math.md 7, paper eq. (1)). With A = [a(u_1) ...
a(u_N)], (M, N),

    zero forcing (ZF)        F = A* (A^T A*)^-1           A^T F = I       paper eq. (7)
    regularised (RZF)        F = A* (A^T A* + x I)^-1 D   D: so that A^T F has a unit diagonal
    maximum ratio (MRT)      F = A* D

RZF is ZF at x = 0 and tends to MRT as x grows. (The published channel has a^H beside this F, which
points elsewhere: one of the two must be conjugated; docs/math.md 8.4.)

The inverse alone gives the cost of zero forcing for user i: its gain falls from |a_i|^2 to 1 /
[(A^T A*)^-1]_ii. Past ``loss_limit_db`` for any user, or past a condition number of A, the policy
decides: load the matrix by the least x at which no user loses more (each loss falls with x, see
``_least_loading``), serve groups in time slots, or leave out the lowest priorities. The cost is
computed with the columns of A scaled to equal length, since a weak element pattern is not
closeness. High cost occurs at mirror images about a line array, or with two UAVs in line
(docs/math.md 7).

Over 300 lines: the methods are fallbacks of one another.
"""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from companion.beams.weights import grouping, powers, zero_forcing
from companion.beams.weights.grouping import PreviousSlots
from companion.beams.weights.lapack import zheevd
from companion.beams.weights.nulls import with_nulls
from companion.beams.weights.widening import Spread, power_gains
from companion.beams.worth.link_budget import LinkBudget
from companion.values import (
    ComplexArray,
    FloatArray,
    IntArray,
    Method,
    Normalisation,
    Policy,
    Power,
    Widen,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Precoder:
    """Settings by which weights are computed.

    method           zero forcing, regularised or maximum ratio
    policy           fallback where zero forcing costs too much
    loss_limit_db    largest loss of any user
    condition_limit  largest condition number of A, with columns of equal length
    regularisation   x / M if RZF itself is the method
    normalisation    scale of the columns
    priority         names of UAVs in descending order; unnamed ones follow in their order
    widen            widths of main lobes and nulls
    floor_db         least gain of a likely beam within the bound, where possible
    power            power allocation between beams; None: by the normalisation
    rate_weights     weight of each UAV's rate in their weighted sum, by name; else 1
    budget           power and noise of the radio
    uav_antennas     antennas that each UAV combines
    worth_db         least guaranteed gain that is useful
    """

    method: Method = Method.ZERO_FORCING
    policy: Policy = Policy.REGULARISE
    loss_limit_db: float = 3.0
    condition_limit: float = 100.0
    regularisation: float = 0.01
    normalisation: Normalisation = Normalisation.UNIT_RESPONSE
    priority: tuple[str, ...] = ()
    widen: Widen = Widen.LIKELY
    floor_db: float = 2.9
    power: Power | None = None
    rate_weights: Mapping[str, float] = field(default_factory=dict)
    budget: LinkBudget = field(
        default_factory=lambda: LinkBudget(
            tx_power_dbm=20.0, bandwidth_hz=50e6, noise_figure_db=7.0
        )
    )
    uav_antennas: int = 4
    worth_db: float = 0.0

    @property
    def needs_radio(self) -> bool:
        """Whether the weights depend on the radio parameters of the users."""
        return self.method is Method.MMSE or self.power not in (None, Power.EQUAL)


@dataclass(frozen=True, slots=True, kw_only=True)
class Precoding:
    """Weights for the K users that are served, and the cost of these weights.

    ``condition_number`` is that of A with columns of equal length, the largest over the groups;
    None without users.
    """

    weights: ComplexArray  # F, (M, K)
    method: Method  # the least exact method over the groups
    normalisation: Normalisation
    condition_number: float | None
    served: IntArray  # (K,), indices of the users served
    groups: IntArray  # (K,), the slot of each
    dropped: dict[int, str]  # why a user is not served, by index
    exact: bool = False  # whether A^T F is diagonal within each group


@dataclass(frozen=True, slots=True)
class Radio:
    """Radio parameters of N users."""

    snr: FloatArray  # (N,), of an isotropic antenna that has the whole power, as a power ratio
    rate_weights: FloatArray  # (N,), weights of the rates

    def of(self, users: IntArray) -> "Radio":
        """Return the parameters of some of the users."""
        return Radio(self.snr[users], self.rate_weights[users])


LEAST_LOADING: Final = 1e-12
"""Least loading if RZF itself is the method, relative to the trace of the Gram matrix."""
ROUNDING: Final = 1e-11
"""Response to another user, relative to a beam's own user, above which it is removed."""
LOADINGS: Final = np.logspace(-6, 6, 49)
"""Loadings tried by ``_least_loading``, in mean eigenvalues; the last gives MRT to 1e-6."""


def precode(
    steering: ComplexArray,
    settings: Precoder,
    spread: Spread | None = None,
    *,
    priorities: Sequence[int] | None = None,
    radio: Radio | None = None,
    before: PreviousSlots | None = None,
) -> Precoding:
    """Compute the weights for a steering matrix (M, N).

        steering    A, one steering vector per column
        settings    how weights are computed
        spread      widening of main lobes and nulls; None: none
        priorities  users in descending priority; None: in their order
        radio       needed if the method is MMSE or power is allocated by rates
        before      previous time slots; None: there are none

    Raises ``ValueError`` for a steering vector that is not finite or is 0, and without a radio
    where one is needed.
    """
    size, users = steering.shape
    power = np.vecdot(steering.T, steering.T).real
    if users and not 0.0 < power.min() <= power.max() < math.inf:
        raise ValueError("a steering vector is 0 or not finite")
    everyone = np.arange(users)
    if users == 0:
        nothing: ComplexArray = np.empty((size, 0), dtype=complex)
        return Precoding(
            weights=nothing,
            method=settings.method,
            normalisation=settings.normalisation,
            condition_number=None,
            served=everyone,
            groups=everyone,
            dropped={},
        )
    groups, dropped = _slots(steering, settings, priorities, before)
    made = [_columns(steering, settings, spread, radio, group) for group in groups]
    shared = [one.weights for one in made]
    if settings.power is not None:
        shared = [
            _with_power_allocation(steering[:, group], columns, settings, radio, group)
            for group, columns in zip(groups, shared, strict=True)
        ]
    if len(groups) == 1 and len(groups[0]) == users:
        served, slots = everyone, np.zeros(users, dtype=np.int64)
        weights = np.ascontiguousarray(shared[0])
    else:
        served, slots, weights = _joined(groups, shared)
    method = max((one.method for one in made), key=_METHODS.index)
    normalise(weights, settings.normalisation, slots)
    return Precoding(
        weights=weights,
        method=method,
        normalisation=settings.normalisation,
        condition_number=max(one.condition_number for one in made),
        served=served,
        groups=slots,
        dropped=dropped,
        exact=method is Method.ZERO_FORCING,
    )


def renewed_column(
    steering: ComplexArray,
    settings: Precoder,
    spread: Spread | None,
    user: int,
    radio: Radio | None = None,
) -> ComplexArray:
    """Compute the column (M,) of one of the users of a slot alone, with unit response.

        steering  A, (M, N), the steering vectors of all users of the slot
        spread    widening of that user's beam and of the nulls on all; None: none
        radio     needed if the method is MMSE

    The other columns are not computed, so that it costs less than ``precode``. Raises
    ``ValueError`` as ``precode`` does.
    """
    everyone = np.arange(steering.shape[1])
    if spread is None:
        return _columns(steering, settings, None, radio, everyone).weights[:, user]
    match settings.method:
        case Method.MATCHED:
            column = spread.beams[:, 0]
        case Method.REGULARISED | Method.MMSE:
            gram = steering.T @ steering.conj()
            loading = _loading(steering, gram, settings, radio, everyone)
            column = with_nulls(spread, loading).weights[:, 0]
        case Method.ZERO_FORCING:
            exact = settings.policy is not Policy.REGULARISE
            if exact:
                gram = steering.T @ steering.conj()
                lengths = np.sqrt(gram.diagonal().real)
                condition = _condition_number(steering, gram / (lengths[:, np.newaxis] * lengths))
                exact = condition <= settings.condition_limit
            column = with_nulls(spread, exact=exact).weights[:, 0]
    scaled: ComplexArray = column / (steering[:, user] @ column)
    return scaled


def _joined(
    groups: list[IntArray], columns: list[ComplexArray]
) -> tuple[IntArray, IntArray, ComplexArray]:
    """Return the users of all groups (K,), ascending, their slots (K,), and weights (M, K)."""
    together = np.concatenate(groups)
    order = np.argsort(together)
    slots = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    return together[order], slots[order], np.concatenate(columns, axis=1)[:, order]


_METHODS: Final = (Method.ZERO_FORCING, Method.REGULARISED, Method.MMSE, Method.MATCHED)


def _slots(
    steering: ComplexArray,
    settings: Precoder,
    priorities: Sequence[int] | None,
    before: PreviousSlots | None,
) -> tuple[list[IntArray], dict[int, str]]:
    """Return the groups of users by time slot, and the users left out with the reason.

    Previous slots within the limits are kept while they are young; later they are kept until others
    need fewer slots or serve more users.
    """
    everyone = np.arange(steering.shape[1])
    if settings.policy is Policy.REGULARISE or settings.method is not Method.ZERO_FORCING:
        return [everyone], {}
    limits = grouping.CostLimits(settings.loss_limit_db, settings.condition_limit)
    lost_db = grouping.lost_db(steering, limits)
    stays = None if before is None else grouping.kept_groups(steering, before, limits)
    young = before is not None and before.young
    if lost_db <= settings.loss_limit_db and not (young and stays is not None):
        return [everyone], {}
    order = everyone.tolist() if priorities is None else list(priorities)
    if settings.policy is Policy.GROUP:
        found = stays if stays is not None and young else None
        if found is None:
            found = grouping.semi_orthogonal(steering, order, limits)
        return stays if stays is not None and len(stays) <= len(found) else found, {}
    if stays is not None and young:
        kept = stays[0]
    else:
        kept = grouping.without_the_lowest(steering, order, limits)
        kept = stays[0] if stays is not None and len(stays[0]) >= len(kept) else kept
    cost = f"cost {lost_db:.0f} dB" if np.isfinite(lost_db) else "exceed the limits"
    why = f"too close to a UAV of higher priority: separating all would {cost}"
    return [kept], dict.fromkeys(set(order).difference(kept.tolist()), why)


@dataclass(frozen=True, slots=True)
class _Columns:
    """Columns of weights with unit response for some users."""

    weights: ComplexArray
    method: Method
    condition_number: float


def _columns(
    steering: ComplexArray,
    settings: Precoder,
    spread: Spread | None,
    radio: Radio | None,
    users: IntArray,
) -> _Columns:
    a = steering if len(users) == steering.shape[1] else steering[:, users]
    wide = None if spread is None else spread.of(users)
    gram = a.T @ a.conj() if wide is None else wide.crossed[:: wide.each]
    lengths = np.sqrt(gram.diagonal().real)
    even_gram: ComplexArray = gram / (lengths[:, np.newaxis] * lengths)
    condition = _condition_number(a, even_gram)
    match settings.method:
        case Method.MATCHED:
            own = a.conj() if wide is None else wide.beams
            return _Columns(_unit_response(a, own), Method.MATCHED, condition)
        case Method.REGULARISED | Method.MMSE:
            loading = _loading(a, gram, settings, radio, users)
            found = _loaded(a, gram, loading) if wide is None else with_nulls(wide, loading).weights
            return _Columns(_unit_response(a, found), settings.method, condition)
        case Method.ZERO_FORCING:
            if wide is not None:
                return _wide_zero_forcing(a, wide, condition, settings)
            made = _zero_forcing(a / lengths, even_gram, condition, settings)
            return replace(made, weights=made.weights / lengths)


def _loading(
    a: ComplexArray, gram: ComplexArray, settings: Precoder, radio: Radio | None, users: IntArray
) -> FloatArray:
    """Return the loading of each user for the regularised methods."""
    least = LEAST_LOADING * float(gram.trace().real)
    if settings.method is Method.MMSE:
        return np.maximum(_mmse_loading(gram, settings, radio, users), least)
    return np.full(len(users), max(settings.regularisation * len(a), least))


def _mmse_loading(
    gram: ComplexArray, settings: Precoder, radio: Radio | None, users: IntArray
) -> FloatArray:
    """Return the loading of each user for the least mean square error at its power share.

    Shares are equal, or the uplink shares that maximise the worst rate or the weighted sum.
    """
    if radio is None:
        raise ValueError("MMSE needs the radio parameters")
    snr = radio.snr[users]
    match settings.power:
        case Power.MAX_MIN:
            return 1 / (snr * powers.dual_of_max_min(gram, snr))
        case Power.WEIGHTED_SUM:
            return 1 / (snr * powers.dual_of_weighted_sum(gram, snr, radio.rate_weights[users]))
        case _:
            return len(users) / snr


def _with_power_allocation(
    a: ComplexArray, weights: ComplexArray, settings: Precoder, radio: Radio | None, users: IntArray
) -> ComplexArray:
    """Return columns (M, K) of a slot with power allocated as the settings say."""
    unit: ComplexArray = weights / np.linalg.norm(weights, axis=0)
    if settings.power is Power.EQUAL:
        return unit
    if radio is None:
        raise ValueError("power allocation by rates needs the radio parameters")
    coupling = radio.snr[users, np.newaxis] * np.abs(a.T @ unit) ** 2
    if settings.power is Power.MAX_MIN:
        share = powers.max_min(coupling)
    else:
        share = powers.weighted_sum(coupling, radio.rate_weights[users])
    shared: ComplexArray = unit * np.sqrt(share)
    return shared


def _zero_forcing(
    a: ComplexArray, gram: ComplexArray, condition: float, settings: Precoder
) -> _Columns:
    """Apply zero forcing if its cost is within the limits, else with the least loading that is.

    The columns of ``a`` (M, N) have unit length.
    """
    if condition <= settings.condition_limit:
        solved = zero_forcing.solve(a)
        if solved is not None and _db(solved.loss_factors.max()) <= settings.loss_limit_db:
            return _Columns(solved.weights, Method.ZERO_FORCING, condition)
    loading = np.full(a.shape[1], _least_loading(a, gram, settings))
    found = _loaded(a, gram, loading)
    return _Columns(_unit_response(a, found), Method.REGULARISED, condition)


def _wide_zero_forcing(
    a: ComplexArray, wide: Spread, condition: float, settings: Precoder
) -> _Columns:
    """Return shaped beams with nulls on other users, exact where no beam's least gain suffers."""
    told_apart = condition <= settings.condition_limit
    found = with_nulls(wide, exact=settings.policy is not Policy.REGULARISE and told_apart)
    if told_apart and found.exact.all():
        exact = _unit_response(a, _exactly(a, found.weights))
        return _Columns(exact, Method.ZERO_FORCING, condition)
    return _Columns(_unit_response(a, found.weights), Method.REGULARISED, condition)


def _exactly(a: ComplexArray, found: ComplexArray) -> ComplexArray:
    """Remove the residual response at predicted directions, left by rounding or nearby points."""
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


def _unit_response(a: ComplexArray, weights: ComplexArray) -> ComplexArray:
    """Scale columns so that each UAV receives 1 from its own column."""
    scaled: ComplexArray = weights / np.vecdot(a.conj().T, weights.T)
    return scaled


def _db(power_ratio: float) -> float:
    return 10 * float(np.log10(power_ratio))


def _loaded(a: ComplexArray, gram: ComplexArray, loading: FloatArray) -> ComplexArray:
    """Return A* (A^T A* + X)^-1, X (N,), by the smaller of the two equivalent matrices."""
    if len(gram) <= len(a):
        loaded: ComplexArray = gram.copy()
        loaded.flat[:: len(loaded) + 1] += loading
        return np.asarray(a.conj() @ np.linalg.inv(loaded))
    scaled = a.conj() / loading
    return np.asarray(np.linalg.solve(np.eye(len(a)) + scaled @ a.T, scaled), dtype=complex)


def _condition_number(a: ComplexArray, gram: ComplexArray) -> float:
    """Return cond(A) in the 2-norm, from the eigenvalues of A^T A*.

    Always finite: past about 1e7 rounding hides the smallest eigenvalue, and the result stays
    there. With more users than elements the smallest is 0, and only rounding determines the result.
    """
    rounding = len(gram) * sys.float_info.epsilon
    if len(gram) > len(a):
        return 1.0 / math.sqrt(rounding)
    eigenvalues, _, info = zheevd(gram, compute_v=0)
    if info:
        raise np.linalg.LinAlgError("the eigenvalues of a Gram matrix do not converge")
    least, most = float(eigenvalues[0]), float(eigenvalues[-1])
    return math.sqrt(most / max(least, most * rounding))


def _spectrum(a: ComplexArray, gram: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues l of A^T A*, ascending, and shares in each user's column, |v_ik|^2 l_k.

    Computed from the smaller of A^T A* and A* A^T, whose eigenvalues are the same but for zeros,
    which do not contribute to any column: v_k sqrt(l_k) = A^T u_k.
    """
    if len(gram) <= len(a):
        values, vectors = np.linalg.eigh(gram)
        values = np.maximum(values, 0.0)
        return values, np.abs(vectors) ** 2 * values
    values, vectors = np.linalg.eigh(a.conj() @ a.T)
    return np.maximum(values, 0.0), np.abs(a.T @ vectors) ** 2


def _least_loading(a: ComplexArray, gram: ComplexArray, settings: Precoder) -> float:
    """Return the least x at which every user's loss and the condition number are within the limits.

    With A^T A* = V diag(l) V^H and w_k = |v_ik|^2 l_k, the gain of user i over that of its own beam
    is (sum w y)^2 / (sum w . sum w y^2), y_k = 1/(l_k + x). Its derivative in x has the sign of
    (sum w y^3)(sum w y) - (sum w y^2)^2, which is never negative (Cauchy-Schwarz): the loss falls
    with x, to 0. The least x is therefore found on a grid, and then on a finer one.
    """
    values, shares = _spectrum(a, gram)
    scale = float(values.sum()) / len(gram)
    wanted = 10 ** (-settings.loss_limit_db / 10)
    square = settings.condition_limit**2
    smallest = values[0] if len(gram) <= len(a) else 0.0
    least = max((values[-1] - square * smallest) / (square - 1), 1e-12 * scale)

    def kept(loadings: FloatArray) -> FloatArray:
        """Return the worst user's share of its own beam's gain, for each loading."""
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


def normalise(weights: ComplexArray, how: Normalisation, slots: IntArray) -> None:
    """Scale columns in place; the columns of one slot share one factor.

    Columns of unit response stay unchanged.
    """
    if how is Normalisation.UNIT_RESPONSE:
        return
    if how is Normalisation.STREAM:
        weights /= np.linalg.norm(weights, axis=0)
        return
    for slot in range(int(slots.max()) + 1):
        columns = slots == slot
        power = np.abs(weights[:, columns]) ** 2
        if how is Normalisation.TOTAL:
            weights[:, columns] /= np.sqrt(power.sum())
        else:
            weights[:, columns] /= np.sqrt(power.sum(axis=1).max() * len(weights))


def gain_db(steering: ComplexArray, weights: ComplexArray) -> FloatArray:
    """Return each column's array gain towards its own direction, |a^T f|^2 / |f|^2, dB, (N,)."""
    gains: FloatArray = 10 * np.log10(power_gains(steering, weights))
    return gains
