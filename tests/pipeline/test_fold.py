"""The whole pipeline as a fold: real MAVLink frames in, beams out."""

import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pymap3d
import pytest
from pymavlink.dialects.v20 import all as dialect
from scipy.spatial.transform import Rotation
from sent_frames import PLACE, START_NS, S, attitude, frame, position, sent

from companion.mavlink.clock.estimates import ClockKind
from companion.pipeline import senders
from companion.pipeline.digest import Digest
from companion.pipeline.fold import DROP_EVERY, Pipeline
from companion.pipeline.ticks import with_ticks
from companion.settings.center import FixedCenter
from companion.settings.model import Settings
from companion.tracking.noise import GEOID_M, SETTLED_NS
from companion.values import (
    Estimate,
    Event,
    Frame,
    Notice,
    Output,
    Reason,
    Refuted,
    Rejection,
    RoundTrip,
    Severity,
    Source,
    Tick,
    Update,
)
from sitl_replay.flight import scenario
from sitl_replay.flight.scenario import Scenario
from sitl_replay.flight.vehicles import schedule


def adsb(
    t_s: float,
    ned_m: tuple[float, float, float],
    flags: int = 1 | 2,
    *,
    east_mps: float | None = None,
    tslc_s: int = 1,
) -> Frame:
    flags |= 0 if east_mps is None else 4 | 8
    lat, lon, alt = pymap3d.ned2geodetic(*ned_m, *PLACE)
    message = dialect.MAVLink_adsb_vehicle_message(
        0x4CA7B3, round(float(lat) * 1e7), round(float(lon) * 1e7), 1, round(float(alt) * 1e3),
        9000, round(100 * (east_mps or 0.0)), 0, b"TEST", 0, tslc_s, flags, 0,
    )  # fmt: skip
    return sent(t_s, "5:1", message)


def tick(t_s: float) -> Tick:
    return Tick(START_NS + round(t_s * 1e9))


EXACT: dict[str, Any] = {"lag_s": (0.0, 0.0), "acceleration_max_mps2": 5.0, "speed_max_mps": 60.0}


def settings(center: str | None = "5:1", **sections: dict[str, Any]) -> Settings:
    """Return settings for simulated senders, whose stamps are exact and arrive at once."""
    sections["observer"] = EXACT | sections.get("observer", {})
    return Settings().override(center={"source": center}, **sections)


def run(pipeline: Pipeline, events: Iterable[Event]) -> list[Output]:
    return [output for event in events for output in pipeline.step(event)]


def updated(pipeline: Pipeline, t_s: float) -> Update:
    *_, update = pipeline.step(tick(t_s))
    assert isinstance(update, Update)
    return update


def flown(flight: Scenario, seconds: float, seed: int = 1) -> list[Event]:
    """Return a scenario's traffic, interleaved with ticks."""
    frames = (
        frame(START_NS + round(t_s * 1e9), raw)
        for t_s, _, raw in schedule(flight, seed, START_NS, seconds)
    )
    return list(with_ticks(frames, 20.0))


@pytest.fixture(scope="module")
def paper() -> list[Event]:
    return flown(scenario.paper(4), 4.0)


@pytest.fixture(scope="module")
def begun(paper: list[Event]) -> list[Event]:
    """Return its first three seconds."""
    return [event for event in paper if event.t_ns < paper[0].t_ns + 3 * S]


# --- beams that point where the UAVs are --------------------------------------------------------


def test_beam_angles_with_a_rotated_carrier() -> None:
    """Heading east, nose up by 10 degrees: the angles by plane geometry."""
    pipeline = Pipeline(settings())
    nose_rad = math.radians(10)
    for t_s in np.arange(0, 2, 0.1):
        for made in (
            position(t_s, "5:1"),
            attitude(t_s, "5:1", 0.0, nose_rad, math.pi / 2),
            position(t_s, "1:1", (0, 200, 0)),
            position(t_s, "2:1", (100, 0, -50)),
        ):
            pipeline.step(made)
    update = updated(pipeline, 2.0)
    assert update.unfit is None
    assert update.beams.uavs == ("1:1", "2:1")
    ahead, left = update.beams.beams
    # East is ahead and, with the nose up, below; north is to the left.
    assert math.degrees(ahead.azimuth_rad) == pytest.approx(0, abs=0.02)
    assert math.degrees(ahead.elevation_rad) == pytest.approx(-10, abs=0.02)
    assert ahead.range_m == pytest.approx(200, abs=0.05)
    forward, up = 50 * math.sin(nose_rad), 50 * math.cos(nose_rad)
    assert left.azimuth_rad == pytest.approx(math.atan2(-100, forward), abs=3e-4)
    assert left.elevation_rad == pytest.approx(math.asin(up / math.hypot(100, 50)), abs=3e-4)
    assert pipeline.last_update is update
    assert pipeline.updates == 1


@pytest.mark.parametrize("mount_deg", [(0, 0, 0), (20.0, -30.0, 140.0)])
def test_beams_on_hovering_uavs_match_the_scenario(mount_deg: tuple[float, float, float]) -> None:
    """The carrier sways; scipy rotates the directions at the time at which the beams apply."""
    flight = scenario.hover(4)
    keys = ("mount_roll_deg", "mount_pitch_deg", "mount_yaw_deg")
    mount = dict(zip(keys, mount_deg, strict=True))
    beams = {"actuation_delay_s": 0.03, "widen": "no"}
    pipeline = Pipeline(settings(array=mount, beams=beams))
    outputs = run(pipeline, flown(flight, 5.0))
    updates = [o for o in outputs if isinstance(o, Update) and o.t_ns > START_NS + 3 * S]
    assert len(updates) >= 35
    roll, pitch, yaw = mount_deg
    array = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix().T
    for update in updates:
        assert update.beams.valid_at_ns == update.t_ns + 30_000_000
        pose = flight.carrier.attitude((update.beams.valid_at_ns - START_NS) * 1e-9)
        body = Rotation.from_euler("ZYX", [pose.yaw_rad, pose.pitch_rad, pose.roll_rad])
        assert set(update.beams.uavs) == {"1:1", "2:1", "3:1", "4:1"}
        for beam in update.beams.beams:
            (vehicle,) = (v for v in flight.uavs if str(v.source) == beam.uav)
            ned = np.array(vehicle.trajectory(0.0).position_ned_m)
            x, y, z = array @ body.as_matrix().T @ ned / np.linalg.norm(ned)
            assert beam.range_m == pytest.approx(np.linalg.norm(ned), abs=0.1)
            assert beam.azimuth_rad == pytest.approx(math.atan2(y, x), abs=2e-3)
            assert beam.elevation_rad == pytest.approx(math.asin(-z), abs=2e-3)


def test_bounds_hold_over_the_paper_flight(paper: list[Event]) -> None:
    """Up to 125 m/s with gusts: positions and directions within the bounds of the update."""
    flight = scenario.paper(4)
    bounds = {
        "speed_max_mps": 151.0, "acceleration_max_mps2": 190.0, "position_noise_m": 1.0,
        "velocity_noise_mps": 0.1,
    }  # fmt: skip
    pipeline = Pipeline(settings(observer=bounds))
    updates = [o for o in run(pipeline, paper) if isinstance(o, Update)]
    checked = 0
    for update in updates[60:]:  # the first frames may all have been late
        assert update.carrier is not None
        t_s = (update.beams.valid_at_ns - START_NS) * 1e-9
        pose = flight.carrier.attitude(t_s)
        body = Rotation.from_euler("ZYX", [pose.yaw_rad, pose.pitch_rad, pose.roll_rad])
        here = update.carrier.position_ned_m
        for track, beam in zip(update.tracks, update.beams.beams, strict=True):
            (vehicle,) = (v for v in flight.uavs if str(v.source) == beam.uav)
            ned = np.array(vehicle.trajectory(t_s).position_ned_m)
            # The local frame has another origin, and the carrier has noise.
            slack_m = update.carrier.bound_m
            away = np.linalg.norm(track.position_ned_m - here - ned)
            assert away <= track.bound_m + slack_m
            truth = body.as_matrix().T @ ned / np.linalg.norm(ned)
            level = math.cos(beam.elevation_rad)
            pointed = np.array(
                [
                    level * math.cos(beam.azimuth_rad),
                    level * math.sin(beam.azimuth_rad),
                    -math.sin(beam.elevation_rad),
                ]
            )
            assert beam.pointing_bound_rad is not None
            assert math.acos(min(1.0, truth @ pointed)) <= beam.pointing_bound_rad
            checked += 1
        if not update.beams.regularised:
            count = len(update.beams.beams)
            lambdas = [np.sin(b.azimuth_rad) * np.cos(b.elevation_rad) for b in update.beams.beams]
            a = np.exp(1j * np.pi * np.outer(np.arange(64), lambdas))
            assert np.abs(a.T @ update.beams.weights - np.eye(count)).max() < 1e-9
    assert checked > 60


