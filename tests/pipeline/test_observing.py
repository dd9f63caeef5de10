"""Measurements of the array's receiver in the whole pipeline, from frames to beams."""

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.tracking.rotations import rotation
from companion.values import (
    Cause,
    Estimate,
    FloatArray,
    Level,
    Observation,
    Reason,
    Rejection,
    Severity,
    Tick,
)
from tests.observed_flight import ObservedFlight

MOUNT = np.radians([0.5, -1.0, 1.5])


def test_beams_point_at_uavs_although_the_mount_is_wrong() -> None:
    without, flight = ObservedFlight(mount_rad=MOUNT), ObservedFlight(mount_rad=MOUNT)
    without.measures = False
    without.fly(5.0)
    flight.fly(5.0)
    assert min(without.errors_deg().values()) > 0.7
    assert max(flight.errors_deg().values()) < 0.25
    bounds = [beam.pointing_bound_rad for beam in flight.pipeline.look(flight.t_ns).beams.beams]
    wide = [beam.pointing_bound_rad for beam in without.pipeline.look(without.t_ns).beams.beams]
    assert None not in (*bounds, *wide)
    assert max(bounds) < 0.5 * min(wide)  # type: ignore[type-var, operator]


def test_attitude_is_corrected_by_what_is_seen() -> None:
    flight = ObservedFlight(mount_rad=MOUNT, range_m=2000.0)
    flight.fly(5.0)
    carrier = flight.pipeline.carrier(flight.t_ns, flight.t_ns)
    assert not isinstance(carrier, str)
    assert carrier.attitude_bound_rad < math.radians(2.0)
    off = compass_error_rad(carrier.body_from_local, flight.mount)
    assert off < carrier.attitude_bound_rad
    assert off < math.radians(0.6)


def compass_error_rad(body_from_local: FloatArray, mount: FloatArray) -> float:
    """Return the angle between a corrected attitude and that of the array, of a level carrier."""
    return float(np.arccos(np.clip((np.trace(body_from_local @ mount.T) - 1) / 2, -1, 1)))


def test_attitude_is_as_before_once_measurements_have_ended() -> None:
    flight = ObservedFlight(mount_rad=MOUNT, range_m=2000.0)
    flight.fly(5.0)
    drift = math.radians(flight.pipeline.settings.observations.drift_max_degps)
    flight.measures = False
    known = flight.pipeline.observing.compass
    assert known.error is not None
    narrow = known.error.bound_rad
    flight.fly(3.0)  # the last measurements count for one second
    assert known.error is not None and known.error.bound_rad >= narrow + 1.9 * drift
    flight.fly(15.0)
    carrier = flight.pipeline.carrier(flight.t_ns, flight.t_ns)
    assert not isinstance(carrier, str)
    error_rad = carrier.attitude_bound_rad - carrier.extrapolation_rad
    assert error_rad == pytest.approx(math.radians(3.0))
    np.testing.assert_allclose(carrier.body_from_local, np.eye(3), atol=1e-3)
    flight.errors_deg()


def test_false_position_is_named_and_the_compass_does_not_move() -> None:
    flight = ObservedFlight(mount_rad=MOUNT)
    flight.fly(5.0)
    flight.false_m = 60.0
    flight.said.clear()
    for _ in range(5):
        flight.fly(1.0)
        errors = flight.errors_deg()
        assert max(errors[uav] for uav in ("2:1", "3:1", "4:1")) < 0.3
    errors_said = [one for one in flight.notices() if one.severity is Severity.ERROR]
    assert [one.subject for one in errors_said] == ["1:1"]
    assert str(Reason.CONTRADICTED_BY_ARRAY) in errors_said[0].text
    verdict = flight.pipeline.health.verdicts["1:1"]
    assert verdict.level is Level.NONE and verdict.blame is not None
    assert verdict.blame.cause is Cause.CONTRADICTED
    beam = next(b for b in flight.pipeline.look(flight.t_ns).beams.beams if b.uav == "1:1")
    assert beam.pointing_bound_rad is None
    flight.false_m = 0.0
    flight.fly(8.0)
    assert flight.pipeline.observing.compass.refuted == []
    assert flight.pipeline.health.verdicts["1:1"].level is not Level.NONE


def test_beam_follows_what_is_seen_if_asked() -> None:
    flight = ObservedFlight(follow=True)
    flight.fly(4.0)
    flight.false_m = 60.0
    flight.fly(5.0)
    assert flight.pipeline.observing.compass.refuted == ["1:1"]
    assert flight.errors_deg()["1:1"] < 1.0
    verdict = flight.pipeline.health.verdicts["1:1"]
    assert verdict.level is Level.WEAK and verdict.blame is not None
    assert verdict.blame.cause is Cause.CONTRADICTED


@pytest.mark.parametrize("uavs", [1, 2, 4])
def test_error_beyond_the_bound_is_announced_and_never_blamed_on_a_uav(uavs: int) -> None:
    flight = ObservedFlight(uavs=uavs, range_m=1000.0, mount_rad=np.radians([0.0, 0.0, 8.0]))
    flight.fly(5.0)
    told = [one.text for one in flight.notices() if "center.attitude_bound_deg" in one.text]
    assert told and "the array sees UAVs" in told[0]
    assert flight.pipeline.observing.compass.refuted == []
    assert max(flight.errors_deg().values()) < 1.0


