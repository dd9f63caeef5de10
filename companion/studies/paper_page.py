"""The reproduction for people: one HTML page that needs nothing else, figures, claims as text."""

from collections.abc import Callable, Sequence
from html import escape
from typing import Any

from companion.studies import figures, paper_figures
from companion.studies.paper import Material
from companion.studies.report import STYLE

MORE_STYLE = """
td.words { text-align: left; vertical-align: top; }
td.verdict { text-align: left; font-weight: 700; vertical-align: top; }
td.key { text-align: left; vertical-align: top; font-size: .75em; overflow-wrap: anywhere;
  min-width: 7rem; }
th.words, th.verdict, th.key { text-align: left; }
"""
ABOUT = """A. Mohammadi, M. Rahmati and H. Malik, “Location-aware Beamforming for MIMO-enabled UAV
Communications: An Unknown Input Observer Approach”. Four UAVs circle an array at 0.5 rad/s; each
reports every 0.15 s where it will be half a second on; the array predicts one report ahead and
makes its beams from that. The scenario is taken as it is written, the gust as d/ΔT.
The paper's text was not at hand: statements are in our words, after notes on it, and some are what
it takes for granted rather than says. Reports have no noise here, so that with L = ΔT/δ the beam
points without error: the comparison under blockage shows what the method can be worth at most."""


def paper_files(
    answer: dict[str, Any], material: Material, progress: Callable[[str], None]
) -> dict[str, bytes]:
    """The page ``paper.html`` and its figures."""
    drawings = paper_figures.drawings(answer, material)
    return figures.files("paper", drawings, lambda shown: _paper(answer, shown), progress)


def text(answer: dict[str, Any]) -> str:
    """The claims and their verdicts, a line each."""
    return "\n".join(f"{row['verdict']:24} {row['statement']}" for row in answer["claims"])


