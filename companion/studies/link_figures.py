"""Figures of the link study, as PNG and SVG: for print in black and white and for all eyes."""

import io
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from companion.studies.link_rows import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEAST: Final = {"ber": 1e-6, "bler": 1e-4}
"""Error rates below are not drawn."""
PNG_DPI: Final = 200


class Style(NamedTuple):
    """How a curve looks. Colours are those of M. Okabe and K. Ito; marks and dashes differ too."""

    label: str
    colour: str
    line: Any
    mark: str


THEORY: Final = Style("AWGN, exact", "#000000", ":", "")
STYLES: Final = {
    "awgn": Style("AWGN, simulated", "#555555", "-.", "x"),
    "perfect": Style("perfect positions", "#0072B2", "-", "o"),
    "predicted": Style("predicted positions", "#009E73", "--", "s"),
    "held": Style("held positions", "#D55E00", (0, (1, 1)), "^"),
}
LOOK: Final[dict[Any, Any]] = {
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.5,
    "legend.fontsize": 8.5,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "lines.markersize": 4.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "link",  # the same names of elements in every run
    "svg.fonttype": "path",
}


def figures(answer: dict[str, Any]) -> dict[str, bytes]:
    """Every figure by name of file: ``link_ber``, ``link_bler``, ``link_rate`` and ``link_evm``,
    each as .png and .svg."""
    import matplotlib

    made: dict[str, bytes] = {}
    with matplotlib.rc_context(LOOK):
        for name, draw in _DRAWN.items():
            figure = draw(answer)
            for form in ("png", "svg"):
                file = io.BytesIO()
                unstamped = {"Date": None} if form == "svg" else {"Software": None}
                figure.savefig(file, format=form, dpi=PNG_DPI, metadata=unstamped)
                made[f"{name}.{form}"] = file.getvalue()
    return made


def _new(panels: int) -> "tuple[Figure, Sequence[Axes]]":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0 if panels > 1 else 4.6, 3.5), layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False, sharey=True)[0]
    figure.supxlabel("SNR of a data carrier, beam exactly on the UAV (dB)", fontsize=9)
    return figure, axes


def _curve(answer: dict[str, Any], positions: str, coded: bool) -> list[Row]:
    return [
        found
        for found in [*answer["awgn"], *answer["rows"]]
        if (found["positions"], found["coded"]) == (positions, coded)
    ]


def _errors(answer: dict[str, Any], key: str, label: str) -> "Figure":
    """Error rates, uncoded beside coded, with their confidence as bands."""
    figure, axes = _new(2)
    for panel, coded in zip(axes, (False, True), strict=True):
        panel.set_title("coded: rate 1/3, K = 7" if coded else "uncoded")
        panel.set_yscale("log")
        panel.set_ylim(LEAST[key], 1.4)
        for positions, style in STYLES.items():
            curve = [found for found in _curve(answer, positions, coded) if found[key] > 0]
            if not curve:
                continue
            levels = [found["snr_db"] for found in curve]
            panel.plot(levels, [found[key] for found in curve], **_look(style))
            low, high = zip(*(found["confidence"][key] for found in curve), strict=True)
            panel.fill_between(
                levels, np.maximum(low, 1e-12), high, color=style.colour, alpha=0.18, linewidth=0
            )
        if key == "ber" and not coded:
            theory = [(found["snr_db"], found["ber"]) for found in answer["theory"]]
            panel.plot(*zip(*theory, strict=True), **_look(THEORY))
    axes[0].set_ylabel(label)
    _legend(figure, axes[0])
    return figure


def _rates(answer: dict[str, Any]) -> "Figure":
    figure, axes = _new(2)
    for panel, coded in zip(axes, (False, True), strict=True):
        panel.set_title("coded: rate 1/3, K = 7" if coded else "uncoded, blocks of 936 bits")
        for positions, style in STYLES.items():
            curve = _curve(answer, positions, coded)
            levels = [found["snr_db"] for found in curve]
            panel.plot(levels, [found["rate_bps"] / 1e6 for found in curve], **_look(style))
        panel.set_ylim(bottom=0)
    axes[0].set_ylabel("throughput of one UAV (Mbit/s)")
    _legend(figure, axes[0])
    return figure


def _evm(answer: dict[str, Any]) -> "Figure":
    figure, (panel,) = _new(1)
    for positions, style in STYLES.items():
        curve = _curve(answer, positions, False)
        levels = [found["snr_db"] for found in curve]
        panel.plot(levels, [found["evm_percent"] for found in curve], **_look(style))
    panel.set_yscale("log")
    panel.set_yticks([3, 5, 10, 20, 50, 100, 200, 400])
    panel.yaxis.set_major_formatter("{x:g}")
    panel.minorticks_off()
    panel.set_ylabel("EVM, median over blocks (%)")
    panel.legend(frameon=False)
    return figure


def _look(style: Style) -> dict[str, Any]:
    return {
        "label": style.label,
        "color": style.colour,
        "linestyle": style.line,
        "marker": style.mark,
        "markevery": 2,
    }


def _legend(figure: "Figure", panel: "Axes") -> None:
    """One for both panels, above them."""
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=4 if len(labels) == 4 else 3,
        frameon=False,
        columnspacing=1.2,
        handlelength=2.4,
    )


_DRAWN: Final[dict[str, Callable[[dict[str, Any]], "Figure"]]] = {
    "link_ber": lambda answer: _errors(answer, "ber", "bit error rate"),
    "link_bler": lambda answer: _errors(answer, "bler", "block error rate"),
    "link_rate": _rates,
    "link_evm": _evm,
}