def test_bound_that_was_refuted_is_assumed_again_once_evidence_confirms_it() -> None:
    """So that a second refutation is announced too."""
    flight = ObservedFlight(uavs=4, range_m=1000.0)
    flight.fly(3.0)
    for _ in range(2):
        flight.said.clear()
        flight.mount = rotation(np.radians([0.0, 0.0, 8.0]))
        flight.fly(3.0)
        assert len([one for one in flight.notices() if "sees UAVs at least" in one.text]) == 1
        assert flight.pipeline.observing.compass.is_raised
        flight.said.clear()
        flight.mount = np.eye(3)
        flight.fly(4.0)
        assert flight.pipeline.observing.compass.is_raised
        flight.fly(8.0)
        assert not flight.pipeline.observing.compass.is_raised
        (told,) = [one.text for one in flight.notices() if "is assumed again" in one.text]
        assert told.endswith("an attitude error of up to 3° is assumed again")


@pytest.mark.parametrize("uavs", [1, 4])
def test_first_measurement_changes_nothing_before_it_is_confirmed(uavs: int) -> None:
    """It may be a reflection; there is no other one yet that would contradict it."""
    flight = ObservedFlight(uavs=uavs)
    flight.measures = False
    flight.fly(2.0)
    flight.said.clear()
    flight.said += flight.pipeline.step(aside(flight.observation("1:1"), 1.0))
    flight.fly(0.5)
    flight.measures = True
    flight.fly(2.0)
    assert not [one.text for one in flight.notices() if "attitude_bound_deg" in one.text]
    assert flight.pipeline.observing.compass.bound_rad == pytest.approx(math.radians(3.0))
    assert flight.unbounded() == 0
    assert max(flight.errors_deg().values()) < 0.3


def aside(measured: Observation, by_rad: float) -> Observation:
    """Return a measurement with a false azimuth."""
    assert measured.azimuth_rad is not None
    return replace(measured, azimuth_rad=measured.azimuth_rad + by_rad)


def test_false_measurement_changes_nothing_while_it_waits_for_an_attitude() -> None:
    flight = ObservedFlight()
    flight.fly(3.0)
    flight.said.clear()
    flight.t_ns += 50_000_000
    flight.said += flight.pipeline.step(aside(flight.observation("1:1"), 1.0))
    flight.said += flight.pipeline.step(Tick(flight.t_ns))
    assert flight.pipeline.look(flight.t_ns).beams.beams
    assert flight.unbounded() == 0
    flight.errors_deg()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"uav": "77:1"}, Reason.UNKNOWN_UAV),
        ({"uav": "9:1"}, Reason.UNKNOWN_UAV),
        ({"measured_ns": 0}, Reason.WRONG_TIME),
        ({"measured_ns": 2 * 10**18}, Reason.WRONG_TIME),
    ],
)
def test_measurement_that_cannot_be_used_is_rejected(
    change: dict[str, object], reason: Reason
) -> None:
    flight = ObservedFlight()
    flight.fly(2.0)
    event = replace(flight.observation("1:1"), **change)  # type: ignore[arg-type]
    (found,) = flight.pipeline.step(event)
    assert isinstance(found, Rejection) and found.reason is reason


def test_measurement_is_rejected_while_the_attitude_is_unknown() -> None:
    flight = ObservedFlight()
    flight.measures = False
    for event in flight.events(1.0):
        if not (hasattr(event, "msgid") and event.msgid == 30):
            flight.pipeline.step(event)
    (found,) = flight.pipeline.step(flight.observation("1:1"))
    assert isinstance(found, Rejection) and found.reason is Reason.NO_POSE


def test_outliers_are_counted_and_change_nothing() -> None:
    flight = ObservedFlight()
    flight.fly(3.0)
    before = flight.errors_deg()
    flight.said.clear()
    flight.said += flight.pipeline.step(aside(flight.observation("1:1"), 0.5))
    flight.fly(0.3)
    reasons = [one.reason for one in flight.said if isinstance(one, Rejection)]
    assert reasons == [Reason.OUTLIER]
    after = flight.errors_deg()
    assert max(after[uav] - before[uav] for uav in after) < 0.2


def test_estimates_do_not_depend_on_measurements() -> None:
    with_them, without = ObservedFlight(), ObservedFlight()
    without.measures = False
    with_them.fly(2.0)
    without.fly(2.0)

    def positions(flight: ObservedFlight) -> list[object]:
        return [one.position_ned_m for one in flight.said if isinstance(one, Estimate)]

    assert positions(with_them) == positions(without)


def test_looks_change_nothing() -> None:
    flight, watched = ObservedFlight(mount_rad=MOUNT), ObservedFlight(mount_rad=MOUNT)
    for event, same in zip(flight.events(3.0), watched.events(3.0), strict=True):
        flight.pipeline.step(event)
        watched.pipeline.step(same)
        watched.pipeline.look(watched.t_ns, 0.05)
    assert flight.pipeline.digest.hexdigest() == watched.pipeline.digest.hexdigest()
