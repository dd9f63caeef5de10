"""Reports of the link study: a plain-text table, one self-contained HTML page, and figures."""

from typing import Any

from companion.studies.figures import plotting
from companion.studies.figures.text_tables import decimal, text_table
from companion.studies.link import figures
from companion.studies.origin import Progress, Row


def files(answer: dict[str, Any], progress: Progress) -> dict[str, bytes]:
    """Return the page and every figure as PNG and SVG, by file name."""
    values = {"answer": answer, "rows": [_cells(row) for row in answer["summary"]]}
    return plotting.files("link", "link/report.html.j2", figures.drawings(answer), values, progress)


def text(answer: dict[str, Any]) -> str:
    """Return a table of required SNRs by kind of positions, and results at the highest SNR."""
    head = ["positions", "code", "dB at 1e-3", "BER at best", "Mbit/s", "error, degrees"]
    rows = text_table([head, *map(_cells, answer["summary"])])
    return f"{answer['scenario']['description']}\n{rows}"


def _cells(row: Row) -> list[str]:
    needed, off = row["snr_at_ber_1e-3_db"], row.get("pointing_error_median_deg")
    return [
        row["positions"],
        "rate 1/3" if row["coded"] else "none",
        decimal(needed),
        f"{row['ber_at_highest_snr']:.1e}",
        f"{row['rate_at_highest_snr_bps'] / 1e6:.1f}",
        "-" if off is None else f"{off:.2f} / {row['pointing_error_p95_deg']:.2f}",
    ]
