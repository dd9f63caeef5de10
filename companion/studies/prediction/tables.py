"""Tables of the prediction study as text."""

from collections.abc import Sequence

from companion.studies.figures.text_tables import decimal, text_table
from companion.studies.prediction import summary
from companion.studies.prediction.comparison import LogComparison
from companion.studies.prediction.summary import MEASURES, pooled


def text(found: Sequence[LogComparison]) -> str:
    """Return the tables: RMS angle at each lead, every measure at the longest, and the regimes."""
    shown = [compared for compared in found if compared.rows]
    tables = [
        table(each) for each in shown for table in (_text_table, _text_measures, _text_regimes)
    ]
    return "\n\n".join(table for table in tables if table)


def _text_table(compared: LogComparison) -> str:
    leads, predictors = summary.axes_of(compared)
    rows = [["", *(f"{lead_s:g} s" for lead_s in leads), "beyond bound"]]
    for name in predictors:
        cells = [decimal(pooled(compared.rows, name, lead_s), 3) for lead_s in leads]
        rows.append([name, *cells, summary.broken(compared, name)])
    title = f"{summary.title(compared)}: RMS angle error, degrees, at a lead of"
    return "\n".join(
        [title, text_table(rows), *(f"  {words}" for words in summary.left_out(compared))]
    )


def _text_measures(compared: LogComparison) -> str:
    leads, predictors = summary.axes_of(compared)
    lead_s = max(leads)
    rows = [["", *(measure.short for measure in MEASURES)]]
    for name in predictors:
        cells = (pooled(compared.rows, name, lead_s, measure) for measure in MEASURES)
        rows.append([name, *(decimal(cell, 3) for cell in cells)])
    title = f"{summary.title(compared)}: at a lead of {lead_s:g} s; p95 and max of the worst UAV"
    return f"{title}\n{text_table(rows)}"


def _text_regimes(compared: LogComparison) -> str:
    """Return the violated bounds over a hostile link; empty over others."""
    regimes = summary.regimes(compared)
    if not regimes:
        return ""
    rows = [["", *regimes[0][1]], *([regime, *cells.values()] for regime, cells in regimes)]
    title = f"{summary.title(compared)}: beyond bound, of them announced, of answers, in the regime"
    return f"{title}\n{text_table(rows)}"
