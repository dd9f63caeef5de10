"""Observer design as a linear matrix inequality, solved by CVXPY and Clarabel.

This is the general case, and the independent proof of the closed forms in ``closed_form``. For one
or more sampling times T, each with its own A, B, C, D,

    x+ = A x + B w,   y = C x + D w,   e+ = (A - L C) e + (L D - B) w

find one P > 0, a Z(T) each, and the smallest mu, for fixed alpha(T) in (0, 1), with L = P^-1 Z,
such that

    [ (1-alpha) P      0          (P A - Z C)^T ]
    [     0        diag(alpha_i)  (Z D - P B)^T ]  >= 0       [ P  H^T  ]
    [ P A - Z C    Z D - P B           P        ]             [ H  mu I ]  >= 0

Then |H e| <= sqrt(mu) from e = 0, and in the limit from anywhere, for any order of the sampling
times: {e : e^T P e <= 1} is invariant. The admissible inputs w depend on the channels. With one
channel, diag(alpha_i) = alpha I and |w| <= 1. With several, alpha is the sum of the alpha_i, all
non-negative and found by the solver (the S-procedure, one multiplier per channel), and |w_i| <= 1
for each block w_i of w. The inequalities are docs/math.md 2, paper eq. (10), with the sign of the
last block corrected (docs/math.md 8.4); L is paper eq. (11), H e paper eq. (9).

Only this module imports cvxpy, which takes more than a second to load, and only commands that
design import this module.

Over 300 lines: one program: its blocks, its scalings, its check by eigenvalues.
"""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cvxpy as cp
import numpy as np

from companion.values import FloatArray, UserError

TOLERANCE: Final = 1e-6
"""Largest magnitude of an accepted negative eigenvalue of a scaled LMI: the solver's accuracy."""

NEARLY_ZERO: Final = 1e-3
"""Limit, in units of the input, below which mu may be an infimum of 0 that no P attains."""


class LmiError(UserError):
    """Error of a solver that gave no solution confirmed by its own certificate."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampling:
    """Plant at one sampling time: A (n, n), B (n, m), C (r, n), D (r, m)."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class LmiSolution:
    """Solution of the LMIs and its certificate, checked by eigenvalues in numpy alone.

    attained     False if mu can be lowered to 0 while P grows without bound: the mu given is
                 certified, but is not the smallest
    """

    gains: tuple[FloatArray, ...]  # L (n, r) for each of the K sampling times
    lyapunov: FloatArray  # P (n, n)
    mu: float  # certified bound on |H e|²
    alphas: FloatArray  # (K,)
    multipliers: FloatArray  # (K, channels), which sum to alphas
    margin: float  # smallest eigenvalue of all LMIs, scaled by congruence
    attained: bool = True

    @property
    def gain(self) -> FloatArray:
        return self.gains[0]


def solve(
    a: FloatArray,
    *,
    b: FloatArray,
    c: FloatArray,
    d: FloatArray,
    h: FloatArray,
    alpha: float,
    channels: Sequence[int] | None = None,
    mu_max: float | None = None,
) -> LmiSolution:
    """Solve for one sampling time, with A (n, n), B (n, m), C (r, n), D (r, m), H (k, n)."""
    return solve_common(
        [Sampling(a=a, b=b, c=c, d=d)], h, [alpha], channels=channels, mu_max=mu_max
    )


