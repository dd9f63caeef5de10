"""Reports of the prediction study: tables as text, and what its self-contained page shows."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from companion.studies.figures import plotting
from companion.studies.prediction.comparison import Compared
from companion.studies.prediction.pointing import HALF_BEAMWIDTH_DEG, Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Pool(StrEnum):
    """How the figures of several UAVs become one, each weighted by its answers."""

    RMS = "all UAVs together"
    MEAN = "mean over all UAVs"
    WORST = "the worst UAV"


@dataclass(frozen=True, slots=True)
class Measure:
    """A figure of the rows and how it is shown.

    key             its key in a row
    caption         caption of its table
    short           its heading in the text
    pool            how the UAVs' figures become one
    more_is_better  whether a larger one is better
    """

    key: str
    caption: str
    short: str
    pool: Pool = Pool.RMS
    more_is_better: bool = False


ANGLE: Final = Measure("angle_rms_deg", "RMS angle error, degrees", "deg rms")
MEASURES: Final = (
    ANGLE,
    Measure("angle_p95_deg", "95th percentile of the angle error, degrees", "p95", Pool.WORST),
    Measure("angle_max_deg", "largest angle error, degrees", "max", Pool.WORST),
    Measure(
        "within_beamwidth",
        f"share of time within the half-power beamwidth ({HALF_BEAMWIDTH_DEG}°)",
        "in beam",
        Pool.MEAN,
        True,
    ),
    Measure(
        "se_loss_bps_hz",
        "spectral efficiency lost against perfect knowledge, bit/s/Hz",
        "bit/s/Hz",
        Pool.MEAN,
    ),
    Measure("position_rms_m", "RMS position error, metres", "m rms"),
    Measure("position_p95_m", "95th percentile of the position error, metres", "p95", Pool.WORST),
    Measure("position_max_m", "largest position error, metres", "max", Pool.WORST),
    Measure(
        "bound_tightness",
        "tightness: median bound over 95th percentile of the position error",
        "tightness",
        Pool.MEAN,
    ),
)


def pooled(
    rows: Sequence[Row], predictor: str, lead_s: float, measure: Measure = ANGLE
) -> float | None:
    """One figure of all UAVs; None without rows, or where one of them has none."""
    chosen = [row for row in rows if row["predictor"] == predictor and row["lead_s"] == lead_s]
    values = [(row["n"], row[measure.key]) for row in chosen]
    if not values or any(value is None for _, value in values):
        return None
    total = sum(n for n, _ in values)
    match measure.pool:
        case Pool.RMS:
            return math.sqrt(sum(n * value**2 for n, value in values) / total)
        case Pool.MEAN:
            return float(sum(n * value for n, value in values) / total)
        case Pool.WORST:
            return float(max(value for _, value in values))


def text(found: Sequence[Compared]) -> str:
    """The tables as text: RMS angle at each lead, and every measure at the longest."""
    shown = [compared for compared in found if compared.rows]
    return "\n\n".join(table(each) for each in shown for table in (_text_table, _text_measures))


def _text_table(compared: Compared) -> str:
    leads, predictors = _axes(compared)
    lines = [
        f"{_title(compared)}: RMS angle error, degrees, at a lead of",
        " " * 26 + "".join(f"{lead_s:>9g} s" for lead_s in leads) + "   beyond bound",
    ]
    for name in predictors:
        cells = [pooled(compared.rows, name, lead_s) for lead_s in leads]
        numbers = "".join(f"{_number(cell):>11}" for cell in cells)
        lines.append(f"  {name:24}{numbers}   {_violations(compared, name)}")
    return "\n".join(lines)


def _text_measures(compared: Compared) -> str:
    leads, predictors = _axes(compared)
    lead_s = max(leads)
    lines = [
        f"{_title(compared)}: at a lead of {lead_s:g} s; p95 and max of the worst UAV",
        " " * 26 + "".join(f"{measure.short:>10}" for measure in MEASURES),
    ]
    for name in predictors:
        cells = [pooled(compared.rows, name, lead_s, measure) for measure in MEASURES]
        lines.append(f"  {name:24}" + "".join(f"{_number(cell):>10}" for cell in cells))
    return "\n".join(lines)


def files(
    answer: dict[str, Any], found: Sequence[Compared], progress: Callable[[str], None]
) -> dict[str, bytes]:
    """The page and every figure as SVG and PNG, by file name: ``angle_`` and the link's name.

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


