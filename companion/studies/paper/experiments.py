"""Reproduction of the published experiments: every number that decides a claim.

Only values stated in the paper (its scenario, gains and limits, named ``PAPER_``) are typed in;
everything else is computed. Blockages, echoes and irregular intervals are random, from one seed.

Over 300 lines: it is a list, an experiment a function.
"""

from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.beams.hardware import quantise
from companion.beams.worth import patterns
from companion.studies.origin import Progress, command_line, versions
from companion.studies.paper import circles as published_scenario
from companion.studies.paper import link, mavlink, published, shown
from companion.studies.paper.circles import PaperFlight, PaperScenario, Tracked
from companion.studies.paper.link import BlockageComparison
from companion.tracking.design import closed_form
from companion.values import FloatArray

PAPER_LEVELS: Final = ((0.05, 0.39), (0.25, 0.60), (1.0, 0.76))
"""The paper's bounds on mu, s², each with its gain L."""
PAPER_INFEASIBLE_S: Final = {0.05: 0.89, 0.25: 1.01, 1.0: 1.3}
"""First infeasible interval in the paper by mu, on a grid of 0.01 s."""
GRID_S: Final = 0.01
ALPHAS: Final = (0.5, 0.1, 0.01)
PAPER_ALPHA: Final = 0.5
PAPER_SUBCARRIERS: Final = 234
PAPER_CYCLIC_PREFIX: Final = 64
PAPER_BITS: Final = 4  # bits per symbol of 16-QAM
PAPER_CODE_RATE: Final = 1 / 3
SIZES: Final = (64, 128)
INSTANTS: Final = (14, 58)
"""Steps at which patterns are drawn, when no UAV is near another one's mirror image."""
STEADY_STEPS: Final = 2000  # steps to measure a steady error
BLOCKAGES_PER_MINUTE: Final = (0.0, 6.0, 15.0, 30.0, 60.0)
DRAWS: Final = 2
OPTIMUM: Final = "optimum"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Material:
    """Data for the figures of the reproduction."""

    flight: PaperFlight
    tracked: dict[str, Tracked]  # by name of the gain
    alphas: dict[float, Tracked]  # by alpha, with a solver's gain
    efficiency: dict[str, FloatArray]  # (K + 1, N), by name of the gain
    arrays: dict[int, Array]  # by number of elements
    compared: BlockageComparison  # schemes under blockage


def level_name(gain: float) -> str:
    """Return the name of a published gain in tables and legends."""
    return f"L = {gain:.2f}"


def study(seed: int, progress: Progress) -> tuple[dict[str, Any], Material]:
    """Return the answer of ``companion study paper`` as JSON, and the data of its figures."""
    rng = np.random.default_rng(seed)
    flight = published_scenario.fly(PaperScenario())
    progress("observer designs by LMI")
    obtained, alphas = _designs(flight)
    tracked = _tracked(flight)
    progress("rates over time")
    compared_before = _rates(flight, tracked)
    aimed = {name: one.estimate_m for name, one in tracked.items()}
    rates = np.array(BLOCKAGES_PER_MINUTE)
    compared = link.under_blockage(flight, aimed, rates, draws=DRAWS, rng=rng, progress=progress)
    progress("through MAVLink")
    agreement = mavlink.compare(flight)
    answer = {
        "command": command_line("paper", seed=seed),
        "versions": versions(("numpy", "scipy", "cvxpy", "clarabel", "matplotlib")),
        "seed": seed,
        "scenario": _scenario(flight),
        "levels": _levels(flight, tracked),
        "designs": obtained,
        "limits": _limits(),
        "unknown_input": _unknown_input(flight, tracked),
        "alphas": _alphas(flight, alphas),
        "waveform": _waveform(),
        "irregular": _irregular(flight.scenario, rng),
        "array": _array(flight),
        "rates": {name: _rate_numbers(found) for name, found in compared_before.items()},
        "blockage": _blockage(compared),
        "mavlink": asdict(agreement),
        "paper": shown.as_json(),
    }
    material = Material(
        flight=flight,
        tracked=tracked,
        alphas=alphas,
        efficiency=compared_before,
        arrays={size: link.line(size) for size in SIZES},
        compared=compared,
    )
    return answer, material


# --- the observer -------------------------------------------------------------------------------


def _tracked(flight: PaperFlight) -> dict[str, Tracked]:
    """Run the observer with the published gains and the optimum, from the true start."""
    scenario = flight.scenario
    best = closed_form.gain(scenario.dt_s, scenario.feedthrough_s, scenario.alpha)
    gains = {level_name(gain): gain for _, gain in PAPER_LEVELS} | {OPTIMUM: best}
    return {name: published_scenario.track(flight, gain) for name, gain in gains.items()}