def test_lead_predicts_to_a_later_time() -> None:
    pipeline = Pipeline(settings(center="47.4,8.55,500"))
    for t_s in (0.0, 0.1, 0.2):
        east_m = 10 * t_s
        pipeline.step(position(t_s, "1:1", (100, east_m, 0), (0, 10, 0)))
    now_ns = tick(0.2).t_ns
    plain, led = pipeline.look(now_ns), pipeline.look(now_ns, lead_s=2.0)
    assert led.beams.valid_at_ns - plain.beams.valid_at_ns == 2 * S
    assert plain.tracks[0].position_ned_m[1] == pytest.approx(2.1, abs=0.03)
    assert led.tracks[0].position_ned_m[1] == pytest.approx(22.1, abs=0.03)
    assert led.tracks[0].bound_m > plain.tracks[0].bound_m


# --- carrier ------------------------------------------------------------------------------------


@pytest.mark.parametrize("center", ["home", None])
def test_home_is_the_first_accepted_report(center: str | None) -> None:
    pipeline = Pipeline(settings(center))
    assert pipeline.step(tick(0))[0].unfit == "no report yet"  # type: ignore[union-attr]
    zero = dialect.MAVLink_global_position_int_message(1, 0, 0, 0, 0, 0, 0, 0, 0)
    pipeline.step(sent(0.1, "9:1", zero))  # rejected
    home, first = pipeline.step(position(0.2, "1:1", (10, 20, -30)))
    assert isinstance(home, Notice)
    assert (home.subject, home.severity) == ("home", Severity.INFO)
    assert "1:1" in home.text
    assert isinstance(first, Estimate)
    lat, lon, alt = pymap3d.ned2geodetic(10, 20, -30, *PLACE)
    at = pipeline.center.place
    assert isinstance(at, FixedCenter)
    assert (at.lat_deg, at.lon_deg) == pytest.approx((lat, lon), abs=1e-7)
    assert at.alt_m == pytest.approx(alt, abs=1e-3)
    pipeline.step(position(0.2, "2:1", (10, 120, -30)))
    update = updated(pipeline, 0.3)
    (beam,) = update.beams.beams
    assert (beam.uav, update.unfit) == ("2:1", None)
    assert math.degrees(beam.azimuth_rad) == pytest.approx(90, abs=0.02)  # facing north
    assert [left.uav for left in update.beams.left_out] == ["1:1"]


def test_local_frame_begins_at_the_carrier_wherever_the_first_report_is() -> None:
    """Far from it, heights are partly horizontal: bounds were up to ten times as large."""
    pipeline = Pipeline(settings())
    stranger = dialect.MAVLink_global_position_int_message(1, *[450_000_000] * 2, 0, 0, 0, 0, 0, 0)
    (first, _) = pipeline.step(sent(0.0, "9:1", stranger))
    assert isinstance(first, Notice) and first.subject == "origin"
    pipeline.step(position(0.1, "1:1", (100, 0, 0)))
    moved, _ = pipeline.step(position(0.2, "5:1"))
    assert isinstance(moved, Notice) and moved.severity is Severity.WARNING
    assert moved.text == (
        "local frame: origin set to 47.400000, 8.550000, 500.0 m, 2778 km from the first report;"
        " all tracks restart"
    )
    assert pipeline.local is not None
    there, _ = pipeline.local.localise(*PLACE, None)
    assert there == pytest.approx((0, 0, 0), abs=0.02)
    assert pipeline.tracker.uavs == ["5:1"]
    away = run(pipeline, [position(0.3, "1:1", (100, 0, 0)), position(0.4, "5:1", (60e3, 0, 0))])
    assert not [one for one in away if isinstance(one, Notice) and one.subject == "origin"]


def test_a_fixed_station_faces_its_heading() -> None:
    pipeline = Pipeline(settings("47.4,8.55,500,90"))
    outputs = pipeline.step(position(0, "1:1", (0, 100, -100)))
    assert [type(output) for output in outputs] == [Estimate]
    update = updated(pipeline, 0.05)
    (beam,) = update.beams.beams
    assert math.degrees(beam.azimuth_rad) == pytest.approx(0, abs=0.02)
    assert math.degrees(beam.elevation_rad) == pytest.approx(45, abs=0.02)
    assert update.carrier is not None
    assert (update.carrier.bound_m, update.carrier.age_s) == (0.0, None)


def test_update_without_carrier_has_a_reason_and_no_beams() -> None:
    pipeline = Pipeline(settings())
    assert updated(pipeline, 0).unfit == "no report yet"
    pipeline.step(position(0.1, "1:1", (100, 0, 0)))
    update = updated(pipeline, 0.2)
    assert update.unfit == "no position from the carrier 5:1"
    assert (update.carrier, update.beams.beams) == (None, ())
    assert [left.uav for left in update.beams.left_out] == ["1:1"]
    assert [track.uav for track in update.tracks] == ["1:1"]
    pipeline.step(position(0.3, "5:1"))
    assert updated(pipeline, 0.4).unfit == "no attitude from the carrier 5:1"
    pipeline.step(attitude(0.5, "1:1"))  # another vehicle's attitude does not count
    assert updated(pipeline, 0.5).unfit == "no attitude from the carrier 5:1"
    pipeline.step(attitude(0.5, "5:1"))
    assert updated(pipeline, 0.6).unfit is None
    pipeline.step(position(3.0, "5:1"))
    assert updated(pipeline, 3.0).unfit == "the attitude of the carrier 5:1 is too old"
    pipeline.step(attitude(18.5, "5:1"))
    assert updated(pipeline, 18.5).unfit == "the carrier 5:1 is stale"


def bearing_deg(update: Update) -> float:
    """Return the bearing of the single beam from the carrier's nose."""
    assert update.unfit is None
    (beam,) = update.beams.beams
    return math.degrees(beam.azimuth_rad)


def test_outdated_attitude_is_ignored() -> None:
    """The carrier heads north, then east; the first attitude arrives again half a second late."""
    pipeline = Pipeline(settings())
    run(pipeline, [position(1.0, "5:1"), position(1.0, "1:1", (200, 0, 0))])
    pipeline.step(attitude(0.6, "5:1", 0.0, 0.0, 0.0))
    assert bearing_deg(updated(pipeline, 1.0)) == pytest.approx(0, abs=0.02)
    pipeline.step(attitude(1.0, "5:1", 0.0, 0.0, math.pi / 2))
    late = attitude(0.7, "5:1", 0.0, 0.0, 0.0)._replace(t_ns=tick(1.2).t_ns)
    pipeline.step(late)
    assert bearing_deg(updated(pipeline, 1.2)) == pytest.approx(-90, abs=0.02)


def test_restarted_carrier_has_no_attitude_until_a_new_one() -> None:
    """The old attitude has a stamp that the new clock has not reached."""
    pipeline = Pipeline(settings())
    for t_s in np.arange(0, 5, 0.5):
        run(pipeline, [position(t_s, "5:1"), attitude(t_s, "5:1", 0.0, 0.0, 0.0)])
    for t_s in np.arange(5, 8, 0.5):
        run(pipeline, [position(t_s, "5:1", boot_s=t_s - 3), position(t_s, "1:1", (200, 0, 0))])
    update = updated(pipeline, 7.6)
    assert (update.carrier, update.unfit) == (None, "no attitude from the carrier 5:1")
    turned = dialect.MAVLink_attitude_message(4600, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0)
    pipeline.step(sent(7.6, "5:1", turned))
    assert bearing_deg(updated(pipeline, 7.7)) == pytest.approx(-90, abs=0.02)


def estimator(t_s: float, ratio: float, flags: int = 831, source: str = "5:1") -> Frame:
    message = dialect.MAVLink_ekf_status_report_message(flags, 0.01, 0.02, 0.03, ratio, 0.04)
    return sent(t_s, source, message)


def test_old_estimator_status_of_a_slower_link_does_not_reduce_the_bound() -> None:
    """A status has no stamp. After a while without a contradiction the newer one counts alone."""
    pipeline = Pipeline(settings().override(center={"source": "5:1"}))
    run(pipeline, [position(0.1, "5:1"), attitude(0.1, "5:1")])
    pipeline.step(estimator(1.0, 0.8))
    bad_rad = pipeline.center.attitude_bound_rad
    assert bad_rad == pytest.approx(0.48)
    pipeline.step(estimator(1.5, 0.01)._replace(link="slower"))
    assert pipeline.center.attitude_bound_rad == bad_rad
    pipeline.step(estimator(2.0, 0.02))
    pipeline.step(estimator(8.0, 0.02))
    assert pipeline.center.attitude_bound_rad == pytest.approx(math.radians(3.0))