def document(title: str, answer: dict[str, Any], body: str) -> str:
    """A whole page: the command and the versions that made it, and a body."""
    made = ", ".join(f"{name} {number}" for name, number in answer["versions"].items())
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{escape(title)}</title>
<style>{STYLE}{MORE_STYLE}</style>
</head>
<body>
<h1>{escape(title)}</h1>
<p><code>{escape(answer["command"])}</code><br>{escape(made)}</p>
{body}
</body>
</html>
"""


def table(
    caption: str, head: Sequence[str], rows: Sequence[Sequence[str]], classes: str = ""
) -> str:
    """A table of cells that are text already; ``classes``: one letter a column, w for words, v for
    a verdict and k for a key, any other for a number."""
    named = {"w": ' class="words"', "v": ' class="verdict"', "k": ' class="key"'}
    kinds = [named.get(letter, "") for letter in classes.ljust(len(head))]
    lines = [f"<table><caption>{escape(caption)}</caption><thead><tr>"]
    lines += [f"<th{kind}>{escape(name)}</th>" for name, kind in zip(head, kinds, strict=True)]
    lines.append("</tr></thead><tbody>")
    for row in rows:
        cells = zip(row, kinds, strict=True)
        lines.append("<tr>" + "".join(f"<td{k}>{escape(c)}</td>" for c, k in cells) + "</tr>")
    return "\n".join([*lines, "</tbody></table>"])


def _paper(answer: dict[str, Any], shown: dict[str, str]) -> str:
    mavlink = answer["mavlink"]
    sections = [
        ("Claims", _claims(answer)),
        ("Paths and predictions", shown["paths"] + shown["coordinates"] + shown["errors"]),
        ("Unknown input", shown["unknown_input"] + shown["alphas"] + _inputs(answer)),
        ("Gains and limits", _gains(answer) + shown["limits"] + _limits(answer)),
        ("Rates", shown["rates"]),
        ("Beams", shown["surfaces"] + shown["cuts"] + shown["polar"] + _beams(answer)),
        ("Under blockage", shown["blockage"]),
        (
            "Through MAVLink",
            f"<p>The same flight as GLOBAL_POSITION_INT frames through the whole service:"
            f" {mavlink['reports']} reports, {mavlink['rejections']} refused. Its predictions and"
            f" the library's differ by {1e3 * mavlink['estimate_m']:.1f} mm at most, its beams by"
            f" {mavlink['direction_deg']:.4f}°: the rounding of the message. At the end the"
            f" prediction is {1e3 * mavlink['settled_m']:.1f} mm off the truth.</p>",
        ),
    ]
    body = "\n".join(f"<section><h2>{title}</h2>\n{part}</section>" for title, part in sections)
    return document("The published experiments, made again", answer, f"<p>{ABOUT}</p>\n{body}")


def _claims(answer: dict[str, Any]) -> str:
    rows = [
        (row["statement"], row["found"], row["verdict"], row["correction"], row["key"])
        for row in answer["claims"]
    ]
    head = ("statement", "found", "verdict", "correction", "number in paper.json")
    return table("Every claim and what became of it", head, rows, "wwvwk")


def _inputs(answer: dict[str, Any]) -> str:
    keys = (
        "b0_in_scenario", "b0_peak", "b0_adversary", "published_3_gamma", "safe_2_gamma_over_dt",
        "bd_in_scenario", "bd_peak", "bd_bound",
    )  # fmt: skip
    rows = [
        (name, *(f"{row[key]:.3f}" for key in keys))
        for name, row in answer["unknown_input"].items()
    ]
    head = (
        "gain", "[B; 0] here", "exact peak", "adversary", "published 3γ", "2γ/ΔT",
        "[B; D] here", "exact peak", "√5‖G†‖γ",
    )  # fmt: skip
    return table("Error of the unknown input over sup‖W‖, and its bounds", head, rows)


def _gains(answer: dict[str, Any]) -> str:
    rows = [
        (
            f"{row['alpha']:g}", f"{row['mu_max_s2']:g}",
            "-" if row["paper_gain"] is None else f"{row['paper_gain']:.2f}",
            f"{row['feasible_gain']:.3f}", f"{row['feasible_q']:.3f}",
            f"{row['feasible_gamma_s']:.3f}", f"{row['optimal_gain']:.4f}",
            f"{row['optimal_gamma_s']:.4f}", f"{row['closed_form_gain']:.4f}",
            f"{row['closed_form_gamma_s']:.4f}",
        )
        for row in answer["designs"]
    ]  # fmt: skip
    head = (
        "α", "μ ≤, s²", "paper's L", "feasible L", "Q", "γ, s", "solver's least: L", "γ, s",
        "closed form: L", "γ, s",
    )  # fmt: skip
    return (
        table("Gains at ΔT = 0.15 s, δ = 0.5 s: feasible and optimal", head, rows)
        + "<p>Where the least μ is 0 no P attains it: the solver's small γ is the start of a"
        " descent, the closed form its limit.</p>"
    )


def _limits(answer: dict[str, Any]) -> str:
    rows = [
        (mu, f"{row['limit_s']:.4f}", f"{row['first_infeasible_s']:.2f}", f"{row['paper_s']:.2f}")
        for mu, row in answer["limits"].items()
    ]
    head = ("μ ≤, s²", "largest ΔT, s", "first infeasible on the grid, s", "paper, s")
    return table("Largest interval between reports, α = δ = 0.5", head, rows)


def _beams(answer: dict[str, Any]) -> str:
    rows = [
        (
            size, f"±{row['half_power_deg']:.2f}", f"±{row['first_null_deg']:.2f}",
            f"{row['side_lobe_db']:.1f}",
            *(f"{loss:.3f}" for loss in row["phase_step_loss_db"].values()),
        )
        for size, row in answer["array"]["sizes"].items()
    ]  # fmt: skip
    head = (
        "elements", "half power, °", "first null, °", "side lobe, dB", "2 bits: loss, dB",
        "3 bits", "4 bits", "5 bits",
    )  # fmt: skip
    return table("The beam ahead, and what phase shifters of few bits cost", head, rows)
