"""UAV positions and beam directions: against the replay's circles and their own past."""

import numpy as np
import pytest

from companion.beams.array.steering import steering_matrix
from companion.beams.weights.zero_forcing import solve
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.studies.link.scenario import PAPER, PositionSource, Reports, Scenario, circles
from companion.studies.prediction.pointing import angles_deg
from sitl_replay.flight.motion import Circle as Flown


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return circles(Settings(), Reports(), 60, np.random.default_rng(1))


def test_circles_match_the_flight_replay() -> None:
    for circle in PAPER:
        flown = Flown(
            radius_m=circle.radius_m, rate_radps=0.5, phase_rad=circle.phase_rad, height_m=0.0
        )
        for t_s in (0.0, 1.7, 33.3):
            position, velocity = circle.at(t_s)
            assert position == pytest.approx(flown(t_s).position_ned_m)
            assert velocity == pytest.approx(flown(t_s).velocity_ned_mps)


def test_held_position_age_matches_report_interval_and_latency(scenario: Scenario) -> None:
    """A held position is the UAV's position 0.06 to 0.21 s before its beam is used."""
    for seen in scenario.instants:
        ages_s = np.arange(0.0, 0.3, 0.001)
        for i, circle in enumerate(PAPER):
            was = np.array([circle.at(seen.t_s - age_s)[0] for age_s in ages_s])
            was /= np.linalg.norm(was, axis=1)[:, None]
            assert seen.towards[PositionSource.PERFECT][i] == pytest.approx(was[0])
            held = np.tile(seen.towards[PositionSource.HELD][i], (len(was), 1))
            age_s = ages_s[np.argmin(angles_deg(held, was))]
            assert 0.058 <= age_s <= 0.212


def test_prediction_points_within_the_beam(scenario: Scenario) -> None:
    off = {
        kind: np.concatenate([
            angles_deg(seen.towards[kind], seen.towards[PositionSource.PERFECT])
            for seen in scenario.instants
        ])
        for kind in PositionSource
    }  # fmt: skip
    assert off[PositionSource.PREDICTED].max() < 1.0
    assert np.median(off[PositionSource.PREDICTED]) < 0.1 * np.median(off[PositionSource.HELD])


def test_inseparable_positions_are_excluded(scenario: Scenario) -> None:
    """A linear array cannot separate front and back; the loss for it rarely exceeds 3 dB."""
    array = assembly.array(Settings())
    for seen in scenario.instants:
        solved = solve(steering_matrix(array, seen.towards[PositionSource.PERFECT]))
        assert solved is not None and solved.loss_factors.max() <= 10**0.3
    assert 0.02 < scenario.unresolved_share < 0.4
    with pytest.raises(ValueError, match="can rarely separate the circling UAVs"):
        few = Settings().override(array={"elements": 2})
        circles(few, Reports(), 5, np.random.default_rng(1))
