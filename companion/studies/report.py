"""A prediction study for people: tables as text, and one HTML page that needs nothing else."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any, Final

from companion.studies import figures
from companion.studies.pointing import HALF_BEAMWIDTH_DEG, Row
from companion.studies.prediction import Compared

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLE: Final = """
body { font: 15px/1.45 system-ui, sans-serif; color: #111; background: #fff;
  max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h2 { margin-top: 2.2rem; border-bottom: 1px solid #999; }
table { border-collapse: collapse; margin: .8rem 0; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: .2rem 0; color: #333; }
th, td { padding: .15rem .6rem; border-bottom: 1px solid #ccc; text-align: right; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1.2rem 0; }
td.best { font-weight: 700; }
code { overflow-wrap: anywhere; }
details { overflow-x: auto; }
img { max-width: 100%; height: auto; }
figcaption { color: #333; max-width: 52rem; }
@media print { section { break-inside: avoid; } body { margin: 0; font-size: 11px; } }
"""


class Pool(StrEnum):
    """How the figures of several UAVs become one, each weighted by its answers."""

    RMS = "all UAVs together"
    MEAN = "mean over all UAVs"
    WORST = "the worst UAV"


@dataclass(frozen=True, slots=True)
class Measure:
    """A figure of the rows: what a table says of it, what the text heads it with, how it is
    pooled, and whether more of it is better."""

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
    """The page and every figure as SVG and PNG, by name of file: ``angle_`` and the link's name.
    Figures of the second log and those after it are numbered."""
    named = _named(found)
    return figures.files(
        "prediction", drawings(found), lambda shown: _page(answer, named, shown), progress
    )


def drawings(found: Sequence[Compared]) -> dict[str, tuple[str, figures.Draw]]:
    """Caption and drawing of each figure by its name."""
    return {
        name: (f"{ANGLE.caption}, over lead: {_title(compared)}", partial(_curves, compared))
        for name, compared in _named(found).items()
    }


def _named(found: Sequence[Compared]) -> dict[str, Compared]:
    """Those that have rows, by the name of their figure."""
    named = {}
    seen = Counter[str]()
    for compared in found:
        seen[compared.link.name] += 1
        number = seen[compared.link.name]
        name = f"angle_{compared.link.name}" + ("" if number == 1 else f"_{number}")
        if compared.rows:
            named[name] = compared
    return named


def _page(answer: dict[str, Any], named: Mapping[str, Compared], shown: dict[str, str]) -> str:
    """The whole report as one HTML document, without anything from elsewhere."""
    sections = "\n".join(_section(compared, shown[name]) for name, compared in named.items())
    versions = ", ".join(f"{name} {version}" for name, version in answer["versions"].items())
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Predictors compared</title>
<style>{STYLE}</style>
</head>
<body>
<h1>Predictors compared</h1>
<p>A pointer at the array's place is asked 20 times a second where each UAV will be at now + lead.
It uses only what has arrived by then. Errors count while the UAV flies. Angles are seen from the
array's true position; {HALF_BEAMWIDTH_DEG}° is half the beamwidth of 64 elements. The Kalman
filters cv and ca were tuned in hindsight on the log itself; nothing else was. kalman-peng takes the
noise that the settings' bounds stand for.</p>
<p>Spectral efficiency is that of a matched beam of the array of the settings, square to the UAV,
with {answer["snr_db"]:g} dB at the UAV when the beam is right on it; the loss is the mean of
log2(1 + SNR) with the true direction less that with the predicted one. A line of elements does not
see errors across it. The bound's tightness would be 1 if the bound were as good as known.</p>
<p><code>{escape(answer["command"])}</code><br>{escape(versions)}; seed {answer["seed"]}</p>
{sections}
</body>
</html>
"""


def _section(compared: Compared, figure: str) -> str:
    tuned = "; ".join(
        f"{name}: process noise {tuning.process_density:g} m²/s{'³' if name[-1] == 'v' else '⁵'},"
        f" noise {tuning.position_noise_m:g} m and {tuning.velocity_noise_mps:g} m/s"
        for name, tuning in compared.tuned.items()
    )
    return "\n".join(
        [
            f"<section><h2>{escape(_title(compared))}</h2>",
            f"<p>{escape(_describe(compared))}</p>",
            figure,
            *(_table(compared, measure) for measure in MEASURES),
            f"<p>Best of the grid: {escape(tuned)}.</p></section>",
            _by_uav(compared),
        ]
    )


def _table(compared: Compared, measure: Measure) -> str:
    leads, predictors = _axes(compared)
    cells = {
        (name, lead_s): pooled(compared.rows, name, lead_s, measure)
        for name in predictors
        for lead_s in leads
    }
    choose = max if measure.more_is_better else min
    best = {
        lead_s: choose(
            (cell for name in predictors if (cell := cells[name, lead_s]) is not None), default=None
        )
        for lead_s in leads
    }
    caption = f"{measure.caption}; {measure.pool}"
    head = "".join(f"<th>{lead_s:g} s</th>" for lead_s in leads)
    lines = [
        f"<table><caption>{caption}</caption>",
        f"<thead><tr><th>predictor, at a lead of</th>{head}<th>beyond bound</th></tr></thead>",
        "<tbody>",
    ]
    for name in predictors:
        row = "".join(
            f"<td{_best(cells[name, lead_s], best[lead_s])}>{_number(cells[name, lead_s])}</td>"
            for lead_s in leads
        )
        lines.append(f"<tr><td>{escape(name)}</td>{row}<td>{_violations(compared, name)}</td></tr>")
    return "\n".join([*lines, "</tbody></table>"])


def _by_uav(compared: Compared) -> str:
    """Every row of the study, folded away."""
    keys = (
        "uav", "predictor", "lead_s", "n", "angle_rms_deg", "angle_p95_deg", "angle_max_deg",
        "within_beamwidth", "se_loss_bps_hz", "position_rms_m", "position_p95_m",
        "position_max_m", "bound_violations", "bound_median_m", "bound_tightness", "truth",
    )  # fmt: skip
    head = "".join(f"<th>{key}</th>" for key in keys)
    body = "\n".join(
        "<tr>" + "".join(f"<td>{escape(_cell(row[key]))}</td>" for key in keys) + "</tr>"
        for row in compared.rows
    )
    return (
        f"<details><summary>each UAV</summary><table><thead><tr>{head}</tr></thead>\n"
        f"<tbody>{body}</tbody></table></details>"
    )


def _curves(compared: Compared) -> "Figure":
    """RMS angle (logarithmic) over lead, a line for each predictor; no point where none is above
    zero, for it has no place there."""
    from matplotlib.ticker import LogLocator

    leads, predictors = _axes(compared)
    figure, (axes,) = figures.new(1, 1, (7.2, 4.4))
    axes.set_yscale("log")
    for number, name in enumerate(predictors):
        cells = [pooled(compared.rows, name, lead_s) for lead_s in leads]
        angles = [cell or math.nan for cell in cells]
        axes.plot(leads, angles, label=name, **figures.marked(number))
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}°")
    axes.minorticks_off()
    axes.set_xticks(leads, [f"{lead_s:g}" for lead_s in leads])
    axes.set_xlabel("lead, s")
    axes.set_ylabel("RMS angle error")
    figures.below(figure, axes, 4)
    return figure


def _axes(compared: Compared) -> tuple[list[float], list[str]]:
    """The leads and the predictors, in the order in which they come."""
    leads = dict.fromkeys(row["lead_s"] for row in compared.rows)
    return list(leads), list(dict.fromkeys(row["predictor"] for row in compared.rows))


def _title(compared: Compared) -> str:
    return f"{compared.log}, {compared.link.name} link"


def _describe(compared: Compared) -> str:
    link, rows = compared.link, compared.rows
    uavs = ", ".join(dict.fromkeys(row["uav"] for row in rows))
    truth = " and ".join(dict.fromkeys(row["truth"] for row in rows))
    told = f"UAVs {uavs}; array at {compared.center}; truth: {truth}. "
    if link.latency_s is None:
        return told + "Reports as they arrived in the log."
    median_s, p95_s = link.latency_s
    known = ", its least value taken as known" if link.known_delay else ""
    return (
        f"{told}Reports thinned to {link.rate_hz:g} Hz, {link.loss:.0%} lost, latency lognormal"
        f" with median {median_s:g} s and 95th percentile {p95_s:g} s{known}."
    )


def _violations(compared: Compared, predictor: str) -> str:
    """How many of a predictor's errors went beyond its own bound, over all rows."""
    counts = [r["bound_violations"] for r in compared.rows if r["predictor"] == predictor]
    if None in counts:
        return "no bound"
    return f"{sum(counts)} of {sum(r['n'] for r in compared.rows if r['predictor'] == predictor)}"


def _best(value: float | None, best: float | None) -> str:
    return ' class="best"' if value is not None and value == best else ""


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
