"""Figures of the link study: error rates, throughput and EVM over the SNR."""

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from companion.studies.figures import plotting
from companion.studies.origin import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEAST: Final = {"ber": 1e-6, "bler": 1e-4}  # least error rate drawn
LABELS: Final = {
    "perfect": "perfect positions",
    "held": "held positions",
    "predicted": "predicted positions",
    "awgn": "AWGN, simulated",
}


def drawings(answer: dict[str, Any]) -> dict[str, tuple[str, plotting.Draw]]:
    """Return caption and drawing of each figure of the study, by name."""
    return {
        "link_ber": (
            "Bit error rate. Bands: 95 % confidence, from the variance between instants."
            " Curves end where no error occurred.",
            lambda: _errors(answer, "ber", "bit error rate"),
        ),
        "link_bler": (
            "Block error rate. A block is one OFDM symbol: 306 bits coded, 936 uncoded.",
            lambda: _errors(answer, "bler", "block error rate"),
        ),
        "link_rate": (
            "Throughput of one UAV: bits of error-free blocks per second.",
            lambda: _rates(answer),
        ),
        "link_evm": (
            "Error vector magnitude after equalisation, relative to the transmitted symbols.",
            lambda: _evm(answer),
        ),
    }


def _new(columns: int, size_in: tuple[float, float]) -> "tuple[Figure, list[Axes]]":
    figure, panels = plotting.new(1, columns, size_in, sharey=True)
    for panel in panels:
        panel.set_xlabel("SNR of a data carrier, dB")
    return figure, panels


def _curve(answer: dict[str, Any], positions: str, coded: bool) -> list[Row]:
    return [
        found
        for found in [*answer["awgn"], *answer["rows"]]
        if (found["positions"], found["coded"]) == (positions, coded)
    ]


def _errors(answer: dict[str, Any], key: str, label: str) -> "Figure":
    figure, axes = _new(2, (7.2, 3.8))
    for panel, coded in zip(axes, (False, True), strict=True):
        panel.set_title("coded: rate 1/3, K = 7" if coded else "uncoded")
        panel.set_yscale("log")
        panel.set_ylim(LEAST[key], 1.4)
        for positions in LABELS:
            curve = [found for found in _curve(answer, positions, coded) if found[key] > 0]
            if not curve:
                continue
            levels = [found["snr_db"] for found in curve]
            panel.plot(levels, [found[key] for found in curve], **_look(positions))
            low, high = zip(*(found["confidence"][key] for found in curve), strict=True)
            panel.fill_between(
                levels,
                np.maximum(low, 1e-12),
                high,
                color=_look(positions)["color"],
                alpha=0.18,
                linewidth=0,
            )
        if key == "ber" and not coded:
            theory = [(found["snr_db"], found["ber"]) for found in answer["theory"]]
            panel.plot(
                *zip(*theory, strict=True), color=plotting.INK, linestyle=":", label="AWGN, exact"
            )
    axes[0].set_ylabel(label)
    plotting.below(figure, axes[0], 3)
    return figure


def _rates(answer: dict[str, Any]) -> "Figure":
    figure, axes = _new(2, (7.2, 3.8))
    for panel, coded in zip(axes, (False, True), strict=True):
        panel.set_title("coded: rate 1/3, K = 7" if coded else "uncoded, blocks of 936 bits")
        for positions in LABELS:
            curve = _curve(answer, positions, coded)
            levels = [found["snr_db"] for found in curve]
            panel.plot(levels, [found["rate_bps"] / 1e6 for found in curve], **_look(positions))
        panel.set_ylim(bottom=0)
    axes[0].set_ylabel("throughput of one UAV, Mbit/s")
    plotting.below(figure, axes[0], 3)
    return figure


def _evm(answer: dict[str, Any]) -> "Figure":
    figure, (panel,) = _new(1, (5.0, 3.8))
    for positions in LABELS:
        curve = _curve(answer, positions, False)
        levels = [found["snr_db"] for found in curve]
        panel.plot(levels, [found["evm_percent"] for found in curve], **_look(positions))
    panel.set_yscale("log")
    panel.set_yticks([3, 5, 10, 20, 50, 100, 200, 400])
    panel.yaxis.set_major_formatter("{x:g}")
    panel.minorticks_off()
    panel.set_ylabel("EVM, median over blocks, %")
    panel.legend()
    return figure


def _look(positions: str) -> dict[str, Any]:
    number = list(LABELS).index(positions)
    return plotting.marked(number) | {"label": LABELS[positions], "markevery": 2}
