"""A beam study for people: a table as text, one HTML page that needs nothing else, and figures."""

from collections.abc import Callable, Sequence
from html import escape
from typing import Any, Final

from companion.studies import figures
from companion.studies.beam_charts import charts
from companion.studies.beam_worth import SHARP, Row, summed_up
from companion.studies.beams import Watched
from companion.studies.report import STYLE

COMPARED: Final = (
    ("predicted gain, dB: 5 % / median", ("gain_p5_db", "gain_median_db")),
    ("true gain, dB: 5 % / median", ("true_gain_p5_db", "true_gain_median_db")),
    ("looks with a guarantee", ("guaranteed_share",)),
    (
        "guaranteed gain, dB: 5 % / median",
        ("guaranteed_gain_p5_db", "guaranteed_gain_median_db"),
    ),
    ("truly less than guaranteed / within the bound", ("violations", "violations_within_bound")),
    ("loss, dB: median / 95 %", ("loss_median_db", "loss_p95_db")),
    ("predicted SINR, dB: median", ("sinr_median_db",)),
    ("spectral efficiency, bit/s/Hz: mean", ("spectral_efficiency_mean",)),
    ("widened", ("widened_share",)),
    ("regularised", ("regularised_share",)),
    ("turns: most", ("turns_max",)),
    ("condition number: largest", ("condition_number_max",)),
)
"""What is told of the beams as set and of sharp ones, side by side."""
AS_FOUND: Final = (
    ("looks with a beam", ("n",)),
    ("tracked without a beam", ("without_beam",)),
    (
        "pointing bound, degrees: median / 95 %",
        ("pointing_bound_median_deg", "pointing_bound_p95_deg"),
    ),
    ("pointing error, degrees: 95 %", ("pointing_error_p95_deg",)),
    ("truly beyond the bound", ("bound_violations",)),
    ("share of the codebook to be swept: mean / 95 %", ("sweep_share_mean", "sweep_share_p95")),
    (
        "best stored beam not in that share / within the bound",
        ("codebook_misses", "codebook_misses_within_bound"),
    ),
)
"""What does not depend on how the beams are made."""

_CAPTIONS: Final = {
    "gain": "Array gain over time, at its least in each interval. Where the line of the guaranteed"
    " gain is missing nothing is guaranteed: the cone of possible directions holds a null.",
    "gain_had": "The share of looks at which a gain is at least so much: towards the predicted"
    " direction, towards the true one, and wherever the UAV may be within its bound. Sharp:"
    " [beams] widen = false.",
    "sweep": "The share of the stored beams that must be swept to be sure of the best, at its"
    " largest in each interval.",
}


def files(
    answer: dict[str, Any], found: Sequence[Watched], progress: Callable[[str], None]
) -> dict[str, bytes]:
    """The page and every figure as SVG and PNG, by name of file; figures of the second log and
    those after it are numbered."""
    drawn: list[dict[str, figures.Draw]] = []
    captions: dict[str, str] = {}
    for number, watched in enumerate(found, 1):
        suffix = "" if number == 1 else f"_{number}"
        made = charts(watched)
        captions |= {f"{name}{suffix}": _CAPTIONS[name] for name in made}
        drawn.append({f"{name}{suffix}": draw for name, draw in made.items()})
    drawings = {name: (captions[name], draw) for each in drawn for name, draw in each.items()}

    def page(shown: dict[str, str]) -> str:
        return _page(answer, found, [[shown[name] for name in each] for each in drawn])

    return figures.files("beams", drawings, page, progress)


def text(found: Sequence[Watched]) -> str:
    """The tables as text, all UAVs of a log together."""
    return "\n\n".join(_text(watched) for watched in found)


def _text(watched: Watched) -> str:
    row = summed_up(watched.samples)
    lines = [_describe(watched)]
    lines += [f"  {label:54}{_cells(row, keys, ''):>16}" for label, keys in AS_FOUND]
    lines.append(f"  {'':54}{'as set':>16}{'sharp':>16}")
    for label, keys in COMPARED:
        lines.append(f"  {label:54}{_cells(row, keys, ''):>16}{_cells(row, keys, SHARP):>16}")
    return "\n".join(lines)


def _page(answer: dict[str, Any], found: Sequence[Watched], shown: Sequence[Sequence[str]]) -> str:
    """The whole report as one HTML document, without anything from elsewhere."""
    sections = "\n".join(
        _section(watched, inlined) for watched, inlined in zip(found, shown, strict=True)
    )
    versions = ", ".join(f"{name} {version}" for name, version in answer["versions"].items())
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Beams over a flight</title>
<style>{STYLE}</style>
</head>
<body>
<h1>Beams over a flight</h1>
<p>What the array would have done, looked at {answer["hz"]:g} times a second: what each beam gives
by the prediction, what it is sure to give wherever the UAV may be within its pointing bound, and
what it truly gave, where the log has the simulator's truth. <em>As set</em> are the beams of the
settings, <em>sharp</em> the same with <code>[beams] widen = false</code>.</p>
<p><code>{escape(answer["command"])}</code><br>{escape(versions)}</p>
{sections}
</body>
</html>
"""


def _section(watched: Watched, inlined: Sequence[str]) -> str:
    row = summed_up(watched.samples)
    parts = [f"<section><h2>{escape(watched.log)}</h2>", f"<p>{escape(_describe(watched))}</p>"]
    parts.append("<table><tbody>")
    parts += [
        f"<tr><td>{label}</td><td>{_cells(row, keys, '')}</td></tr>" for label, keys in AS_FOUND
    ]
    parts.append("</tbody></table>")
    parts.append(
        "<table><thead><tr><th>beams</th><th>as set</th><th>sharp</th></tr></thead><tbody>"
    )
    parts += [
        f"<tr><td>{label}</td><td>{_cells(row, keys, '')}</td>"
        f"<td>{_cells(row, keys, SHARP)}</td></tr>"
        for label, keys in COMPARED
    ]
    parts.append("</tbody></table>")
    return "\n".join([*parts, *inlined, _by_uav(watched), "</section>"])


def _by_uav(watched: Watched) -> str:
    """Every figure of each UAV, folded away."""
    rows = {uav: summed_up(samples) for uav, samples in watched.by_uav.items()}
    head = "".join(f"<th>{escape(uav)}</th>" for uav in rows)
    body = "\n".join(
        f"<tr><td>{key}</td>"
        + "".join(f"<td>{_cell(key, row[key])}</td>" for row in rows.values())
        + "</tr>"
        for key in next(iter(rows.values()))
    )
    return (
        f"<details><summary>each UAV</summary><table><thead><tr><th></th>{head}</tr></thead>\n"
        f"<tbody>{body}</tbody></table></details>"
    )


def _describe(watched: Watched) -> str:
    stored = watched.codebook_beams
    return (
        f"{watched.log}: {watched.array}, on {watched.center};"
        f" UAVs {', '.join(watched.by_uav)}; {watched.looks} looks;"
        f" {'no codebook' if stored is None else f'codebook of {stored} beams'};"
        f" truth: {watched.truth or 'none'}; beams {'' if watched.widen else 'not '}widened"
    )


def _cells(row: Row, keys: Sequence[str], prefix: str) -> str:
    return " / ".join(_cell(key, row[prefix + key]) for key in keys)


def _cell(key: str, value: float | None) -> str:
    if value is None:
        return "-"
    if "share" in key:
        return f"{value:.1%}"
    return str(value) if isinstance(value, int) else f"{value:.2f}"
