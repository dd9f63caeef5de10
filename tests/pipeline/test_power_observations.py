"""Powers through beams as observations: from the event to the beam that points better."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sent_frames import START_NS, attitude, position

from companion.beams.array import steering
from companion.pipeline import power_beams
from companion.pipeline.fold import Pipeline
from companion.pipeline.power_beams import POWERS_PER_S, POWERS_SAVED, PowerBeams
from companion.settings.model import Settings
from companion.tracking.carrier import body_from_ned
from companion.values import (
    Beam,
    ComplexArray,
    FloatArray,
    Observation,
    Output,
    Reason,
    Rejection,
    Tick,
    Update,
)

UAV, CARRIER = "1:1", "5:1"
AT_M = (400.0, 60.0, -40.0)
YAW_ERROR_RAD = math.radians(2.0)  # true heading less the reported one
ARRAY = {"kind": "ura", "rows": 16, "columns": 16}


def started(**sections: dict[str, Any]) -> Pipeline:
    """Return a pipeline after two seconds with a hovering carrier and UAV, and updates."""
    sections = {
        "array": ARRAY,
        "codebook": {"kind": "dft", "oversampling": 2},
        "observer": {"lag_s": (0.0, 0.0), "acceleration_max_mps2": 5.0, "speed_max_mps": 30.0},
    } | sections
    pipeline = Pipeline(Settings().override(center={"source": CARRIER}, **sections))
    fly(pipeline, 0.0, 2.0)
    return pipeline


def fly(pipeline: Pipeline, from_s: float, to_s: float) -> None:
    for t_s in np.arange(from_s, to_s, 0.1):
        for made in (position(t_s, CARRIER), attitude(t_s, CARRIER), position(t_s, UAV, AT_M)):
            pipeline.step(made)
        pipeline.step(Tick(ns(t_s + 0.02)))


def ns(t_s: float) -> int:
    return START_NS + round(t_s * 1e9)


def true_direction() -> FloatArray:
    body = body_from_ned(0.0, 0.0, YAW_ERROR_RAD) @ np.array(AT_M)
    found: FloatArray = body / np.linalg.norm(body)
    return found


def powers(
    pipeline: Pipeline,
    t_s: float,
    weights: ComplexArray,
    *,
    update: int | None = None,
    beams: tuple[int, ...] = (),
    error_db: float = 0.5,
    towards: FloatArray | None = None,
    **given: Any,
) -> Observation:
    """Return what a receiver measures through columns of weights; those beams that are strongest,
    unless given; with errors of ``error_db`` of either sign."""
    towards = true_direction() if towards is None else towards
    received = steering.steering_matrix(pipeline.array, towards[np.newaxis])[:, 0]
    levels_db = 20 * np.log10(np.abs(received @ weights))
    chosen = list(beams or np.argsort(-levels_db)[:6].tolist())
    errors_db = error_db * np.where(np.arange(len(chosen)) % 2, 1.0, -1.0)
    measured = {
        "t_ns": ns(t_s),
        "measured_ns": ns(t_s - 0.01),
        "uav": UAV,
        "update": update,
        "beams": tuple(chosen),
        "powers_db": tuple((levels_db[chosen] + errors_db - 70).tolist()),
        "power_bound_db": 0.5,
    }
    return Observation(**(measured | given))


def codebook(pipeline: Pipeline) -> ComplexArray:
    stored = PowerBeams(pipeline.settings, pipeline.array)
    event = Observation(t_ns=0, measured_ns=0, uav=UAV, beams=tuple(range(1024)))
    found = stored.weights(event)
    assert not isinstance(found, str)
    return found


def step(pipeline: Pipeline, event: Observation) -> list[Rejection]:
    outputs: list[Output] = pipeline.step(event)
    return [one for one in outputs if isinstance(one, Rejection)]


def beam(pipeline: Pipeline, t_s: float) -> Beam:
    *_, update = pipeline.step(Tick(ns(t_s)))
    assert isinstance(update, Update)
    (found,) = update.beams.beams
    return found


def error_rad(found: Beam) -> float:
    (towards,) = steering.unit_directions(
        np.array([found.azimuth_rad]), np.array([found.elevation_rad])
    )
    return 2 * math.asin(float(np.linalg.norm(towards - true_direction())) / 2)


def test_powers_through_the_codebook_correct_a_beam() -> None:
    """A heading that is off by 2 degrees: the beam turns to the UAV, and its bound gets smaller."""
    pipeline = started()
    before = beam(pipeline, 2.01)
    assert before.pointing_bound_rad is not None
    stored = codebook(pipeline)
    for n in range(5):
        t_s = 2.0 + 0.2 * n
        fly(pipeline, t_s, t_s + 0.2)
        assert not step(pipeline, powers(pipeline, t_s + 0.15, stored))
    fly(pipeline, 3.0, 3.2)
    after = beam(pipeline, 3.2)
    assert after.pointing_bound_rad is not None
    assert error_rad(before) > math.radians(1.5) and error_rad(after) < math.radians(0.7)
    assert error_rad(after) <= after.pointing_bound_rad < 0.6 * before.pointing_bound_rad


def test_powers_through_the_weights_of_an_update() -> None:
    """The number of an update is that of its records: from 0."""
    pipeline = started()
    fly(pipeline, 2.0, 2.2)
    number, last = pipeline.updates - 1, pipeline.last_update
    assert last is not None and last.beams.weights.shape == (256, 1)
    sweep = steering.steering_matrix(
        pipeline.array, np.array([[math.cos(a), math.sin(a), 0.0] for a in (0.1, 0.2, 0.25)])
    ).conj()
    pipeline.observing.power_beams.add_update(number + 1, sweep)
    event = powers(pipeline, 2.2, sweep, update=number + 1, beams=(0, 1, 2))
    assert not step(pipeline, event)
    wrong = replace(event, update=number)
    (rejection,) = step(pipeline, wrong)
    assert rejection.reason is Reason.MALFORMED
    assert rejection.detail == f"beams: update {number} has 1 beams, no index 1"


def test_only_the_newest_updates_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = started()
    stored = codebook(pipeline)
    fly(pipeline, 2.0, 6.0)
    newest = pipeline.updates - 1
    first = newest - power_beams.UPDATES_KEPT + 1
    event = powers(pipeline, 6.0, stored, beams=(0, 1))
    for number, is_known in (
        (first, True),
        (newest, True),
        (first - 1, False),
        (newest + 1, False),
    ):
        (rejection,) = step(pipeline, replace(event, update=number))
        assert rejection.reason is Reason.MALFORMED
        assert (rejection.detail.startswith("beams: update")) is is_known
        if not is_known:
            kept = f"the weights of {first} to {newest} are kept"
            assert rejection.detail == f"update: {number} is unknown; {kept}"
    monkeypatch.setattr(power_beams, "ENTRIES_KEPT", 3 * 256)
    fly(pipeline, 6.0, 6.1)
    (rejection,) = step(pipeline, replace(event, t_ns=ns(6.1), update=0))
    assert f"of {newest - 1} to {newest + 1} are" in rejection.detail


def test_powers_that_no_direction_explains_are_outliers() -> None:
    pipeline = started()
    stored = codebook(pipeline)
    fly(pipeline, 2.0, 2.2)
    elsewhere = np.array([math.cos(0.6), math.sin(0.6), 0.0])
    (rejection,) = step(pipeline, powers(pipeline, 2.2, stored, towards=elsewhere))
    assert rejection.reason is Reason.OUTLIER
    assert rejection.detail.endswith("of the reported one explains the powers")
    assert not pipeline.observing.uavs


def test_powers_that_show_nothing_new_are_accepted_and_not_used() -> None:
    pipeline = started()
    fly(pipeline, 2.0, 2.2)
    event = powers(pipeline, 2.2, codebook(pipeline), power_bound_db=60.0)
    assert not step(pipeline, event)
    assert not pipeline.observing.uavs


def test_powers_without_a_codebook_or_a_beam_of_it_are_malformed() -> None:
    pipeline = started()
    event = powers(pipeline, 2.0, codebook(pipeline))
    (rejection,) = step(pipeline, replace(event, beams=(1, 1024), powers_db=(0.0, 0.0)))
    assert rejection.reason is Reason.MALFORMED
    assert rejection.detail == "beams: codebook has 1024 beams, no index 1024"
    (rejection,) = step(started(codebook={}), event)
    assert rejection.reason is Reason.MALFORMED and "there is no codebook" in rejection.detail


def test_powers_of_a_uav_whose_position_is_refuted_are_not_used() -> None:
    """The directions that are considered are those of its reported position."""
    pipeline = started()
    stored = codebook(pipeline)
    fly(pipeline, 2.0, 2.2)
    assert not step(pipeline, powers(pipeline, 2.2, stored))
    record = pipeline.observing.uavs.get(UAV)
    assert record is not None
    record.is_refuted = True
    (rejection,) = step(pipeline, powers(pipeline, 2.2, stored))
    assert rejection.reason is Reason.CONTRADICTED_BY_ARRAY


def test_powers_beyond_the_budget_are_rejected() -> None:
    pipeline = started()
    fly(pipeline, 2.0, 2.2)
    event = powers(pipeline, 2.2, codebook(pipeline))
    for _ in range(int(POWERS_SAVED)):
        assert not step(pipeline, event)
    (rejection,) = step(pipeline, event)
    assert rejection.reason is Reason.TOO_FREQUENT
    later = replace(event, t_ns=event.t_ns + round(1.01e9 / POWERS_PER_S))
    assert not step(pipeline, later)


def test_the_true_direction_stays_inside_whatever_the_errors() -> None:
    """The prior contains the truth up to the bound on attitudes: here errors just below it."""
    rng = np.random.default_rng(3)
    pipeline = started()
    stored = codebook(pipeline)
    bound_rad = pipeline.observing.compass.bound_rad
    assert bound_rad > 0
    radii = []
    for n in range(20):
        t_s = 2.0 + 0.1 * n
        fly(pipeline, t_s, t_s + 0.1)
        axis = rng.standard_normal(3)
        error = body_from_ned(*(0.97 * bound_rad * axis / np.linalg.norm(axis)))
        towards = error @ np.array(AT_M) / np.linalg.norm(AT_M)
        event = powers(pipeline, t_s + 0.09, stored, towards=towards)
        found = pipeline.observing._measured_by_powers(event)
        assert found is not None and not isinstance(found, Rejection)
        assert (
            2 * math.asin(float(np.linalg.norm(found.direction - towards)) / 2) <= found.bound_rad
        )
        radii.append(found.bound_rad)
    assert np.median(radii) < math.radians(0.6)
