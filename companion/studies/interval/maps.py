"""Required report rate: feasible intervals, gamma and peak gain over alpha and feedthrough.

All values follow from the closed forms of ``tracking.design.closed_form`` (docs/math.md 2.2 and
2.6). A bound of gamma seconds is gamma metres of error per m/s of unknown input, which here is
speed that the reports do not predict.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from companion.studies.figures import plotting
from companion.studies.figures.text_tables import text_table
from companion.studies.origin import Progress, command_line, versions
from companion.tracking.design import closed_form
from companion.values import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MUS_S2: Final = (0.05, 0.25, 1.0)
ALPHAS: Final = (0.1, 0.5, 0.9)
ERRORS_M: Final = (1.0, 5.0, 20.0)
SPEEDS_MPS: Final = (5.0, 20.0, 60.0)
FEEDTHROUGHS_S: Final = (-0.2, 0.0, 0.2, 0.5)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Maps:
    """Maps of the interval study: gains and errors over alpha and feedthrough."""

    alpha: FloatArray  # (A,), decay axis
    feedthrough_s: FloatArray  # (D,), feedthrough axis
    dt_s: FloatArray  # (T,), interval axis
    limit_s: dict[float, FloatArray]  # by mu: largest feasible interval, (D, A)
    gamma_s: dict[float, FloatArray]  # by alpha: gamma of the optimal gain, (D, T)
    peak_gain_s: dict[float, FloatArray]  # by alpha: peak gain of the optimal gain, (D, T)


def maps() -> Maps:
    """Compute the maps, from a lag of half a second to a lead of one second."""
    alpha = np.linspace(0.02, 0.98, 49)
    feedthrough_s = np.linspace(-0.5, 1.0, 61)
    dt_s = np.linspace(0.025, 2.0, 80)
    limit_s = {
        mu: np.array([[closed_form.dt_limit_s(mu, d, a) for a in alpha] for d in feedthrough_s])
        for mu in MUS_S2
    }
    gamma_s, peak_s = {}, {}
    for a in ALPHAS:
        gamma_s[a] = np.array([np.sqrt(closed_form.mu_stars(dt_s, d, a)) for d in feedthrough_s])
        gains = [closed_form.gains(dt_s, d, a) for d in feedthrough_s]
        peak_s[a] = np.array(
            [closed_form.peak_gain(dt_s, d, g) for d, g in zip(feedthrough_s, gains, strict=True)]
        )
    axes = {"alpha": alpha, "feedthrough_s": feedthrough_s, "dt_s": dt_s}
    return Maps(**axes, limit_s=limit_s, gamma_s=gamma_s, peak_gain_s=peak_s)


def study(progress: Progress) -> tuple[dict[str, Any], Maps]:
    """Return the answer of ``companion study dt`` as JSON, and its maps."""
    progress("maps")
    found = maps()
    answer = {
        "command": command_line("dt"),
        "versions": versions(),
        "alpha": found.alpha.tolist(),
        "feedthrough_s": found.feedthrough_s.tolist(),
        "dt_s": found.dt_s.tolist(),
        "limit_s": {f"{mu:g}": rows.tolist() for mu, rows in found.limit_s.items()},
        "gamma_s": {f"{a:g}": rows.tolist() for a, rows in found.gamma_s.items()},
        "peak_gain_s": {f"{a:g}": rows.tolist() for a, rows in found.peak_gain_s.items()},
        "rates": rates(),
    }
    return answer, found


def rates() -> list[dict[str, float]]:
    """Return the longest intervals by error, speed and feedthrough, at the best alpha.

    If alpha is free, the largest interval is the larger of 2 d, below which the input can be
    cancelled, and d + error / speed, which alpha near 1 approaches without cancellation.
    """
    found = []
    for error_m in ERRORS_M:
        for speed_mps in SPEEDS_MPS:
            for d in FEEDTHROUGHS_S:
                mu = (error_m / speed_mps) ** 2
                alphas = np.linspace(0.01, closed_form.FASTEST_DECAY, 99)
                limits = [round(closed_form.dt_limit_s(mu, d, float(a)), 9) for a in alphas]
                best = int(np.argmax(limits))
                found.append(
                    {
                        "error_m": error_m,
                        "speed_mps": speed_mps,
                        "feedthrough_s": d,
                        "dt_max_s": limits[best],
                        "alpha": float(alphas[best]),
                    }
                )
    return found


# --- figures and page ---------------------------------------------------------------------------


def files(answer: dict[str, Any], found: Maps, progress: Progress) -> dict[str, bytes]:
    """Return the page ``dt.html`` and its figures, by file name."""
    drawings = {
        "dt_limit": (
            "Largest feasible interval between reports over the decay α and the feedthrough δ"
            " (a lead above 0, a lag below).",
            lambda: _limit_maps(found),
        ),
        "dt_gamma": (
            "Least γ over the interval and the feedthrough. It is 0 in the hatched region, where"
            " the unknown input is cancelled.",
            lambda: _gain_maps(found, found.gamma_s, "γ, s"),
        ),
        "dt_peak": (
            "Exact peak gain of the same optimal gains: the worst error per m/s.",
            lambda: _gain_maps(found, found.peak_gain_s, "peak gain, s"),
        ),
    }
    values = {
        "answer": answer,
        "feedthroughs": [f"δ = {d:g} s" for d in FEEDTHROUGHS_S],
        "rows": _rates(answer),
    }
    return plotting.files("dt", "interval/maps.html.j2", drawings, values, progress)


def _limit_maps(found: Maps) -> "Figure":
    figure, panels = plotting.new(1, 3, (9.6, 3.5), sharey=True)
    levels = np.linspace(0.0, 2.25, 10)
    for axes, mu in zip(panels, MUS_S2, strict=True):
        drawn = _map(axes, found.alpha, found.feedthrough_s, found.limit_s[mu], levels)
        axes.set_xlabel("decay α")
    panels[0].set_ylabel("feedthrough δ, s")
    plotting.title_panels(panels, [f"μ ≤ {mu:g} s²" for mu in MUS_S2])
    figure.colorbar(drawn, ax=panels, label="largest ΔT, s", shrink=0.95)
    return figure


def _gain_maps(found: Maps, values: dict[float, FloatArray], label: str) -> "Figure":
    figure, panels = plotting.new(1, 3, (9.6, 3.5), sharey=True)
    levels = np.linspace(0.0, 2.5, 11)
    for axes, alpha in zip(panels, ALPHAS, strict=True):
        drawn = _map(axes, found.dt_s, found.feedthrough_s, values[alpha], levels)
        none = (values[alpha] < 1e-9).astype(float)
        axes.contourf(
            found.dt_s, found.feedthrough_s, none, levels=[0.5, 1.5], colors="none",
            hatches=["////"],
        )  # fmt: skip
        axes.set_xlabel("interval ΔT, s")
    panels[0].set_ylabel("feedthrough δ, s")
    plotting.title_panels(panels, [f"α = {alpha:g}" for alpha in ALPHAS])
    figure.colorbar(drawn, ax=panels, label=label, shrink=0.95)
    return figure


def _map(axes: "Axes", x: FloatArray, y: FloatArray, values: FloatArray, levels: FloatArray) -> Any:
    drawn = axes.contourf(x, y, values, levels=levels, cmap=plotting.MAP, extend="max")
    lines = axes.contour(x, y, values, levels=levels[1::2], colors="#ffffff", linewidths=0.8)
    axes.clabel(lines, fmt="%.2f", fontsize=7.5)
    axes.grid(visible=False)
    return drawn


def _rates(answer: dict[str, Any]) -> list[tuple[str, ...]]:
    by_case: dict[tuple[float, float], list[float]] = {}
    for row in answer["rates"]:
        by_case.setdefault((row["error_m"], row["speed_mps"]), []).append(row["dt_max_s"])
    return [
        (f"{error:g}", f"{speed:g}", *("none" if s <= 0 else f"{1 / s:.2f}" for s in limits))
        for (error, speed), limits in by_case.items()
    ]


def text(answer: dict[str, Any]) -> str:
    """Return the longest intervals as a table for a terminal."""
    rows = [["error m", "speed m/s", "feedthrough s", "longest interval s", "at alpha"]]
    for one in answer["rates"]:
        longest = f"{one['dt_max_s']:.3f}" if one["dt_max_s"] > 0 else "none"
        given = (f"{one[key]:g}" for key in ("error_m", "speed_mps", "feedthrough_s"))
        rows.append([*given, longest, f"{one['alpha']:g}"])
    return text_table(rows)
