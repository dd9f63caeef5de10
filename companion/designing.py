"""``companion design``: rows of the answer by closed form or by LMI, and tables of gains."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from companion.tracking import design, kinematic
from companion.tracking.kinematic import KinematicDesign
from companion.values import FloatArray

if TYPE_CHECKING:
    from companion.tracking.lmi import LmiSolution, Sampling

POSITION: Final = np.array([[1.0, 0.0]])
"""H of the kinematic model: what mu bounds is the position."""

FASTEST_SHARE: Final = 0.98
"""alpha of a table stays at or below this: a P for alpha = 1 does not let anything persist."""


@dataclass(frozen=True, slots=True)
class Motion:
    """What the kinematic model takes for granted; ``velocity_noise_mps=None``: not reported."""

    acceleration_mps2: float
    position_noise_m: float
    velocity_noise_mps: float | None

    def __post_init__(self) -> None:
        given = (self.acceleration_mps2, self.position_noise_m, self.velocity_noise_mps or 1.0)
        if not all(0 < value < np.inf for value in given):
            raise ValueError("bounds on acceleration and noise are positive numbers")


def row(
    dt_s: float,
    feedthrough_s: float,
    alpha: float | None,
    mu_max: float | None,
    model: str,
    method: str,
) -> dict[str, Any]:
    """The position model's design for one interval, with the keys of ``companion design --json``.

    ``ValueError`` for an interval or alpha out of range; ``LmiError`` if the solver fails.
    """
    found = design.design(dt_s, feedthrough_s, alpha)
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
        else design.dt_limit_s(mu_max, feedthrough_s, found.alpha),
        "method": method,
    }


def _by_lmi(dt_s: float, feedthrough_s: float, alpha: float) -> dict[str, float]:
    """The same axis by CVXPY and Clarabel, which only this loads."""
    from companion.tracking import lmi

    one = np.eye(1)
    solved = lmi.solve(one, dt_s * one, one, feedthrough_s * one, one, alpha)
    gain = float(solved.gain[0, 0])
    return {
        "L": gain,
        "Q": 1 - gain,
        "mu": solved.mu,
        "gamma": float(np.sqrt(solved.mu)),
        "peak_gain": float(design.peak_gain(dt_s, feedthrough_s, gain)),
        "residual": solved.margin,
    }


def as_text(row: dict[str, Any]) -> str:
    """One row for a reader."""
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
    motion: Motion,
    alpha: float | None = None,
    mu_max: float | None = None,
    dt_limit_s: float | None = None,
) -> dict[str, Any]:
    """The kinematic model's design for one interval alone: the keys of ``row``, L and Q nested.

    ``mu`` is in m^2, ``gamma`` the certified and ``peak_gain`` the exact largest position error
    in metres under the bounds of ``motion``. ``ValueError`` and ``LmiError`` as for ``row``.
    """
    if not 0 < dt_s < np.inf:
        raise ValueError("an interval between reports is a positive number of seconds")
    solved = _optimum(dt_s, motion, alpha)
    seen = np.eye(2)[: solved.gain.shape[1]]
    return {
        "dt_s": dt_s,
        "model": "kinematic",
        "alpha": float(solved.alphas[0]),
        "feedthrough_s": 0.0,
        "L": solved.gain.tolist(),
        "Q": (kinematic.transition(dt_s) - solved.gain @ seen).tolist(),
        "mu": solved.mu,
        "gamma": float(np.sqrt(solved.mu)),
        "peak_gain": peak_error_m(dt_s, solved.gain, motion),
        "residual": solved.margin,
        "feasible": mu_max is None or solved.mu <= mu_max * (1 + 1e-9),
        "dt_limit_s": dt_limit_s,
        "method": "lmi",
    }


def kinematic_rows(
    dts_s: Sequence[float], motion: Motion, alpha: float | None, mu_max: float | None
) -> list[dict[str, Any]]:
    """``kinematic_row`` at each interval; what does not depend on it is found once."""
    limit_s = _dt_limit_s(mu_max, motion, alpha) if dts_s and mu_max is not None else None
    return [kinematic_row(dt_s, motion, alpha, mu_max, limit_s) for dt_s in dts_s]


def peak_error_m(dt_s: float, gain: FloatArray, motion: Motion) -> float:
    """The exact worst position error in the long run at one interval and gain, metres, one axis.

    The l-infinity gain: sum over k of |h (A - L C)^k (L n - g)| at its largest, the acceleration
    free to change within each interval. Infinite where the gain does not contract.
    """
    noises = np.array([motion.position_noise_m, motion.velocity_noise_mps or 0.0])
    noises = noises[: gain.shape[1]]
    closed = kinematic.transition(dt_s) - gain @ np.eye(2)[: gain.shape[1]]
    if not np.max(np.abs(np.linalg.eigvals(closed))) < 1 - 1e-9:
        return float("inf")
    at, total = POSITION[0], 0.0
    while True:
        swept = motion.acceleration_mps2 * _swept(at[0], at[1], dt_s)
        step = swept + float(np.abs(at @ gain) @ noises)
        total += step
        at = at @ closed
        if float(np.abs(at).sum()) * (1 + dt_s) < 1e-12:
            return total


def _swept(slope: float, start: float, dt_s: float) -> float:
    """int_0^T |slope u + start| du."""
    end = start + slope * dt_s
    if start * end >= 0:
        return float(abs(start + end) * dt_s / 2)
    return float((start * start + end * end) / (2 * abs(slope)))


def _sampling(dt_s: float, motion: Motion) -> "tuple[Sampling, tuple[int, ...]]":
    from companion.tracking.lmi import Sampling

    b, d, channels = kinematic.inputs(
        dt_s, motion.acceleration_mps2, motion.position_noise_m, motion.velocity_noise_mps
    )
    return Sampling(kinematic.transition(dt_s), b, np.eye(2)[: len(d)], d), channels


def _optimum(dt_s: float, motion: Motion, alpha: float | None) -> "LmiSolution":
    """The LMI's solution at one interval; ``alpha=None``: the best of a grid, refined."""
    from companion.tracking import lmi

    sampling, channels = _sampling(dt_s, motion)

    def at(share: float) -> "LmiSolution":
        return lmi.solve_common([sampling], POSITION, [share], channels=channels)

    if alpha is not None:
        return at(alpha)
    coarse = [*np.arange(0.1, 0.95, 0.1).tolist(), design.FASTEST_DECAY]
    best = _least(at, coarse)
    middle = float(best.alphas[0])
    near = [
        x for x in middle + np.array([-0.06, -0.03, 0.03, 0.06]) if 0 < x < design.FASTEST_DECAY
    ]
    return min(best, _least(at, near), key=lambda solved: solved.mu)


