"""Random flights for training, and random radio links for their reports.

A flight turns, accelerates and climbs by Ornstein-Uhlenbeck processes about its own values: some
circle, some fly straight, some wander. Velocity is the integral of acceleration and position of
velocity, so that the three are consistent. Frame: local NED, metres; not at any position on Earth.
"""

from typing import Final

import numpy as np

from companion.studies.prediction.radio_link import RadioLink
from companion.studies.truth.trajectory import Times, Trajectory
from companion.studies.truth.vehicles import Flight
from companion.values import FloatArray

STEP_S: Final = 0.05
REPORT_STEPS: Final = 2  # steps between reports: one every 0.1 s, which a link then thins
EPOCH_NS: Final = 1_700_000_000_000_000_000
BOOT_MS: Final = 5000
DELAY_NS: Final = 5_000_000
POSITION_NOISE_M: Final = 0.1
VELOCITY_NOISE_MPS: Final = 0.1


def flight(rng: np.random.Generator, uav: str, seconds: float = 60.0) -> Flight:
    """Return one random flight with noisy reports, 10 a second, each with 5 ms latency."""
    n = round(seconds / STEP_S)
    position, velocity = _motion(rng, n)
    t_ns = EPOCH_NS + np.arange(n, dtype=np.int64) * round(STEP_S * 1e9)
    rows = np.arange(0, n, REPORT_STEPS)
    boot_ms: Times = BOOT_MS + rows * round(STEP_S * 1e3)
    height = np.full(len(rows), np.nan)
    return Flight(
        uav=uav,
        arrival_ns=t_ns[rows] + DELAY_NS,
        boot_ms=boot_ms,
        position_ned_m=position[rows] + rng.normal(0, POSITION_NOISE_M, (len(rows), 3)),
        velocity_ned_mps=velocity[rows] + rng.normal(0, VELOCITY_NOISE_MPS, (len(rows), 3)),
        height_m=height,
        gnss=(None,) * len(rows),
        truth=Trajectory(
            kind="SIM_STATE", t_ns=t_ns, position_ned_m=position, velocity_ned_mps=velocity
        ),
        made_ns=t_ns[rows],
    )


def made_ns(made: Flight, sender_ns: Times, first: FloatArray) -> Times:
    """Return the true times of reports (N,) by the sender's clock.

    ``first`` is the position (3,) in the first report, which identifies the flight.
    """
    (row,) = np.flatnonzero((made.position_ned_m == first).all(axis=1))
    times: Times = made.arrival_ns[row] - DELAY_NS + sender_ns - sender_ns[0]
    return times


def link(rng: np.random.Generator) -> RadioLink:
    """Return a random link between a clean one at 10 Hz and a slow radio.

    The sender's clock is known, as by TIMESYNC: the network should not learn a clock's errors.
    """
    rate_hz = float(np.exp(rng.uniform(np.log(0.5), np.log(10.0))))
    median_s = float(np.exp(rng.uniform(np.log(0.01), np.log(1.0))))
    latency_s = (median_s, median_s * float(rng.uniform(1.0, 4.0)))
    return RadioLink(
        name="made up",
        rate_hz=rate_hz,
        latency_s=latency_s,
        loss=float(rng.uniform(0, 0.3)),
        known_delay=True,
    )


def _motion(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    """Return positions and velocities (n, 3) of a random flight."""
    turn = _wander(rng, n, rng.choice([0.0, rng.uniform(-0.5, 0.5)]), rng.uniform(0, 0.2), 5.0)
    speed = np.abs(_wander(rng, n, rng.uniform(1.0, 20.0), rng.uniform(0, 2.0), 8.0))
    climb = _wander(rng, n, 0.0, rng.uniform(0, 1.5), 5.0)
    turn = np.clip(turn, -5.0 / np.maximum(speed, 1.0), 5.0 / np.maximum(speed, 1.0))
    course = rng.uniform(-np.pi, np.pi) + np.cumsum(turn) * STEP_S
    velocity = np.stack([speed * np.cos(course), speed * np.sin(course), -climb], axis=1)
    mean = (velocity[1:] + velocity[:-1]) / 2
    start = np.array([*rng.uniform(-300, 300, 2), -rng.uniform(20, 120)])
    way = np.concatenate([np.zeros((1, 3)), np.cumsum(mean, axis=0) * STEP_S])
    return start + way, velocity


def _wander(
    rng: np.random.Generator, n: int, about: float, deviation: float, memory_s: float
) -> FloatArray:
    """Return an Ornstein-Uhlenbeck process (n,), stationary, smoothed over half a second.

    The smoothing models a vehicle's inertia.
    """
    keep = np.exp(-STEP_S / memory_s)
    drawn = rng.standard_normal(n) * deviation
    values = np.empty(n)
    values[0] = drawn[0]
    fresh = np.sqrt(1 - keep * keep)
    for k in range(1, n):
        values[k] = keep * values[k - 1] + fresh * drawn[k]
    width = round(0.5 / STEP_S)
    padded = np.concatenate([np.full(width - 1, values[0]), values])
    return about + np.convolve(padded, np.full(width, 1 / width), mode="valid")
