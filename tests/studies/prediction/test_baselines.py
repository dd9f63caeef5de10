"""Baselines of the observer: analytic cases, AntennaTracker's behaviour, and Kalman filters
against least squares over the whole flight and against the noise integral."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.integrate import quad_vec
from scipy.linalg import expm

from companion.studies.prediction import kalman
from companion.studies.prediction.baselines import (
    DeadReckoning,
    DeadReckoningOnArrival,
    Hold,
    ObservedReport,
    Predicted,
    Predictor,
)
from companion.studies.prediction.kalman import Kalman, Tuning
from companion.values import FloatArray

S = 1_000_000_000
TUNING = Tuning(
    process_density=0.7,
    position_noise_m=0.4,
    velocity_noise_mps=0.15,
    start_velocity_mps=20.0,
    start_acceleration_mps2=4.0,
)
ALL: list[Callable[[], Predictor]] = [
    Hold,
    DeadReckoningOnArrival,
    DeadReckoning,
    lambda: Kalman(2, TUNING),
    lambda: Kalman(3, TUNING),
]
P0, V0 = np.array([10.0, -20.0, -30.0]), np.array([3.0, -4.0, 0.5])


def observed(
    sent_s: float,
    position: ArrayLike,
    velocity: ArrayLike | None = None,
    late_s: float = 0.0,
    offset_s: float = 0.0,
) -> ObservedReport:
    """A report that takes ``late_s`` to arrive, the sender's timeline ``offset_s`` behind the
    node's."""
    return ObservedReport(
        arrival_ns=round((sent_s + late_s) * S),
        sent_ns=round(sent_s * S),
        sender_ns=round((sent_s - offset_s) * S),
        position_ned_m=np.array(position, dtype=float),
        velocity_ned_mps=None if velocity is None else np.array(velocity, dtype=float),
    )


def straight(sent_s: float, late_s: float = 0.0) -> ObservedReport:
    """A report of a straight flight."""
    return observed(sent_s, P0 + V0 * sent_s, V0, late_s)


def ask(predictor: Predictor, now_s: float, lead_s: float = 0.0) -> Predicted:
    """A prediction that must exist."""
    predicted = predictor.predict(round(now_s * S), round((now_s + lead_s) * S))
    assert predicted is not None
    return predicted