def test_attitude_bound_follows_the_estimator_status() -> None:
    """A ratio can only widen the bound; without an attitude estimate any attitude is possible."""
    held = {"source": "5:1", "turn_acceleration_max_degps2": 0.0}
    pipeline, at_s = Pipeline(settings().override(center=held)), 0.1

    def bound_deg(*frames: Frame) -> float:
        nonlocal at_s
        said = run(pipeline, [position(at_s, "5:1"), attitude(at_s, "5:1"), *frames])
        notices.extend(one for one in said if isinstance(one, Notice) and "estimator" in one.text)
        at_s += 0.1
        carrier = updated(pipeline, at_s - 0.1).carrier
        assert carrier is not None
        return math.degrees(carrier.attitude_bound_rad)

    notices: list[Notice] = []
    assert bound_deg() == pytest.approx(3.0)
    assert bound_deg(estimator(at_s, 0.03)) == pytest.approx(3.0)
    assert bound_deg(estimator(at_s, 0.9, source="1:1")) == pytest.approx(3.0)
    assert notices == []
    assert bound_deg(estimator(at_s, 0.5)) == pytest.approx(math.degrees(0.3))
    assert bound_deg(estimator(at_s, 0.4)) == pytest.approx(math.degrees(0.24))
    assert len(notices) == 1
    assert "17°" in notices[0].text
    assert bound_deg(estimator(at_s, 0.0)) == pytest.approx(3.0)
    for flags in (830, 831 | 1024):
        assert bound_deg(estimator(at_s, 0.0, flags)) == 180.0
    assert len(notices) == 2
    assert bound_deg(estimator(at_s, 0.0)) == pytest.approx(3.0)


def test_step_that_system_time_proves_is_announced() -> None:
    """From one of its messages on, a vehicle states another time of day: one of both is wrong."""
    trusting = settings().override(clocks={"trust_gnss": True, "node_utc_error_s": 0.01})
    pipeline, said = Pipeline(trusting), list[Output]()
    for n in range(200):
        t_s = n / 10
        said += run(pipeline, [position(t_s, "1:1")])
        if n % 10 == 0:
            unix_us = (START_NS + round((t_s - (1.0 if t_s >= 15.0 else 0.0)) * S)) // 1000
            stamp = dialect.MAVLink_system_time_message(unix_us, round((100 + t_s) * 1000))
            said += run(pipeline, [sent(t_s + 0.02, "1:1", stamp)])
    (refuted,) = (one for one in said if isinstance(one, Refuted))
    assert refuted.setting == "clocks.drift_max_ppm"
    assert (refuted.t_ns - START_NS) / S == pytest.approx(15.02)


def test_gnss_heading_of_the_carrier_that_contradicts_its_attitude_raises_the_bound() -> None:
    """Other vehicles' headings are not used; neither is a heading before any attitude."""

    def heading(t_s: float, deg: float, source: str = "5:1", receiver: int = 1) -> Frame:
        if receiver == 2:
            second = dialect.MAVLink_gps2_raw_message(
                1, 3, 2, 3, 4, 5, 6, 7, 8, 9, 0, 0, round(100 * deg), 0, 1, 1, 1, 100_000
            )
            return sent(t_s, source, second)
        first = dialect.MAVLink_gps_raw_int_message(
            1, 3, 2, 3, 4, 5, 6, 7, 8, 9, 0, 1, 1, 1, 100_000, round(100 * deg)
        )
        return sent(t_s, source, first)

    for receiver in (1, 2):
        pipeline = Pipeline(settings())
        run(pipeline, [heading(0.0, 90, receiver=receiver), attitude(0.1, "5:1")])
        run(pipeline, [heading(0.2, 90, "1:1", receiver), heading(0.2, 360, receiver=receiver)])
        assert pipeline.center.attitude_bound_rad == pytest.approx(math.radians(3.0))
        said = run(pipeline, [heading(0.3, 90, receiver=receiver)])
        assert pipeline.center.attitude_bound_rad == pytest.approx(math.radians(96.0))
        (notice,) = (one for one in said if isinstance(one, Notice))
        assert "96°" in notice.text and "GNSS heading" in notice.text
        (refuted,) = (one for one in said if isinstance(one, Refuted))
        assert refuted.setting == "center.attitude_bound_deg"
        run(pipeline, [heading(0.4, 1, receiver=receiver)])
        assert pipeline.center.attitude_bound_rad == pytest.approx(math.radians(3.0))


def test_what_other_vehicles_say_of_their_attitude_is_not_decoded() -> None:
    pipeline = Pipeline(settings())
    invalid = dialect.MAVLink_attitude_quaternion_cov_message(1, (0.0,) * 4, 0, 0, 0, [0.0] * 9)
    assert run(pipeline, [sent(0.1, "1:1", invalid)]) == []
    (rejected,) = run(pipeline, [sent(0.1, "5:1", invalid)])
    assert isinstance(rejected, Rejection)
    assert rejected.reason is Reason.MALFORMED


def test_stated_covariance_raises_the_bound_and_lowers_it_only_if_set() -> None:
    def stated(variance: float, source: str = "5:1") -> Frame:
        message = dialect.MAVLink_attitude_quaternion_cov_message(
            1, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, [variance] * 9
        )
        return sent(0.2, source, message)

    for follows, least_rad in ((False, math.radians(3.0)), (True, 0.009 + math.radians(2.0))):
        center = {"source": "5:1", "follow_attitude_accuracy": follows, "mount_bound_deg": 2.0}
        pipeline = Pipeline(settings().override(center=center))
        run(pipeline, [attitude(0.1, "5:1"), stated(0.01, "1:1"), stated(1e-6)])
        assert pipeline.center.attitude_bound_rad == pytest.approx(least_rad)
        run(pipeline, [stated(0.01)])
        added_rad = math.radians(2.0) if follows else 0.0
        assert pipeline.center.attitude_bound_rad == pytest.approx(0.9 + added_rad)
        run(pipeline, [position(t_s, "5:1") for t_s in np.arange(0.5, 5, 0.5)])
        run(pipeline, [position(t_s, "5:1", boot_s=t_s - 3) for t_s in np.arange(5, 8, 0.5)])
        assert pipeline.center.attitude_bound_rad == pytest.approx(math.radians(3.0))


def test_the_carrier_is_never_its_own_target() -> None:
    pipeline = Pipeline(settings(beams={"targets": "all"}))
    run(pipeline, [position(0, "5:1"), attitude(0, "5:1"), position(0, "1:1", (99, 0, 0))])
    update = updated(pipeline, 0.1)
    assert [track.uav for track in update.tracks] == ["1:1"]
    assert update.beams.uavs == ("1:1",)
    assert not pipeline.targets.wants("5:1")
    now_ns = tick(0.1).t_ns
    assert [track.uav for track in pipeline.tracks(now_ns, now_ns)] == ["1:1"]


# --- targets and rejections ---------------------------------------------------------------------


@pytest.mark.parametrize(("targets", "aimed"), [("telemetry", ()), ("all", ("icao:4CA7B3",))])
def test_adsb_traffic_is_a_target_only_if_enabled(targets: str, aimed: tuple[str, ...]) -> None:
    pipeline = Pipeline(settings("47.4,8.55,500", beams={"targets": targets}))
    (seen,) = pipeline.step(adsb(0, (3000, 500, -800)))
    assert isinstance(seen, Estimate)
    assert updated(pipeline, 0.1).beams.uavs == aimed
    now_ns = tick(0.1).t_ns
    assert [track.uav for track in pipeline.tracks(now_ns, now_ns)] == ["icao:4CA7B3"]


@pytest.mark.parametrize(
    ("flags", "reason", "who"),
    [(2, Reason.NO_POSITION, "5:1"), (1, Reason.NO_ALTITUDE, "icao:4CA7B3")],
)
def test_incomplete_adsb_reports_are_rejected_and_counted(
    flags: int, reason: Reason, who: str
) -> None:
    pipeline = Pipeline(settings())
    (refused,) = pipeline.step(adsb(0, (3000, 500, -800), flags))
    assert isinstance(refused, Rejection)
    assert refused.reason is reason
    assert pipeline.refusals.total == {reason: 1}
    assert pipeline.refusals.of(who).counts == {reason: 1}
    assert pipeline.local is None


