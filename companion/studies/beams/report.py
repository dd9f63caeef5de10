"""Reports of the beam study: a table as text, one self-contained HTML page, and figures."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

from companion.studies.beams import modes
from companion.studies.beams.charts import charts
from companion.studies.beams.flight import StudiedFlight
from companion.studies.beams.worth import SHARP, cell, summed_up
from companion.studies.figures import plotting
from companion.studies.figures.text_tables import text_table
from companion.studies.origin import Progress, Row, by_log

COMPARED: Final = (
    ("predicted gain, dB: 5 % / median", ("gain_p5_db", "gain_median_db")),
    ("true gain, dB: 5 % / median", ("true_gain_p5_db", "true_gain_median_db")),
    ("looks with a guarantee", ("guaranteed_share",)),
    ("guaranteed gain, dB: 5 % / median", ("guaranteed_gain_p5_db", "guaranteed_gain_median_db")),
    ("true gain below guaranteed / within the bound", ("violations", "violations_within_bound")),
    ("loss, dB: median / 95 %", ("loss_median_db", "loss_p95_db")),
    ("predicted SINR, dB: median", ("sinr_median_db",)),
    ("spectral efficiency, bit/s/Hz: mean", ("spectral_efficiency_mean",)),
    ("widened", ("widened_share",)),
    ("regularised", ("regularised_share",)),
    ("time slots: most", ("turns_max",)),
    ("condition number: largest", ("condition_number_max",)),
)
"""Keys of figures that are shown for beams as set and for sharp beams, side by side."""
AS_FOUND: Final = (
    ("looks with a beam", ("n",)),
    ("tracked without a beam", ("without_beam",)),
    (
        "pointing bound, degrees: median / 95 %",
        ("pointing_bound_median_deg", "pointing_bound_p95_deg"),
    ),
    ("pointing error, degrees: 95 %", ("pointing_error_p95_deg",)),
    ("true direction beyond the bound", ("bound_violations",)),
    ("share of the codebook to sweep: mean / 95 %", ("sweep_share_mean", "sweep_share_p95")),
    (
        "best stored beam not in that share / within the bound",
        ("codebook_misses", "codebook_misses_within_bound"),
    ),
)
"""Keys of figures that do not depend on the beam width."""

_CAPTIONS: Final = {
    "gain": "Array gain over time, the least in each interval. A gap in the line of the guaranteed"
    " gain means that no gain is guaranteed: the cone of possible directions contains a null.",
    "gain_had": "Share of looks with at least a given gain: towards the predicted direction,"
    " towards the true one, and guaranteed within the pointing bound. Sharp:"
    ' [beams] widen = "no".',
    "sweep": "Share of the stored beams that must be swept to include the best one, the largest in"
    " each interval.",
}


def files(
    answer: dict[str, Any], found: Sequence[StudiedFlight], progress: Progress
) -> dict[str, bytes]:
    """Return the page and every figure as SVG and PNG, by file name.

    Figures of the second and later logs are numbered.
    """
    drawings: dict[str, tuple[str, plotting.Draw]] = {}
    sections = []
    for number, watched in enumerate(found, 1):
        suffix = "" if number == 1 else f"_{number}"
        made = {
            f"{name}{suffix}": (_CAPTIONS[name], draw) for name, draw in charts(watched).items()
        }
        drawings |= made
        sections.append(_section(watched, made))
    compared = [modes.cells(row) for row in answer["modes"]]
    head = [words for words, _ in modes.COLUMNS]
    values = {"answer": answer, "sections": sections, "modes": compared, "modes_head": head}
    return plotting.files("beams", "beams/report.html.j2", drawings, values, progress)


def text(found: Sequence[StudiedFlight], compared: Sequence[Row] = ()) -> str:
    """Return the tables of the study as text, all UAVs of a log together."""
    parts = [_text(watched) for watched in found]
    parts += [
        f"{log}, three widths and three other predictors, gains in dB:\n{modes.text(rows)}"
        for log, rows in by_log(compared).items()
    ]
    return "\n\n".join(parts)


def _text(watched: StudiedFlight) -> str:
    row = summed_up(watched.samples)
    rows = [(label, _cells(row, keys, ""), "") for label, keys in AS_FOUND]
    rows.append(("", "as set", "sharp"))
    rows += [(label, _cells(row, keys, ""), _cells(row, keys, SHARP)) for label, keys in COMPARED]
    return f"{_describe(watched)}\n{text_table(rows)}"


def _section(watched: StudiedFlight, figures: Iterable[str]) -> dict[str, Any]:
    row = summed_up(watched.samples)
    by_uav = {uav: summed_up(samples) for uav, samples in watched.by_uav.items()}
    return {
        "log": watched.log,
        "told": _describe(watched),
        "as_found": [(label, _cells(row, keys, "")) for label, keys in AS_FOUND],
        "compared": [
            (label, _cells(row, keys, ""), _cells(row, keys, SHARP)) for label, keys in COMPARED
        ],
        "figures": list(figures),
        "uavs": ["", *by_uav],
        "by_uav": [
            [key, *(cell(key, found[key]) for found in by_uav.values())]
            for key in next(iter(by_uav.values()))
        ],
    }


def _describe(watched: StudiedFlight) -> str:
    stored = watched.codebook_beams
    return (
        f"{watched.log}: {watched.array}, on {watched.center};"
        f" UAVs {', '.join(watched.by_uav)}; {watched.looks} looks;"
        f" {'no codebook' if stored is None else f'codebook of {stored} beams'};"
        f" truth: {watched.truth or 'none'}; beams {'' if watched.widen else 'not '}widened"
    )


def _cells(row: Row, keys: Sequence[str], prefix: str) -> str:
    return " / ".join(cell(key, row[prefix + key]) for key in keys)