def _scenario(flight: PaperFlight) -> dict[str, Any]:
    other = published_scenario.fly(replace(flight.scenario, literal=False))
    gust = np.linalg.norm(flight.input_mps - other.input_mps, axis=-1)
    return {
        **asdict(flight.scenario),
        "uavs": len(flight.scenario.radii_m),
        "feedthrough_matrix_rows": flight.input_mps[0].size,
        "input_sup_mps": flight.largest_input_mps,
        "input_sup_gust_as_velocity_mps": other.largest_input_mps,
        "farthest_m": float(np.linalg.norm(flight.position_m, axis=-1).max()),
        "fastest_mps": float(np.linalg.norm(flight.input_mps, axis=-1).max()),
        "literal_gust_excess_mps": float(gust.max()),
    }


def _levels(flight: PaperFlight, tracked: dict[str, Tracked]) -> dict[str, dict[str, float]]:
    """Return errors and bounds of each gain: over many steps, and from a wrong start."""
    scenario, found = flight.scenario, {}
    long_flight = published_scenario.fly(replace(scenario, steps=STEADY_STEPS))
    for name, one in tracked.items():
        steady = published_scenario.track(long_flight, one.gain)
        lost = published_scenario.track(long_flight, one.gain, 0 * flight.position_m[0])
        mu = published_scenario.gain_mu(
            scenario.dt_s, scenario.feedthrough_s, scenario.alpha, one.gain
        )
        peak_s = closed_form.peak_gain(scenario.dt_s, scenario.feedthrough_s, one.gain)
        errors = published_scenario.stacked(steady.estimate_m - long_flight.position_m)
        late = published_scenario.stacked(lost.estimate_m - long_flight.position_m)[
            STEADY_STEPS // 2 :
        ]
        angles = np.degrees(published_scenario.angle_errors_rad(long_flight, steady.estimate_m))
        running = published_scenario.running_bounds(long_flight, one.gain)
        gamma_m = float(np.sqrt(mu)) * long_flight.largest_input_mps
        found[name] = {
            "gain": one.gain,
            "q": 1 - one.gain,
            "gamma_s": float(np.sqrt(mu)),
            "peak_gain_s": float(peak_s),
            "error_sup_m": float(errors.max()),
            "error_sup_from_elsewhere_m": float(late.max()),
            "gamma_bound_m": gamma_m,
            "peak_bound_m": float(peak_s) * long_flight.largest_input_mps,
            "running_bound_excess_m": float((errors - running).max()),
            "angle_error_deg": float(angles[STEADY_STEPS // 2 :].max()),
        }
        if gamma_m > 0:
            found[name]["error_over_gamma_bound"] = found[name]["error_sup_m"] / gamma_m
    return found


def _designs(flight: PaperFlight) -> tuple[list[dict[str, Any]], dict[float, Tracked]]:
    """Compute gains by a solver, for feasibility and for the least mu, and by the closed form.

    Also returns the observer at each alpha with the gain that the solver found feasible at mu <=
    0.25, as in the paper's figure 4.
    """
    from companion.tracking.design import lmi

    scenario, one = flight.scenario, np.eye(1)
    b, d = scenario.dt_s, scenario.feedthrough_s
    held, reported = b * one, d * one
    rows: list[dict[str, Any]] = []
    tracked = {}
    for alpha in ALPHAS:
        least = lmi.solve(one, b=held, c=one, d=reported, h=one, alpha=alpha)
        for mu_max, gain in PAPER_LEVELS:
            feasible = lmi.solve(one, b=held, c=one, d=reported, h=one, alpha=alpha, mu_max=mu_max)
            solved = float(feasible.gain[0, 0])
            rows.append(
                {
                    "alpha": alpha,
                    "mu_max_s2": mu_max,
                    "paper_gain": gain if alpha == PAPER_ALPHA else None,
                    "feasible_gain": solved,
                    "feasible_q": 1 - solved,
                    "feasible_gamma_s": float(np.sqrt(feasible.mu)),
                    "feasible_margin": feasible.margin,
                    "optimal_gain": float(least.gain[0, 0]),
                    "optimal_gamma_s": float(np.sqrt(least.mu)),
                    "optimal_attained": least.attained,
                    "closed_form_gain": closed_form.gain(b, d, alpha),
                    "closed_form_gamma_s": float(np.sqrt(closed_form.mu_star(b, d, alpha))),
                    "printed_sign_eigenvalue": _decay_eigenvalue(b, d, alpha, feasible, 1.0),
                    "right_sign_eigenvalue": _decay_eigenvalue(b, d, alpha, feasible, -1.0),
                }
            )
        tracked[alpha] = published_scenario.track(flight, rows[-2]["feasible_gain"])
    return rows, tracked


def _alphas(flight: PaperFlight, alphas: dict[float, Tracked]) -> dict[str, Any]:
    """Return the largest errors at each alpha over many steps, with the gain of figure 4."""
    long_flight = published_scenario.fly(replace(flight.scenario, steps=STEADY_STEPS))
    found = {}
    for alpha, one in alphas.items():
        steady = published_scenario.track(long_flight, one.gain)
        place_m = published_scenario.stacked(steady.estimate_m - long_flight.position_m)
        miss_mps = published_scenario.stacked(steady.input_b0_mps - long_flight.input_mps)
        found[f"{alpha:g}"] = {
            "gain": one.gain,
            "error_sup_m": float(place_m.max()),
            "input_error_sup_mps": float(miss_mps.max()),
        }
    errors = [row["error_sup_m"] for row in found.values()]
    return {**found, "least_step_down": float(min(a / b for a, b in pairwise(errors)))}


def _waveform() -> dict[str, float]:
    """Return the largest rate of the stated waveform: a symbol's bits over its time and bandwidth.

    The transform has at least as many points as there are subcarriers.
    """
    samples = PAPER_SUBCARRIERS + PAPER_CYCLIC_PREFIX
    carried = PAPER_BITS * PAPER_CODE_RATE * PAPER_SUBCARRIERS / samples
    return {"most_bit_s_hz": carried}


def _decay_eigenvalue(b: float, d: float, alpha: float, solution: Any, sign: float) -> float:
    """Return the largest eigenvalue of the decay LMI in "<= 0" form with last block ``sign`` P."""
    gain, p = float(solution.gain[0, 0]), float(solution.lyapunov[0, 0])
    keep, enters = (1 - gain) * p, (gain * d - b) * p
    matrix = np.array([[(alpha - 1) * p, 0, keep], [0, -alpha, enters], [keep, enters, sign * p]])
    return float(np.linalg.eigvalsh(matrix / max(p, 1.0))[-1])


def _limits() -> dict[str, dict[str, float]]:
    scenario, found = PaperScenario(), {}
    for mu, paper_s in PAPER_INFEASIBLE_S.items():
        limit_s = closed_form.dt_limit_s(mu, scenario.feedthrough_s, scenario.alpha)
        first = (np.floor(limit_s / GRID_S + 1e-9) + 1) * GRID_S
        found[f"{mu:g}"] = {
            "limit_s": limit_s,
            "first_infeasible_s": float(first),
            "paper_s": paper_s,
            "off_s": abs(float(first) - paper_s),
        }
    return found


def _unknown_input(flight: PaperFlight, tracked: dict[str, Tracked]) -> dict[str, dict[str, float]]:
    scenario, found = flight.scenario, {}
    levels = {level_name(gain): mu for mu, gain in PAPER_LEVELS}
    for name, one in tracked.items():
        full, plain = published.unknown_input_peak(scenario.dt_s, scenario.feedthrough_s, one.gain)
        mu = published_scenario.gain_mu(
            scenario.dt_s, scenario.feedthrough_s, scenario.alpha, one.gain
        )
        gamma_s = float(np.sqrt(levels.get(name, mu)))
        misses = published_scenario.stacked(one.input_b0_mps - flight.input_mps)
        misses_bd = published_scenario.stacked(one.input_bd_mps - flight.input_mps)
        found[name] = {
            "b0_in_scenario": float(misses.max()) / flight.largest_input_mps,
            "bd_in_scenario": float(misses_bd.max()) / flight.largest_input_mps,
            "b0_peak": plain,
            "bd_peak": full,
            "b0_adversary": published_scenario.adversarial_input_error(scenario, one.gain),
            "published_3_gamma": 3 * gamma_s,
            "published_3_gamma_least": 3 * float(np.sqrt(mu)),
            "safe_2_gamma_over_dt": 2 * float(np.sqrt(mu)) / scenario.dt_s,
            "bd_bound": published.unknown_input_bound(
                scenario.dt_s, scenario.feedthrough_s, float(np.sqrt(mu))
            )[0],
        }
    return found


def _irregular(scenario: PaperScenario, rng: np.random.Generator) -> dict[str, float]:
    longest_s, steps, gain = 1.2, 20_000, PAPER_LEVELS[0][1]
    found = published_scenario.irregular(scenario, gain, longest_s, steps, rng)
    return {
        "longest_s": longest_s,
        "fixed_gain": gain,
        **asdict(found),
        "fixed_over_gamma": found.fixed_s / found.gamma_s,
        "scheduled_over_gamma": found.scheduled_s / found.gamma_s,
    }


# --- the array ----------------------------------------------------------------------------------


def _array(flight: PaperFlight) -> dict[str, Any]:
    """Return widths, nulls and phase-step losses of the array, and errors of its formulas."""
    sizes = {}
    for size in SIZES:
        array = link.line(size)
        ahead = np.array([1.0, 0.0, 0.0])
        matched = steering_matrix(array, ahead[np.newaxis])[:, 0].conj()
        cut = patterns.lobe(array, matched, ahead).azimuth
        nulls, width = cut.first_nulls_rad, cut.half_power_width_rad
        sizes[str(size)] = {
            "half_power_deg": None if width is None else float(np.degrees(width / 2)),
            "first_null_deg": None if nulls is None else float(np.degrees(nulls[1])),
            "side_lobe_db": cut.side_lobe_db,
            "phase_step_loss_db": {str(bits): _phase_loss_db(array, bits) for bits in (2, 3, 4, 5)},
        }
    array = link.line(SIZES[0])
    # Generic positions: in the paper's, the mirror image of each UAV is in a null of another.
    azimuths = np.radians([10.0, 35.0, -20.0, 60.0])
    apart = 100.0 * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    right, printed = link.conjugate_responses(array, apart)
    own_right, own_printed = link.conjugate_responses(array, flight.position_m[INSTANTS[0]])
    loss_db = link.zero_forcing_loss_db(array, flight.position_m)
    return {
        "sizes": sizes,
        "transposed_response_min": float(min(right.min(), own_right.min())),
        "conjugated_response_max": float(printed.max()),
        "conjugated_response_max_in_scenario": float(own_printed.max()),
        "arccos_wrong_share": float(np.mean(flight.position_m[..., 1] < 0)),
        "arccos_error_deg": _arccos_error_deg(flight.position_m),
        "opposite_sines_apart": _opposite_sines_apart(flight.position_m),
        "zero_forcing_unsolved": int(np.sum(loss_db > 120)),
        "zero_forcing_over_3_db_share": float(np.mean(loss_db > 3)),
    }


def _arccos_error_deg(position_m: FloatArray) -> float:
    """Return the largest error of arccos(x / r), which assumes y >= 0, degrees."""
    ranges_m = np.linalg.norm(position_m, axis=-1)
    angle = np.arccos(np.clip(position_m[..., 0] / ranges_m, -1, 1))
    true = np.arctan2(position_m[..., 1], position_m[..., 0])
    off = np.abs(np.angle(np.exp(1j * (angle - true))))
    return float(np.degrees(off.max()))


def _opposite_sines_apart(position_m: FloatArray) -> float:
    """Return the largest difference of sin(arccos(x / r)) between opposite UAVs.

    The printed steering vectors use this value, |y| / r.
    """
    sines = np.abs(position_m[..., 1]) / np.linalg.norm(position_m, axis=-1)
    half = sines.shape[1] // 2
    return float(np.abs(sines[:, :half] - sines[:, half:]).max())


def _phase_loss_db(array: Array, bits: int) -> float:
    """Return the mean loss of a matched beam by plain rounding of phases, over many directions."""
    azimuths = np.arcsin(np.linspace(-0.95, 0.95, 1001))
    level = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=-1)
    matched = steering_matrix(array, link.directions(level)).conj()
    steps = quantise.Resolution(2**bits)
    rounded = steps.values(steps.nearest(matched))
    gains = np.abs(np.sum(matched.conj() * rounded, axis=0)) ** 2 / array.size**2
    return float(-10 * np.log10(gains.mean()))


def _rates(flight: PaperFlight, tracked: dict[str, Tracked]) -> dict[str, FloatArray]:
    array = link.line(SIZES[0])
    found = {}
    for name, one in tracked.items():
        heard = link.responses(array, flight.position_m, one.estimate_m)
        found[name] = link.efficiency(array, heard, flight.position_m)
    return found


def _rate_numbers(found: FloatArray) -> dict[str, float]:
    return {
        "mean_bit_s_hz": float(found.mean()),
        "p5_bit_s_hz": float(np.percentile(found, 5)),
        "least_bit_s_hz": float(found.min()),
    }


def _blockage(compared: BlockageComparison) -> dict[str, Any]:
    echo, middle = compared.schemes["echo probing"], len(compared.blockages_per_minute) // 2
    return {
        "tx_power_dbm": link.BUDGET.tx_power_dbm,
        "blockages_per_minute": compared.blockages_per_minute.tolist(),
        "mean_blockage_s": link.MEAN_BLOCKAGE_S,
        "mean_bit_s_hz": {name: means.tolist() for name, means in compared.schemes.items()},
        "gain_over_echo_bit_s_hz": {
            name: float(means[middle] - echo[middle])
            for name, means in compared.schemes.items()
            if means is not echo
        },
    }