def relayed(t_s: float, north_m: float, alt_m: float, datum: int, relay: str = "5:1") -> Frame:
    """Return an ADSB_VEHICLE flying level to the north at 50 m/s; ``datum`` is
    ADSB_ALTITUDE_TYPE.
    """
    lat, lon, _ = pymap3d.ned2geodetic(north_m, 500, 0, *PLACE)
    message = dialect.MAVLink_adsb_vehicle_message(
        0x4CA7B3, round(float(lat) * 1e7), round(float(lon) * 1e7), datum, round(alt_m * 1e3),
        0, 5000, 0, b"TEST", 0, 0, 1 | 2 | 4 | 8 | 128, 0,
    )  # fmt: skip
    return sent(t_s, relay, message)


def test_aircraft_from_two_relays_is_one_track_with_one_datum() -> None:
    """One relay reports pressure altitude, 300 m off; it is used only when the other falls
    silent.
    """
    pipeline = Pipeline(settings("47.4,8.55,500"))
    heard = [relayed(t_s, 50 * t_s, 1300, 1) for t_s in range(10)]
    heard += [relayed(t_s + 0.5, 50 * t_s + 25, 1000, 0, "6:1") for t_s in range(30)]
    heard += [relayed(t_s + 0.6, 50 * t_s, 1300, 1, "7:1") for t_s in range(10)]
    outputs = run(pipeline, sorted(heard, key=lambda each: each.t_ns))
    heights = [o.fix.report.alt_m for o in outputs if isinstance(o, Estimate)]
    assert heights == [1300] * 29 + [1000] * 11  # 1300 m was last reported at 9 s
    assert pipeline.refusals.total == {Reason.DUPLICATE: 10}
    (notice,) = (output for output in outputs if isinstance(output, Notice))
    assert (notice.subject, notice.severity) == ("icao:4CA7B3", Severity.INFO)
    assert "is pressure now, not geometric" in notice.text
    now_ns = tick(30).t_ns
    (track,) = pipeline.tracks(now_ns, now_ns)
    assert track.position_ned_m[2] == pytest.approx(-500, abs=1)
    assert track.reports == 11  # the new datum only


