"""The 3D scene shows the beams and tracks of the update, in frames with z up."""

import math
from dataclasses import replace

import numpy as np
import pymap3d
import pytest
import tracks
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from companion.beams.array.geometry import Array, uniform_linear, uniform_rectangular
from companion.beams.array.steering import unit_directions
from companion.beams.worth.patterns import half_power_beamwidths_rad
from companion.recording.scene import ARRAY, CARRIER, MAP, WIDEST_RAD, Scene
from companion.tracking.carrier import body_from_ned
from companion.values import (
    Beam,
    BeamSet,
    Carrier,
    FloatArray,
    Method,
    Normalisation,
    TrackState,
    Update,
)

NOW_NS = 1_700_000_000_000_000_000
ANGLES = st.floats(-3.1, 3.1)
TURNS = st.tuples(ANGLES, st.floats(-1.5, 1.5), ANGLES)


def array_on(turn: tuple[float, float, float], lever_arm_m: FloatArray) -> Array:
    return uniform_linear(
        8,
        3e9,
        spacing_wavelengths=0.5,
        array_from_body=body_from_ned(*turn),
        lever_arm_m=lever_arm_m,
    )


def update_of(array: Array, turn: tuple[float, float, float], place_ned_m: FloatArray) -> Update:
    """One live track with a beam, seen from the array at the given position and attitude."""
    carrier = Carrier(
        valid_at_ns=NOW_NS,
        position_ned_m=np.array([10.0, -20.0, -30.0]),
        velocity_ned_mps=None,
        body_from_local=body_from_ned(*turn),
        body_rates_radps=np.zeros(3),
        bound_m=1.0,
        attitude_bound_rad=0.01,
        age_s=0.1,
    )
    begin = carrier.position_ned_m + carrier.body_from_local.T @ array.lever_arm_m
    seen = array.array_from_body @ carrier.body_from_local @ (place_ned_m - begin)
    range_m = float(np.linalg.norm(seen))
    azimuth, elevation = math.atan2(seen[1], seen[0]), math.asin(-seen[2] / range_m)
    beam = Beam(
        uav="1:1",
        azimuth_rad=azimuth,
        elevation_rad=elevation,
        range_m=range_m,
        azimuth_rate_radps=None,
        elevation_rate_radps=None,
        range_rate_mps=None,
        pointing_bound_rad=0.1,
        gain_db=9.0,
        loss_db=0.0,
    )
    track = tracks.track(
        place_ned_m,
        valid_at_ns=NOW_NS,
        bound_m=5.0,
        horizontal_bound_m=4.0,
        vertical_bound_m=3.0,
        set_center_ned_m=place_ned_m,
        dt_s=0.1,
        latency_s=0.05,
        gamma=1.0,
        innovation_m=0.5,
        reports=9,
    )
    beams = BeamSet(
        t_ns=NOW_NS,
        valid_at_ns=NOW_NS,
        beams=(beam,),
        weights=np.ones((8, 1), complex),
        method=Method.ZERO_FORCING,
        normalisation=Normalisation.STREAM,
        condition_number=1.0,
        left_out=(),
    )
    return Update(t_ns=NOW_NS, carrier=carrier, unfit=None, tracks=(track,), beams=beams)


def xyz(vector: object) -> FloatArray:
    return np.array([getattr(vector, axis) for axis in "xyz"])


def turned(quaternion: object) -> Rotation:
    return Rotation.from_quat([getattr(quaternion, part) for part in "xyzw"])


@given(TURNS, TURNS, st.tuples(*[st.floats(-500, 500)] * 3))
def test_drawn_line_of_sight_ends_at_the_uav(
    mount: tuple[float, float, float],
    attitude: tuple[float, float, float],
    place: tuple[float, float, float],
) -> None:
    place_ned_m = np.array([place[0] + 2000.0, *place[1:]])
    array = array_on(mount, np.array([1.0, 2.0, 3.0]))
    update = update_of(array, attitude, place_ned_m)
    scene = Scene(array, 2.0)
    uav, beam = scene.picture(update).entities
    east_north_up = [place_ned_m[1], place_ned_m[0], -place_ned_m[2]]
    assert xyz(uav.texts[0].pose.position) == pytest.approx(east_north_up)
    begin, end = map(xyz, beam.lines[0].points)
    assert end == pytest.approx(np.array(east_north_up), abs=1e-6)
    (cone,) = beam.cylinders
    half = turned(cone.pose.orientation).apply([0, 0, cone.size.z / 2])
    assert xyz(cone.pose.position) - half == pytest.approx(begin, abs=1e-6)
    assert xyz(cone.pose.position) + half == pytest.approx(end, abs=1e-6)
    assert (cone.bottom_scale, cone.top_scale) == (0, 1)  # the apex is at the array

    # The chain of frames gives the same: the UAV position relative to the array, z up.
    on_map, on_carrier = scene.transforms(update)
    assert (on_map.parent_frame_id, on_map.child_frame_id) == (MAP, CARRIER)
    assert (on_carrier.parent_frame_id, on_carrier.child_frame_id) == (CARRIER, ARRAY)
    seen = end
    for transform in (on_map, on_carrier):
        seen = turned(transform.rotation).inv().apply(seen - xyz(transform.translation))
    drawn = update.beams.beams[0]
    flat = drawn.range_m * math.cos(drawn.elevation_rad)
    expected = [
        flat * math.cos(drawn.azimuth_rad),
        -flat * math.sin(drawn.azimuth_rad),  # azimuth grows to the right, y to the left
        drawn.range_m * math.sin(drawn.elevation_rad),
    ]
    assert seen == pytest.approx(np.array(expected), abs=1e-6)


