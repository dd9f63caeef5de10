"""A beam that a report renews, against the beams of a whole update at the same time."""

from typing import Any

import numpy as np
import pytest
from arm import flight

from companion import Pipeline, Settings, Tick
from companion.beams.array import steering
from companion.beams.weights.precoding import gain_db
from companion.mavlink.wire.framing import Splitter
from companion.values import Normalisation, TrackState
from tests.sent_frames import START_NS

UPDATE_NS = 100_000_000
SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "line": {},
    "for the bound": {"beams": {"widen": "guarantee"}},
    "sharp": {"beams": {"widen": "no"}},
    "plane": {"array": {"kind": "ura"}},
    "time slots": {"beams": {"policy": "group", "condition_limit": 3.0}},
    "exact nulls": {"beams": {"policy": "drop"}},
    "least mean square error": {"beams": {"method": "mmse"}},
    "regularised": {"beams": {"method": "rzf"}},
    "maximum ratio": {"beams": {"method": "mrt"}},
    "unit power": {"beams": {"normalisation": "stream"}},
    "shared power": {"beams": {"power": "max-min"}},
    "busiest element": {"beams": {"normalisation": "antenna"}},
}


def flown(uavs: int = 6, **settings: Any) -> tuple[Pipeline, int]:
    """Return the pipeline after two seconds of flight, and the time of the last report."""
    pipeline = Pipeline(Settings().override(center={"source": flight.CENTER}, **settings))
    splitters = [Splitter("flight") for _ in range(uavs)]
    due_ns, t_ns = flight.BEGIN_NS + UPDATE_NS, START_NS
    for t_ns, index, data in flight.arrivals(uavs, 2.05):
        while due_ns <= t_ns:
            pipeline.step(Tick(due_ns))
            due_ns += UPDATE_NS
        for item in splitters[index].feed(t_ns, data):
            pipeline.step(item)
    return pipeline, t_ns


@pytest.mark.parametrize("name", SETTINGS)
def test_renewed_beam_equals_that_of_a_whole_update(name: str) -> None:
    pipeline, now_ns = flown(**SETTINGS[name])
    whole = pipeline.look(now_ns).beams
    assert pipeline.last_update is not None
    for uav in pipeline.last_update.beams.uavs:
        found = pipeline.renewed(uav, now_ns)
        assert found is not None
        (beam,) = found.one.beams
        assert pipeline.last_update.beams.uavs[found.column] == uav
        assert (beam.uav, found.one.valid_at_ns) == (uav, whole.valid_at_ns)
        column = whole.uavs.index(uav)
        expected, made = whole.weights[:, column], found.one.weights[:, 0]
        alike = abs(np.vdot(expected, made))
        assert alike >= 0.999 * np.linalg.norm(expected) * np.linalg.norm(made)
        assert np.linalg.norm(made) == pytest.approx(np.linalg.norm(expected), rel=0.1)
        assert beam.azimuth_rad == pytest.approx(whole.beams[column].azimuth_rad, abs=1e-9)
        assert beam.pointing_bound_rad == whole.beams[column].pointing_bound_rad
        assert beam.gain_db == pytest.approx(whole.beams[column].gain_db, abs=0.05)
        assert beam.group == pipeline.last_update.beams.beams[found.column].group


def test_renewed_beam_has_nulls_on_the_others_where_they_are_now() -> None:
    """Half a second after the update: the others have moved by degrees."""
    pipeline, now_ns = flown(beams={"widen": "no"})
    later_ns = now_ns + 5 * UPDATE_NS
    whole = pipeline.look(later_ns).beams
    towards = steering.unit_directions(
        np.array([beam.azimuth_rad for beam in whole.beams]),
        np.array([beam.elevation_rad for beam in whole.beams]),
    )
    vectors = steering.steering_matrix(pipeline.array, towards)
    found = pipeline.renewed("1:1", later_ns)
    assert found is not None
    for uav, vector in zip(whole.uavs, vectors.T, strict=True):
        gain = gain_db(vector[:, np.newaxis], found.one.weights)[0]
        assert gain > 17.0 if uav == "1:1" else gain < -10.0, uav


def test_no_element_exceeds_its_power_with_a_renewed_beam() -> None:
    pipeline, now_ns = flown(beams={"normalisation": "antenna"})
    assert pipeline.last_update is not None
    kept = pipeline.last_update.beams
    assert kept.normalisation is Normalisation.ANTENNA
    weights = kept.weights.copy()
    for uav in kept.uavs:  # one after the other, as reports come
        found = pipeline.renewed(uav, now_ns + 5 * UPDATE_NS)
        assert found is not None
        weights[:, found.column] = found.one.weights[:, 0]
        assert (np.abs(weights) ** 2).sum(axis=1).max() <= (1 + 1e-9) / len(weights)


def test_uav_that_cannot_have_a_beam_is_not_renewed() -> None:
    pipeline, now_ns = flown(array={"azimuth_limits_deg": (-180, 0)})
    assert pipeline.last_update is not None
    update = pipeline.last_update
    (outside,) = [one.uav for one in update.beams.left_out][:1]
    assert pipeline.renewed(outside, now_ns) is None
    assert pipeline.renewed("77:1", now_ns) is None
    assert Pipeline(pipeline.settings).renewed("1:1", now_ns) is None
    late_ns = now_ns + 60_000_000_000
    (lost,) = pipeline.tracks(late_ns, late_ns, [update.beams.uavs[0]])
    assert lost.state is TrackState.LOST
    assert pipeline.renewed(update.beams.uavs[0], late_ns) is None
