"""Predictors of a study that are not covered by the tracking tests."""

import numpy as np
import pytest

from companion.settings.model import Settings
from companion.studies.prediction.baselines import ObservedReport
from companion.studies.prediction.kalman import Kalman
from companion.studies.prediction.predictors import MANOEUVRE_S, known_tuning

S = 1_000_000_000


def test_known_noise_tuning_follows_the_settings() -> None:
    given = {"acceleration_max_mps2": 6.0, "position_noise_m": 1.5, "velocity_noise_mps": 0.9}
    tuning = known_tuning(Settings().override(observer={**given, "accuracy_factor": 3.0}))
    assert tuning.process_density == pytest.approx(4.0 * MANOEUVRE_S)
    assert (tuning.position_noise_m, tuning.velocity_noise_mps) == pytest.approx((0.5, 0.3))


def test_known_noise_filter_matches_a_textbook_filter() -> None:
    """One axis, as in a textbook: position and velocity measured together, at irregular times."""
    tuning = known_tuning(Settings())
    rng = np.random.default_rng(4)
    times_s = np.cumsum(rng.uniform(0.1, 1.5, 12))
    measured = rng.normal(size=(12, 2)) * [5.0, 2.0]
    R = np.diag([tuning.position_noise_m**2, tuning.velocity_noise_mps**2])
    x = np.array([measured[0, 0], 0.0])
    P = np.diag([tuning.position_noise_m**2, tuning.start_velocity_mps**2])
    # The first position is the start; its velocity is a measurement.
    gain = P[:, 1] / (P[1, 1] + R[1, 1])
    x, P = x + gain * (measured[0, 1] - x[1]), P - np.outer(gain, P[1])
    for T, z in zip(np.diff(times_s), measured[1:], strict=True):
        F = np.array([[1, T], [0, 1]])
        Q = tuning.process_density * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
        x, P = F @ x, F @ P @ F.T + Q
        K = P @ np.linalg.inv(P + R)
        x, P = x + K @ (z - x), P - K @ P
    ours = Kalman(2, tuning)
    for t_s, (p, v) in zip(times_s, measured, strict=True):
        t_ns = round(t_s * S)
        ours.report(
            ObservedReport(
                arrival_ns=t_ns,
                sent_ns=t_ns,
                sender_ns=t_ns,
                position_ned_m=np.array([p, 0, 0]),
                velocity_ned_mps=np.array([v, 0, 0]),
            )
        )
    now_ns = round(times_s[-1] * S)
    found = ours.predict(now_ns, now_ns + S // 2)
    assert found is not None
    assert found.position_ned_m[0] == pytest.approx(x[0] + 0.5 * x[1], rel=1e-6)
