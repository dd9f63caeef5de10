"""Self-contained page of the prediction study, and its figures."""

import math
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from companion.studies.figures import plotting
from companion.studies.figures.text_tables import decimal
from companion.studies.origin import Progress
from companion.studies.prediction import summary
from companion.studies.prediction.comparison import LogComparison
from companion.studies.prediction.pointing import HALF_BEAMWIDTH_DEG
from companion.studies.prediction.summary import ANGLE, MEASURES, Measure, pooled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def files(
    answer: dict[str, Any], found: Sequence[LogComparison], progress: Progress
) -> dict[str, bytes]:
    """Return the page, and figures ``angle_`` and link name as SVG and PNG, by file name.

    Figures of the second and later logs are numbered.
    """
    values = {
        "answer": answer,
        "half_beamwidth_deg": HALF_BEAMWIDTH_DEG,
        "sections": [_section(name, compared) for name, compared in _named(found).items()],
    }
    return plotting.files(
        "prediction", "prediction/report.html.j2", drawings(found), values, progress
    )


def drawings(found: Sequence[LogComparison]) -> dict[str, tuple[str, plotting.Draw]]:
    """Return caption and drawing of each figure of the study, by name."""
    return {
        name: (f"{ANGLE.caption}, over lead: {summary.title(compared)}", partial(_curves, compared))
        for name, compared in _named(found).items()
    }


def _named(found: Sequence[LogComparison]) -> dict[str, LogComparison]:
    """Return the comparisons that have rows, by the name of their figure."""
    named = {}
    seen = Counter[str]()
    for compared in found:
        seen[compared.link.name] += 1
        number = seen[compared.link.name]
        name = f"angle_{compared.link.name}" + ("" if number == 1 else f"_{number}")
        if compared.rows:
            named[name] = compared
    return named


def _section(name: str, compared: LogComparison) -> dict[str, Any]:
    leads, predictors = summary.axes_of(compared)
    rows = compared.rows
    keys = (
        "uav", "predictor", "lead_s", "n", "angle_rms_deg", "angle_p95_deg", "angle_max_deg",
        "within_beamwidth", "se_loss_bps_hz", "position_rms_m", "position_p95_m",
        "position_max_m", "answers", "violations", "announced", "in_faults", "worst_of_bound",
        "bound_median_m", "bound_tightness", "truth",
    )  # fmt: skip
    return {
        "name": name,
        "title": summary.title(compared),
        "link": compared.link,
        "center": compared.center,
        "uavs": ", ".join(dict.fromkeys(row["uav"] for row in rows)),
        "truth": " and ".join(dict.fromkeys(row["truth"] for row in rows)),
        "tuned": compared.tuned,
        "leads": [f"{lead_s:g}" for lead_s in leads],
        "violations": {name: summary.broken(compared, name) for name in predictors},
        "tables": [_table(compared, measure) for measure in MEASURES],
        "regimes": summary.regimes(compared),
        "left_out": summary.left_out(compared),
        "head": keys,
        "by_uav": [[_cell(row[key]) for key in keys] for row in rows],
    }


def _table(compared: LogComparison, measure: Measure) -> dict[str, Any]:
    """Return a caption, and each predictor's figure at each lead with whether it is the best."""
    leads, predictors = summary.axes_of(compared)
    cells = {
        name: [pooled(compared.rows, name, lead_s, measure) for lead_s in leads]
        for name in predictors
    }
    choose = max if measure.more_is_better else min
    best = [
        choose((cell for cell in column if cell is not None), default=None)
        for column in zip(*cells.values(), strict=True)
    ]
    rows = [
        (
            name,
            [
                (decimal(cell, 3), cell is not None and cell == top)
                for cell, top in zip(row, best, strict=True)
            ],
        )
        for name, row in cells.items()
    ]
    return {"caption": f"{measure.caption}; {measure.pool}", "rows": rows}


def _curves(compared: LogComparison) -> "Figure":
    """Draw the RMS angle (logarithmic) over lead, one line per predictor, without zeros."""
    from matplotlib.ticker import LogLocator

    leads, predictors = summary.axes_of(compared)
    figure, (axes,) = plotting.new(1, 1, (7.2, 4.4))
    axes.set_yscale("log")
    for number, name in enumerate(predictors):
        cells = [pooled(compared.rows, name, lead_s) for lead_s in leads]
        angles = [cell or math.nan for cell in cells]
        axes.plot(leads, angles, label=name, **plotting.marked(number))
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}°")
    axes.minorticks_off()
    axes.set_xticks(leads, [f"{lead_s:g}" for lead_s in leads])
    axes.set_xlabel("lead, s")
    axes.set_ylabel("RMS angle error")
    plotting.below(figure, axes, 4)
    return figure


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
