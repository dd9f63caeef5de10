"""Figures of the published experiments: flight, observer, limits and rates."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from companion.studies.figures import plotting
from companion.studies.paper import circles, published
from companion.studies.paper.circles import Tracked
from companion.studies.paper.experiments import OPTIMUM, PAPER_LEVELS, Material, level_name
from companion.studies.paper.patterns import cuts, polar, surfaces
from companion.tracking.design import closed_form
from companion.values import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Answer = dict[str, Any]
LEVELS = tuple(level_name(gain) for _, gain in PAPER_LEVELS)
TITLES = tuple(f"{level_name(gain)}, μ ≤ {mu:g} s²" for mu, gain in PAPER_LEVELS)
FIGURE_SPAN_S = 13.0  # time span of figures: slightly over one turn


def drawings(answer: Answer, material: Material) -> dict[str, tuple[str, plotting.Draw]]:
    """Return caption and drawing of each figure of the paper by name, in the paper's order."""
    return {
        "paths": (
            "Paths of the four UAVs and positions predicted one report ahead, over one turn.",
            lambda: _paths(material),
        ),
        "coordinates": (
            "Coordinates of the outermost UAV and their predictions over time.",
            lambda: _coordinates(material),
        ),
        "errors": (
            "Norm of the error of all UAVs together, and its bounds. γ is the least of each gain;"
            " the exact peak is the smallest bound from sup‖W‖ alone; the running bound uses ‖W‖"
            " at each report.",
            lambda: _errors(answer, material),
        ),
        "unknown_input": (
            "North component of the unknown input of the innermost UAV, as published (G = [B; 0]),"
            " and the norm of the error over all UAVs.",
            lambda: _unknown_input(answer, material),
        ),
        "alphas": (
            "The same at α = 0.5, 0.1 and 0.01, with the solver's feasible gain for μ ≤ 0.25 s²."
            " The optimum is L = 0.30 at every α, without error.",
            lambda: _alphas(material),
        ),
        "limits": (
            "Least μ over the interval ΔT, α = δ = 0.5. It meets the bound at the largest feasible"
            " interval. Dots: first infeasible interval in the paper.",
            lambda: _limits(answer),
        ),
        "rates": (
            "Spectral efficiency, mean of the UAVs, 64 elements: over time, and by azimuth."
            " Common dips are mirror images, which a line array cannot separate.",
            lambda: _rates(material),
        ),
        "surfaces": (
            "Zero-forcing beam for UAV 1 at two instants: array gain over azimuth and elevation.",
            lambda: surfaces(material),
        ),
        "cuts": (
            "Azimuth and elevation cuts of the same beams; dotted: half power.",
            lambda: cuts(material),
        ),
        "polar": (
            "Polar patterns (dB) of the beams for UAVs 1 and 2; numbers mark the UAVs.",
            lambda: polar(material),
        ),
        "blockage": (
            "Mean spectral efficiency per UAV over the blockage rate, compared with echo probing."
            " Blockages last 0.5 s on average and are 25 dB deep.",
            lambda: _blockage(material),
        ),
    }


def _paths(material: Material) -> "Figure":
    figure, panels = plotting.new(1, 3, (9.6, 3.9), sharex=True, sharey=True)
    shown = material.flight.time_s <= FIGURE_SPAN_S
    true = material.flight.position_m[shown]
    for axes, name in zip(panels, LEVELS, strict=True):
        seen = material.tracked[name].estimate_m[shown]
        for uav in range(true.shape[1]):
            colour = plotting.COLOURS[uav]
            axes.plot(
                true[:, uav, 1], true[:, uav, 0], "-", color=colour, lw=1.2, label=f"UAV {uav + 1}"
            )
            axes.plot(seen[:, uav, 1], seen[:, uav, 0], ":", color=colour, lw=1.5)
        axes.plot([], [], ":", color=plotting.INK, label="predicted")
        axes.plot([0], [0], marker="^", ls="none", color=plotting.INK, ms=5, label="array")
        axes.set_aspect("equal")
        axes.set_xlabel("east, m")
    panels[0].set_ylabel("north, m")
    plotting.title_panels(panels, TITLES)
    plotting.below(figure, panels[0], 6)
    return figure