def wandering(n: int, seed: int = 5, late_s: float = 0.0) -> list[ObservedReport]:
    """Irregular reports of a random flight; every third is without velocity."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.05, 1.5, n))
    return [
        observed(t, rng.normal(0, 5, 3), None if k % 3 == 1 else rng.normal(0, 2, 3), late_s)
        for k, t in enumerate(times)
    ]


@pytest.mark.parametrize("make", ALL)
def test_no_prediction_before_the_first_report(make: Callable[[], Predictor]) -> None:
    assert make().predict(0, S) is None


@pytest.mark.parametrize("make", ALL[1:])
@pytest.mark.parametrize("lead_s", [0.0, 1.0])
def test_straight_flight_without_delay_is_predicted_exactly(
    make: Callable[[], Predictor], lead_s: float
) -> None:
    predictor = make()
    for sent_s in (0.0, 0.3, 1.4, 1.5, 4.0):
        predictor.report(straight(sent_s))
    # A filter loses its uncertain start as the weight of its measurements allows.
    exact = 1e-9 if not isinstance(predictor, Kalman) else 0.02
    predicted = ask(predictor, 4.5, lead_s)
    assert predicted.position_ned_m == pytest.approx(P0 + V0 * (4.5 + lead_s), abs=exact)
    assert predicted.velocity_ned_mps == pytest.approx(V0, abs=exact)
    assert predicted.bound_m is None


def test_hold_uses_the_last_report_to_arrive() -> None:
    predictor = Hold()
    predictor.report(straight(2.0, late_s=0.1))
    predictor.report(straight(1.0, late_s=1.2))
    assert ask(predictor, 9.0, 1.0).position_ned_m == pytest.approx(P0 + V0)


def test_arrival_time_prediction_lags_by_the_latency() -> None:
    """The whole error is speed times latency."""
    by_arrival, by_sender = DeadReckoningOnArrival(), DeadReckoning()
    for predictor in (by_arrival, by_sender):
        predictor.report(straight(1.0, late_s=0.6))
    truly = P0 + V0 * 2.3
    assert ask(by_arrival, 2.0, 0.3).position_ned_m == pytest.approx(truly - V0 * 0.6)
    assert ask(by_sender, 2.0, 0.3).position_ned_m == pytest.approx(truly)


def test_reordered_report_misleads_only_arrival_time_prediction() -> None:
    by_arrival, by_sender = DeadReckoningOnArrival(), DeadReckoning()
    for predictor in (by_arrival, by_sender):
        predictor.report(straight(2.0, late_s=0.1))
        predictor.report(observed(1.0, P0, -V0, late_s=1.5))
    assert ask(by_sender, 2.5).position_ned_m == pytest.approx(P0 + V0 * 2.5)
    assert ask(by_arrival, 2.5, 1.0).position_ned_m == pytest.approx(P0 - V0)


def test_antenna_tracker_stops_predicting_after_five_seconds() -> None:
    predictor = DeadReckoningOnArrival()
    predictor.report(straight(0.0))
    assert ask(predictor, 4.9).position_ned_m == pytest.approx(P0 + V0 * 4.9)
    for now_s in (5.0, 8.0, 100.0):
        assert ask(predictor, now_s).position_ned_m == pytest.approx(P0 + V0 * 5.0)
    predictor.report(straight(200.0))
    assert ask(predictor, 201.0).position_ned_m == pytest.approx(P0 + V0 * 201.0)


@pytest.mark.parametrize("make", ALL[2:])
def test_clock_correction_applies_to_earlier_reports(make: Callable[[], Predictor]) -> None:
    """The first reports were dated 0.5 s too late; the correction applies to all of them."""
    predictor = make()
    for sent_s in (1.0, 1.5, 2.0, 2.5, 3.0):
        placed_s, right = sent_s + 0.5, P0 + V0 * sent_s
        predictor.report(observed(placed_s, right, V0, offset_s=1000.5))
    assert ask(predictor, 3.5).position_ned_m == pytest.approx(P0 + V0 * 3.0, abs=0.1)
    predictor.report(
        observed(2.4, P0 + V0 * 2.4, V0, offset_s=1000.0)
    )  # reordered, but earlier here
    assert ask(predictor, 3.5).position_ned_m == pytest.approx(P0 + V0 * 3.5, abs=0.1)


@pytest.mark.parametrize("make", ALL[1:3])
def test_position_is_held_without_velocity(make: Callable[[], Predictor]) -> None:
    predictor = make()
    predictor.report(observed(0.0, P0))
    assert ask(predictor, 3.0, 1.0).position_ned_m == pytest.approx(P0)
    assert ask(predictor, 3.0).velocity_ned_mps is None


# --- Kalman -------------------------------------------------------------------------------------


def generator(states: int) -> FloatArray:
    """A of x' = A x + noise in the last state: ones above the diagonal."""
    return np.diag(np.ones(states - 1), 1)


@pytest.mark.parametrize("states", [2, 3])
def test_process_noise_equals_its_numerical_integral(states: int) -> None:
    interval_s, density = 0.7, 1.9
    into = np.zeros((states, 1))
    into[-1] = 1.0

    def grown(t: float) -> FloatArray:
        column = expm(generator(states) * t) @ into
        return density * column @ column.T

    integral, _ = quad_vec(grown, 0.0, interval_s)
    assert kalman.process_noise(states, interval_s, density) == pytest.approx(integral)
    moved = expm(generator(states) * interval_s)
    assert kalman.transition(states, interval_s) == pytest.approx(moved)


