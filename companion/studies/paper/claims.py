"""Claims of the published method, each decided by one number of the study.

A claim names that number by its path in the study's answer. Verdict and text are computed from
the number and cannot disagree with it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final


class ClaimVerdict(StrEnum):
    """Verdict on a claim of the paper."""

    HOLDS = "holds"
    CORRECTED = "holds with a correction"
    FAILS = "does not hold"


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """Claim of the paper and the criterion for its verdict."""

    statement: str  # text of the claim
    key: str  # path of the deciding number
    found: str  # result, with {value} in place of the number
    verdict: Callable[[float], ClaimVerdict]  # verdict for a number
    correction: str = ""  # correction for a reader of the paper


def lookup(answer: dict[str, Any], key: str) -> float:
    """Return the number at a path in the study's answer, such as ``levels/L = 0.39/gamma_s``.

    Raises ``KeyError`` if the path does not lead to a number.
    """
    place: Any = answer
    for part in key.split("/"):
        try:
            place = place[int(part)] if isinstance(place, list) else place[part]
        except (ValueError, IndexError, TypeError) as error:
            raise KeyError(key) from error
    if isinstance(place, bool) or not isinstance(place, int | float):
        raise KeyError(key)
    return place


def judge(answer: dict[str, Any]) -> list[dict[str, Any]]:
    """Return every claim with its deciding number, the result and the verdict."""
    return [
        {
            "statement": claim.statement,
            "key": claim.key,
            "value": (value := lookup(answer, claim.key)),
            "found": claim.found.format(value=value),
            "verdict": claim.verdict(value),
            "correction": claim.correction,
        }
        for claim in CLAIMS
    ]


_HOLDS, _CORRECTED, _FAILS = ClaimVerdict.HOLDS, ClaimVerdict.CORRECTED, ClaimVerdict.FAILS
_NEVER_OFF_S: Final = 1e-9


def _limit(mu: str, infeasible: str) -> Claim:
    return Claim(
        statement=f"With α = δ = 0.5 and μ ≤ {mu} s² the design becomes infeasible at ΔT ="
        f" {infeasible} s.",
        key=f"limits/{mu}/off_s",
        found="the first infeasible interval on the paper's grid of 0.01 s differs by {value:.2f}"
        " s",
        verdict=lambda off: _HOLDS if off < _NEVER_OFF_S else _FAILS,
        correction="No search is needed: ΔT_max = δ + √(αμ + (1−α)δ²).",
    )


def _bounded(name: str) -> Claim:
    return Claim(
        statement=f"The error stays below γ sup‖W‖ ({name}).",
        key=f"levels/{name}/error_over_gamma_bound",
        found="the largest error over many turns is {value:.3f} of the bound with the least γ of"
        " this gain",
        verdict=lambda share: _HOLDS if share <= 1 else _FAILS,
    )


CLAIMS: Final = (
    Claim(
        statement="The design is the linear matrix inequality as printed, with last diagonal block"
        " +P.",
        key="designs/0/printed_sign_eigenvalue",
        found="in the “⪯ 0” form the printed matrix has an eigenvalue of {value:+.2f}; with P ≻ 0"
        " on its diagonal it is never negative semidefinite",
        verdict=lambda eigenvalue: _CORRECTED if eigenvalue > 0 else _HOLDS,
        correction="The last block must be −P. The inequality is then feasible and the guarantee"
        " follows.",
    ),
    Claim(
        statement="D is an N × 2N matrix.",
        key="scenario/feedthrough_matrix_rows",
        found="the reports of the four UAVs in the plane have {value:d} rows; D needs as many",
        verdict=lambda rows: _CORRECTED if rows != 4 else _HOLDS,
        correction="D is 2N × 2N: with Y = X + D W it has one row per reported coordinate.",
    ),
    _bounded("L = 0.39"),
    _bounded("L = 0.60"),
    _bounded("L = 0.76"),
    Claim(
        statement="L = 0.39, 0.60 and 0.76 are the gains for the three performance levels.",
        key="designs/0/feasible_gain",
        found="a feasibility solver at μ ≤ 0.05 returns {value:.3f}: close, but its own choice",
        verdict=lambda gain: _HOLDS if abs(gain - 0.39) < 0.005 else _CORRECTED,
        correction="At each level a whole interval of gains is feasible, and the solver picks one."
        " Another solver returns other digits.",
    ),
    Claim(
        statement="The gains of the three levels are the best of the method at ΔT = 0.15 s.",
        key="levels/L = 0.39/angle_error_deg",
        found="with L = 0.39 the direction error reaches {value:.2f}°, with L = ΔT/δ = 0.30 it is"
        " 0",
        verdict=lambda degrees: _FAILS if degrees > 0.01 else _HOLDS,
        correction="They are feasible, not optimal. For |ΔT − δ| < δ√(1−α) the infimum of μ is 0,"
        " approached at L = ΔT/δ, which cancels the unknown input.",
    ),
    Claim(
        statement="The three gains have performance levels γ = 0.21, 0.47 and 0.96 s.",
        key="levels/L = 0.39/gamma_s",
        found="these are certified by that solution; the least γ of the first gain is"
        " {value:.3f} s",
        verdict=lambda gamma: _CORRECTED if gamma < 0.205 else _HOLDS,
        correction="γ depends on the solution, not only on the gain: the same gains have"
        " guarantees up to three times tighter.",
    ),
    Claim(
        statement="At one level (μ ≤ 0.25 s²) the errors decrease with α (0.5, 0.1, 0.01).",
        key="alphas/least_step_down",
        found="each step divides the largest position error by at least {value:.1f}",
        verdict=lambda ratio: _HOLDS if ratio > 1 else _FAILS,
        correction="The cause is the gain of the feasible solution, which approaches ΔT/δ. At"
        " L = ΔT/δ the error is 0 for every α.",
    ),
    Claim(
        statement="The UAVs stay within 500 m.",
        key="scenario/farthest_m",
        found="the largest distance is {value:.0f} m",
        verdict=lambda farthest: _HOLDS if farthest < 500 else _FAILS,
    ),
    _limit("0.05", "0.89"),
    _limit("0.25", "1.01"),
    _limit("1", "1.3"),
    Claim(
        statement="The error of the estimated unknown input stays below 3γ sup‖W‖ in the"
        " simulation.",
        key="unknown_input/L = 0.76/b0_in_scenario",
        found="in the published scenario it reaches {value:.2f} sup‖W‖ at L = 0.76, where 3γ is"
        " 3.00",
        verdict=lambda share: _HOLDS if share <= 3 else _FAILS,
        correction="It holds because this input is mild; 3γ is not a bound (next row).",
    ),
    Claim(
        statement="3γ sup‖W‖ bounds the error of the estimated unknown input in general.",
        key="unknown_input/L = 0.76/b0_adversary",
        found="an input that reverses at the worst moment reaches {value:.3f} sup‖W‖ at L = 0.76,"
        " against 3γ = 3.00 with γ = √μ = 1",
        verdict=lambda reached: _FAILS if reached > 3 else _HOLDS,
        correction="With Ŵ = (X̂⁺ − X̂)/ΔT the exact peak is 2|Lδ − ΔT|/ΔT for 0 ≤ 1 − L < 1, and"
        " is unbounded as ΔT falls. 2γ sup‖W‖/ΔT is a bound. G = [B; D] has √5‖G†‖γ sup‖W‖.",
    ),
    Claim(
        statement="A gain designed for one ΔT keeps the guarantee.",
        key="irregular/fixed_over_gamma",
        found="on intervals of 0.05 to 1.2 s a fixed gain reaches {value:.2f} times the γ of a"
        " scheduled gain",
        verdict=lambda share: _CORRECTED if share > 1 else _HOLDS,
        correction="Real intervals are irregular. Schedule L by the actual ΔT: one P ="
        " 1/max μ*(ΔT) certifies all intervals, in any order.",
    ),
    Claim(
        statement="The angle of a UAV is θ = arccos(x/r).",
        key="array/arccos_error_deg",
        found="for y < 0, half of the time, it points to the mirror image: an error of up to"
        " {value:.0f}°",
        verdict=lambda degrees: _CORRECTED if degrees > 0.01 else _HOLDS,
        correction="arccos loses the sign of y. Use the unit vector or atan2(y, x).",
    ),
    Claim(
        statement="The steering vectors use sin θ of that angle.",
        key="array/opposite_sines_apart",
        found="sin(arccos(x/r)) is |y|/r, which differs by at most {value:.0e} for opposite UAVs:"
        " two columns of A are equal, and AᵀA* is singular",
        verdict=lambda apart: _HOLDS if apart > 1e-6 else _CORRECTED,
        correction="Measure θ from broadside: sin θ = x/r for elements along x. (Opposite pairs of"
        " UAVs are our assumption about the initial phases.)",
    ),
    Claim(
        statement="UAV i receives aᴴ F s, with F = A*(AᵀA*)⁻¹.",
        key="array/conjugated_response_max",
        found="for four UAVs at generic positions |aᴴf| of the own beam is at most {value:.3f},"
        " not 1",
        verdict=lambda response: _CORRECTED if response < 0.5 else _HOLDS,
        correction="Channel and precoder must agree: aᵀ with F = A*(AᵀA*)⁻¹ gives |aᵀf| = 1.",
    ),
    Claim(
        statement="Zero forcing separates the four UAVs at all times.",
        key="array/zero_forcing_over_3_db_share",
        found="for {value:.0%} of the reports it costs a UAV more than 3 dB; at a mirror image no"
        " solution exists",
        verdict=lambda share: _CORRECTED if share > 0 else _HOLDS,
        correction="A line array cannot separate a direction from its mirror image about its axis,"
        " and the circling UAVs pass through such pairs. Regularise or use time slots there.",
    ),
    Claim(
        statement="The gust enters as d/ΔT.",
        key="scenario/input_sup_mps",
        found="in this reading sup‖W‖ is {value:.2f} m/s: the gust is a third faster than the"
        " flight",
        verdict=lambda largest: _CORRECTED if largest > 400 else _HOLDS,
        correction="d is then a step in metres per report, independent of ΔT. As a velocity,"
        " W = v + d. The reading changes every plotted error; this study uses the printed form.",
    ),
    Claim(
        statement="The beam of 64 elements is narrow enough to separate users (half-power angle).",
        key="array/sizes/64/half_power_deg",
        found="the gain halves at ±{value:.2f}°; with 128 elements at half that angle",
        verdict=lambda degrees: _HOLDS if degrees < 1 else _FAILS,
    ),
    Claim(
        statement="The waveform is 16-QAM with a code of rate 1/3 on 234 subcarriers with a prefix"
        " of 64.",
        key="waveform/most_bit_s_hz",
        found="it carries at most {value:.2f} bit/s/Hz at any SINR",
        verdict=lambda most: _CORRECTED if most < 2 else _HOLDS,
        correction="Higher spectral efficiencies, including ours, are capacities, log2(1 + SINR),"
        " not rates of this waveform.",
    ),
    Claim(
        statement="Location-aware beams exceed echo probing in average spectral efficiency under"
        " blockage.",
        key="blockage/gain_over_echo_bit_s_hz/optimum",
        found="with L = 0.30: {value:+.2f} bit/s/Hz per UAV at 15 blockages of 0.5 s per minute",
        verdict=lambda gain: _HOLDS if gain > 0 else _FAILS,
    ),
    Claim(
        statement="They do so with the paper's own gain.",
        key="blockage/gain_over_echo_bit_s_hz/L = 0.39",
        found="with L = 0.39: {value:+.2f} bit/s/Hz per UAV, because the beam of 64 elements"
        " misses the UAV",
        verdict=lambda gain: _HOLDS if gain > 0 else _FAILS,
        correction="An error of 6° is eight half-power angles. Only the optimal gain has the"
        " advantage. Our baseline is a favourable one; the paper does not give its settings.",
    ),
)
