"""Input of a learned predictor, and synthetic flights for its training."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.studies.prediction import made_up
from companion.studies.prediction.baselines import ObservedReport
from companion.studies.prediction.delivery import deliver
from companion.studies.prediction.windows import (
    FEATURES,
    FORGOTTEN_NS,
    REPORTS,
    SPEED_UNIT_MPS,
    WAY_UNIT_M,
    RecentReports,
)

S = 1_000_000_000


def report(
    made_ns: int,
    position: list[float] | np.ndarray,
    velocity: list[float] | np.ndarray | None,
    arrived_ns: int | None = None,
) -> ObservedReport:
    """Report times and arrivals on one timeline, with the sender's clock 5 s behind."""
    place = np.array(position, dtype=float)
    speed = None if velocity is None else np.array(velocity, dtype=float)
    return ObservedReport(
        arrival_ns=arrived_ns or made_ns,
        sent_ns=made_ns,
        sender_ns=made_ns - 5 * S,
        position_ned_m=place,
        velocity_ned_mps=speed,
    )


def seen(*reports: ObservedReport) -> np.ndarray:
    recent = RecentReports()
    for each in reports:
        recent.add(each)
    return recent.window().seen


def test_window_matches_hand_computed_values() -> None:
    """Flying east: east is ahead, south to the right."""
    found = seen(report(10 * S, [0, 0, -30], [0, 10, 0]), report(12 * S, [4, 20, -32], [0, 10, -1]))
    assert found.shape == (2, FEATURES)
    assert found[1] == pytest.approx([0, 0, 0, 0, 10 / SPEED_UNIT_MPS, 0, -1 / SPEED_UNIT_MPS])
    ahead, right, down = np.array([-20, 4, 2]) / WAY_UNIT_M
    assert found[0] == pytest.approx([-2, ahead, right, down, 10 / SPEED_UNIT_MPS, 0, 0])


@settings(deadline=None, max_examples=examples(50))
@given(st.integers(0, 2**32 - 1), st.floats(-np.pi, np.pi))
def test_window_is_invariant_to_position_heading_and_order(seed: int, turn: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, REPORTS + 1))
    times = np.cumsum(rng.integers(1, S, n))
    places, speeds = rng.normal(size=(n, 3)) * 50, rng.normal(size=(n, 3)) * 5
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    plain = [report(int(t), p, v) for t, p, v in zip(times, places, speeds, strict=True)]
    moved = [
        report(int(t) + 77 * S, turned @ p + [1e3, -2e3, 50], turned @ v)
        for t, p, v in zip(times, places, speeds, strict=True)
    ]
    expected = seen(*plain)
    assert seen(*[moved[k] for k in rng.permutation(n)]) == pytest.approx(expected, abs=1e-6)


def test_window_keeps_the_last_reports() -> None:
    recent = RecentReports()
    for k in range(REPORTS + 5):
        assert recent.add(report((k + 1) * S, [k, 0, 0], [1, 0, 0]))
    assert len(recent.window().seen) == REPORTS
    assert not recent.add(report(S, [0, 0, 0], [1, 0, 0]))  # older than all
    assert not recent.add(report(8 * S, [9, 9, 9], [1, 0, 0]))  # a second of the same time
    late = REPORTS + 5
    assert recent.add(report(late * S + FORGOTTEN_NS + 1, [0, 0, 0], [1, 0, 0]))
    assert len(recent.window().seen) == 1


def test_missing_velocities_are_derived_from_positions() -> None:
    found = seen(
        report(S, [0, 0, 0], None), report(2 * S, [3, 0, 0], None), report(4 * S, [9, 0, 0], None)
    )
    assert found[:, 4] * SPEED_UNIT_MPS == pytest.approx([3, 3, 3])
    assert seen(report(S, [5, 5, 5], None)) == pytest.approx(np.zeros((1, FEATURES)))


@pytest.mark.parametrize("seed", range(6))
def test_synthetic_flight_is_physically_consistent(seed: int) -> None:
    """Velocity is the derivative of position, acceleration is a multirotor's, noise is as
    stated."""
    flight = made_up.flight(np.random.default_rng(seed), "1:1")
    t_s = (flight.truth.t_ns - flight.truth.t_ns[0]) * 1e-9
    way = np.gradient(flight.truth.position_ned_m, t_s, axis=0)
    assert way[1:-1] == pytest.approx(flight.truth.velocity_ned_mps[1:-1], abs=0.2)
    pull = np.linalg.norm(np.gradient(flight.truth.velocity_ned_mps, t_s, axis=0), axis=1)
    assert np.percentile(pull, 99) < 10
    speed = np.linalg.norm(flight.truth.velocity_ned_mps, axis=1)
    assert speed.max() < 40
    made_ns = flight.arrival_ns - made_up.DELAY_NS
    position, velocity = flight.truth.at(made_ns)
    assert np.std(flight.position_ned_m - position) == pytest.approx(0.1, rel=0.1)
    assert np.std(flight.velocity_ned_mps - velocity) == pytest.approx(0.1, rel=0.1)
    again = made_up.flight(np.random.default_rng(seed), "1:1")
    assert np.array_equal(flight.position_ned_m, again.position_ned_m)


@pytest.mark.parametrize("seed", range(4))
def test_synthetic_reports_are_irregular_and_timestamped(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flight = made_up.flight(rng, "1:1")
    observed = deliver(flight, made_up.link(rng), seed).observed
    sender_ns = np.array([each.sender_ns for each in observed])
    found = made_up.made_ns(flight, sender_ns, observed[0].position_ned_m)
    for each, made_ns in zip(observed, found, strict=True):
        (row,) = np.flatnonzero((flight.position_ned_m == each.position_ned_m).all(axis=1))
        assert flight.arrival_ns[row] - made_up.DELAY_NS == made_ns
        assert each.arrival_ns > made_ns
    assert np.ptp(np.diff([each.arrival_ns for each in observed])) > 0