def least_squares(reports: Sequence[ObservedReport], states: int, tuning: Tuning) -> FloatArray:
    """The last state (n, 3) by one weighted least-squares fit of all states to all measurements.

    Each row is a linear combination of states, its value and its standard deviation.
    """
    n = states
    lines: list[FloatArray] = []
    values: list[FloatArray] = []

    def say(blocks: dict[int, FloatArray], value: FloatArray, covariance: FloatArray) -> None:
        weigh = np.linalg.inv(np.linalg.cholesky(covariance))
        line = np.zeros((len(value), n * len(reports)))
        for k, block in blocks.items():
            line[:, n * k : n * (k + 1)] = block
        lines.append(weigh @ line)
        values.append(weigh @ value)

    vague = [tuning.start_velocity_mps, tuning.start_acceleration_mps2][: n - 1]
    say({0: np.eye(n)[1:]}, np.zeros((n - 1, 3)), np.diag(np.square(vague)))
    for k, report in enumerate(reports):
        for row, measured, noise in (
            (0, report.position_ned_m, tuning.position_noise_m),
            (1, report.velocity_ned_mps, tuning.velocity_noise_mps),
        ):
            if measured is not None:
                say({k: np.eye(n)[row : row + 1]}, measured[None], np.array([[noise**2]]))
        if k:
            t = (report.sent_ns - reports[k - 1].sent_ns) / S
            moved = expm(generator(n) * t)
            noise_there = kalman.process_noise(n, t, tuning.process_density)
            say({k - 1: -moved, k: np.eye(n)}, np.zeros((n, 3)), noise_there)
    fit, *_ = np.linalg.lstsq(np.vstack(lines), np.vstack(values), rcond=None)
    return np.asarray(fit[-n:], dtype=float)


@pytest.mark.parametrize("states", [2, 3])
@pytest.mark.parametrize("count", [1, 2, 25])
def test_kalman_filter_equals_the_least_squares_fit(states: int, count: int) -> None:
    reports = wandering(count)
    predictor = Kalman(states, TUNING)
    for report in reports:
        predictor.report(report)
    fit = least_squares(reports, states, TUNING)
    newest_s, later_s = reports[-1].sent_ns / S, 0.8
    moved = expm(generator(states) * later_s) @ fit
    predicted = ask(predictor, newest_s, later_s)
    assert predicted.position_ned_m == pytest.approx(moved[0], abs=1e-6)
    assert predicted.velocity_ned_mps == pytest.approx(moved[1], abs=1e-6)


@pytest.mark.parametrize("states", [2, 3])
def test_batched_filters_equal_separate_filters(states: int) -> None:
    tunings = [
        TUNING,
        Tuning(
            process_density=0.3,
            position_noise_m=0.05,
            velocity_noise_mps=0.7,
            start_velocity_mps=3.0,
            start_acceleration_mps2=1.0,
        ),
        Tuning(process_density=90.0, position_noise_m=2.0, velocity_noise_mps=0.2),
    ]
    together, alone = Kalman(states, *tunings), [Kalman(states, each) for each in tunings]
    for report in wandering(20):
        for predictor in (together, *alone):
            predictor.report(report)
        expected = [ask(each, 20.0, 0.7).position_ned_m for each in alone]
        assert ask(together, 20.0, 0.7).position_ned_m == pytest.approx(np.array(expected))


@pytest.mark.parametrize("states", [2, 3])
def test_arrival_order_does_not_change_the_prediction(states: int) -> None:
    reports = wandering(5)
    answers = []
    for order in itertools.permutations(reports):
        predictor = Kalman(states, TUNING)
        for report in order:
            predictor.report(report)
        answers.append(ask(predictor, 20.0).position_ned_m)
    assert np.ptp(answers, axis=0).max() < 1e-9
    assert np.linalg.norm(answers[0]) > 0.1


def test_a_report_older_than_the_history_is_dropped() -> None:
    reports = wandering(kalman.HISTORY + 20)
    stiff = Tuning(process_density=1e-6)  # it remembers, so a restart would be visible
    whole, late = Kalman(2, stiff), Kalman(2, stiff)
    for report in reports[1:]:
        whole.report(report)
        late.report(report)
    late.report(reports[0])
    assert np.array_equal(ask(late, 70.0).position_ned_m, ask(whole, 70.0).position_ned_m)
    late.report(reports[-3])  # the same again, still within the history: it counts
    assert not np.allclose(ask(late, 70.0).position_ned_m, ask(whole, 70.0).position_ned_m)


def test_unsupported_state_count_is_rejected() -> None:
    with pytest.raises(ValueError, match="allowed: 2 or 3"):
        Kalman(4, TUNING)
