"""Report of measured beams: one self-contained HTML page, and its figure."""

from typing import TYPE_CHECKING, Any

import numpy as np

from companion.studies.figures import plotting
from companion.studies.figures.text_tables import decimal
from companion.studies.origin import Progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def files(answer: dict[str, Any], progress: Progress) -> dict[str, bytes]:
    """Return the page and its figure as PNG and SVG, by file name."""
    drawings = {
        "deepsense_tops": (
            "Share of samples whose best beam is among the likeliest; lines are the targets on"
            " blocks.",
            lambda: _tops(answer),
        )
    }
    values = {"answer": answer, "rows": [_cells(row) for row in answer["rows"]]}
    template = "deepsense/report.html.j2"
    return plotting.files("deepsense", template, drawings, values, progress)


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    return (
        row["split"],
        row["predictor"],
        *(f"{row[f'top_{top}']:.1f}" for top in (1, 3, 5, 8)),
        f"{row['set_size_mean']:.1f}",
        f"{100 * row['set_coverage']:.1f}",
        decimal(row["power_lost_db"]),
    )


def _tops(answer: dict[str, Any]) -> "Figure":
    figure, panels = plotting.new(1, 2, (8.4, 3.4), sharey=True)
    for axes, split in zip(panels, ("blocks", "shuffled"), strict=True):
        rows = [row for row in answer["rows"] if row["split"] == split]
        for number, row in enumerate(rows):
            at = np.arange(3) + (number - (len(rows) - 1) / 2) * 0.25
            heights = [row[f"top_{top}"] for top in (1, 3, 5)]
            axes.bar(at, heights, 0.22, color=plotting.COLOURS[number], label=row["predictor"])
        for place, top in enumerate((1, 3, 5)):
            wanted = answer["targets"][str(top)]
            axes.hlines(wanted, place - 0.45, place + 0.45, plotting.INK, linestyles="--")
        axes.set_xticks(range(3), ["top-1", "top-3", "top-5"])
    panels[0].set_ylabel("%")
    plotting.title_panels(panels, ("contiguous blocks", "random split, which leaks"))
    plotting.below(figure, panels[0], 3)
    return figure
