"""Quantisation of complex weights to the settings of phase shifters and attenuators.

The cost of settings that radiate g (M,) if f (M,) is wanted is

    J = min over complex beta of |f - beta g|^2 + sum_j w_j |a_j^T (f - beta g)|^2

For a half-wave line the first term is the mean square error of the pattern over one period of
sin(angle) (Parseval). The second weights the response in given directions, to preserve a deep null
or a gain. beta is free because the level and the phase of a whole beam are set elsewhere. With
K = I + sum_j w_j a_j* a_j^T (Hermitian, positive definite),

    J = f^H K f - |g^H K f|^2 / (g^H K g)

so the best settings have the largest second term, which the search compares. The phases of all
elements may rotate together, so the first step rounds at several common rotations. From the best
few of them, coordinate descent moves one element after the other to its best neighbouring setting
until a whole sweep changes nothing. Every step lowers J, and rounding without a rotation is among
the candidates: the result is never worse than plain rounding. Nothing is random: equal input gives
equal codes.

The cost of plain rounding for a matched beam: phase errors uniform over a step of 2 pi / n leave
the amplitude sinc(1/n) in the mean, a loss of -20 log10(sinc(1/n)) dB with sinc(x) = sin(pi x)/(pi
x) (docs/math.md 7; R. J. Mailloux, Phased Array Antenna Handbook, quantisation of phase). Hardware
without gain control radiates every element at full gain: a taper, or the unequal amplitudes of
nulls, are then lost, except for what the phases can recover.

Over 300 lines: one search: its steps, its metric, its descent.
"""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from companion.values import ComplexArray, FloatArray, IntArray

ROTATIONS: Final = 16  # common rotations that are tried, over one step of phase
STARTS: Final = 4  # best rotations from which the descent starts
SWEEPS: Final = 100
"""Most sweeps of the coordinate descent; it usually ends after three to eight."""
MOVES: Final = 2048
"""Most moves of the descent, each of a third of a millisecond; one sweep is always made."""
REACH: Final = 2  # steps of phase, gain, I or Q that one move may take
NEAR: Final = np.array([(i, j) for i in range(-REACH, REACH + 1) for j in range(-REACH, REACH + 1)])
"""All moves between codes within ``REACH``, as pairs of steps."""
EMPHASIS: Final = 1.0
"""Weight w_j of an emphasised direction if the elements of a_j have amplitude 1.

At 1 a direction counts as much as the whole pattern. A larger weight deepens nulls by less than a
decibel and costs gain.
"""


class SettableStates(Protocol):
    """Possible settings of one element: codes of two integers each, full gain at amplitude 1.

    period_rad  the rotation that maps the settings onto themselves
    values      complex factors (...) of codes (..., 2)
    nearest     codes (..., 2) nearest to wanted factors (...) of amplitude at most 1
    around      codes (S, n, 2) that are tried from each code (S, 2)
    """

    @property
    def period_rad(self) -> float: ...
    def values(self, codes: IntArray) -> ComplexArray: ...
    def nearest(self, wanted: ComplexArray) -> IntArray: ...
    def around(self, codes: IntArray) -> IntArray: ...


@dataclass(frozen=True, slots=True)
class Resolution:
    """Resolution of a phase shifter with gain control; codes are (phase, gain).

    Phase code k is a factor exp(+j 2 pi k / ``phase_steps``); b bits are 2**b steps. Gain code i
    has amplitude ``levels[i]``, decreasing from 1, full gain; a last level of 0 is an element
    switched off; (1.0,) is hardware without gain control. Raises ``ValueError`` for other steps or
    levels.
    """

    phase_steps: int
    levels: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        if self.phase_steps < 2:
            raise ValueError(f"{self.phase_steps} phase steps; give at least 2")
        falling = all(a > b for a, b in zip(self.levels, self.levels[1:], strict=False))
        if not self.levels or self.levels[0] != 1.0 or not falling or self.levels[-1] < 0:
            raise ValueError(f"levels {self.levels} must decrease from 1 and be 0 or more")

    @property
    def period_rad(self) -> float:
        return 2 * np.pi / self.phase_steps

    def values(self, codes: IntArray) -> ComplexArray:
        """Return the complex factors (...) of codes (..., 2)."""
        phases_rad = self.period_rad * codes[..., 0]
        factors: ComplexArray = np.asarray(self.levels)[codes[..., 1]] * np.exp(1j * phases_rad)
        return factors

    def nearest(self, wanted: ComplexArray) -> IntArray:
        """Return the codes (..., 2) nearest to factors: phase and gain, each rounded separately.

        An amplitude below the range becomes the lowest level or off, whichever is nearer. An
        amplitude of 1 stays at full gain, whatever its phase error.
        """
        phase = np.rint(np.angle(wanted) / self.period_rad).astype(np.int64)
        rising = np.asarray(self.levels)[::-1]
        gain = len(rising) - 1 - np.searchsorted((rising[1:] + rising[:-1]) / 2, np.abs(wanted))
        return np.stack([phase % self.phase_steps, gain], axis=-1)

    def around(self, codes: IntArray) -> IntArray:
        """Return codes (S, n, 2) within ``REACH`` steps of phase and gain, and the lowest level."""
        last = len(self.levels) - 1
        lowest = NEAR[NEAR[:, 1] == 0] + (0, last)
        near = codes[:, np.newaxis] + (np.concatenate([NEAR, lowest]) if last else lowest)
        phases, gains = near[..., 0] % self.phase_steps, np.clip(near[..., 1], 0, last)
        return np.stack([phases, gains], axis=-1)


