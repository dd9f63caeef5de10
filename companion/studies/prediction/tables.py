"""The tables of the prediction study as text."""

from collections.abc import Sequence

from companion.studies.prediction import summary
from companion.studies.prediction.comparison import LogComparison
from companion.studies.prediction.summary import MEASURES, pooled


def text(found: Sequence[LogComparison]) -> str:
    """The tables as text: RMS angle at each lead, every measure at the longest, and the regimes."""
    shown = [compared for compared in found if compared.rows]
    tables = [
        table(each) for each in shown for table in (_text_table, _text_measures, _text_regimes)
    ]
    return "\n\n".join(table for table in tables if table)


def _text_table(compared: LogComparison) -> str:
    leads, predictors = summary.axes_of(compared)
    lines = [
        f"{summary.title(compared)}: RMS angle error, degrees, at a lead of",
        " " * 26 + "".join(f"{lead_s:>9g} s" for lead_s in leads) + "   beyond bound",
    ]
    for name in predictors:
        cells = [pooled(compared.rows, name, lead_s) for lead_s in leads]
        numbers = "".join(f"{summary.number(cell):>11}" for cell in cells)
        lines.append(f"  {name:24}{numbers}   {summary.broken(compared, name)}")
    lines += [f"  {words}" for words in summary.left_out(compared)]
    return "\n".join(lines)


def _text_measures(compared: LogComparison) -> str:
    leads, predictors = summary.axes_of(compared)
    lead_s = max(leads)
    lines = [
        f"{summary.title(compared)}: at a lead of {lead_s:g} s; p95 and max of the worst UAV",
        " " * 26 + "".join(f"{measure.short:>10}" for measure in MEASURES),
    ]
    for name in predictors:
        cells = [pooled(compared.rows, name, lead_s, measure) for measure in MEASURES]
        lines.append(f"  {name:24}" + "".join(f"{summary.number(cell):>10}" for cell in cells))
    return "\n".join(lines)


def _text_regimes(compared: LogComparison) -> str:
    """Where bounds were broken over a hostile link; empty over others."""
    regimes = summary.regimes(compared)
    if not regimes:
        return ""
    names = list(regimes[0][1])
    lines = [
        f"{summary.title(compared)}: beyond bound, of them announced, of answers, in the regime",
        " " * 14 + "".join(f"{name:>24}" for name in names),
    ]
    for regime, cells in regimes:
        lines.append(f"  {regime:12}" + "".join(f"{cell:>24}" for cell in cells.values()))
    return "\n".join(lines)
