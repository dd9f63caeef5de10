"""Report of the compass study: one self-contained HTML page, and its figures."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from companion.studies.compass.flight import ARRAY, KALMAN, METHODS, NONE, ORACLE, Row
from companion.studies.compass.study import HEAD, cells
from companion.studies.figures import plotting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NAMES: Final = {
    NONE: "reported attitude",
    ARRAY: "array",
    KALMAN: "Kalman filter",
    ORACLE: "true directions",
}


def files(answer: dict[str, Any], progress: Callable[[str], None]) -> dict[str, bytes]:
    """Return the page and its figures as PNG and SVG, by file name."""
    logs = list(dict.fromkeys(row["log"] for row in answer["rows"]))
    drawings: dict[str, tuple[str, plotting.Draw]] = {}
    for number, log in enumerate(logs, 1):
        rows = [row for row in answer["rows"] if row["log"] == log]
        suffix = "" if number == 1 else f"_{number}"
        drawings[f"compass_errors{suffix}"] = (
            f"{log}: 95th percentile of the pointing error by case, and the median of the bound"
            " where a method states one.",
            _drawing(rows),
        )
    tables = [(log, [cells(row) for row in answer["rows"] if row["log"] == log]) for log in logs]
    values = {"answer": answer, "head": HEAD, "tables": tables}
    return plotting.files("compass", "compass/report.html.j2", drawings, values, progress)


def _drawing(rows: list[Row]) -> plotting.Draw:
    return lambda: _errors(rows)


def _errors(rows: list[Row]) -> "Figure":
    cases = list(dict.fromkeys((r["receiver"], r["mount_deg"], r["uavs"]) for r in rows))
    figure, (axes,) = plotting.new(1, 1, (8.4, 0.5 * len(cases) + 1.4))
    for number, method in enumerate(METHODS[:-1]):
        of_method = [row for row in rows if row["method"] == method]
        at = np.arange(len(cases)) + (number - 1) * 0.26
        errors = [row["pointing_error_p95_deg"] or 0.0 for row in of_method]
        colour = plotting.COLOURS[number]
        axes.barh(at, errors, 0.24, color=colour, label=_NAMES[method])
        bounds = [row["pointing_bound_median_deg"] for row in of_method]
        known = [(place, bound) for place, bound in zip(at, bounds, strict=True) if bound]
        if known:
            places, values = zip(*known, strict=True)
            label = f"{_NAMES[method]}: bound"
            axes.plot(values, places, "|", color=colour, markersize=11, label=label)
    axes.set_yticks(
        range(len(cases)), [f"{name}\n{mount:g}° mount, {uavs}" for name, mount, uavs in cases]
    )
    axes.invert_yaxis()
    axes.set_xlabel("pointing error, 95 %, degrees; bar: bound, median")
    plotting.below(figure, axes, 3)
    return figure