def test_level_carrier_facing_north_has_x_north_and_z_up() -> None:
    array = array_on((0, 0, 0), np.array([1.0, 2.0, 3.0]))
    update = update_of(array, (0, 0, 0), np.array([1000.0, 0.0, 0.0]))
    on_map, on_carrier = Scene(array, 2.0).transforms(update)
    assert xyz(on_map.translation).tolist() == [-20, 10, 30]
    assert turned(on_map.rotation).apply(np.eye(3)) == pytest.approx(
        np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # x north, y west, z up, in east-north-up
    )
    assert xyz(on_carrier.translation).tolist() == [1, -2, -3]


@pytest.mark.parametrize("azimuth_deg", [0.0, 30.0, -50.0])
def test_cone_widths_match_the_beamwidths(azimuth_deg: float) -> None:
    array = uniform_rectangular(
        16, columns=32, frequency_hz=3e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)
    )
    azimuth, elevation = math.radians(azimuth_deg), 0.2
    direction = unit_directions(np.array([azimuth]), np.array([elevation]))[0]
    exact = half_power_beamwidths_rad(array, direction)
    ((across, upright),) = Scene(array, 2.0).widths_rad(direction[np.newaxis])
    assert across == pytest.approx(exact[0] * math.cos(elevation), rel=0.25)
    assert upright == pytest.approx(exact[1], rel=0.25)
    scene = Scene(uniform_linear(8, 3e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)), 2.0)
    ((across, upright),) = scene.widths_rad(direction[np.newaxis])
    assert across < upright / 2 <= WIDEST_RAD / 2


def test_cylinder_shows_the_bound_and_disappears_without_it() -> None:
    array = array_on((0, 0, 0), np.zeros(3))
    update = update_of(array, (0, 0, 0), np.array([1000.0, 0.0, 0.0]))
    uav, _ = Scene(array, 4.0).picture(update).entities
    (cylinder,) = uav.cylinders
    assert xyz(cylinder.size).tolist() == [8, 8, 6]
    assert (cylinder.bottom_scale, cylinder.top_scale) == (1, 1)
    assert uav.lifetime.ToNanoseconds() == 750_000_000
    assert uav.timestamp.ToNanoseconds() == NOW_NS
    assert uav.texts[0].text == "1:1 live"
    unbounded = replace(update.tracks[0], bound_m=math.inf, state=TrackState.LOST)
    (gone,) = Scene(array, 4.0).picture(replace(update, carrier=None, tracks=(unbounded,))).entities
    assert not gone.cylinders
    assert gone.spheres[0].color != uav.spheres[0].color
    assert Scene(array, 4.0).transforms(replace(update, carrier=None)) == []


@given(st.floats(-89, 89), st.floats(-180, 180), st.floats(-100, 9000))
def test_map_frame_matches_pymap3d(lat_deg: float, lon_deg: float, alt_m: float) -> None:
    """A map point transformed to the Earth frame equals the result of pymap3d."""
    array = array_on((0.0, 0.0, 0.0), np.zeros(3))
    found = Scene(array, 2.0).origin(NOW_NS, lat_deg, lon_deg, alt_m)
    assert (found.parent_frame_id, found.child_frame_id) == ("wgs84", MAP)
    turned = found.rotation
    ecef_from_map = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w])
    point = np.array([120.0, -40.0, 7.0])  # east, north, up
    placed = ecef_from_map.apply(point)
    placed += [found.translation.x, found.translation.y, found.translation.z]
    true = pymap3d.enu2ecef(*point, lat_deg, lon_deg, alt_m)
    assert placed == pytest.approx(true, abs=1e-3)