def solve_common(
    samplings: Sequence[Sampling],
    h: FloatArray,
    alphas: Sequence[float],
    *,
    channels: Sequence[int] | None = None,
    mu_max: float | None = None,
    slack: float = 0.0,
    scale: FloatArray | None = None,
) -> LmiSolution:
    """Find the gains with the smallest mu under one P for all sampling times.

        samplings  the plant at each of K sampling times
        h          H (k, n), the output whose error mu bounds
        alphas     (K,), each in (0, 1)
        channels   widths of the blocks of w that are bounded separately; None: one block
        mu_max     find any solution with mu at this limit, as the paper does; which one depends on
                   the solver
        slack      margin required of every decay LMI
        scale      (n,), typical sizes of the states, tried first

    Raises ``UserError`` for an alpha outside (0, 1), ``ValueError`` for widths that do not match,
    and ``LmiError`` if, in every scaling tried, the solver fails or its answer fails the eigenvalue
    check.
    """
    for alpha in alphas:
        if not 0.0 < alpha < 1.0:
            raise UserError(f"alpha is {alpha}, allowed: 0 to 1, both excluded")
    widths = [samplings[0].b.shape[1]] if channels is None else list(channels)
    if sum(widths) != samplings[0].b.shape[1] or min(widths) < 1 or len(alphas) != len(samplings):
        raise ValueError("channels must cover the columns of B, and each sampling needs an alpha")
    failure = LmiError("the solver has no scaling to try")
    for states, reports in _scalings(samplings, scale):
        try:
            found = _solve_scaled(
                samplings,
                h,
                alphas,
                widths=widths,
                mu_max=mu_max,
                slack=slack,
                states=states,
                reports=reports,
            )
        except LmiError as error:
            failure = error
            continue
        if mu_max is None and found.mu < NEARLY_ZERO * float(np.max(np.abs(h) @ states)) ** 2:
            return _with_attainment(
                found, samplings, h, alphas=alphas, widths=widths, states=states, reports=reports
            )
        return found
    raise failure