def stepped(
    phase_steps: int,
    gain_step_db: float | None = None,
    gain_range_db: float = 0.0,
    off: bool = False,
) -> Resolution:
    """Return equal gain steps in dB from 0 to ``-gain_range_db`` (None: no gain control).

    ``off``: an element can be switched off. Raises ``ValueError`` for an invalid step or range.
    """
    levels = [1.0]
    if gain_step_db is not None:
        if not (0 < gain_step_db <= gain_range_db < np.inf):
            raise ValueError(
                f"gain steps of {gain_step_db} dB over {gain_range_db} dB: "
                "both finite, the step above 0 and at most the range"
            )
        count = int(np.floor(gain_range_db / gain_step_db + 1e-9))
        levels += [10 ** (-gain_step_db * i / 20) for i in range(1, count + 1)]
    return Resolution(phase_steps, (*levels, 0.0) if off else tuple(levels))


@dataclass(frozen=True, slots=True)
class Quadrature:
    """Resolution of a vector modulator: codes are (I, Q), integers from -``peak`` to ``peak``.

    The factor is (I + jQ) / ``peak``, so that full gain is possible at every phase; no code is more
    than half a step above that. I = Q = 0 is off.
    """

    peak: int

    @property
    def period_rad(self) -> float:
        return np.pi / 2

    def values(self, codes: IntArray) -> ComplexArray:
        """Return the complex factors (...) of codes (..., 2)."""
        factors: ComplexArray = codes.astype(np.float64).view(np.complex128)[..., 0] / self.peak
        return factors

    def nearest(self, wanted: ComplexArray) -> IntArray:
        """Return the codes (..., 2) nearest to factors: I and Q, each rounded separately."""
        both = np.stack([wanted.real, wanted.imag], axis=-1) * self.peak
        return np.clip(np.rint(both), -self.peak, self.peak).astype(np.int64)

    def around(self, codes: IntArray) -> IntArray:
        """Return codes (S, n, 2) within ``REACH`` steps of I and Q, and not above full gain."""
        near = codes[:, np.newaxis] + NEAR
        full = np.hypot(near[..., 0], near[..., 1]) <= self.peak + 0.5
        allowed = full & (np.abs(near).max(axis=-1) <= self.peak)
        return np.where(allowed[..., np.newaxis], near, codes[:, np.newaxis])


@dataclass(frozen=True, slots=True, eq=False)
class Quantised:
    """Quantised settings of one beam.

    weights  (M,) that they radiate, channel factors included; the strongest element is at full
             gain
    """

    codes: IntArray  # (M, 2), as the settings define them
    weights: ComplexArray
    cost: float  # J over its value for zero weights: 0 is exact, 1 useless


def quantise(
    weights: ComplexArray,
    settings: SettableStates,
    towards: ComplexArray | None = None,
    channel: ComplexArray | None = None,
    emphasis: float = EMPHASIS,
) -> Quantised:
    """Return the settings whose pattern is nearest to that of ``weights`` (M,).

        settings  possible settings of one element
        towards   (M, J), steering vectors of emphasised directions, such as the beam's own UAV and
                  the nulled ones
        channel   (M,), factor that each channel applies to its setting; None: 1
        emphasis  w_j if the elements of a_j have amplitude 1; in general w_j = emphasis M /
                  |a_j|^2

    The element with the largest required amplitude gets full gain and keeps it. Raises
    ``ValueError`` for weights that are all zero, for channels that are zero, and for shapes that do
    not match.
    """
    factors = np.ones(len(weights), dtype=complex) if channel is None else channel
    metric = _metric(len(weights), towards, emphasis)
    wanted = _target_factors(weights, factors)
    strongest = int(np.argmax(np.abs(wanted)))
    starts = _best_rotations(wanted, settings, metric, weights, factors)
    codes = _descend(
        starts, settings, metric, weights=weights, factors=factors, strongest=strongest
    )
    radiated = factors * settings.values(codes)
    score = _score(radiated, metric, weights)
    best = int(np.argmax(score))
    whole = float((weights.conj() @ metric @ weights).real)
    return Quantised(codes[best], radiated[best], max(1 - float(score[best]) / whole, 0.0))