def _least(at: "Callable[[float], LmiSolution]", tried: Sequence[float]) -> "LmiSolution":
    """The solution with the smallest mu; the last failure where there is none."""
    from companion.tracking.lmi import LmiError

    found, failure = [], LmiError("nothing was tried")
    for value in tried:
        try:
            found.append(at(value))
        except LmiError as error:
            failure = error
    if not found:
        raise failure
    return min(found, key=lambda solved: solved.mu)


def _dt_limit_s(mu_max: float, motion: Motion, alpha: float | None) -> float:
    """The largest interval, to a part in a thousand, with mu below the limit; 0 if there is none.

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
    dt_range_s: Sequence[float], motion: Motion, points: int = 24, slack: float = 1e-4
) -> KinematicDesign:
    """Gains over a range of intervals under one P, verified between the grid's points as well.

    alpha(T) = 1 - exp(-T/tau): every interval gives up its share of the error in proportion to
    its length. One alpha for all would ask of the shortest what only the longest can do, and the
    bound be up to twice as large. tau is searched: among those within 1 % of the smallest bound
    the shortest, which forgets fastest. ``slack``: the margin asked of the LMIs, for what lies
    between the points. ``LmiError`` where none is solved, ``DesignError`` where the result does
    not hold there.
    """
    match dt_range_s:
        case [low_s, high_s] if 0 < low_s < high_s < np.inf:
            pass
        case _:
            raise ValueError("a range of intervals is LOW,HIGH: positive, ascending, in seconds")
    from companion.tracking import lmi

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
    dt_s: FloatArray, solved: "LmiSolution", motion: Motion, tau_s: float
) -> KinematicDesign:
    gains = zip(dt_s.tolist(), solved.gains, strict=True)
    p = solved.lyapunov
    found = KinematicDesign(
        motion.acceleration_mps2,
        motion.position_noise_m,
        motion.velocity_noise_mps,
        dt_s=tuple(dt_s.tolist()),
        corrections=tuple(
            tuple((kinematic.transition(-t) @ gain).ravel().tolist()) for t, gain in gains
        ),
        lyapunov=(float(p[0, 0]), float(p[0, 1]), float(p[1, 1])),
        multipliers=tuple(tuple(shares) for shares in solved.multipliers.tolist()),
        margin=0.0,
        provenance=f"companion design --model kinematic {_flags(motion)}"
        f" --dt-range {dt_s[0]:g},{dt_s[-1]:g} --out FILE; tau {tau_s:.3g} s; "
        + ", ".join(f"{name} {version(name)}" for name in ("cvxpy", "clarabel", "numpy")),
    )
    return replace(found, margin=kinematic.verify(found))


def _flags(motion: Motion) -> str:
    noise = motion.velocity_noise_mps
    last = "--no-velocity" if noise is None else f"--velocity-noise {noise:g}"
    first = f"--acceleration {motion.acceleration_mps2:g}"
    return f"{first} --position-noise {motion.position_noise_m:g} {last}"


def described(found: KinematicDesign) -> str:
    """One line about a table."""
    return (
        f"{len(found.dt_s)} intervals from {found.dt_s[0]:g} to {found.dt_s[-1]:g} s, position"
        f" within {kinematic.invariant_bound(found):.3g} m, margin {found.margin:.1e}"
    )


def quantify(
    found: KinematicDesign, dts_s: Sequence[float] = (0.1, 0.25, 1.0)
) -> list[dict[str, Any]]:
    """For documents: the bounds that a table gives at fixed intervals, in metres.

    ``running_m``: where the running bound settles; ``peak_m``: the exact worst; ``off_deadbeat``:
    the largest entry of M less that of the observer that forgets all, [1 0; 0 1] or [1; 1/T].
    """
    motion = Motion(found.acceleration_mps2, found.position_noise_m, found.velocity_noise_mps)
    rows = []
    for dt_s in dts_s:
        bound = kinematic.begin_bound(found, 60.0)
        for _ in range(1000):
            bound = kinematic.bound_step(found, bound, dt_s)
        m = kinematic.correction(found, dt_s)
        deadbeat = (1.0, 0.0, 0.0, 1.0) if found.has_velocity else (1.0, 1 / dt_s)
        gain = kinematic.gain(found, dt_s)
        rows.append(
            {
                "dt_s": dt_s,
                "L": gain.tolist(),
                "invariant_m": kinematic.invariant_bound(found),
                "running_m": bound.position_m,
                "peak_m": peak_error_m(dt_s, gain, motion),
                "off_deadbeat": max(abs(x - y) for x, y in zip(m, deadbeat, strict=True)),
            }
        )
    return rows
