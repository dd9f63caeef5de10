"""Summary of the rows of a comparison: measures over UAVs, and violated bounds."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from companion.studies.origin import Row
from companion.studies.prediction.comparison import LogComparison
from companion.studies.prediction.pointing import HALF_BEAMWIDTH_DEG


class Pool(StrEnum):
    """How the figures of several UAVs are combined, each weighted by its number of answers."""

    RMS = "all UAVs together"
    MEAN = "mean over all UAVs"
    WORST = "the worst UAV"


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """Figure in the rows of a comparison, and how it is shown."""

    key: str  # its key in a row
    caption: str  # caption of its table
    short: str  # its heading in the text
    pool: Pool = Pool.RMS  # how the UAVs' figures are combined
    more_is_better: bool = False  # whether a larger one is better


ANGLE: Final = Measure(key="angle_rms_deg", caption="RMS angle error, degrees", short="deg rms")
MEASURES: Final = (
    ANGLE,
    Measure(
        key="angle_p95_deg",
        caption="95th percentile of the angle error, degrees",
        short="p95",
        pool=Pool.WORST,
    ),
    Measure(
        key="angle_max_deg", caption="largest angle error, degrees", short="max", pool=Pool.WORST
    ),
    Measure(
        key="within_beamwidth",
        caption=f"share of time within the half-power beamwidth ({HALF_BEAMWIDTH_DEG}°)",
        short="in beam",
        pool=Pool.MEAN,
        more_is_better=True,
    ),
    Measure(
        key="se_loss_bps_hz",
        caption="spectral efficiency lost against perfect knowledge, bit/s/Hz",
        short="bit/s/Hz",
        pool=Pool.MEAN,
    ),
    Measure(key="position_rms_m", caption="RMS position error, metres", short="m rms"),
    Measure(
        key="position_p95_m",
        caption="95th percentile of the position error, metres",
        short="p95",
        pool=Pool.WORST,
    ),
    Measure(
        key="position_max_m", caption="largest position error, metres", short="max", pool=Pool.WORST
    ),
    Measure(
        key="bound_tightness",
        caption="tightness: median bound over 95th percentile of the position error",
        short="tightness",
        pool=Pool.MEAN,
    ),
    Measure(
        key="usual_covers",
        caption="share of errors no larger than the stated usual error (95 % expected)",
        short="covered",
        pool=Pool.MEAN,
        more_is_better=True,
    ),
)


def pooled(
    rows: Sequence[Row], predictor: str, lead_s: float, measure: Measure = ANGLE
) -> float | None:
    """Return one figure over all UAVs; None without rows, or if a UAV lacks the figure."""
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


def regimes(compared: LogComparison) -> list[tuple[str, dict[str, str]]]:
    """Return the number of violated bounds in each regime of a hostile link, by predictor."""
    sums: dict[str, dict[str, Counter[str]]] = {}
    for row in compared.rows:
        for regime, counts in (row["regimes"] or {}).items():
            sums.setdefault(regime, {}).setdefault(row["predictor"], Counter()).update(counts)
    names = dict.fromkeys(row["predictor"] for row in compared.rows if row["regimes"])
    return [
        (regime, {name: _beyond(by_name.get(name, Counter())) for name in names})
        for regime, by_name in sums.items()
    ]


def _beyond(counts: Mapping[str, int]) -> str:
    told = f" ({counts['announced']} announced)" if counts["announced"] else ""
    return f"{counts['violations']}{told} of {counts['answers']}"


def left_out(compared: LogComparison) -> list[str]:
    """Return a line on the answers within declared faults; empty without any."""
    left = {row["predictor"]: 0 for row in compared.rows if row["in_faults"]}
    for row in compared.rows:
        left[row["predictor"]] = left.get(row["predictor"], 0) + (row["in_faults"] or 0)
    most = max(left.values(), default=0)
    return [f"not counted for the bounds: {most} answers in windows of declared faults"][: most > 0]


def axes_of(compared: LogComparison) -> tuple[list[float], list[str]]:
    """Return the leads and the predictors, in the order of the rows."""
    leads = dict.fromkeys(row["lead_s"] for row in compared.rows)
    return list(leads), list(dict.fromkeys(row["predictor"] for row in compared.rows))


def title(compared: LogComparison) -> str:
    """Return the log and the link, for headings."""
    return f"{compared.log}, {compared.link.name} link"


def broken(compared: LogComparison, predictor: str) -> str:
    """Return how many of a predictor's errors exceeded its own bound, over all rows."""
    rows = [row for row in compared.rows if row["predictor"] == predictor]
    if any(row["violations"] is None for row in rows):
        return "no bound"
    keys = ("answers", "violations", "announced")
    return _beyond({key: sum(row[key] for row in rows) for key in keys})
