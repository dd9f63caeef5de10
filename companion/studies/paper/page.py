"""Reports of the reproduction: one self-contained HTML page, figures, and claims as text."""

from typing import Any

from companion.studies.figures import plotting
from companion.studies.origin import Progress
from companion.studies.paper import figures
from companion.studies.paper.experiments import Material

Rows = list[tuple[str, ...]]


def paper_files(answer: dict[str, Any], material: Material, progress: Progress) -> dict[str, bytes]:
    """Return the page ``paper.html`` and its figures."""
    values = {
        "answer": answer,
        "inputs": _inputs(answer),
        "gains": _gains(answer),
        "limits": _limits(answer),
        "beams": _beams(answer),
    }
    drawings = figures.drawings(answer, material)
    return plotting.files("paper", "paper/page.html.j2", drawings, values, progress)


def text(answer: dict[str, Any]) -> str:
    """Return the paper's claims with their verdicts, one line each."""
    return "\n".join(f"{row['verdict']:24} {row['statement']}" for row in answer["claims"])


def _inputs(answer: dict[str, Any]) -> Rows:
    keys = (
        "b0_in_scenario", "b0_peak", "b0_adversary", "published_3_gamma", "safe_2_gamma_over_dt",
        "bd_in_scenario", "bd_peak", "bd_bound",
    )  # fmt: skip
    return [
        (name, *(f"{row[key]:.3f}" for key in keys))
        for name, row in answer["unknown_input"].items()
    ]


def _gains(answer: dict[str, Any]) -> Rows:
    return [
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


def _limits(answer: dict[str, Any]) -> Rows:
    return [
        (mu, f"{row['limit_s']:.4f}", f"{row['first_infeasible_s']:.2f}", f"{row['paper_s']:.2f}")
        for mu, row in answer["limits"].items()
    ]


def _beams(answer: dict[str, Any]) -> Rows:
    return [
        (
            size, f"±{row['half_power_deg']:.2f}", f"±{row['first_null_deg']:.2f}",
            f"{row['side_lobe_db']:.1f}",
            *(f"{loss:.3f}" for loss in row["phase_step_loss_db"].values()),
        )
        for size, row in answer["array"]["sizes"].items()
    ]  # fmt: skip
