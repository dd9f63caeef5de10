"""Published scenario: four UAVs on circles, their reports and the observer.

Coordinates are north and east of the array, metres; step k lasts from report k to report k + 1:

    v_k = R w [cos(w T k + f), -sin(w T k + f)]      the nominal velocity, T the interval
    d_k = (R w / 5) [cos(10 w T k + f), -sin(10 w T k + f)]
    x_k+1 = x_k + T W_k,   y_k = x_k + D W_k,   W_k = v_k + d_k / T

The last line is the scenario as printed. In this reading d is a step in metres and the gust d / T
is faster than the flight. ``literal=False`` reads d as the gust's velocity, W = v + d. See
docs/math.md 8.2. Source: Mohammadi, Rahmati and Malik.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.studies.paper import published
from companion.tracking.design import closed_form
from companion.values import FloatArray

GUST_RATE_RATIO: Final = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperScenario:
    """Parameters of the published scenario; initial phases are a quarter turn apart."""

    radii_m: tuple[float, ...] = (100.0, 150.0, 200.0, 250.0)  # one per UAV
    rate_radps: float = 0.5  # angular rate of every UAV
    dt_s: float = 0.15  # interval between reports
    feedthrough_s: float = 0.5  # lead of a report over the position
    alpha: float = 0.5  # decay of the certificate
    gust: float = 0.2  # |d| over |v|
    literal: bool = True  # read the gust as printed
    steps: int = 170  # reports of each UAV


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PaperFlight:
    """Flight of N UAVs over K steps; coordinates are north and east."""

    scenario: PaperScenario
    position_m: FloatArray  # (K + 1, N, 2)
    input_mps: FloatArray  # W, (K, N, 2)
    report_m: FloatArray  # y, (K, N, 2)

    @property
    def time_s(self) -> FloatArray:
        """Times of the positions, (K + 1,), seconds."""
        return np.arange(len(self.position_m)) * np.float64(self.scenario.dt_s)

    @property
    def largest_input_mps(self) -> float:
        """Largest unknown input, sup ||W||, the norm over all UAVs together, m/s."""
        return float(stacked(self.input_mps).max())


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Tracked:
    """Estimates of the published observer with one gain."""

    gain: float  # l
    estimate_m: FloatArray  # (K + 1, N, 2), predicted one report ahead
    input_b0_mps: FloatArray  # (K, N, 2), the unknown input with G = [b; 0] (as published)
    input_bd_mps: FloatArray  # (K, N, 2), the unknown input with G = [b; d]


def stacked(vectors: FloatArray) -> FloatArray:
    """Return the norm of (K, N, 2) over all UAVs and axes, at each step (K,)."""
    norms: FloatArray = np.linalg.norm(vectors.reshape(len(vectors), -1), axis=1)
    return norms


def fly(scenario: PaperScenario) -> PaperFlight:
    """Return the flight of the published scenario, which starts on the circles."""
    radii = np.array(scenario.radii_m)
    phases = np.arange(len(radii)) * np.pi / 2
    turns = scenario.rate_radps * scenario.dt_s * np.arange(scenario.steps)[:, np.newaxis]
    speeds = (radii * scenario.rate_radps)[:, np.newaxis]
    nominal = speeds * _heading(turns + phases)
    gusts = scenario.gust * speeds * _heading(GUST_RATE_RATIO * turns + phases)
    inputs = nominal + gusts / (scenario.dt_s if scenario.literal else 1.0)
    start = radii[:, np.newaxis] * np.stack([np.sin(phases), np.cos(phases)], axis=-1)
    moved = scenario.dt_s * np.cumsum(inputs, axis=0)
    positions = start + np.concatenate([np.zeros((1, len(radii), 2)), moved])
    return PaperFlight(
        scenario=scenario,
        position_m=positions,
        input_mps=inputs,
        report_m=positions[:-1] + scenario.feedthrough_s * inputs,
    )


def _heading(angle_rad: FloatArray) -> FloatArray:
    """Return unit vectors [cos, -sin], (..., 2), of angles (...)."""
    return np.stack([np.cos(angle_rad), -np.sin(angle_rad)], axis=-1)


def track(flight: PaperFlight, gain: float, start_m: FloatArray | None = None) -> Tracked:
    """Run the published observer from ``start_m`` (N, 2); None starts without error."""
    scenario = flight.scenario
    estimate = flight.position_m[0] if start_m is None else start_m
    estimates, plain, full = [estimate], [], []
    for report in flight.report_m:
        step = published.step(
            estimate,
            report_m=report,
            dt_s=scenario.dt_s,
            feedthrough_s=scenario.feedthrough_s,
            gain=gain,
        )
        estimate = step.estimate_m
        estimates.append(estimate)
        plain.append(step.unknown_input_b0_mps)
        full.append(step.unknown_input_bd_mps)
    return Tracked(
        gain=gain,
        estimate_m=np.array(estimates),
        input_b0_mps=np.array(plain),
        input_bd_mps=np.array(full),
    )


def running_bounds(flight: PaperFlight, gain: float) -> FloatArray:
    """Return the running bound on ||E_k||, (K + 1,): |q| e + |l d - b| ||W||, with true ||W_k||."""
    scenario, bounds = flight.scenario, [0.0]
    enters = abs(gain * scenario.feedthrough_s - scenario.dt_s)
    for size in stacked(flight.input_mps).tolist():
        bounds.append(abs(1 - gain) * bounds[-1] + enters * size)
    return np.array(bounds)


def angle_errors_rad(flight: PaperFlight, estimate_m: FloatArray) -> FloatArray:
    """Return the angle between the true and the estimated direction from the array, (K + 1, N)."""
    true, seen = flight.position_m, estimate_m
    cross = true[..., 0] * seen[..., 1] - true[..., 1] * seen[..., 0]
    angles: FloatArray = np.abs(np.arctan2(cross, np.sum(true * seen, axis=-1)))
    return angles


def gain_mu(dt_s: float, feedthrough_s: float, alpha: float, gain: float) -> float:
    """Return the least mu (s²) that the LMIs certify for a given gain; inf if infeasible.

    With q = 1 - l and c = l d - b the decay LMI is p c^2 / alpha <= 1 - q^2 / (1 - alpha), and mu =
    1 / p (Schur complements; docs/math.md 2.2).
    """
    margin = 1 - (1 - gain) ** 2 / (1 - alpha)
    enters = gain * feedthrough_s - dt_s
    if enters == 0 and margin >= 0:
        return 0.0
    return enters**2 / (alpha * margin) if margin > 0 else np.inf


@dataclass(frozen=True, slots=True)
class Irregular:
    """Errors over random intervals with an adversarial input: largest |e| / sup|w|."""

    fixed_s: float  # with a fixed gain
    scheduled_s: float  # with a gain scheduled by the interval
    gamma_s: float  # gamma over the same intervals


def irregular(
    scenario: PaperScenario, gain: float, longest_s: float, steps: int, rng: np.random.Generator
) -> Irregular:
    """Return the largest errors over random intervals of 0.05 s to ``longest_s``.

    The input has size 1 and its sign always increases the error.
    """
    intervals = rng.uniform(0.05, longest_s, steps)
    d, alpha = scenario.feedthrough_s, scenario.alpha
    worst = []
    for gains in (np.full(steps, gain), closed_form.gains(intervals, d, alpha)):
        error, most = 0.0, 0.0
        for b, l_gain in zip(intervals.tolist(), gains.tolist(), strict=True):
            error = abs((1 - l_gain) * error) + abs(l_gain * d - b)
            most = max(most, error)
        worst.append(most)
    gamma_s = float(np.sqrt(closed_form.mu_stars(intervals, d, alpha).max()))
    return Irregular(worst[0], worst[1], gamma_s)


def adversarial_input_error(scenario: PaperScenario, gain: float, steps: int = 400) -> float:
    """Return |W^ - W| / sup|W| under the worst input for G = [b; 0], by simulation.

    The worst input is constant, then reverses at the end.
    """
    b, d = scenario.dt_s, scenario.feedthrough_s
    place, estimate, miss = np.zeros(1), np.zeros(1), 0.0
    for sign in [1.0] * (steps - 1) + [-1.0]:
        step = published.step(
            estimate, report_m=place + d * sign, dt_s=b, feedthrough_s=d, gain=gain
        )
        miss = max(miss, abs(float(step.unknown_input_b0_mps[0]) - sign))
        place, estimate = place + b * sign, step.estimate_m
    return miss
