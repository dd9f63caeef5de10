"""The claims of the published method, each judged by a number of the study.

A claim names the number that decides it by its path in the study's answer. Its verdict and the text
of what was found are made from that number, so that they cannot disagree with it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final


class ClaimVerdict(StrEnum):
    """The verdict on a claim."""

    HOLDS = "holds"
    CORRECTED = "holds with a correction"
    FAILS = "does not hold"


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A statement of the paper and how it is judged."""

    statement: str  # what the paper says
    key: str  # path of the number that decides
    found: str  # text with {value} for the number
    verdict: Callable[[float], ClaimVerdict]  # what the number makes of it
    correction: str = ""  # what a reader of the paper must change


def lookup(answer: dict[str, Any], key: str) -> float:
    """The number at a path such as ``levels/L = 0.39/gamma_s``.

    Raises ``KeyError`` if there is none.
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
    """Every claim with its number, what was found and the verdict."""
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
        correction="The limit need not be searched for: ΔT_max = δ + √(αμ + (1−α)δ²).",
    )


def _bounded(name: str) -> Claim:
    return Claim(
        statement=f"The error stays below γ sup‖W‖ ({name}).",
        key=f"levels/{name}/error_over_gamma_bound",
        found="the largest error over many turns is {value:.3f} of the bound, γ the least for this"
        " gain",
        verdict=lambda share: _HOLDS if share <= 1 else _FAILS,
    )


CLAIMS: Final = (
    Claim(
        statement="The design is the linear matrix inequality as printed, its last diagonal block"
        " +P.",
        key="designs/0/printed_sign_eigenvalue",
        found="in the “⪯ 0” form the printed matrix has an eigenvalue of {value:+.2f}, and with P"
        " ≻ 0 in its diagonal no choice makes it negative",
        verdict=lambda eigenvalue: _CORRECTED if eigenvalue > 0 else _HOLDS,
        correction="The last block must be −P. The inequality is then feasible and the guarantee"
        " follows.",
    ),
    Claim(
        statement="D is an N × 2N matrix.",
        key="scenario/feedthrough_matrix_rows",
        found="the reports of the four UAVs in the plane have {value:d} rows, and so must D",
        verdict=lambda rows: _CORRECTED if rows != 4 else _HOLDS,
        correction="D is 2N × 2N: with Y = X + D W it has a row for each coordinate that is"
        " reported.",
    ),
    _bounded("L = 0.39"),
    _bounded("L = 0.60"),
    _bounded("L = 0.76"),
    Claim(
        statement="L = 0.39, 0.60 and 0.76 are the gains for the three performance levels.",
        key="designs/0/feasible_gain",
        found="a solver asked for feasibility at μ ≤ 0.05 returns {value:.3f}: near, and its own"
        " choice",
        verdict=lambda gain: _HOLDS if abs(gain - 0.39) < 0.005 else _CORRECTED,
        correction="Any gain of a whole interval is feasible at each level. Which one comes out is"
        " the solver's business; do not expect these digits from another solver.",
    ),
    Claim(
        statement="The gains of the three levels are what the method has to offer at ΔT = 0.15 s.",
        key="levels/L = 0.39/angle_error_deg",
        found="with L = 0.39 the direction is still off by up to {value:.2f}°, with L = ΔT/δ ="
        " 0.30 by 0",
        verdict=lambda degrees: _FAILS if degrees > 0.01 else _HOLDS,
        correction="They are feasible, not optimal. Where |ΔT − δ| < δ√(1−α) the least μ is 0,"
        " attained in the limit with L = ΔT/δ, which cancels the unknown input altogether.",
    ),
    Claim(
        statement="The performance levels that come with the three gains are γ = 0.21, 0.47 and"
        " 0.96 s.",
        key="levels/L = 0.39/gamma_s",
        found="they are what that solution certified; the least that the first gain has is"
        " {value:.3f} s",
        verdict=lambda gamma: _CORRECTED if gamma < 0.205 else _HOLDS,
        correction="γ is a bound of the solution found, not a property of the gain: the guarantee"
        " of the same gains is up to three times tighter.",
    ),
    Claim(
        statement="At one level (μ ≤ 0.25 s²) the errors become smaller as α does (0.5, 0.1,"
        " 0.01).",
        key="alphas/least_step_down",
        found="each step makes the largest error of the positions {value:.1f} times smaller or"
        " more",
        verdict=lambda ratio: _HOLDS if ratio > 1 else _FAILS,
        correction="By the gain that a feasible solution then has, nearer to ΔT/δ; with that gain"
        " there is no error at any α.",
    ),
    Claim(
        statement="The UAVs stay within 500 m.",
        key="scenario/farthest_m",
        found="the farthest is {value:.0f} m away",
        verdict=lambda farthest: _HOLDS if farthest < 500 else _FAILS,
    ),
    _limit("0.05", "0.89"),
    _limit("0.25", "1.01"),
    _limit("1", "1.3"),
    Claim(
        statement="The error of the estimated unknown input stays below 3γ sup‖W‖ in the"
        " simulation.",
        key="unknown_input/L = 0.76/b0_in_scenario",
        found="in the published scenario it reaches {value:.2f} sup‖W‖ at L = 0.76; 3γ is 3.00"
        " there",
        verdict=lambda share: _HOLDS if share <= 3 else _FAILS,
        correction="It held because this input is mild, not because it is a bound; see the next"
        " row.",
    ),
    Claim(
        statement="3γ sup‖W‖ bounds the error of the estimated unknown input in general.",
        key="unknown_input/L = 0.76/b0_adversary",
        found="an input that turns round at the worst moment makes it {value:.3f} sup‖W‖ at L ="
        " 0.76, against 3γ = 3.00 with γ = √μ = 1",
        verdict=lambda reached: _FAILS if reached > 3 else _HOLDS,
        correction="With Ŵ = (X̂⁺ − X̂)/ΔT the exact peak is 2|Lδ − ΔT|/ΔT for 0 ≤ 1 − L < 1: it"
        " grows without limit as ΔT falls. 2γ sup‖W‖/ΔT is safe. G = [B; D] has √5‖G†‖γ sup‖W‖.",
    ),
    Claim(
        statement="A gain designed for one ΔT carries the guarantee.",
        key="irregular/fixed_over_gamma",
        found="on intervals between 0.05 and 1.2 s a gain that stays reaches {value:.2f} times the"
        " γ that a scheduled gain keeps",
        verdict=lambda share: _CORRECTED if share > 1 else _HOLDS,
        correction="Real reports come irregularly. Schedule L by the ΔT that occurred: one P ="
        " 1/max μ*(ΔT) serves all intervals, in any order.",
    ),
    Claim(
        statement="The angle of a UAV is θ = arccos(x/r).",
        key="array/arccos_error_deg",
        found="half of the time y < 0, and then it points to the mirror image: up to {value:.0f}°"
        " off",
        verdict=lambda degrees: _CORRECTED if degrees > 0.01 else _HOLDS,
        correction="arccos loses the sign of y. Use the unit vector, or atan2(y, x).",
    ),
    Claim(
        statement="That angle goes into steering vectors of sin θ.",
        key="array/opposite_sines_apart",
        found="sin(arccos(x/r)) is |y|/r: of UAVs that face each other these differ by {value:.0e}"
        " at most, two columns of A are one, and AᵀA* has no inverse",
        verdict=lambda apart: _HOLDS if apart > 1e-6 else _CORRECTED,
        correction="Measure θ from broadside: sin θ = x/r for elements along x. (That two and two"
        " UAVs face each other is our guess of where they begin.)",
    ),
    Claim(
        statement="UAV i receives aᴴ F s, with F = A*(AᵀA*)⁻¹.",
        key="array/conjugated_response_max",
        found="for four UAVs at general places |aᴴf| of the own beam is {value:.3f} at most, not 1",
        verdict=lambda response: _CORRECTED if response < 0.5 else _HOLDS,
        correction="Channel and precoder must agree: aᵀ with F = A*(AᵀA*)⁻¹, for which |aᵀf| = 1.",
    ),
    Claim(
        statement="Zero forcing separates the four UAVs at all times.",
        key="array/zero_forcing_over_3_db_share",
        found="for {value:.0%} of the reports it costs a UAV more than 3 dB, and at a mirror image"
        " there is no answer",
        verdict=lambda share: _CORRECTED if share > 0 else _HOLDS,
        correction="A line array cannot tell a direction from its mirror image about its axis,"
        " where the circling UAVs meet. Regularise or serve in time slots there.",
    ),
    Claim(
        statement="The gust enters as d/ΔT.",
        key="scenario/input_sup_mps",
        found="read so, sup‖W‖ is {value:.2f} m/s: the gust is a third faster than the flight"
        " itself",
        verdict=lambda largest: _CORRECTED if largest > 400 else _HOLDS,
        correction="d is then a step in metres for each report, whatever ΔT. Taken for a velocity,"
        " W = v + d. The reading changes every error that is drawn; this study takes it as it is"
        " written.",
    ),
    Claim(
        statement="64 elements have a beam narrow enough to separate users (half-power angle).",
        key="array/sizes/64/half_power_deg",
        found="the gain falls by half at ±{value:.2f}°; with 128 elements at half that angle",
        verdict=lambda degrees: _HOLDS if degrees < 1 else _FAILS,
    ),
    Claim(
        statement="16-QAM with a code of rate 1/3 on 234 subcarriers with a prefix of 64 is the"
        " waveform.",
        key="waveform/most_bit_s_hz",
        found="it carries {value:.2f} bit/s/Hz at most, whatever the SINR",
        verdict=lambda most: _CORRECTED if most < 2 else _HOLDS,
        correction="Spectral efficiencies above that are capacities, log2(1 + SINR), not rates of"
        " this waveform; so are those here.",
    ),
    Claim(
        statement="Location-aware beams exceed echo probing in average spectral efficiency under"
        " blockage.",
        key="blockage/gain_over_echo_bit_s_hz/optimum",
        found="with L = 0.30: {value:+.2f} bit/s/Hz a UAV at 15 blockages a minute of 0.5 s",
        verdict=lambda gain: _HOLDS if gain > 0 else _FAILS,
    ),
    Claim(
        statement="They do so with the paper's own gain.",
        key="blockage/gain_over_echo_bit_s_hz/L = 0.39",
        found="with L = 0.39: {value:+.2f} bit/s/Hz a UAV, for the beam of 64 elements misses the"
        " UAV",
        verdict=lambda gain: _HOLDS if gain > 0 else _FAILS,
        correction="An error of 6° is eight half-power angles. The advantage is the optimal"
        " gain's. The baseline here is one at its best, not the paper's, whose settings are not"
        " given.",
    ),
)