def _coordinates(material: Material) -> "Figure":
    figure, panels = plotting.new(2, 1, (7.2, 4.6), sharex=True)
    time_s = material.flight.time_s
    shown = time_s <= FIGURE_SPAN_S
    for axis, (axes, word) in enumerate(zip(panels, ("north", "east"), strict=True)):
        true = material.flight.position_m[shown, -1, axis]
        axes.plot(time_s[shown], true, color=plotting.INK, lw=2.0, label="actual")
        for number, name in enumerate(LEVELS):
            seen = material.tracked[name].estimate_m[shown, -1, axis]
            axes.plot(time_s[shown], seen, label=name, **plotting.line(number + 1))
        axes.set_ylabel(f"{word}, m")
    panels[1].set_xlabel("time, s")
    panels[1].set_xlim(0, FIGURE_SPAN_S)
    plotting.below(figure, panels[0], 4)
    return figure


def _errors(answer: Answer, material: Material) -> "Figure":
    figure, panels = plotting.new(1, 3, (9.6, 3.4), sharey=True)
    flight = material.flight
    for axes, name in zip(panels, LEVELS, strict=True):
        one, numbers = material.tracked[name], answer["levels"][name]
        error = circles.stacked(one.estimate_m - flight.position_m)
        running = circles.running_bounds(flight, one.gain)
        axes.axhline(numbers["gamma_bound_m"], label="γ sup‖W‖", **plotting.line(1))
        axes.axhline(numbers["peak_bound_m"], label="exact peak", **plotting.line(2))
        axes.plot(flight.time_s, running, label="running bound", **plotting.line(3))
        axes.plot(flight.time_s, error, label="error", **plotting.line(0))
        axes.set_xlabel("time, s")
        axes.set_xlim(0, flight.time_s[-1])
    panels[0].set_ylabel("norm of the error, m")
    panels[0].set_ylim(0, None)
    plotting.title_panels(panels, TITLES)
    plotting.below(figure, panels[0], 4)
    return figure


def _unknown_input(answer: Answer, material: Material) -> "Figure":
    columns = []
    for name in LEVELS:
        one, numbers = material.tracked[name], answer["unknown_input"][name]
        errors = {"[B; 0]": one.input_b0_mps, "[B; D]": one.input_bd_mps}
        bounds = {
            "exact peak, [B; 0]": numbers["b0_peak"],
            "published 3γ sup‖W‖": numbers["published_3_gamma"],
        }
        columns.append((one, errors, bounds))
    return _input_figure(material, 5.2, TITLES, columns)


def _alphas(material: Material) -> "Figure":
    scenario, titles, columns = material.flight.scenario, [], []
    for alpha, one in material.alphas.items():
        _, peak = published.unknown_input_peak(scenario.dt_s, scenario.feedthrough_s, one.gain)
        titles.append(f"α = {alpha:g}, L = {one.gain:.3f}")
        columns.append((one, {"[B; 0]": one.input_b0_mps}, {"exact peak, [B; 0]": peak}))
    return _input_figure(material, 5.0, titles, columns)


def _input_figure(
    material: Material,
    height_in: float,
    titles: Sequence[str],
    columns: Sequence[tuple[Tracked, dict[str, FloatArray], dict[str, float]]],
) -> "Figure":
    """Draw the unknown input of three observers, and the norm of its error below.

    ``columns`` holds the estimates whose errors are drawn, and bounds over sup‖W‖, by their labels.
    """
    figure, panels = plotting.new(2, 3, (9.6, height_in), sharex=True, sharey="row")
    flight = material.flight
    shown = flight.time_s[:-1] <= FIGURE_SPAN_S
    time_s = flight.time_s[:-1][shown]
    for above, under, (one, errors, bounds) in zip(panels[:3], panels[3:], columns, strict=True):
        above.plot(
            time_s, flight.input_mps[shown, 0, 0], color=plotting.INK, lw=1.8, label="W, actual"
        )
        above.plot(time_s, one.input_b0_mps[shown, 0, 0], label="Ŵ, G = [B; 0]", **plotting.line(1))
        for number, (label, estimate) in enumerate(errors.items()):
            miss = circles.stacked(estimate - flight.input_mps)[shown]
            under.plot(time_s, miss, label=f"error, {label}", **plotting.line(2 * number))
        for number, (label, bound) in enumerate(bounds.items(), 3):
            under.axhline(bound * flight.largest_input_mps, label=label, **plotting.line(number))
        under.set_xlabel("time, s")
        under.set_xlim(0, FIGURE_SPAN_S)
    panels[0].set_ylabel("north, UAV 1, m/s")
    panels[3].set_ylabel("norm of the error, m/s")
    panels[3].set_ylim(0, None)
    plotting.title_panels(panels[:3], titles)
    plotting.below(figure, panels[0], 4 if len(columns[0][1]) == 1 else 3, panels[3])
    return figure