def _target_factors(weights: ComplexArray, factors: ComplexArray) -> ComplexArray:
    """Return the wanted factors of settings: weights over channels, the strongest being 1."""
    if weights.ndim != 1 or factors.shape != weights.shape:
        raise ValueError(f"weights {weights.shape} and channels {factors.shape}: both must be (M,)")
    if not (np.isfinite(weights).all() and np.isfinite(factors).all() and factors.all()):
        raise ValueError("weights and channels must be finite, and no channel may be 0")
    wanted = weights / factors
    strongest = np.abs(wanted).max(initial=0.0)
    if strongest == 0:
        raise ValueError("all weights are 0")
    scaled: ComplexArray = wanted / strongest
    return scaled


def _metric(size: int, towards: ComplexArray | None, emphasis: float) -> ComplexArray:
    """Return K (M, M): the identity for the pattern, plus a term for each emphasised direction."""
    metric = np.eye(size, dtype=complex)
    if towards is None:
        return metric
    if towards.ndim != 2 or len(towards) != size or not np.isfinite(towards).all():
        raise ValueError(f"directions {towards.shape} must be ({size}, J) and finite")
    power = np.sum(np.abs(towards) ** 2, axis=0)
    seen = towards[:, power > 0]  # element patterns may be 0 there
    scaled = seen * np.sqrt(emphasis * size / power[power > 0])
    metric += scaled.conj() @ scaled.T
    return metric


def _score(radiated: ComplexArray, metric: ComplexArray, weights: ComplexArray) -> FloatArray:
    """Return |g^H K f|^2 / (g^H K g) for each row g of ``radiated`` (n, M)."""
    towards_wanted = radiated.conj() @ (metric @ weights)
    power = np.einsum("nm,nm->n", radiated.conj() @ metric, radiated).real
    score: FloatArray = np.abs(towards_wanted) ** 2 / power
    return score


def _best_rotations(
    wanted: ComplexArray,
    settings: SettableStates,
    metric: ComplexArray,
    weights: ComplexArray,
    factors: ComplexArray,
) -> IntArray:
    """Return codes (``STARTS``, M, 2), rounded at the best common rotations, including 0."""
    turns = np.exp(1j * settings.period_rad * np.arange(ROTATIONS) / ROTATIONS)
    codes = np.unique(settings.nearest(turns[:, np.newaxis] * wanted), axis=0)
    best = np.argsort(-_score(factors * settings.values(codes), metric, weights), kind="stable")
    found: IntArray = codes[best[:STARTS]]
    return found


def _descend(
    starts: IntArray,
    settings: SettableStates,
    metric: ComplexArray,
    *,
    weights: ComplexArray,
    factors: ComplexArray,
    strongest: int,
) -> IntArray:
    """Run coordinate descent from each of ``starts`` (S, M, 2), all at once.

    A change of element m by d changes p = g^H K f by d* (K f)_m and q = g^H K g by 2 Re(d* (K g)_m)
    + |d|^2 K_mm, so all settings of one element are compared at once, and K g is updated by one
    column of K. The descent is sequential, and meant for exports, not for every update. The
    strongest element may rotate but not become weaker.
    """
    codes, set_to = starts.copy(), settings.values(starts)
    least = np.zeros(set_to.shape)
    least[:, strongest] = np.abs(set_to[:, strongest]) * (1 - 1e-12)
    aim, each = metric @ weights, np.arange(len(codes))
    for _ in range(min(SWEEPS, max(1, MOVES // len(weights)))):
        radiated = factors * set_to
        pull = radiated @ metric.T  # recomputed, so that rounding does not accumulate
        p = radiated.conj() @ aim
        q = np.einsum("sm,sm->s", radiated.conj(), pull).real
        moved = False
        for m in range(len(weights)):
            near = settings.around(codes[:, m])
            values = settings.values(near)
            change = factors[m] * (values - set_to[:, m, np.newaxis])
            new_p = p[:, np.newaxis] + change.conj() * aim[m]
            new_q = q[:, np.newaxis] + 2 * (change.conj() * pull[:, m, np.newaxis]).real
            new_q += np.abs(change) ** 2 * metric[m, m].real
            score = np.abs(new_p) ** 2 / np.maximum(new_q, 1e-300)
            score[np.abs(values) < least[:, m, np.newaxis]] = -1.0
            best = np.argmax(score, axis=1)
            better = np.flatnonzero(score[each, best] > np.abs(p) ** 2 / q * (1 + 1e-12))
            if not len(better):
                continue
            moved, taken = True, best[better]
            p[better], q[better] = new_p[better, taken], new_q[better, taken]
            pull[better] += change[better, taken, np.newaxis] * metric[:, m]
            codes[better, m], set_to[better, m] = near[better, taken], values[better, taken]
        if not moved:
            break
    return codes