def test_the_same_report_over_two_links_counts_once() -> None:
    pipeline = Pipeline(settings("home"))
    pipeline.step(position(0, "1:1", seq=1))
    again = position(0.0, "1:1", seq=77, link="tcp")._replace(t_ns=START_NS + S // 2)
    (refused,) = pipeline.step(again)
    assert refused == Rejection(t_ns=again.t_ns, source="1:1", reason=Reason.DUPLICATE)
    assert pipeline.refusals.total == {Reason.DUPLICATE: 1}
    assert list(pipeline.refusals.of("1:1").recent) == [refused]
    assert pipeline.frames == 2
    track = pipeline.tracks(again.t_ns, again.t_ns)[0]
    assert track.reports == 1


def test_late_report_is_inserted_in_order() -> None:
    """Half a second late: the track equals that of a timely report."""
    made = [position(t_s, "1:1", (t_s, t_s**2, 0), (1, 2 * t_s, 0)) for t_s in (0.0, 0.5, 1.0)]
    in_order, late = Pipeline(settings("home")), Pipeline(settings("home"))
    run(in_order, made)
    found = run(late, [made[0], made[2], made[1]._replace(t_ns=START_NS + S)])
    assert isinstance(found[-1], Estimate)
    assert not late.refusals.total
    one, other = (updated(pipeline, 1.5).tracks[0] for pipeline in (in_order, late))
    assert one.position_ned_m.tolist() == other.position_ned_m.tolist()
    assert (one.reports, other.reports) == (3, 3)


def test_report_older_than_the_window_is_out_of_order() -> None:
    pipeline = Pipeline(settings("home"))
    run(pipeline, [position(0, "1:1"), position(1, "1:1", (1, 0, 0))])
    late = position(7.5, "1:1", (0.5, 0, 0), boot_s=100.5)
    pipeline.step(position(7.0, "1:1", (7, 0, 0)))
    (refused,) = pipeline.step(late)
    assert isinstance(refused, Rejection)
    assert refused.reason is Reason.OUT_OF_ORDER
    assert pipeline.refusals.total == {Reason.OUT_OF_ORDER: 1}


def test_queued_reports_are_not_out_of_order() -> None:
    """Read together but made one after the other: the track continues from the newest."""
    pipeline = Pipeline(settings("47.4,8.55,500"))
    for number in range(5):
        made = position(2.0, "1:1", (100, number, 0), boot_s=100 + 0.1 * number)
        pipeline.step(made)
    assert not pipeline.refusals.total
    newest = pipeline.tracker.newest("1:1")
    assert newest is not None
    assert newest.position_ned_m[1] == pytest.approx(4, abs=0.02)


def accuracy(t_s: float, source: str, h_acc_m: float, v_acc_m: float, vel_mps: float) -> Frame:
    """Return a GPS_RAW_INT; an accuracy of 0 means that it is not sent."""
    message = dialect.MAVLink_gps_raw_int_message(
        round(1e6 * t_s), 3, 0, 0, 0, 100, 100, 0, 0, 12, 0,
        *(round(1000 * value) for value in (h_acc_m, v_acc_m, vel_mps)), 0, 0,
    )  # fmt: skip
    return sent(t_s, source, message)


def noise_of(pipeline: Pipeline, uav: str) -> tuple[float, float, float]:
    newest = pipeline.tracker.newest(uav)
    assert newest is not None
    return newest.noise.horizontal_m, newest.noise.vertical_m, newest.noise.velocity_mps


@pytest.mark.parametrize(
    ("follow", "accuracies", "expected"),
    [
        (True, (0.8, 1.5, 0.1), (2.0, 3.75, 0.25)),
        (True, (0.8, 0.0, 0.0), (2.0, 6.0, 0.7)),
        (True, (0.0, 1.5, 0.0), (6.0, 3.75, 0.7)),
        (False, (0.8, 1.5, 0.1), (6.0, 6.0, 0.7)),
    ],
)
def test_reported_accuracy_is_used_when_enabled(
    follow: bool, accuracies: tuple[float, float, float], expected: tuple[float, float, float]
) -> None:
    """From the first report that was made after it, times the factor; missing values use the
    default."""
    given = {
        "position_noise_m": 6.0, "velocity_noise_mps": 0.7,
        "accuracy_factor": 2.5, "follow_accuracy": follow,
    }  # fmt: skip
    pipeline = Pipeline(settings("home", observer=given))
    run(pipeline, steady("1:1"))
    assert noise_of(pipeline, "1:1") == (6.0, 6.0, 0.7)
    pipeline.step(accuracy(STEADY_S, "1:1", *accuracies))
    run(pipeline, [position(STEADY_S + 0.1, "1:1"), position(STEADY_S + 0.1, "2:1", (50, 0, 0))])
    assert noise_of(pipeline, "1:1") == pytest.approx(expected)
    assert noise_of(pipeline, "2:1") == (6.0, 6.0, 0.7)
    pipeline.step(accuracy(STEADY_S + 0.2, "1:1", 0, 0, 0))  # no longer sent
    pipeline.step(position(STEADY_S + 0.3, "1:1"))
    assert noise_of(pipeline, "1:1") == (6.0, 6.0, 0.7)


STEADY_S = 5.0
"""Time after which the clock of a sender of ``steady`` reports is known to 0.1 s."""


def steady(uav: str) -> list[Frame]:
    return [position(0.1 * n, uav) for n in range(round(10 * STEADY_S))]


@pytest.mark.parametrize("late_s", [0.05, 0.4, 1.5])
def test_report_overtaken_by_a_better_accuracy_keeps_the_worse_one(late_s: float) -> None:
    """The status says 0.5 m after 5 m; a report made between the two arrives after both."""
    pipeline = Pipeline(settings("home"))
    run(pipeline, [*steady("1:1"), accuracy(STEADY_S, "1:1", 5.0, 5.0, 0.2)])
    made_s = STEADY_S + 0.1
    late = position(made_s + late_s, "1:1", boot_s=100 + made_s)
    run(pipeline, [accuracy(made_s + 0.01, "1:1", 0.5, 0.5, 0.1), late])
    assert noise_of(pipeline, "1:1") == pytest.approx((15.0, 15.0, 0.6))
    again_s = made_s + SETTLED_NS / S + 0.1  # the autopilot has followed its receiver
    run(pipeline, [position(made_s + n, "1:1") for n in range(2, round(again_s - made_s))])
    run(pipeline, [accuracy(again_s, "1:1", 0.5, 0.5, 0.1), position(again_s + 1.0, "1:1")])
    assert noise_of(pipeline, "1:1") == pytest.approx((1.5, 1.5, 0.3))


def test_worse_accuracy_that_was_overtaken_holds_for_reports_made_before_it_arrived() -> None:
    """A better status overtook it, and so did the report that it concerns."""
    pipeline = Pipeline(settings("home"))
    run(pipeline, [*steady("1:1"), accuracy(STEADY_S, "1:1", 0.5, 0.5, 0.1)])
    run(pipeline, [accuracy(STEADY_S + 0.4, "1:1", 0.5, 0.5, 0.1)])
    overtaken = accuracy(STEADY_S + 0.2, "1:1", 5.0, 5.0, 0.2)._replace(
        t_ns=START_NS + round((STEADY_S + 0.5) * S)
    )
    late = position(STEADY_S + 0.6, "1:1", boot_s=100 + STEADY_S + 0.3)
    run(pipeline, [overtaken, late])
    assert noise_of(pipeline, "1:1") == pytest.approx((15.0, 15.0, 0.6))
    run(pipeline, [position(STEADY_S + 1.0, "1:1")])
    assert noise_of(pipeline, "1:1") == pytest.approx((1.5, 1.5, 0.3))


def test_outdated_receiver_status_is_ignored() -> None:
    """A slower second link repeats it; a much earlier time belongs to another boot."""
    pipeline = Pipeline(settings("home"))
    run(pipeline, [position(0.1 * n, "1:1") for n in range(450, 500)])
    run(pipeline, [accuracy(50.0, "1:1", 0.5, 0.5, 0.1)])
    run(pipeline, [accuracy(51.0, "1:1", 5.0, 5.0, 0.2), position(51.1, "1:1")])
    assert noise_of(pipeline, "1:1") == pytest.approx((15.0, 15.0, 0.6))
    late = accuracy(50.0, "1:1", 0.5, 0.5, 0.1)
    run(pipeline, [late._replace(t_ns=START_NS + 51_200 * S // 1000), position(51.3, "1:1")])
    assert noise_of(pipeline, "1:1") == pytest.approx((15.0, 15.0, 0.6))
    anew = accuracy(2.0, "1:1", 1.0, 1.0, 0.1)
    run(pipeline, [anew._replace(t_ns=START_NS + 52 * S)])
    run(pipeline, [position(0.1 * n, "1:1") for n in range(521, 580)])
    again = accuracy(8.0, "1:1", 1.0, 1.0, 0.1)._replace(t_ns=START_NS + 58 * S)
    run(pipeline, [again, position(58.1, "1:1")])
    assert noise_of(pipeline, "1:1") == pytest.approx((3.0, 3.0, 0.3))


def test_accuracy_that_is_stated_no_more_ends() -> None:
    """A receiver may have lost RTK since, and anybody may have stated it while a radio was off."""
    pipeline = Pipeline(settings("home"))
    run(pipeline, [position(n / 5, "1:1") for n in range(100)])
    default = noise_of(pipeline, "1:1")
    run(pipeline, [accuracy(20.0, "1:1", 0.1, 20.0, 0.1)])
    run(pipeline, [position(20.0 + n / 5, "1:1") for n in range(1, 40)])
    assert noise_of(pipeline, "1:1") == pytest.approx((0.9, 60.0, 0.3))
    run(pipeline, [position(28.0 + n / 5, "1:1") for n in range(20)])
    assert noise_of(pipeline, "1:1") == pytest.approx((default[0], 60.0, default[2]))
    run(pipeline, [position(32.0 + n / 5, "1:1") for n in range(250)])
    assert noise_of(pipeline, "1:1") == default


def test_accuracy_before_the_first_position_counts_for_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nobody is known to speak for the vehicle yet."""
    monkeypatch.setattr(senders, "RECEIVER_WAIT_NS", 0)  # the receiver's height is another
    flight = [position(1.0 + n / 5, "1:1") for n in range(30)]
    alone, after = Pipeline(settings("47.4,8.5,400")), Pipeline(settings("47.4,8.5,400"))
    run(alone, flight)
    run(after, [accuracy(0.0, "1:1", 0.1, 20.0, 0.1), *flight])
    assert noise_of(after, "1:1") == noise_of(alone, "1:1")


def test_receiver_status_after_a_reboot_replaces_the_old_one() -> None:
    """Within the lag of a second link, so that only the reboot distinguishes it from an old
    status.
    """
    pipeline = Pipeline(settings("home"))
    run(pipeline, [position(n / 5, "1:1") for n in range(100)])
    run(pipeline, [accuracy(15.0, "1:1", 5.0, 5.0, 0.2)])
    run(pipeline, [position(20.0 + n, "1:1", boot_s=1.0 + n) for n in range(4)])
    anew = accuracy(3.0, "1:1", 1.0, 1.0, 0.1)
    pipeline.step(anew._replace(t_ns=START_NS + 23_500 * S // 1000))
    run(pipeline, [position(20.0 + n, "1:1", boot_s=1.0 + n) for n in range(4, 10)])
    again = accuracy(9.0, "1:1", 1.0, 1.0, 0.1)
    pipeline.step(again._replace(t_ns=START_NS + 29_500 * S // 1000))
    run(pipeline, [position(20.0 + n, "1:1", boot_s=1.0 + n) for n in range(10, 13)])
    assert pipeline.restarts["1:1"] == 1
    assert noise_of(pipeline, "1:1") == pytest.approx((3.0, 3.0, 0.3))


def test_relayed_report_has_transponder_noise_bounds() -> None:
    """100 m plus the distance flown in the second to which its time is known."""
    pipeline = Pipeline(settings("home", observer={"speed_max_mps": 90.0}))
    run(pipeline, [accuracy(0.0, "5:1", 0.5, 0.5, 0.1), adsb(0.1, (3000, 500, -800))])
    assert noise_of(pipeline, "icao:4CA7B3") == pytest.approx((190.0, 190.0 + GEOID_M, 10.0))
    lat, lon, alt = pymap3d.ned2geodetic(3000, 540, -800, *PLACE)
    told = dialect.MAVLink_adsb_vehicle_message(
        0x4CA7B3, round(float(lat) * 1e7), round(float(lon) * 1e7), 1, round(float(alt) * 1e3),
        9000, 4000, 300, b"TEST", 0, 1, 1 | 2 | 4 | 8 | 128, 0,
    )  # fmt: skip
    pipeline.step(sent(1.1, "5:1", told))
    assert noise_of(pipeline, "icao:4CA7B3") == pytest.approx(
        (140.1, 140.1 + GEOID_M, 10.0), abs=0.1
    )
    now_ns = tick(1.2).t_ns
    (track,) = pipeline.tracks(now_ns, now_ns)
    assert track.clock_bound_s == 1.0


def test_relayed_report_is_dated_by_its_age_field() -> None:
    """One second earlier by ``tslc``; the arrival time is unchanged."""
    (seen,) = Pipeline(settings("47.4,8.55,500")).step(adsb(5.0, (3000, 500, -800)))
    assert isinstance(seen, Estimate)
    assert (seen.fix.t_ns, seen.fix.sender_ns) == (START_NS + 4 * S, START_NS + 4 * S)
    assert seen.fix.arrival_ns == START_NS + 5 * S


@pytest.mark.parametrize("is_repeated", [False, True])
def test_relayed_report_over_a_late_link_may_be_as_late(is_repeated: bool) -> None:
    """The relay's own reports come 3 s late over it, and perhaps sooner over another link."""
    pipeline = Pipeline(settings("47.4,8.55,500", observer={"speed_max_mps": 90.0}))
    for n in range(50):
        t_s = 0.2 * n
        late_s = 3.0 if n >= 25 else 0.0
        if is_repeated:
            pipeline.step(position(t_s, "5:1", boot_s=100 + t_s, link="fast"))
        pipeline.step(position(t_s, "5:1", boot_s=100 + t_s - late_s, link="udp"))
    (seen,) = (
        output
        for output in pipeline.step(adsb(10.0, (3000, 500, -800)))
        if isinstance(output, Estimate)
    )
    sent_ns = seen.fix.arrival_ns - 3 * S - S  # a second is its own age
    apart_s = (seen.fix.t_ns - sent_ns) * 1e-9
    assert apart_s == pytest.approx(1.5, abs=0.1)
    horizontal_m = 100.0 + 90.0 * (1.0 + apart_s)
    assert seen.fix.noise.horizontal_m == pytest.approx(horizontal_m, abs=20.0)
    (other,) = Pipeline(settings("47.4,8.55,500")).step(adsb(10.0, (3000, 500, -800)))
    assert isinstance(other, Estimate) and other.fix.t_ns == other.fix.arrival_ns - S


@pytest.mark.parametrize("late_s", [2.5, 4.0])
def test_bound_of_a_relayed_aircraft_holds_while_its_relay_is_late(late_s: float) -> None:
    """Lateness that lasts looks like a clock that stalled; 932 m off at 581 m, without a notice.

    The first late message of the aircraft comes before the first late position of the relay.
    """
    pipeline = Pipeline(settings("47.4,8.55,500", observer={"speed_max_mps": 300.0}))
    sent_s = [("relay", 0.25 * n) for n in range(400)] + [("aircraft", n - 0.1) for n in range(100)]
    worst = 0.0
    for which, t_s in sorted(sent_s, key=lambda one: one[1]):
        at_s = t_s + (late_s if t_s > 19.8 else 0.05)
        if which == "relay":
            pipeline.step(position(at_s, "5:1", boot_s=100 + t_s, link="udp"))
            continue
        place = -3000.0 + 230.0 * t_s
        pipeline.step(adsb(at_s, (3000, place, -800), east_mps=230.0, tslc_s=0))
        if t_s < 1.0:
            continue
        now_ns = START_NS + round(at_s * S)
        (track,) = (one for one in pipeline.tracks(now_ns, now_ns) if one.uav.startswith("icao"))
        off_m = math.dist(track.position_ned_m[:2], (3000, -3000.0 + 230.0 * at_s))
        worst = max(worst, off_m / track.horizontal_bound_m)
    assert 0.1 < worst < 1.0


def test_aircraft_has_a_beam_as_soon_as_the_vehicle_that_it_was_taken_for_is_stale() -> None:
    pipeline = Pipeline(settings("47.4,8.55,500", beams={"targets": "all"}))
    served = list[tuple[str, ...]]()
    for n in range(400):
        t_s = 0.1 * n
        place = (3000, 20.0 * t_s, -800)
        if n < 100:
            pipeline.step(position(t_s, "1:1", place, (0, 20, 0)))
        if n % 10 == 0:
            pipeline.step(adsb(t_s, place, east_mps=20.0, tslc_s=0))
        served.append(updated(pipeline, t_s).beams.uavs)
    assert sum(not uavs for uavs in served[10:]) <= 1, "until the next update"
    assert served[-1] == ("icao:4CA7B3",)


def test_aircraft_that_is_taken_for_another_is_announced_once() -> None:
    pipeline = Pipeline(settings("47.4,8.55,500", beams={"targets": "all"}))
    texts = list[str]()
    for n in range(100):
        t_s, place = 0.5 * n, (3000, 10.0 * n, -800)
        if n // 30 % 2:  # it parts, and returns
            place = (4000, 10.0 * n, -800)
        outputs = pipeline.step(position(t_s, "1:1", (3000, 10.0 * n, -800), (0, 20, 0)))
        outputs += pipeline.step(adsb(t_s, place, east_mps=20.0, tslc_s=0))
        texts += [one.text for one in outputs if isinstance(one, Notice) and "same" in one.text]
    assert texts == [
        "icao:4CA7B3: is where 1:1 is, within the errors of both, and counts as the same aircraft:"
        " it has no beam of its own"
    ]


def test_track_restart_is_announced_once() -> None:
    """A lasting jump of 200 m."""
    pipeline = Pipeline(settings("47.4,8.55,500"))
    outputs: list[Output] = []
    for number in range(100):
        place = (100 + (200 if number >= 50 else 0), 0.1 * number, 0)
        outputs += pipeline.step(position(number / 10, "1:1", place, (0, 1, 0)))
    (notice,) = (output for output in outputs if isinstance(output, Notice))
    assert (notice.subject, notice.severity) == ("1:1", Severity.WARNING)
    assert "1:1: track restarted" in notice.text
    estimate = outputs[outputs.index(notice) + 1]
    assert isinstance(estimate, Estimate)
    assert estimate.reacquired
    assert estimate.fix.arrival_ns == notice.t_ns == START_NS + 6 * S
    assert pipeline.refusals.total == {Reason.UNREACHABLE: 10}
    assert updated(pipeline, 10.0).beams.uavs == ("1:1",)


def test_zero_position_is_rejected_and_counted() -> None:
    pipeline = Pipeline(settings())
    zero = dialect.MAVLink_global_position_int_message(1, 200, -300, 0, 0, 0, 0, 0, 0)
    for t_s in (0.0, 0.1):
        (refused,) = pipeline.step(sent(t_s, "1:1", zero))
        assert isinstance(refused, Rejection)
        assert refused.reason is Reason.ZERO_POSITION
    assert pipeline.refusals.total == {Reason.ZERO_POSITION: 2}
    assert updated(pipeline, 0.2).tracks == ()


def test_rejections_pass_through_and_are_counted() -> None:
    pipeline = Pipeline(settings())
    garbage = Rejection(t_ns=START_NS, source="udp", reason=Reason.GARBAGE, count=17)
    assert pipeline.step(garbage) == [garbage]
    pipeline.step(garbage)
    pipeline.step(Rejection(t_ns=START_NS, source="tcp", reason=Reason.BAD_CRC, count=2))
    assert pipeline.refusals.total == {Reason.GARBAGE: 34, Reason.BAD_CRC: 2}
    assert pipeline.refusals.of("udp").counts == {Reason.GARBAGE: 34}
    assert pipeline.frames == 0


def test_unused_frames_are_only_counted() -> None:
    pipeline = Pipeline(settings())
    before = pipeline.digest.hexdigest()
    assert pipeline.step(sent(0, "1:1", dialect.MAVLink_ping_message(1, 2, 3, 4))) == []
    beat = dialect.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3)
    assert pipeline.step(sent(0, "1:1", beat)) == []
    assert pipeline.frames == 2
    assert pipeline.digest.hexdigest() == before


def test_track_waits_for_receiver_status_again_after_a_reboot() -> None:
    """The receiver's height always differs, so the first track started after ten seconds."""
    pipeline = Pipeline(settings("47.4,8.55,500"))

    def reasons(from_s: float, to_s: float, boot_s: float) -> list[Reason]:
        found = []
        for t_s in np.arange(from_s, to_s, 0.5):
            events = [accuracy(t_s, "1:1", 1, 1, 1), position(t_s, "1:1", boot_s=boot_s + t_s)]
            found += [one.reason for one in run(pipeline, events) if isinstance(one, Rejection)]
        return found

    assert reasons(0, 15, 100.0) == [Reason.NO_FIX] * 20
    after = reasons(15, 30, -14.0)
    assert pipeline.restarts["1:1"] == 1
    assert after.count(Reason.NO_FIX) == 20


def test_reboot_is_announced_and_starts_a_new_track() -> None:
    pipeline = Pipeline(settings("47.4,8.55,500"))
    for t_s in range(5):
        pipeline.step(position(t_s, "1:1", (100 + t_s, 0, 0)))
    pipeline.step(position(4, "2:1", (0, 90, 0)))
    for t_s in (5.0, 5.5):  # a stamp far in the past needs confirmation by others
        (refused,) = pipeline.step(position(t_s, "1:1", (200, 0, 0), boot_s=t_s - 3))
        assert isinstance(refused, Rejection)
        assert refused.reason is Reason.UNPLACED_STAMP
    notice, first = pipeline.step(position(6, "1:1", (200, 0, 0), boot_s=3.0))
    assert isinstance(notice, Notice)
    assert (notice.subject, notice.severity) == ("1:1", Severity.WARNING)
    assert "restarted" in notice.text
    assert isinstance(first, Estimate)
    assert first.dt_s is None
    assert first.fix.t_ns == START_NS + 6 * S
    update = updated(pipeline, 6.1)
    tracks = {track.uav: track for track in update.tracks}
    assert (tracks["1:1"].reports, tracks["2:1"].reports) == (1, 1)
    assert tracks["1:1"].position_ned_m[0] == pytest.approx(200, abs=0.05)
    assert set(update.beams.uavs) == {"1:1", "2:1"}
    (second,) = pipeline.step(position(7, "1:1", (201, 0, 0), boot_s=4.0))
    assert isinstance(second, Estimate)
    assert second.dt_s == pytest.approx(1.0)


def test_state_changes_are_announced() -> None:
    pipeline = Pipeline(settings("47.4,8.55,500"))
    pipeline.step(position(0, "1:1", (100, 0, 0)))
    said = {}
    for t_s in (0.1, 1.0, 2.5, 3.0, 16.0, 17.0, 61.0, 62.0):
        *notices, update = pipeline.step(tick(t_s))
        assert isinstance(update, Update)
        said[t_s] = [(n.severity, n.text) for n in notices if isinstance(n, Notice)]
        assert len(update.beams.beams) == (t_s < 15)
        assert len(update.tracks) == 1  # the lost state is shown, too
    assert {t_s: notices for t_s, notices in said.items() if notices} == {
        0.1: [(Severity.INFO, "1:1 is live")],
        2.5: [(Severity.INFO, "1:1 is coasting")],
        16.0: [(Severity.WARNING, "1:1 is stale")],
        61.0: [(Severity.WARNING, "1:1 is lost")],
    }


# --- a fold: the same events, the same digest ---------------------------------------------------


def test_the_same_events_give_the_same_digest(paper: list[Event]) -> None:
    one, two = Pipeline(settings()), Pipeline(settings())
    run(one, paper)
    run(two, paper)
    assert one.digest.hexdigest() == two.digest.hexdigest()
    assert len(one.digest.hexdigest()) == 64


def test_other_events_give_another_digest(begun: list[Event]) -> None:
    def digest(events: list[Event], **sections: dict[str, Any]) -> str:
        pipeline = Pipeline(settings("5:1", **sections))
        run(pipeline, events)
        return pipeline.digest.hexdigest()

    reports = [n for n, e in enumerate(begun) if isinstance(e, Frame) and e.msgid == 33]
    attitudes = [
        n for n, e in enumerate(begun) if isinstance(e, Frame) and e.msgid == 30
        and e.source == Source(5, 1)
    ]  # fmt: skip
    ticks = [n for n, e in enumerate(begun) if isinstance(e, Tick)]
    digests = [digest(begun), digest(flown(scenario.paper(4), 3.0, seed=2))]
    for dropped in (reports[30], attitudes[15], ticks[15]):
        digests.append(digest(begun[:dropped] + begun[dropped + 1 :]))
    digests.append(digest(begun, array={"elements": 32}))
    digests.append(digest(begun, observer={"position_noise_m": 4.0, "follow_accuracy": False}))
    digests.append(digest(begun, observer={"model": "position"}))
    digests.append(digest(begun, observer={"feed_forward": False}))
    assert len(set(digests)) == len(digests)


def stalled_order(events: list[Event], begin_s: float, end_s: float) -> list[Event]:
    """Return the events in the order of a stalled node: its first tick precedes the queued frames,
    and the ticks in between are missing."""
    begin_ns, end_ns = START_NS + round(begin_s * S), START_NS + round(end_s * S)

    def waits(event: Event) -> bool:
        return begin_ns <= event.t_ns < end_ns

    frames = [event for event in events if waits(event) and isinstance(event, Frame)]
    before = [event for event in events if event.t_ns < begin_ns]
    return [*before, Tick(end_ns), *frames, *(e for e in events if e.t_ns >= end_ns)]


def digest_of(*outputs: Estimate | Update) -> str:
    digest = Digest()
    for output in outputs:
        digest.add(output)
    return digest.hexdigest()


def test_stalled_node_reaches_the_same_state(paper: list[Event]) -> None:
    """Frames are processed after a later tick, with their true arrival times."""
    smooth, busy = Pipeline(settings("5:1")), Pipeline(settings("5:1"))
    late = stalled_order(paper, 2.0, 2.5)
    assert any(a.t_ns > b.t_ns + S // 4 for a, b in pairwise(late))
    estimated = [
        [output for output in run(pipeline, events) if isinstance(output, Estimate)]
        for pipeline, events in ((smooth, paper), (busy, late))
    ]
    assert digest_of(*estimated[0]) == digest_of(*estimated[1])
    now_ns = paper[-1].t_ns + S // 10
    ours, theirs = busy.look(now_ns), smooth.look(now_ns)
    # The width of a beam follows its bound step by step, and so has other rounding errors.
    np.testing.assert_allclose(ours.beams.weights, theirs.beams.weights, rtol=0.0, atol=1e-14)
    assert digest_of(replace(ours, beams=theirs.beams)) == digest_of(theirs)
    again = Pipeline(settings("5:1"))
    run(again, late)
    assert again.digest.hexdigest() == busy.digest.hexdigest()


def test_digest_covers_every_field_of_an_estimate() -> None:
    (seen,) = Pipeline(settings("47.4,8.55,500")).step(position(0.0, "1:1", (3.0, 4.0, 5.0)))
    assert isinstance(seen, Estimate)
    others = [
        replace(seen, fix=seen.fix._replace(uav="1:2")),
        replace(seen, fix=seen.fix._replace(t_ns=seen.fix.t_ns + 1)),
        replace(seen, bound_m=seen.bound_m + 1e-9),
        *(replace(seen, position_ned_m=seen.position_ned_m + axis) for axis in 1e-9 * np.eye(3)),
    ]
    digests = []
    for one in (seen, *others):
        digests.append(Digest())
        digests[-1].add(one)
    assert len({digest.hexdigest() for digest in digests}) == len(digests)


def test_queries_do_not_change_the_pipeline(begun: list[Event]) -> None:
    """Neither the digest nor later outputs change."""
    quiet, watched = Pipeline(settings()), Pipeline(settings())
    for number, event in enumerate(begun):
        plain, seen = quiet.step(event), watched.step(event)
        assert repr(plain) == repr(seen)
        if number % 7 == 0:
            for lead_s in (0.0, 0.5, -0.2):
                watched.look(event.t_ns + number, lead_s)
            watched.tracks(event.t_ns + S, event.t_ns + 2 * S)
            watched.carrier(event.t_ns + S, event.t_ns)
            watched.tracker.newest("1:1")
    assert quiet.digest.hexdigest() == watched.digest.hexdigest()
    assert quiet.updates == watched.updates
    last = watched.last_update
    watched.look(START_NS + 100 * S)
    assert watched.last_update is last


def test_geodetic_inverts_local_coordinates() -> None:
    pipeline = Pipeline(settings("47.4,8.55,500"))
    lat, lon, alt = pipeline.geodetic(np.array([[10.0, 20, -30]]))
    assert (lat[0], lon[0], alt[0]) == pytest.approx(pymap3d.ned2geodetic(10, 20, -30, *PLACE))
    with pytest.raises(ValueError, match="no report yet"):
        Pipeline(settings()).geodetic(np.zeros((1, 3)))


# --- ticks of a log -----------------------------------------------------------------------------


def test_ticks_follow_the_configured_rate() -> None:
    frames = [position(t_s, "1:1") for t_s in (0.0, 0.01, 0.3, 0.31, 1.0)]
    events = list(with_ticks(frames, 20.0))
    ticks = [event.t_ns for event in events if isinstance(event, Tick)]
    assert ticks == [START_NS + n * 50_000_000 for n in range(1, 21)]
    assert [event for event in events if isinstance(event, Frame)] == frames
    assert events[0] is frames[0]
    assert all(a.t_ns <= b.t_ns for a, b in pairwise(events))
    # Ticks due by the time of a frame precede it.
    assert events.index(frames[4]) == len(events) - 1


def test_tick_period_rounding_does_not_accumulate() -> None:
    frames = [position(t_s, "1:1") for t_s in (0.0, 10.0)]
    ticks = [e.t_ns for e in with_ticks(frames, 3.0) if isinstance(e, Tick)]
    assert ticks == [START_NS + n * 333_333_333 for n in range(1, 31)]


def test_no_events_give_no_ticks() -> None:
    assert list(with_ticks([], 20.0)) == []
    garbage = Rejection(t_ns=START_NS, source="udp", reason=Reason.GARBAGE)
    assert list(with_ticks([garbage, garbage], 1000.0)) == [garbage, garbage]


def test_relayed_aircraft_gets_its_beam_back_when_its_own_telemetry_ends() -> None:
    """The bound of the silent track grew to kilometres, and held every aircraft for ten minutes."""
    pipeline = Pipeline(settings("47.4,8.55,500", beams={"targets": "all"}))
    beams = list[set[str]]()
    for n in range(60):
        here = (300.0 + 5 * n, 40.0, -120.0)
        if n < 20:
            pipeline.step(position(n, "1:1", here, (5, 0, 0)))
        pipeline.step(adsb(n + 0.1, (here[0] + 8, 30.0, -130.0)))
        beams.append(set(updated(pipeline, n + 0.2).beams.uavs))
    assert beams[19] == {"1:1"}
    assert beams[40:] == [{"icao:4CA7B3"}] * 20
    assert max(map(len, beams[19:])) == 1  # two beams on one aircraft ruin zero forcing


def test_own_telemetry_and_adsb_of_one_aircraft_get_one_beam() -> None:
    pipeline = Pipeline(settings("47.4,8.55,500", beams={"targets": "all"}))
    for n in range(8):
        here = (300.0 + 5 * n, 40.0, -120.0)
        pipeline.step(position(n, "1:1", here, (5, 0, 0)))
        pipeline.step(adsb(n + 0.1, (here[0] + 8, 30.0, -130.0)))
        update = updated(pipeline, n + 0.2)
        assert set(update.beams.uavs) == ({"1:1", "icao:4CA7B3"} if n < 4 else {"1:1"})
    assert pipeline.targets.identities.same_as("icao:4CA7B3") == "1:1"
    assert pipeline.targets.identities.same_as("1:1") is None
    assert not pipeline.targets.wants("icao:4CA7B3")


# --- links, lists and round trips ---------------------------------------------------------------


def test_denied_senders_are_not_tracked_and_are_counted() -> None:
    lists = {"allow": ["*:1"], "deny": ["2:1", "5:1"]}
    pipeline = Pipeline(settings(tracks=lists))
    for t_s in np.arange(0, 2, 0.1):
        for source in ("1:1", "2:1", "3:7", "5:1"):
            run(pipeline, [position(t_s, source, (100.0, 0.0, 0.0))])
        run(pipeline, [adsb(t_s, (500.0, 0.0, -50.0))])
    now_ns = START_NS + 2 * S
    assert [track.uav for track in pipeline.tracks(now_ns, now_ns)] == ["1:1"]
    assert pipeline.tracker.newest("5:1") is not None  # the carrier is always tracked
    refused = {
        uav: pipeline.refusals.of(uav).counts[Reason.NOT_ALLOWED]
        for uav in ("2:1", "3:7", "icao:4CA7B3", "5:1")
    }
    assert refused["2:1"] == refused["3:7"] == 20
    assert refused["icao:4CA7B3"] > 0
    assert refused["5:1"] == 0


def test_first_link_and_latency_of_each_link_are_recorded() -> None:
    """``fast`` delivers a report at once and ``slow`` 50 ms later; one report was lost on fast."""
    pipeline = Pipeline(settings("47.4,8.55,500"))
    for n in range(50):
        both = [position(n / 10, "1:1", link="fast"), position(n / 10, "1:1", link="slow")]
        if n == 30:
            del both[0]
        late = both[-1]._replace(t_ns=both[-1].t_ns + S // 20)
        run(pipeline, [*both[:-1], late])
    fast, slow = pipeline.senders.link_share("fast"), pipeline.senders.link_share("slow")
    assert (fast.first, fast.repeats, slow.first, slow.repeats) == (49, 0, 1, 49)
    assert np.median(fast.latencies_s) == pytest.approx(0.0, abs=1e-3)
    assert np.median(slow.latencies_s) == pytest.approx(0.05, abs=1e-3)
    assert pipeline.refusals.total[Reason.DUPLICATE] == 49
    assert pipeline.senders.link_share("another").first == 0


def test_round_trips_reveal_one_way_latency() -> None:
    """Every report takes at least 300 ms; the TIMESYNC answers show it."""
    pipeline = Pipeline(settings("47.4,8.55,500"))
    for n in range(40):
        made_s = n / 4
        late = position(made_s, "1:1")._replace(t_ns=START_NS + round((made_s + 0.3) * S))
        run(pipeline, [late])
        sent_ns = late.t_ns + S // 50
        remote_ns = (
            sent_ns + S // 100 - START_NS + 100 * S
        )  # halfway; the boot clock started at 100 s
        assert (
            pipeline.step(
                RoundTrip(
                    t_ns=sent_ns + S // 50,
                    source=Source(1, 1),
                    sent_ns=sent_ns,
                    remote_ns=remote_ns,
                )
            )
            == []
        )
    estimate = pipeline.clock_estimate("1:1")
    assert estimate is not None
    assert estimate.kind is ClockKind.TIMESYNC
    assert estimate.latency_s == pytest.approx(0.3, abs=0.011)
    assert estimate.uncertainty_s < 0.02


def test_long_silent_uav_is_dropped_and_returns_as_new() -> None:
    ages = {"coasting_s": 1.0, "stale_s": 2.0, "lost_s": 3.0, "dropped_s": 8.0}
    pipeline = Pipeline(settings("47.4,8.55,500", tracks=ages))
    outputs = run(pipeline, [position(n / 10, "1:1", (50.0, 0.0, 0.0)) for n in range(10)])
    events: list[Event] = [position(0.95 + n / 10, "2:1", (0.0, 50.0, 0.0)) for n in range(300)]
    events += [tick(n / 10) for n in range(300)]
    outputs += run(pipeline, sorted(events, key=lambda event: event.t_ns))
    said = [one.text for one in outputs if isinstance(one, Notice) and one.subject == "1:1"]
    assert said == [
        *(f"1:1 is {state}" for state in ("live", "coasting", "stale", "lost")),
        "1:1 is dropped: no usable report for 8 s",
    ]
    now_ns = START_NS + 30 * S
    assert [track.uav for track in pipeline.tracks(now_ns, now_ns)] == ["2:1"]
    (again,) = run(pipeline, [position(31.0, "1:1", (60.0, 0.0, 0.0))])
    assert isinstance(again, Estimate)
    assert again.dt_s is None


@pytest.mark.parametrize("center", ["47.4,8.55,500", "11:1"])
def test_number_of_tracks_is_limited(center: str) -> None:
    """The carrier is tracked beyond the limit: without it, there would be no beams."""
    pipeline, said = Pipeline(settings(center, tracks={"most": 3})), list[Output]()
    for n in range(20):
        for sysid in range(1, 11):
            said += run(pipeline, [position(n / 10, f"{sysid}:1", (10.0 * sysid, 0.0, 0.0))])
        if center == "11:1":
            run(pipeline, [position(n / 10, center)])
    (notice,) = (one for one in said if isinstance(one, Notice) and one.subject == "tracks")
    assert notice.text == "limit of 3 tracks reached: 4:1 and other new UAVs are not tracked"
    assert (pipeline.tracker.newest("11:1") is not None) == (center == "11:1")
    now_ns = START_NS + 2 * S
    assert [t.uav for t in pipeline.tracks(now_ns, now_ns)] == ["1:1", "2:1", "3:1"]
    assert pipeline.refusals.total == {Reason.TOO_MANY: 7 * 20}


def test_number_of_clocks_without_a_track_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Invented senders use bounded memory; senders with a track and the carrier keep their
    clocks.
    """
    monkeypatch.setattr("companion.pipeline.records.RECORDS_MAX", 10)
    monkeypatch.setattr("companion.pipeline.senders.RECORDS_MAX", 10)
    monkeypatch.setattr("companion.pipeline.records.DROPPED_TOGETHER", 2)
    pipeline = Pipeline(settings(tracks={"most": 2}))
    pipeline.step(attitude(0, "5:1"))  # the carrier has no position and thus no track
    for sysid in range(11, 61):
        pipeline.step(position(0, f"{sysid}:1", (10.0 * sysid, 0.0, 0.0)))
    kept = ["5:1", "11:1", "12:1", *(f"{sysid}:1" for sysid in range(55, 61))]
    for _ in range(2):  # before and after ticks
        known = [f"{sysid}:1" for sysid in range(1, 61) if pipeline.clock_estimate(f"{sysid}:1")]
        assert known == kept
        run(pipeline, [tick(n / 100) for n in range(100)])


def test_long_pauses_of_a_log_are_skipped() -> None:
    """A thousand pauses of one hour each would be 36 million ticks."""
    hour_ns = 3_590 * S
    garbage = [
        Rejection(t_ns=n * hour_ns, source="log", reason=Reason.GARBAGE) for n in range(1_000)
    ]
    ticks = sum(isinstance(event, Tick) for event in with_ticks(garbage, 10.0))
    assert 4 * 35_000 < ticks < 4 * 36_100 + 1_000


def test_short_pauses_of_a_log_are_ticked_through() -> None:
    """Each is shorter than a minute; together they last a day."""
    garbage = [
        Rejection(t_ns=n * 50 * S, source="log", reason=Reason.GARBAGE) for n in range(1_728)
    ]
    ticks = sum(isinstance(event, Tick) for event in with_ticks(garbage, 1.0))
    assert ticks == 1_727 * 50


def test_clock_of_a_long_silent_sender_is_forgotten() -> None:
    """Except for the carrier's, and not within the hour in which it may return."""
    pipeline = Pipeline(settings())
    run(pipeline, [position(0.0, "5:1"), position(0.0, "7:1")])
    run(pipeline, [tick(3_500.0 + n * 0.05) for n in range(DROP_EVERY)])
    assert pipeline.clock_estimate("7:1") is not None
    run(pipeline, [tick(3_700.0 + n * 0.05) for n in range(DROP_EVERY)])
    assert pipeline.clock_estimate("7:1") is None
    assert pipeline.clock_estimate("5:1") is not None
