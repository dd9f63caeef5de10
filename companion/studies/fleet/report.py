"""Reports of the fleet study: a plain-text table, one HTML page, and figures."""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from companion.studies.figures import plotting
from companion.studies.figures.text_tables import decimal, text_table
from companion.studies.fleet.sky import Sky
from companion.studies.fleet.study import FleetSize, FleetStudy
from companion.studies.origin import Progress

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS: Final = (
    "nodes", "UAVs", "served by one", "by several", "by none", "handovers/min",
    "sends, kbit/s", "receives, kbit/s", "CPU of a node", "takeover, s", "split: none", "heals, s",
)  # fmt: skip
CAPTIONS: Final = {
    "traffic": "Traffic that a node sends and receives, by size of the fleet.",
    "time": "Processor time of a node without its pipeline, and takeover time after a node dies.",
}


def cells(one: FleetSize) -> list[str]:
    """Return the results of one fleet size as a row of the table."""
    return [
        str(one.nodes),
        str(one.uavs),
        f"{one.served:.3%}",
        f"{one.twice:.3%}",
        f"{one.none:.3%}",
        f"{one.handovers_per_min:.0f}",
        f"{sum(one.told_kbps.values()):.0f}",
        f"{one.link_kbps:.0f}",
        f"{one.cpu_share:.1%}",
        decimal(one.takeover_s, 1),
        f"{one.parted_none:.3%}",
        f"{one.heal_s:.1f}",
    ]


def text(found: Sequence[FleetSize]) -> str:
    """Return the table of fleet sizes as text."""
    return text_table([COLUMNS, *map(cells, found)])


def files(
    asked: FleetStudy, found: Sequence[FleetSize], answer: dict[str, Any], progress: Progress
) -> dict[str, bytes]:
    """Return the page and every figure as SVG and PNG, by file name."""
    drawings = {
        "traffic": (CAPTIONS["traffic"], partial(_traffic, found)),
        "time": (CAPTIONS["time"], partial(_time, found)),
    }
    told = {
        "spacing_m": f"{Sky(nodes=1, uavs=1).spacing_m:g}",
        "delay_ms": f"{1000 * asked.delay_s:g}",
        "loss": f"{asked.loss:.0%}",
    }
    values = {"answer": answer, "asked": told, "head": COLUMNS, "rows": list(map(cells, found))}
    return plotting.files("fleet", "fleet/report.html.j2", drawings, values, progress)


def _traffic(found: Sequence[FleetSize]) -> "Figure":
    figure, (left, right) = plotting.new(1, 2, (7.2, 3.0))
    nodes = [one.nodes for one in found]
    for number, what in enumerate(found[0].told_kbps):
        values = [one.told_kbps[what] for one in found]
        left.plot(nodes, values, label=what, **plotting.marked(number))
    right.plot(nodes, [one.link_kbps for one in found], **plotting.marked(0))
    for axes, title in ((left, "a node sends"), (right, "a node receives")):
        _sized(axes, nodes)
        axes.set(yscale="log", ylabel="kbit/s", title=title)
        _plain(axes)
    left.legend()
    return figure


def _time(found: Sequence[FleetSize]) -> "Figure":
    figure, (left, right) = plotting.new(1, 2, (7.2, 3.0))
    nodes = [one.nodes for one in found]
    left.plot(nodes, [100 * one.cpu_share for one in found], **plotting.marked(0))
    left.set(yscale="log", ylabel="% of a core", title="time")
    _plain(left)
    known = [(one.nodes, one.takeover_s) for one in found if one.takeover_s is not None]
    right.plot([n for n, _ in known], [s for _, s in known], **plotting.marked(1))
    right.set(ylabel="s", title="takeover", ylim=(0, None))
    for axes in (left, right):
        _sized(axes, nodes)
    return figure


def _sized(axes: "Axes", nodes: Sequence[int]) -> None:
    axes.set(xscale="log", xlabel="nodes")
    axes.set_xticks(nodes, labels=map(str, nodes))
    axes.set_xticks([], minor=True)


def _plain(axes: "Axes") -> None:
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}")