def _limits(answer: Answer) -> "Figure":
    figure, (axes,) = plotting.new(1, 1, (6.4, 3.8))
    scenario = answer["scenario"]
    intervals = np.linspace(0.02, 1.45, 400)
    for number, alpha in enumerate((0.5, 0.1, 0.01)):
        mu = closed_form.mu_stars(intervals, scenario["feedthrough_s"], alpha)
        axes.plot(intervals, mu, label=f"least μ, α = {alpha:g}", **plotting.line(number))
    for mu_text, row in answer["limits"].items():
        bound = float(mu_text)
        axes.axhline(bound, color="#777777", lw=0.8)
        axes.annotate(
            f"μ ≤ {bound:g}: ΔT ≤ {row['limit_s']:.4f} s",
            (0.3, bound), xytext=(0, 3), textcoords="offset points", fontsize=8.5,
        )  # fmt: skip
        axes.plot(row["paper_s"], bound, "o", color=plotting.INK, ms=5)
    axes.set_xlim(0, 1.45)
    axes.set_ylim(0, 1.2)
    axes.set_xlabel("interval between reports ΔT, s")
    axes.set_ylabel("μ, s²")
    plotting.below(figure, axes, 3)
    return figure


def _rates(material: Material) -> "Figure":
    figure, panels = plotting.new(1, 2, (9.6, 3.6), sharey=True)
    time_s = material.flight.time_s
    shown = time_s <= FIGURE_SPAN_S
    place = material.flight.position_m
    azimuth_deg = np.degrees(np.arctan2(place[..., 1], place[..., 0]))
    edges = np.linspace(-180, 180, 37)
    names = (OPTIMUM, *LEVELS)
    for number, name in enumerate(names):
        found = material.efficiency[name]
        label = f"{name}, L = 0.30" if name == OPTIMUM else name
        panels[0].plot(
            time_s[shown], found[shown].mean(axis=1), label=label, **plotting.line(number)
        )
        panels[1].plot(
            (edges[1:] + edges[:-1]) / 2,
            _binned(azimuth_deg, found, edges),
            **plotting.line(number),
        )
    panels[0].set_xlabel("time, s")
    panels[0].set_xlim(0, FIGURE_SPAN_S)
    panels[0].set_ylabel("spectral efficiency, bit/s/Hz")
    panels[0].set_ylim(0, None)
    panels[1].set_xlabel("azimuth of the UAV, degrees (0: boresight)")
    panels[1].set_xlim(-180, 180)
    panels[1].set_xticks(np.arange(-180, 181, 60))
    plotting.title_panels(panels, ("mean of the UAVs over time", "mean over reports by azimuth"))
    plotting.below(figure, panels[0], 4)
    return figure


def _binned(azimuth_deg: FloatArray, values: FloatArray, edges: FloatArray) -> FloatArray:
    """Return means of values in bins of azimuth; NaN in an empty bin."""
    where = np.clip(np.digitize(azimuth_deg.ravel(), edges) - 1, 0, len(edges) - 2)
    counts = np.bincount(where, minlength=len(edges) - 1)
    sums = np.bincount(where, weights=values.ravel(), minlength=len(edges) - 1)
    means: FloatArray = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)
    return means


def _blockage(material: Material) -> "Figure":
    figure, (axes,) = plotting.new(1, 1, (6.4, 3.8))
    compared = material.compared
    order = ("echo probing", OPTIMUM, *LEVELS)
    for number, name in enumerate(order):
        label = {"echo probing": name, OPTIMUM: "location-aware, L = 0.30 (optimum)"}.get(
            name, f"location-aware, {name}"
        )
        rates, efficiency = compared.blockages_per_minute, compared.schemes[name]
        axes.plot(rates, efficiency, ms=4, label=label, **plotting.marked(number))
    axes.set_ylim(0, None)
    axes.set_xlim(0, None)
    axes.set_xlabel("blockages per minute and UAV")
    axes.set_ylabel("mean spectral efficiency, bit/s/Hz")
    plotting.below(figure, axes, 2)
    return figure
