"""Report of the compass study: one self-contained HTML page, and its figures."""

from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from companion.studies.compass.flight import ARRAY, KALMAN, METHODS, NONE, ORACLE
from companion.studies.compass.study import HEAD, cells
from companion.studies.figures import plotting
from companion.studies.origin import Progress, Row, by_log

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NAMES: Final = {
    NONE: "reported attitude",
    ARRAY: "array",
    KALMAN: "Kalman filter",
    ORACLE: "true directions",
}


def files(answer: dict[str, Any], progress: Progress) -> dict[str, bytes]:
    """Return the page and its figures as PNG and SVG, by file name."""
    drawings: dict[str, tuple[str, plotting.Draw]] = {}
    tables = []
    for number, (log, rows) in enumerate(by_log(answer["rows"]).items(), 1):
        suffix = "" if number == 1 else f"_{number}"
        drawings[f"compass_errors{suffix}"] = (
            f"{log}: 95th percentile of the pointing error by case, and the median of the bound"
            " where a method states one.",
            partial(_errors, rows),
        )
        tables.append((log, list(map(cells, rows))))
    values = {"answer": answer, "head": HEAD, "tables": tables}
    return plotting.files("compass", "compass/report.html.j2", drawings, values, progress)


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
