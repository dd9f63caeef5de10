"""The published experiments: golden values, bounds, claims against their numbers, and the page."""

import json
import math
from collections.abc import Callable
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common  # reference implementation: only tests may import it

from companion.studies.paper import circles as scenario
from companion.studies.paper import claims, link, mavlink
from companion.studies.paper.circles import PaperFlight, PaperScenario
from companion.studies.paper.claims import Claim, ClaimVerdict
from companion.tracking.design import closed_form

LEVELS = ("L = 0.39", "L = 0.60", "L = 0.76")


@pytest.fixture(scope="module")
def made(studied: Callable[..., Path]) -> Path:
    """The folder with the output of ``companion study paper``."""
    return studied("paper")


@pytest.fixture(scope="module")
def answer(made: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((made / "paper.json").read_text("utf-8"))
    return found


@pytest.fixture(scope="module")
def flight() -> PaperFlight:
    return scenario.fly(PaperScenario())


# --- golden values (MATH: 8), from the answer ---------------------------------------------------


def test_interval_limits_match_golden_values(answer: dict[str, Any]) -> None:
    found = [answer["limits"][mu]["limit_s"] for mu in ("0.05", "0.25", "1")]
    assert found == pytest.approx([0.8873, 1.0000, 1.2906], abs=5e-5)


def test_input_and_steady_errors_match_golden_values(answer: dict[str, Any]) -> None:
    levels = answer["levels"]
    assert answer["scenario"]["input_sup_mps"] == pytest.approx(428.66, abs=0.01)
    assert levels["L = 0.39"]["angle_error_deg"] == pytest.approx(6.24, abs=0.01)
    assert levels["optimum"]["gain"] == pytest.approx(0.30)
    assert levels["optimum"]["angle_error_deg"] < 1e-9


def test_beam_matches_golden_values(answer: dict[str, Any]) -> None:
    small, large = answer["array"]["sizes"]["64"], answer["array"]["sizes"]["128"]
    assert small["half_power_deg"] == pytest.approx(0.79, abs=0.005)
    assert large["half_power_deg"] == pytest.approx(0.40, abs=0.005)
    assert small["first_null_deg"] == pytest.approx(1.79, abs=0.005)
    losses = [small["phase_step_loss_db"][bits] for bits in "2345"]
    assert losses == pytest.approx([0.89, 0.22, 0.054, 0.014], rel=0.05)


def test_lmi_solver_matches_the_closed_form(answer: dict[str, Any]) -> None:
    for row in answer["designs"]:
        assert row["feasible_gamma_s"] ** 2 <= row["mu_max_s2"] * (1 + 1e-6)
        assert row["feasible_margin"] >= -1e-6
        assert row["closed_form_gamma_s"] == 0 and not row["optimal_attained"]
        assert row["optimal_gamma_s"] < 1e-3
        assert row["optimal_gain"] == pytest.approx(row["closed_form_gain"], abs=1e-3)
        assert row["right_sign_eigenvalue"] < 1e-6
        assert row["printed_sign_eigenvalue"] > 1


def test_numbers_in_the_paper_text_are_reproduced(answer: dict[str, Any]) -> None:
    """Levels by the formula of docs/math.md 2.2; the waveform by its own parameters."""
    published = {"L = 0.39": 0.21, "L = 0.60": 0.47, "L = 0.76": 0.96}
    for name, gamma_s in published.items():
        gain = answer["levels"][name]["gain"]
        least_s = abs(0.5 * gain - 0.15) / math.sqrt(0.5 * (1 - (1 - gain) ** 2 / 0.5))
        assert answer["levels"][name]["gamma_s"] == pytest.approx(least_s)
        assert 1 < gamma_s / least_s < 3  # published bound: up to 3 times larger
    gains = [answer["alphas"][alpha]["gain"] for alpha in ("0.5", "0.1", "0.01")]
    errors = [answer["alphas"][alpha]["error_sup_m"] for alpha in ("0.5", "0.1", "0.01")]
    assert gains == sorted(gains, reverse=True) and errors == sorted(errors, reverse=True)
    level = [row["feasible_gain"] for row in answer["designs"] if row["mu_max_s2"] == 0.25]
    assert gains == level
    assert answer["waveform"]["most_bit_s_hz"] == pytest.approx(4 / 3 * 234 / 298)
    assert answer["array"]["opposite_sines_apart"] < 1e-12
    assert 250 < answer["scenario"]["farthest_m"] < 500


def test_every_paper_figure_is_compared(answer: dict[str, Any], made: Path) -> None:
    figures = answer["paper"]["figures"]
    assert [one["number"] for one in figures] == list(range(1, 11))
    assert {one["likeness"] for one in figures} == {"same", "differs", "cannot be told"}
    page = unescape((made / "paper.html").read_text("utf-8"))
    for one in figures:
        assert one["shows"] in page and one["why"] in page
    for one in answer["paper"]["guesses"]:
        assert one["setting"] in page and one["taken"] in page
    assert {one["setting"]: one["bears_on"] for one in answer["paper"]["guesses"]} == {
        "initial phase of each UAV (φ)": "all figures; opposite UAVs",
        "duration": "means of rates",
        "initial state of the observer": "first seconds of figures 2 to 4",
        "transmit power": "figures 5, 6 and 10",
        "noise figure": "figures 5, 6 and 10",
        "path loss": "figures 5, 6 and 10",
        "spectral efficiency": "figures 5, 6 and 10",
        "scattered rays": "figures 5, 6 and 10",
        "size of the OFDM transform": "the waveform",
        "blockages": "figure 10",
        "echo probing": "figure 10",
        "element pattern": "figures 7 to 9",
    }


# --- the scenario and its bounds ----------------------------------------------------------------


def test_flight_matches_a_step_by_step_simulation(flight: PaperFlight) -> None:
    """With complex numbers and a loop: north + j east."""
    for uav, radius in enumerate((100, 150, 200, 250)):
        phase = uav * math.pi / 2
        place = radius * complex(math.sin(phase), math.cos(phase))
        for k in range(len(flight.input_mps)):
            turn = 0.5 * 0.15 * k
            v = radius * 0.5 * np.exp(-1j * (turn + phase))
            d = radius * 0.1 * np.exp(-1j * (10 * turn + phase))
            w = v + d / 0.15
            assert flight.position_m[k, uav] == pytest.approx([place.real, place.imag])
            assert flight.report_m[k, uav] == pytest.approx(
                [(place + 0.5 * w).real, (place + 0.5 * w).imag]
            )
            place += 0.15 * w


def test_alternative_gust_model_bounds_the_input_by_velocity() -> None:
    """|W| is then at most 1.2 times |v|, over all UAVs."""
    flight = scenario.fly(PaperScenario(literal=False))
    nominal = 0.5 * math.hypot(100, 150, 200, 250)
    assert flight.largest_input_mps == pytest.approx(1.2 * nominal)


@pytest.mark.parametrize("gain", [0.3, 0.39, 0.6, 0.76, 0.9])
def test_estimate_matches_the_matrix_form(flight: PaperFlight, gain: float) -> None:
    """The stacked observer, X^ = Q X^ + L Y, as 8 x 8 matrices."""
    tracked = scenario.track(flight, gain)
    q, big_l = (1 - gain) * np.eye(8), gain * np.eye(8)
    estimate = flight.position_m[0].ravel()
    for k, report in enumerate(flight.report_m):
        after = q @ estimate + big_l @ report.ravel()
        assert tracked.estimate_m[k + 1].ravel() == pytest.approx(after)
        assert tracked.input_b0_mps[k].ravel() == pytest.approx((after - estimate) / 0.15)
        estimate = after


@pytest.mark.parametrize("gain", [0.2, 0.3, 0.39, 0.6, 0.76, 0.95])
def test_error_running_bound_peak_and_gamma_are_ordered(flight: PaperFlight, gain: float) -> None:
    tracked = scenario.track(flight, gain)
    errors = scenario.stacked(tracked.estimate_m - flight.position_m)
    running = scenario.running_bounds(flight, gain)
    peak = float(closed_form.peak_gain(0.15, 0.5, gain)) * flight.largest_input_mps
    gamma = math.sqrt(scenario.gain_mu(0.15, 0.5, 0.5, gain)) * flight.largest_input_mps
    assert (errors <= running + 1e-9).all()
    assert running.max() <= peak + 1e-9 <= gamma + 2e-9


def test_peak_bound_is_tight_in_the_scenario(answer: dict[str, Any]) -> None:
    """In the scenario the error reaches 90 % of it at L = 0.76."""
    levels = answer["levels"]["L = 0.76"]
    assert 0.9 * levels["peak_bound_m"] < levels["error_sup_m"] <= levels["peak_bound_m"]


@given(st.floats(0.05, 1.5), st.floats(-0.3, 0.8), st.floats(0.05, 0.95), st.floats(0.05, 1.5))
def test_smallest_mu_of_a_gain_is_certified_and_smaller_is_not(
    dt_s: float, feedthrough_s: float, alpha: float, gain: float
) -> None:
    """Against the eigenvalues of the LMIs."""
    mu = scenario.gain_mu(dt_s, feedthrough_s, alpha, gain)
    if not 1e-3 < mu < 1e3:
        return
    assert (
        closed_form.lmi_margin(
            dt_s, feedthrough_s=feedthrough_s, alpha=alpha, l_gain=gain, mu=mu, p=1 / mu
        )
        >= -1e-9
    )
    less = 0.99 * mu
    assert (
        closed_form.lmi_margin(
            dt_s, feedthrough_s=feedthrough_s, alpha=alpha, l_gain=gain, mu=less, p=1 / less
        )
        < 0
    )
    assert mu >= closed_form.mu_star(dt_s, feedthrough_s, alpha) * (1 - 1e-9)


@pytest.mark.parametrize("name", LEVELS)
def test_adversarial_input_attains_the_exact_peak(answer: dict[str, Any], name: str) -> None:
    row = answer["unknown_input"][name]
    assert row["b0_adversary"] == pytest.approx(row["b0_peak"], rel=1e-9)
    assert row["b0_in_scenario"] <= row["b0_peak"] <= row["safe_2_gamma_over_dt"]
    assert row["bd_in_scenario"] <= row["bd_peak"] <= row["bd_bound"]


def test_scheduled_gain_keeps_its_bound_at_irregular_intervals() -> None:
    found = scenario.irregular(PaperScenario(), 0.39, 1.2, 5000, np.random.default_rng(7))
    assert found.scheduled_s <= found.gamma_s < found.fixed_s


def test_rotation_by_90_deg_gives_90_deg_angle_error(flight: PaperFlight) -> None:
    turned = np.array([[0.0, 1.0], [-1.0, 0.0]])
    off = np.degrees(scenario.angle_errors_rad(flight, flight.position_m @ turned))
    assert off == pytest.approx(np.full_like(off, 90.0))


# --- the link and the service -------------------------------------------------------------------


def test_aligned_beam_attains_the_shannon_rate(flight: PaperFlight) -> None:
    """A single UAV: 64 elements, 4 antennas, 30 dBm, free space, by hand."""
    place = np.array([[[120.0, 40.0]]])
    array = link.line(64)
    heard = link.responses(array, place, place)
    found = link.efficiency(array, heard, place)
    loss = (299_792_458 / 30e9 / (4 * math.pi * math.hypot(120, 40))) ** 2
    noise_w = 1.380649e-23 * 290 * 50e6 * 10**0.7
    assert found == pytest.approx(math.log2(1 + 64 * 4 * loss / noise_w))
    blocked = link.efficiency(array, heard, place, np.array([[25.0]]))
    assert blocked == pytest.approx(math.log2(1 + 64 * 4 * loss / noise_w / 10**2.5))


def test_positions_between_steps_are_interpolated(flight: PaperFlight) -> None:
    step = flight.scenario.dt_s
    found = link.between(flight, flight.position_m, np.array([0.0, 0.5, 1.0, 1.5]) * step)
    first, second, third = flight.position_m[:3]
    wanted = [first, (first + second) / 2, second, (second + third) / 2]
    assert found == pytest.approx(np.array(wanted))


def test_every_scheme_has_the_same_blockages(answer: dict[str, Any]) -> None:
    """No scheme exceeds the optimum, and more blockages never increase the rate."""
    means = answer["blockage"]["mean_bit_s_hz"]
    for found in means.values():
        assert found == sorted(found, reverse=True)
        assert all(rate <= best for rate, best in zip(found, means["optimum"], strict=True))


def test_the_same_seed_gives_the_same_rates(flight: PaperFlight) -> None:
    short = PaperFlight(
        scenario=flight.scenario,
        position_m=flight.position_m[:12],
        input_mps=flight.input_mps[:11],
        report_m=flight.report_m[:11],
    )
    rates = np.array([0.0, 60.0])

    def rates_of(seed: int) -> dict[str, list[float]]:
        rng = np.random.default_rng(seed)
        aimed = {"right": short.position_m}
        found = link.under_blockage(short, aimed, rates, draws=1, rng=rng, progress=lambda _: None)
        return {name: means.tolist() for name, means in found.schemes.items()}

    assert rates_of(5) == rates_of(5) != rates_of(6)


def test_service_results_match_the_library(answer: dict[str, Any]) -> None:
    """To the quantisation of the message: 1e-7 degree is 11 mm; velocity errors are at most 7
    mm/s."""
    found = answer["mavlink"]
    assert found["reports"] == 4 * 170 and found["rejections"] == 0
    kept = [found[name] for name in ("estimate_m", "direction_deg", "settled_m")]
    assert kept == pytest.approx([0.0052, 0.0015, 0.0033], rel=0.2)


def test_frames_are_decoded_by_pymavlink(flight: PaperFlight) -> None:
    parser = common.MAVLink(None)
    data = b"".join(mavlink.frames(flight)[:3])
    messages = parser.parse_buffer(data)
    assert [message.get_type() for message in messages] == ["GLOBAL_POSITION_INT"] * 12
    assert [message.get_srcSystem() for message in messages] == [1, 2, 3, 4] * 3
    assert [message.time_boot_ms for message in messages[::4]] == [10_000, 10_150, 10_300]
    north, east = flight.input_mps[1, 2] * 100
    assert (messages[6].vx, messages[6].vy) == (round(north), round(east))
    metres = (messages[6].lat * 1e-7 - mavlink.ORIGIN[0]) * 111_178  # at 47.4 degrees
    assert metres == pytest.approx(flight.report_m[1, 2, 0], abs=0.5)


# --- claims -------------------------------------------------------------------------------------


def test_every_claim_shows_its_computed_number(answer: dict[str, Any]) -> None:
    rows = answer["claims"]
    assert len(rows) == len(claims.CLAIMS) >= 15
    for row, claim in zip(rows, claims.CLAIMS, strict=True):
        value = claims.lookup(answer, row["key"])
        assert row["value"] == value
        assert row["found"] == claim.found.format(value=value) != claim.found
        if row["verdict"] != ClaimVerdict.HOLDS:
            assert row["correction"]


VERDICTS = {
    "designs/0/printed_sign_eigenvalue": ClaimVerdict.CORRECTED,
    "scenario/feedthrough_matrix_rows": ClaimVerdict.CORRECTED,
    "levels/L = 0.39/error_over_gamma_bound": ClaimVerdict.HOLDS,
    "levels/L = 0.60/error_over_gamma_bound": ClaimVerdict.HOLDS,
    "levels/L = 0.76/error_over_gamma_bound": ClaimVerdict.HOLDS,
    "designs/0/feasible_gain": ClaimVerdict.CORRECTED,
    "levels/L = 0.39/angle_error_deg": ClaimVerdict.FAILS,
    "levels/L = 0.39/gamma_s": ClaimVerdict.CORRECTED,
    "alphas/least_step_down": ClaimVerdict.HOLDS,
    "scenario/farthest_m": ClaimVerdict.HOLDS,
    "limits/0.05/off_s": ClaimVerdict.HOLDS,
    "limits/0.25/off_s": ClaimVerdict.HOLDS,
    "limits/1/off_s": ClaimVerdict.HOLDS,
    "unknown_input/L = 0.76/b0_in_scenario": ClaimVerdict.HOLDS,
    "unknown_input/L = 0.76/b0_adversary": ClaimVerdict.FAILS,
    "irregular/fixed_over_gamma": ClaimVerdict.CORRECTED,
    "array/arccos_error_deg": ClaimVerdict.CORRECTED,
    "array/opposite_sines_apart": ClaimVerdict.CORRECTED,
    "array/conjugated_response_max": ClaimVerdict.CORRECTED,
    "array/zero_forcing_over_3_db_share": ClaimVerdict.CORRECTED,
    "scenario/input_sup_mps": ClaimVerdict.CORRECTED,
    "array/sizes/64/half_power_deg": ClaimVerdict.HOLDS,
    "waveform/most_bit_s_hz": ClaimVerdict.CORRECTED,
    "blockage/gain_over_echo_bit_s_hz/optimum": ClaimVerdict.HOLDS,
    "blockage/gain_over_echo_bit_s_hz/L = 0.39": ClaimVerdict.FAILS,
}
"""The verdict on each claim, by the number that decides it."""


def test_claims_have_the_expected_verdicts(answer: dict[str, Any]) -> None:
    assert {row["key"]: row["verdict"] for row in answer["claims"]} == VERDICTS
    by_statement = {row["statement"]: row["verdict"] for row in answer["claims"]}
    for part, verdict in (
        ("last diagonal block +P", ClaimVerdict.CORRECTED),
        ("ΔT = 0.89", ClaimVerdict.HOLDS),
        ("3γ sup‖W‖ bounds", ClaimVerdict.FAILS),
        ("arccos", ClaimVerdict.CORRECTED),
        ("N × 2N", ClaimVerdict.CORRECTED),
        ("exceed echo probing", ClaimVerdict.HOLDS),
        ("paper's own gain", ClaimVerdict.FAILS),
    ):
        assert [by_statement[one] for one in by_statement if part in one] == [verdict]


def test_changed_number_changes_the_verdict(answer: dict[str, Any]) -> None:
    """No verdict is hard-coded: a limit that differs from the paper's fails the claim."""
    answer = json.loads(json.dumps(answer))
    answer["limits"]["0.25"]["off_s"] = 0.01
    answer["blockage"]["gain_over_echo_bit_s_hz"]["optimum"] = -0.1
    changed = {row["key"]: row["verdict"] for row in claims.judge(answer)}
    assert changed["limits/0.25/off_s"] == ClaimVerdict.FAILS
    assert changed["blockage/gain_over_echo_bit_s_hz/optimum"] == ClaimVerdict.FAILS


@pytest.mark.parametrize("key", ["limits", "limits/2", "designs/99/alpha", "command", "command/x"])
def test_claim_key_without_a_number_is_rejected(answer: dict[str, Any], key: str) -> None:
    with pytest.raises(KeyError):
        claims.lookup(answer, key)


def test_claims_have_unique_nonempty_statements(answer: dict[str, Any]) -> None:
    assert all(isinstance(claim, Claim) and claim.statement for claim in claims.CLAIMS)
    assert len({claim.statement for claim in claims.CLAIMS}) == len(claims.CLAIMS)


# --- output files -------------------------------------------------------------------------------


class Page(HTMLParser):
    """Addresses fetched by a page, its scripts, figures and text."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.tags: list[str] = []
        self.words: list[str] = []
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_page_is_self_contained_and_lists_every_claim(made: Path, answer: dict[str, Any]) -> None:
    page = Page(made / "paper.html")
    words = " ".join(page.words)
    assert "script" not in page.tags
    assert all(address.startswith("data:") for address in page.addresses)
    assert page.tags.count("figure") == len(list(made.glob("*.png"))) == 11
    for row in answer["claims"]:
        assert row["statement"] in words and row["found"] in words and row["key"] in words
    assert "companion study paper" in words
    assert all(version in words for version in answer["versions"].values())


def test_figures_are_valid_svg_and_png(made: Path) -> None:
    names = {path.stem for path in made.glob("*.svg")}
    assert names == {path.stem for path in made.glob("*.png")}
    for path in made.glob("*.svg"):
        assert ElementTree.parse(path).getroot().tag.endswith("svg")
        assert (made / f"{path.stem}.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_json_contains_no_nan_or_infinity(made: Path) -> None:
    def refuse(text: str) -> float:
        raise AssertionError(f"{text} is no JSON")

    json.loads((made / "paper.json").read_text("utf-8"), parse_constant=refuse)