def drawings(found: Sequence[Compared]) -> dict[str, tuple[str, plotting.Draw]]:
    """Caption and drawing of each figure by its name."""
    return {
        name: (f"{ANGLE.caption}, over lead: {_title(compared)}", partial(_curves, compared))
        for name, compared in _named(found).items()
    }


def _named(found: Sequence[Compared]) -> dict[str, Compared]:
    """The comparisons that have rows, by the name of their figure."""
    named = {}
    seen = Counter[str]()
    for compared in found:
        seen[compared.link.name] += 1
        number = seen[compared.link.name]
        name = f"angle_{compared.link.name}" + ("" if number == 1 else f"_{number}")
        if compared.rows:
            named[name] = compared
    return named


def _section(name: str, compared: Compared) -> dict[str, Any]:
    """What the page shows of one log over one link."""
    leads, predictors = _axes(compared)
    rows = compared.rows
    keys = (
        "uav", "predictor", "lead_s", "n", "angle_rms_deg", "angle_p95_deg", "angle_max_deg",
        "within_beamwidth", "se_loss_bps_hz", "position_rms_m", "position_p95_m",
        "position_max_m", "bound_violations", "bound_median_m", "bound_tightness", "truth",
    )  # fmt: skip
    return {
        "name": name,
        "title": _title(compared),
        "link": compared.link,
        "center": compared.center,
        "uavs": ", ".join(dict.fromkeys(row["uav"] for row in rows)),
        "truth": " and ".join(dict.fromkeys(row["truth"] for row in rows)),
        "tuned": compared.tuned,
        "leads": [f"{lead_s:g}" for lead_s in leads],
        "violations": {name: _violations(compared, name) for name in predictors},
        "tables": [_table(compared, measure) for measure in MEASURES],
        "head": keys,
        "by_uav": [[_cell(row[key]) for key in keys] for row in rows],
    }


def _table(compared: Compared, measure: Measure) -> dict[str, Any]:
    """The caption, and of each predictor its figure at each lead and whether it is the best."""
    leads, predictors = _axes(compared)
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
                (_number(cell), cell is not None and cell == top)
                for cell, top in zip(row, best, strict=True)
            ],
        )
        for name, row in cells.items()
    ]
    return {"caption": f"{measure.caption}; {measure.pool}", "rows": rows}


def _curves(compared: Compared) -> "Figure":
    """RMS angle (logarithmic) over lead, one line per predictor.

    Zero has no place on the axis and is left out.
    """
    from matplotlib.ticker import LogLocator

    leads, predictors = _axes(compared)
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


def _axes(compared: Compared) -> tuple[list[float], list[str]]:
    """The leads and the predictors, in the order in which they come."""
    leads = dict.fromkeys(row["lead_s"] for row in compared.rows)
    return list(leads), list(dict.fromkeys(row["predictor"] for row in compared.rows))


def _title(compared: Compared) -> str:
    return f"{compared.log}, {compared.link.name} link"


def _violations(compared: Compared, predictor: str) -> str:
    """How many of a predictor's errors went beyond its own bound, over all rows."""
    counts = [r["bound_violations"] for r in compared.rows if r["predictor"] == predictor]
    if None in counts:
        return "no bound"
    return f"{sum(counts)} of {sum(r['n'] for r in compared.rows if r['predictor'] == predictor)}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
