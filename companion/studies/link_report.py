"""A link study for people: a table as text, one HTML page that needs nothing else, the figures."""

from collections.abc import Callable
from html import escape
from typing import Any, Final

from companion.studies import figures, link_figures
from companion.studies.link_rows import Row
from companion.studies.report import STYLE

_HEAD: Final = (
    "positions", "code", "SNR at BER 1e-3, dB", "BER at highest SNR", "Mbit/s at highest SNR",
    "pointing error, degrees: median / 95 %",
)  # fmt: skip


def files(answer: dict[str, Any], progress: Callable[[str], None]) -> dict[str, bytes]:
    """The page and every figure as PNG and SVG, by name of file."""
    drawings = link_figures.drawings(answer)
    return figures.files("link", drawings, lambda shown: _page(answer, shown), progress)


def text(answer: dict[str, Any]) -> str:
    """What each kind of positions needs and ends at."""
    lines = [answer["scenario"]["description"], "  ".join(f"{word:>12}" for word in (
        "positions", "code", "dB at 1e-3", "BER at best", "Mbit/s", "degrees off"))]  # fmt: skip
    lines += ["  ".join(f"{cell:>12}" for cell in _cells(row)) for row in answer["summary"]]
    return "\n".join(lines)


def _cells(row: Row) -> list[str]:
    needed, off = row["snr_at_ber_1e-3_db"], row.get("pointing_error_median_deg")
    return [
        row["positions"],
        "rate 1/3" if row["coded"] else "none",
        "-" if needed is None else f"{needed:.2f}",
        f"{row['ber_at_highest_snr']:.1e}",
        f"{row['rate_at_highest_snr_bps'] / 1e6:.1f}",
        "-" if off is None else f"{off:.2f} / {row['pointing_error_p95_deg']:.2f}",
    ]


def _page(answer: dict[str, Any], shown: dict[str, str]) -> str:
    """The whole report as one HTML document, without anything from elsewhere."""
    told = answer["scenario"]
    versions = ", ".join(f"{name} {version}" for name, version in answer["versions"].items())
    head = "".join(f"<th>{escape(word)}</th>" for word in _HEAD)
    body = "\n".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in _cells(row)) + "</tr>"
        for row in answer["summary"]
    )
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>The link, bit by bit</title>
<style>{STYLE}</style>
</head>
<body>
<h1>The link, bit by bit</h1>
<p>{escape(told["description"])}; {escape(told["array"])}, zero forcing; {told["uav_antennas"]}
antennas on each UAV; {told["instants"]} instants. {told["unresolved_share"]:.1%} of the time not
even the true directions let the array tell all UAVs apart: that time is left out.</p>
<p>16-QAM (Gray) on OFDM, 50 MHz: 256 carriers, 234 with data, 8 pilots, prefix 64; convolutional
code of rate 1/3, constraint length 7, generators 133 171 165, soft Viterbi decoding. The SNR is of
a data carrier at a UAV with a beam exactly on it, for it alone, on the line of sight: the same for
every UAV. The same bits, channels and noise for all kinds of positions.</p>
<p>Simplified: the prefix is not charged to the SNR; delays are whole samples; nothing moves within
an OFDM symbol; time and frequency are followed exactly; amplifiers are linear. There is no
interleaver: scattered rays are so far below the beam that carriers hardly differ.</p>
<p><code>{escape(answer["command"])}</code><br>{escape(versions)}; seed {answer["seed"]}</p>
<table><thead><tr>{head}</tr></thead>
<tbody>
{body}
</tbody></table>
{"".join(shown.values())}
</body>
</html>
"""
