"""``companion design``: one row of the answer, by the closed form or by the LMI."""

from typing import Any

import numpy as np

from companion.tracking import design


def row(
    dt_s: float,
    feedthrough_s: float,
    alpha: float | None,
    mu_max: float | None,
    model: str,
    method: str,
) -> dict[str, Any]:
    """The design for one interval, with the keys of ``companion design --json``.

    ``ValueError`` for an interval or alpha out of range; ``LmiError`` if the solver fails.
    """
    found = design.design(dt_s, feedthrough_s, alpha)
    values = {
        "L": found.l_gain,
        "Q": found.q,
        "mu": found.mu,
        "gamma": found.gamma,
        "peak_gain": found.peak_gain,
        "residual": found.residual,
    }
    if method == "lmi":
        values = _by_lmi(dt_s, feedthrough_s, found.alpha)
    return {
        "dt_s": dt_s,
        "model": model,
        "alpha": found.alpha,
        "feedthrough_s": feedthrough_s,
        **values,
        "feasible": mu_max is None or values["mu"] <= mu_max * (1 + 1e-9),
        "dt_limit_s": None
        if mu_max is None
        else design.dt_limit_s(mu_max, feedthrough_s, found.alpha),
        "method": method,
    }


def _by_lmi(dt_s: float, feedthrough_s: float, alpha: float) -> dict[str, float]:
    """The same axis by CVXPY and Clarabel, which only this loads."""
    from companion.tracking import lmi

    one = np.eye(1)
    solved = lmi.solve(one, dt_s * one, one, feedthrough_s * one, one, alpha)
    gain = float(solved.gain[0, 0])
    return {
        "L": gain,
        "Q": 1 - gain,
        "mu": solved.mu,
        "gamma": float(np.sqrt(solved.mu)),
        "peak_gain": float(design.peak_gain(dt_s, feedthrough_s, gain)),
        "residual": solved.margin,
    }