def _scalings(
    samplings: Sequence[Sampling], scale: FloatArray | None
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield sizes of states (n,) and reports (r,) to try: as given, from the inputs, and ones."""
    inputs = np.max([np.linalg.norm(s.b, axis=1) for s in samplings], axis=0)
    noises = np.max([np.linalg.norm(s.d, axis=1) for s in samplings], axis=0)
    seen = np.max([np.abs(s.c) for s in samplings], axis=0)
    entering = np.maximum(inputs, np.linalg.pinv(seen) @ noises)
    entering = np.where(entering > 0, entering, np.max(entering, initial=0.0) or 1.0)
    n, r = samplings[0].a.shape[0], samplings[0].c.shape[0]
    for states in ([] if scale is None else [scale]) + [entering]:
        reports = seen @ states
        yield states, np.where(reports > 0, reports, 1.0)
    yield np.ones(n), np.ones(r)
    yield entering / 30, np.where(seen @ entering > 0, seen @ entering, 1.0) / 30


def _solve_scaled(
    samplings: Sequence[Sampling],
    h: FloatArray,
    alphas: Sequence[float],
    *,
    widths: Sequence[int],
    mu_max: float | None,
    slack: float,
    states: FloatArray,
    reports: FloatArray,
) -> LmiSolution:
    """Solve with scaled states and reports, and certify in the original units."""
    unit = float(np.max(np.abs(h) @ states)) or 1.0
    scaled = [
        Sampling(
            a=s.a * states / states[:, None],
            b=s.b / states[:, None],
            c=s.c * states / reports[:, None],
            d=s.d / reports[:, None],
        )
        for s in samplings
    ]
    top = None if mu_max is None else mu_max / unit**2
    p, zs, multipliers = _solve_sdp(
        scaled, h * states / unit, alphas, widths=widths, mu_max=top, slack=slack
    )
    gains = [np.linalg.solve(p, z) * states[:, None] / reports for z in zs]
    p = p / np.outer(states, states)
    mu = float(np.linalg.eigvalsh(h @ np.linalg.solve(p, h.T))[-1])  # the exact value for this P
    return _certified(
        p, gains, mu, samplings=samplings, h=h, multipliers=multipliers, widths=widths
    )


def _solve_sdp(
    samplings: Sequence[Sampling],
    h: FloatArray,
    alphas: Sequence[float],
    *,
    widths: Sequence[int],
    mu_max: float | None,
    slack: float,
) -> tuple[FloatArray, list[FloatArray], FloatArray]:
    """Return P, each Z and the multipliers (K, channels) that the solver found."""
    n, k = samplings[0].a.shape[0], h.shape[0]
    p = cp.Variable((n, n), symmetric=True)
    mu = cp.Variable(nonneg=True)
    zs = [cp.Variable((n, s.c.shape[0])) for s in samplings]
    shares = cp.Variable((len(samplings), len(widths)), nonneg=True)
    constraints = [_symmetric(cp.bmat([[p, h.T], [h, mu * np.eye(k)]])) >> 0]
    constraints.append(cp.sum(shares, axis=1) == np.array(alphas))
    for i, (s, z, alpha) in enumerate(zip(samplings, zs, alphas, strict=True)):
        left, right = p @ s.a - z @ s.c, z @ s.d - p @ s.b
        columns = [shares[i, j] for j, width in enumerate(widths) for _ in range(width)]
        zero = np.zeros((n, sum(widths)))
        decay = cp.bmat(
            [
                [(1 - alpha - slack) * p, zero, left.T],
                [zero.T, cp.diag(cp.hstack(columns)) - slack * np.eye(sum(widths)), right.T],
                [left, right, (1 - slack) * p],
            ]
        )
        constraints.append(_symmetric(decay) >> 0)
    if mu_max is not None:
        constraints.append(mu == mu_max)
    problem = cp.Problem(cp.Minimize(mu if mu_max is None else 0), constraints)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the certificate detects an inaccurate answer
            problem.solve(solver=cp.CLARABEL)
    except cp.SolverError as failure:
        raise LmiError(f"the solver failed: {failure}") from failure
    answered = problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
    if not answered or p.value is None or shares.value is None:
        raise LmiError(f"the solver found no solution: {problem.status}")
    multipliers = np.maximum(shares.value, 0.0)
    multipliers *= (np.array(alphas) / multipliers.sum(axis=1))[:, None]
    return p.value, [z.value for z in zs], multipliers


def _with_attainment(
    found: LmiSolution,
    samplings: Sequence[Sampling],
    h: FloatArray,
    *,
    alphas: Sequence[float],
    widths: Sequence[int],
    states: FloatArray,
    reports: FloatArray,
) -> LmiSolution:
    """Mark a small mu as not attained if a hundredth of that mu is feasible as well."""
    try:
        _solve_scaled(
            samplings,
            h,
            alphas,
            widths=widths,
            mu_max=found.mu / 100,
            slack=0.0,
            states=states,
            reports=reports,
        )
    except LmiError:
        return found
    return replace(found, attained=False)


def _symmetric(matrix: cp.Expression) -> cp.Expression:
    return (matrix + matrix.T) / 2


def _certified(
    p: FloatArray,
    gains: Sequence[FloatArray],
    mu: float,
    *,
    samplings: Sequence[Sampling],
    h: FloatArray,
    multipliers: FloatArray,
    widths: Sequence[int],
) -> LmiSolution:
    """Check the solver's answer by eigenvalues in numpy alone."""
    try:
        margin = min(
            lmi_margin(
                p,
                gain=gain,
                mu=mu,
                plant=(s.a, s.b, s.c, s.d, h),
                alpha=sum(shares),
                shares=np.repeat(shares, widths),
            )
            for gain, s, shares in zip(gains, samplings, multipliers, strict=True)
        )
    except np.linalg.LinAlgError as error:
        raise LmiError("the solver's answer fails its certificate: P is not positive") from error
    if not margin >= -TOLERANCE:
        raise LmiError(f"the solver's answer fails its certificate: margin {margin:.2e}")
    return LmiSolution(
        gains=tuple(gains),
        lyapunov=p,
        mu=mu,
        alphas=multipliers.sum(axis=1),
        multipliers=multipliers,
        margin=margin,
    )


def lmi_margin(
    p: FloatArray,
    *,
    gain: FloatArray,
    mu: float,
    plant: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray],
    alpha: float,
    shares: FloatArray | None = None,
) -> float:
    """Return the smallest eigenvalue of both LMIs at (P, L, mu), scaled so that P is I.

    ``plant`` is A, B, C, D, H; ``shares`` (m,) is the multiplier for each column of B, or None for
    one channel with alpha for all columns.
    """
    a, b, c, d, h = plant
    scale = np.linalg.cholesky(p).T  # P = scale^T scale; e in the scaled frame is scale e
    left = scale @ np.linalg.solve(scale.T, (a - gain @ c).T).T
    right = scale @ (gain @ d - b)
    n, m = right.shape
    weights = np.full(m, alpha) if shares is None else shares
    decay = np.block(
        [
            [(1 - alpha) * np.eye(n), np.zeros((n, m)), left.T],
            [np.zeros((m, n)), np.diag(weights), right.T],
            [left, right, np.eye(n)],
        ]
    )
    scaled_h = np.linalg.solve(scale.T, h.T).T
    k = h.shape[0]
    output = np.block([[np.eye(n), scaled_h.T], [scaled_h, mu * np.eye(k)]])
    return float(min(np.linalg.eigvalsh(decay)[0], np.linalg.eigvalsh(output)[0]))
