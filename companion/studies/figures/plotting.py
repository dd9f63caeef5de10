"""Figure style and output as PNG and SVG by matplotlib, without a screen.

The style suits print: lines differ in colour and in dash. Colours are those of Okabe and Ito
(2008), which colour-blind readers can distinguish. SVG has no dates and no random ids: equal
numbers give equal files.
"""

import base64
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final

from companion.studies.figures import pages
from companion.studies.origin import Progress

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES: Final = ("-", "--", "-.", (0, (1, 1.2)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)))
MARKS: Final = ("o", "s", "^", "D", "v", "X", "P", "<", ">")
INK: Final = "#111111"
MAP: Final = "cividis"
PNG_DPI: Final = 160
_STYLE: Final[Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.5,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.linewidth": 0.8,
    "lines.linewidth": 1.4,
    "lines.markersize": 4.0,
    "legend.frameon": False,
    "hatch.color": "#ffffff",
    "svg.hashsalt": "companion",
    "svg.fonttype": "path",
    "figure.constrained_layout.use": True,
}

Draw = Callable[[], "Figure"]


@contextmanager
def style() -> Iterator[None]:
    """Return a context with this figure style; the previous settings are restored after it."""
    import matplotlib

    with matplotlib.rc_context(_STYLE):
        yield


def new(
    rows: int, columns: int, size_in: tuple[float, float], **options: Any
) -> "tuple[Figure, list[Axes]]":
    """Return a new figure and its panels in row order; sizes in inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size_in)
    grid = figure.subplots(rows, columns, squeeze=False, **options)
    return figure, list(grid.flat)


def line(number: int) -> dict[str, Any]:
    """Return colour and dash of line ``number``; no two of the first 36 share both."""
    turns, at = divmod(number, len(COLOURS))
    return {"color": COLOURS[at], "linestyle": DASHES[(at + turns) % len(DASHES)]}


def marked(number: int) -> dict[str, Any]:
    """Return colour, dash and marker of a line, for curves through few points, or many curves."""
    return line(number) | {"marker": MARKS[number % len(MARKS)]}


def below(figure: "Figure", axes: "Axes", columns: int, *others: "Axes") -> None:
    """Place one legend for all panels of a figure below them, with the entries of some panels."""
    handles, labels = axes.get_legend_handles_labels()
    for other in others:
        more_handles, more_labels = other.get_legend_handles_labels()
        handles, labels = handles + more_handles, labels + more_labels
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def title_panels(panels: "Sequence[Axes]", titles: Sequence[str]) -> None:
    """Title the panels of a figure (a), (b) and so on."""
    for number, (axes, title) in enumerate(zip(panels, titles, strict=True)):
        axes.set_title(f"({chr(ord('a') + number)}) {title}")


def render_figure(draw: Draw) -> tuple[bytes, bytes]:
    """Return a figure as SVG and as PNG."""
    with style():
        figure = draw()
        svg, png = BytesIO(), BytesIO()
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
        figure.savefig(png, format="png", dpi=PNG_DPI, metadata={"Software": None})
    return svg.getvalue(), png.getvalue()


def files(
    name: str,
    template: str,
    drawings: Mapping[str, tuple[str, Draw]],
    values: Mapping[str, Any],
    progress: Progress,
) -> dict[str, bytes]:
    """Return every figure as SVG and PNG, and the page ``name``.html, by file name.

    template  of the page, as in ``pages.page``
    drawings  caption and drawing of each figure by name
    values    template variables, besides ``figures`` (name, caption and PNG of each)
    progress  called with the name of each figure
    """
    made, shown = {}, {}
    for figure, (caption, draw) in drawings.items():
        progress(f"drawing {figure}")
        svg, png = render_figure(draw)
        made[f"{figure}.svg"], made[f"{figure}.png"] = svg, png
        data = base64.b64encode(png).decode()
        shown[figure] = {"name": figure, "caption": caption, "png_base64": data}
    made[f"{name}.html"] = pages.page(template, figures=shown, **values).encode()
    return made
