"""Answers of ``companion design``: rows by closed form or by LMI, and tables of gains.

Over 300 lines: the two models' answers have the same keys and are computed side by side.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from companion.tracking.design import closed_form, gain_table
from companion.tracking.design.gain_table import KinematicDesign
from companion.values import FloatArray, UserError

if TYPE_CHECKING:
    from companion.tracking.design.lmi import LmiSolution, Sampling

POSITION: Final = np.array([[1.0, 0.0]])
"""Output matrix H of the kinematic model, by which mu bounds the position error."""

FASTEST_SHARE: Final = 0.98
"""Largest alpha of a table; at alpha = 1 no error would persist from step to step."""


@dataclass(frozen=True, slots=True)
class KinematicLimits:
    """Bounds assumed by the kinematic model.

    ``velocity_noise_mps`` is None if no velocity is reported. Raises ``UserError`` unless all are
    positive and finite.
    """

    acceleration_mps2: float
    position_noise_m: float
    velocity_noise_mps: float | None

    def __post_init__(self) -> None:
        given = (self.acceleration_mps2, self.position_noise_m, self.velocity_noise_mps or 1.0)
        if not all(0 < value < np.inf for value in given):
            raise UserError("bounds on acceleration and noise: give positive numbers")


def row(
    dt_s: float,
    *,
    feedthrough_s: float,
    alpha: float | None,
    mu_max: float | None,
    model: str,
    method: str,
) -> dict[str, Any]:
    """Return the position model's design for one interval, as in ``companion design --json``.

        dt_s           interval between reports, seconds
        feedthrough_s  time by which a report leads the position, seconds
        alpha          decay in (0, 1); None: the best
        mu_max         limit on mu, s²; None: no limit
        method         "closed" or "lmi"

    Raises ``UserError`` for an interval or alpha out of range, ``LmiError`` if the solver fails.
    """
    found = closed_form.design(dt_s, feedthrough_s, alpha)
    values = {
        "L": found.l_gain,
        "Q": found.q,
        "mu": found.mu,
        "gamma": found.gamma,
        "peak_gain": found.peak_gain,
        "residual": found.residual,
    }
    if method == "lmi":
        values = _by_lmi(dt_s, feedthrough_s, found.alpha)
    return {
        "dt_s": dt_s,
        "model": model,
        "alpha": found.alpha,
        "feedthrough_s": feedthrough_s,
        **values,
        "feasible": mu_max is None or values["mu"] <= mu_max * (1 + 1e-9),
        "dt_limit_s": None
        if mu_max is None
        else closed_form.dt_limit_s(mu_max, feedthrough_s, found.alpha),
        "method": method,
    }


def _by_lmi(dt_s: float, feedthrough_s: float, alpha: float) -> dict[str, float]:
    """Solve the design of one axis by CVXPY and Clarabel, which only this function loads."""
    from companion.tracking.design import lmi

    one = np.eye(1)
    solved = lmi.solve(one, b=dt_s * one, c=one, d=feedthrough_s * one, h=one, alpha=alpha)
    gain = float(solved.gain[0, 0])
    return {
        "L": gain,
        "Q": 1 - gain,
        "mu": solved.mu,
        "gamma": float(np.sqrt(solved.mu)),
        "peak_gain": float(closed_form.peak_gain(dt_s, feedthrough_s, gain)),
        "residual": solved.margin,
    }


def as_text(row: dict[str, Any]) -> str:
    """Format one row of a design as text."""
    kinematic_model = row["model"] == "kinematic"
    unit = "m" if kinematic_model else "s"
    limit = "" if row["dt_limit_s"] is None else f"  dt limit {row['dt_limit_s']:.4f} s"
    return (
        f"dt {row['dt_s']:g} s  alpha {row['alpha']:g}  L {_numbers(row['L'])}"
        f"  Q {_numbers(row['Q'])}  mu {row['mu']:.4g} {unit}²  gamma {row['gamma']:.4g} {unit}"
        f"  peak gain {row['peak_gain']:.4g} {unit}"
        f"  {'feasible' if row['feasible'] else 'NOT feasible'}{limit}"
    )


def _numbers(value: float | list[list[float]]) -> str:
    if isinstance(value, float):
        return f"{value:.4f}"
    return "[" + "; ".join(" ".join(f"{x:.4f}" for x in line) for line in value) + "]"


# --- the kinematic model ------------------------------------------------------------------------


def kinematic_row(
    dt_s: float,
    motion: KinematicLimits,
    alpha: float | None = None,
    mu_max: float | None = None,
    dt_limit_s: float | None = None,
) -> dict[str, Any]:
    """Return the kinematic model's design for one interval alone.

    The result has the keys of ``row``, with L and Q nested. ``mu`` is in m². ``gamma`` is the
    certified and ``peak_gain`` the exact largest position error, in metres, under the bounds of
    ``motion`` (docs/math.md 4). Raises ``UserError`` for an interval or alpha out of range,
    ``LmiError`` if the solver fails.
    """
    if not 0 < dt_s < np.inf:
        raise UserError("interval between reports: give a positive number of seconds")
    solved = _optimum(dt_s, motion, alpha)
    seen = np.eye(2)[: solved.gain.shape[1]]
    return {
        "dt_s": dt_s,
        "model": "kinematic",
        "alpha": float(solved.alphas[0]),
        "feedthrough_s": 0.0,
        "L": solved.gain.tolist(),
        "Q": (gain_table.transition(dt_s) - solved.gain @ seen).tolist(),
        "mu": solved.mu,
        "gamma": float(np.sqrt(solved.mu)),
        "peak_gain": peak_error_m(dt_s, solved.gain, motion),
        "residual": solved.margin,
        "feasible": mu_max is None or solved.mu <= mu_max * (1 + 1e-9),
        "dt_limit_s": dt_limit_s,
        "method": "lmi",
    }


def kinematic_rows(
    dts_s: Sequence[float], motion: KinematicLimits, alpha: float | None, mu_max: float | None
) -> list[dict[str, Any]]:
    """Return ``kinematic_row`` at each interval; shared values are computed once."""
    limit_s = _dt_limit_s(mu_max, motion, alpha) if dts_s and mu_max is not None else None
    return [kinematic_row(dt_s, motion, alpha, mu_max, limit_s) for dt_s in dts_s]


def peak_error_m(dt_s: float, gain: FloatArray, motion: KinematicLimits) -> float:
    """Return the largest position error in the long run at one interval and gain, m, one axis.

    This is the l-infinity gain: the sum over k of the largest |h (A - L C)^k (L n - g)|, where the
    acceleration may change within each interval. Infinite if the gain does not contract.
    """
    noises = np.array([motion.position_noise_m, motion.velocity_noise_mps or 0.0])
    noises = noises[: gain.shape[1]]
    closed = gain_table.transition(dt_s) - gain @ np.eye(2)[: gain.shape[1]]
    if not np.max(np.abs(np.linalg.eigvals(closed))) < 1 - 1e-9:
        return float("inf")
    at, total = POSITION[0], 0.0
    while True:
        swept = motion.acceleration_mps2 * _absolute_integral(at[0], at[1], dt_s)
        step = swept + float(np.abs(at @ gain) @ noises)
        total += step
        at = at @ closed
        if float(np.abs(at).sum()) * (1 + dt_s) < 1e-12:
            return total


def _absolute_integral(slope: float, start: float, dt_s: float) -> float:
    """Return the integral of |slope u + start| over u from 0 to T."""
    end = start + slope * dt_s
    if start * end >= 0:
        return float(abs(start + end) * dt_s / 2)
    return float((start * start + end * end) / (2 * abs(slope)))


def _sampling(dt_s: float, motion: KinematicLimits) -> "tuple[Sampling, tuple[int, ...]]":
    from companion.tracking.design.lmi import Sampling

    b, d, channels = gain_table.inputs(
        dt_s, motion.acceleration_mps2, motion.position_noise_m, motion.velocity_noise_mps
    )
    return Sampling(a=gain_table.transition(dt_s), b=b, c=np.eye(2)[: len(d)], d=d), channels


def _optimum(dt_s: float, motion: KinematicLimits, alpha: float | None) -> "LmiSolution":
    """Solve the LMI at one interval; ``alpha=None``: use the best alpha of a grid, refined once."""
    from companion.tracking.design import lmi

    sampling, channels = _sampling(dt_s, motion)

    def at(share: float) -> "LmiSolution":
        return lmi.solve_common([sampling], POSITION, [share], channels=channels)

    if alpha is not None:
        return at(alpha)
    coarse = [*np.arange(0.1, 0.95, 0.1).tolist(), closed_form.FASTEST_DECAY]
    best = _least(at, coarse)
    middle = float(best.alphas[0])
    near = [
        x
        for x in middle + np.array([-0.06, -0.03, 0.03, 0.06])
        if 0 < x < closed_form.FASTEST_DECAY
    ]
    return min(best, _least(at, near), key=lambda solved: solved.mu)


def _least(at: "Callable[[float], LmiSolution]", tried: Sequence[float]) -> "LmiSolution":
    """Return the solution with the smallest mu. If all attempts fail, raise the last failure."""
    from companion.tracking.design.lmi import LmiError

    found, failure = [], LmiError("the search for alpha has no candidate")
    for value in tried:
        try:
            found.append(at(value))
        except LmiError as error:
            failure = error
    if not found:
        raise failure
    return min(found, key=lambda solved: solved.mu)


def _dt_limit_s(mu_max: float, motion: KinematicLimits, alpha: float | None) -> float:
    """Return the largest interval with mu within the limit, to 0.1 %; 0 without such an interval.

    By bisection: mu grows with the interval, from the noise alone to about (a T^2 / sqrt 3)^2.
    """
    top = float(np.sqrt(2 * np.sqrt(mu_max) / motion.acceleration_mps2)) * 1.5 + 1e-9
    low, high = 1e-3 * top, top
    if _optimum(low, motion, alpha).mu > mu_max:
        return 0.0
    while high > low * 1.001:
        middle = float(np.sqrt(low * high))
        if _optimum(middle, motion, alpha).mu <= mu_max:
            low = middle
        else:
            high = middle
    return low


def table(
    dt_range_s: Sequence[float], motion: KinematicLimits, points: int = 24, slack: float = 1e-4
) -> KinematicDesign:
    """Compute gains over a range of intervals under one P; verify them between grid points too.

        dt_range_s  shortest and longest interval, seconds
        motion      bounds on acceleration and noise
        points      number of intervals in the grid, spaced geometrically
        slack       margin required of the LMIs, for intervals between the points

    The decay is alpha(T) = 1 - exp(-T/tau), so that the error decays in proportion to the interval.
    A single alpha would demand from the shortest interval what only the longest can achieve, and
    make the bound up to twice as large. tau is searched: among those within 1 % of the smallest
    bound the shortest is taken, which decays fastest. See docs/math.md 4.

    Raises ``UserError`` for an impossible range, ``LmiError`` if no tau is solved, ``DesignError``
    if the result does not hold between the points.
    """
    match dt_range_s:
        case [low_s, high_s] if 0 < low_s < high_s < np.inf:
            pass
        case _:
            raise UserError("range of intervals: give LOW,HIGH, positive and ascending, in seconds")
    from companion.tracking.design import lmi

    dt_s = np.geomspace(low_s, high_s, points)
    pairs = [_sampling(x, motion) for x in dt_s.tolist()]
    samplings, channels = [pair[0] for pair in pairs], pairs[0][1]

    def at(tau_s: float) -> "LmiSolution":
        alphas = np.minimum(FASTEST_SHARE, -np.expm1(-dt_s / tau_s))
        return lmi.solve_common(
            samplings, POSITION, alphas.tolist(), channels=channels, slack=slack
        )

    taus = (np.geomspace(0.02, 10.0, 14) * dt_s[-1]).tolist()
    best = _least(at, taus)
    for tau_s in taus:
        try:
            solved = at(tau_s)
        except lmi.LmiError:
            continue
        if solved.mu <= 1.01**2 * best.mu:
            return _as_table(dt_s, solved, motion, tau_s)
    raise lmi.LmiError("the solver did not repeat its own solution")


def _as_table(
    dt_s: FloatArray, solved: "LmiSolution", motion: KinematicLimits, tau_s: float
) -> KinematicDesign:
    gains = zip(dt_s.tolist(), solved.gains, strict=True)
    p = solved.lyapunov
    found = KinematicDesign(
        acceleration_mps2=motion.acceleration_mps2,
        position_noise_m=motion.position_noise_m,
        velocity_noise_mps=motion.velocity_noise_mps,
        dt_s=tuple(dt_s.tolist()),
        corrections=tuple(
            tuple((gain_table.transition(-t) @ gain).ravel().tolist()) for t, gain in gains
        ),
        lyapunov=(float(p[0, 0]), float(p[0, 1]), float(p[1, 1])),
        multipliers=tuple(tuple(shares) for shares in solved.multipliers.tolist()),
        margin=0.0,
        provenance=f"companion design --model kinematic {_flags(motion)}"
        f" --dt-range {dt_s[0]:g},{dt_s[-1]:g} --out FILE; tau {tau_s:.3g} s; "
        + ", ".join(f"{name} {version(name)}" for name in ("cvxpy", "clarabel", "numpy")),
    )
    return replace(found, margin=gain_table.verify(found))


def _flags(motion: KinematicLimits) -> str:
    noise = motion.velocity_noise_mps
    last = "--no-velocity" if noise is None else f"--velocity-noise {noise:g}"
    first = f"--acceleration {motion.acceleration_mps2:g}"
    return f"{first} --position-noise {motion.position_noise_m:g} {last}"


def described(found: KinematicDesign) -> str:
    """Return one line of text about a gain table."""
    return (
        f"{len(found.dt_s)} intervals from {found.dt_s[0]:g} to {found.dt_s[-1]:g} s, position"
        f" within {gain_table.invariant_bound(found):.3g} m, margin {found.margin:.1e}"
    )
