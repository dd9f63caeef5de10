"""Aiming: selection of UAVs, pointing, and invariance under rotations of the world."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import tracks
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import examples

from companion.beams.aim import aim, directions, without
from companion.beams.array import steering
from companion.beams.array.coverage import Coverage, Sector
from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import Array, listed, uniform_circular, uniform_linear
from companion.beams.weights.precoding import Precoder, Radio, precode
from companion.values import (
    Beam,
    BeamSet,
    Carrier,
    FloatArray,
    Method,
    Normalisation,
    Policy,
    Track,
    TrackState,
    Widen,
)

EYE = np.eye(3)
STILL = np.zeros(3)
ARRAY = uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
PLACES = {"1:1": (100.0, 20.0, -10.0), "2:1": (80.0, -60.0, 5.0), "3:1": (30.0, 90.0, 0.0)}


def track(
    uav: str,
    position: FloatArray | tuple[float, ...],
    state: str = "live",
    bound_m: float = 2.0,
    velocity: FloatArray | None = None,
) -> Track:
    return tracks.track(
        np.array(position, dtype=float),
        uav=uav,
        state=TrackState(state),
        valid_at_ns=9,
        velocity_ned_mps=velocity,
        bound_m=bound_m,
    )


def carrier(
    position: tuple[float, ...] | FloatArray = (0, 0, 0),
    turn: FloatArray = EYE,
    bound_m: float = 0.0,
    *,
    velocity: FloatArray | None = None,
    rates: FloatArray = STILL,
    attitude_bound_rad: float = 0.0,
) -> Carrier:
    place = np.array(position, dtype=float)
    return Carrier(
        valid_at_ns=9,
        position_ned_m=place,
        velocity_ned_mps=velocity,
        body_from_local=turn,
        body_rates_radps=rates,
        bound_m=bound_m,
        attitude_bound_rad=attitude_bound_rad,
        age_s=None,
    )


def pointed(
    tracks: list[Track], at: Carrier | None, array: Array = ARRAY, limit: float = 100.0
) -> BeamSet:
    return aim(
        7,
        valid_at_ns=9,
        tracks=tracks,
        carrier=at,
        array=array,
        precoder=Precoder(condition_limit=limit),
    )


def test_beams_point_where_the_tracks_are() -> None:
    """Right is positive azimuth, up positive elevation, from the array's boresight."""
    at = carrier((10, 20, -5))
    tracks = [track("a", (110, 120, -5)), track("b", (60, -30, -55)), track("c", (110, 20, 95))]
    found = pointed(tracks, at)
    assert (found.t_ns, found.valid_at_ns) == (7, 9)
    assert [beam.uav for beam in found.beams] == ["a", "b", "c"]
    angles = [(45, 0, 141.42), (-45, math.degrees(math.atan2(1, math.sqrt(2))), 86.60)]
    angles.append((0, -45, 141.42))
    for beam, (azimuth, elevation, range_m) in zip(found.beams, angles, strict=True):
        assert math.degrees(beam.azimuth_rad) == pytest.approx(azimuth, abs=1e-9)
        assert math.degrees(beam.elevation_rad) == pytest.approx(elevation, abs=1e-9)
        assert beam.range_m == pytest.approx(range_m, abs=0.01)
        assert beam.pointing_bound_rad == pytest.approx(math.asin(2.0 / beam.range_m))


def test_pointing_bound_adds_carrier_and_track_bounds() -> None:
    (beam,) = pointed([track("a", (100, 0, 0), bound_m=3.0)], carrier(bound_m=4.0)).beams
    assert beam.pointing_bound_rad == pytest.approx(math.asin(0.07))
    (beam,) = pointed([track("a", (100, 0, 0), bound_m=60.0)], carrier(bound_m=40.0)).beams
    assert beam.pointing_bound_rad is None


def test_attitude_bound_adds_to_every_pointing_bound() -> None:
    tracks = [track("a", (100, 0, 0), bound_m=3.0), track("b", (0, 50, 0), bound_m=60.0)]
    near, anywhere = pointed(tracks, carrier(bound_m=4.0, attitude_bound_rad=0.05)).beams
    assert near.pointing_bound_rad == pytest.approx(math.asin(0.07) + 0.05)
    assert anywhere.pointing_bound_rad is None
    (beam,) = pointed(tracks[:1], carrier(attitude_bound_rad=math.pi)).beams
    assert beam.pointing_bound_rad == math.pi  # the largest possible angle


def test_a_true_direction_lies_within_the_pointing_bound() -> None:
    """Worst case of both errors: a lateral position error plus an attitude error in the same
    sense."""
    tracks = [track("a", (100, 0, 0), bound_m=6.0)]
    (beam,) = pointed(tracks, carrier(bound_m=2.0, attitude_bound_rad=0.1)).beams
    assert beam.pointing_bound_rad is not None
    worst = 0.0
    for angle in np.linspace(0, math.pi, 721):
        true = np.array([100.0, 0, 0]) + 8.0 * np.array([math.cos(angle), math.sin(angle), 0])
        x, y, _ = Rotation.from_euler("z", 0.1).as_matrix() @ true
        worst = max(worst, abs(math.atan2(y, x)))
    assert worst <= beam.pointing_bound_rad + 1e-12
    assert worst == pytest.approx(beam.pointing_bound_rad, abs=1e-5)


def test_pointing_bound_covers_attitude_error_with_a_lever_arm() -> None:
    """Lever arm of 10 m, a UAV 2 m from the array, attitude error of 2 degrees."""
    array = uniform_linear(
        8,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=EYE,
        lever_arm_m=np.array([10.0, 0.0, 0.0]),
    )
    turned = math.radians(2.0)
    place = np.array([10.0, 0.0, 0.0]) + 2.0 * np.array([math.cos(0.5), math.sin(0.5), 0.0])
    at = carrier(bound_m=0.0, attitude_bound_rad=turned)
    beams = aim(
        9,
        valid_at_ns=9,
        tracks=[track("a", tuple(place), bound_m=0.0)],
        carrier=at,
        array=array,
        precoder=Precoder(),
        coverage=Coverage(),
    )
    (beam,) = beams.beams
    assert beam.pointing_bound_rad is not None
    worst = 0.0
    for angle in np.linspace(-turned, turned, 101):
        body = Rotation.from_euler("z", angle).as_matrix()
        x, y, _ = body.T @ (place - body @ np.array([10.0, 0.0, 0.0]))
        worst = max(worst, abs(math.atan2(y, x) - beam.azimuth_rad))
    assert turned < worst <= beam.pointing_bound_rad


def test_zero_forcing_weights_respond_only_to_their_own_direction() -> None:
    """Compared with explicit phases for elements along y, half a wavelength apart."""
    found = pointed([track(uav, place) for uav, place in PLACES.items()], carrier())
    assert (found.method, found.regularised) == (Method.ZERO_FORCING, False)
    assert found.weights.shape == (16, 3)
    assert found.uavs == tuple(PLACES)
    a = np.array(
        [
            [np.exp(1j * np.pi * m * y / math.dist((0, 0, 0), (x, y, z))) for m in range(16)]
            for x, y, z in PLACES.values()
        ]
    )
    assert np.abs(a @ found.weights - np.eye(3)).max() < 1e-9
    assert found.condition_number == pytest.approx(np.linalg.cond(a))
    for column, beam in enumerate(found.beams):
        power = np.sum(np.abs(found.weights[:, column]) ** 2)
        assert beam.gain_db == pytest.approx(-10 * math.log10(power))


@pytest.mark.parametrize("order", [("1:1", "2:1", "3:1"), ("3:1", "1:1", "2:1")])
def test_weight_columns_follow_the_track_order(order: tuple[str, ...]) -> None:
    plain = pointed([track(uav, PLACES[uav]) for uav in PLACES], carrier())
    found = pointed([track(uav, PLACES[uav]) for uav in order], carrier())
    assert found.uavs == order
    for column, uav in enumerate(order):
        same = plain.weights[:, plain.uavs.index(uav)]
        assert found.weights[:, column] == pytest.approx(same, abs=1e-12)


def test_tracks_without_a_beam_have_a_reason() -> None:
    tracks = [
        track("live", (100, 0, 0)),
        track("stale", (90, 40, 0), "stale"),
        track("lost", (80, -40, 0), "lost"),
        track("coasting", (70, 50, 0), "coasting"),
        track("here", (0, 0.6, 0.6)),
        track("beside", (0, 1.1, 0.0)),
    ]
    found = pointed(tracks, carrier())
    assert found.uavs == ("live", "coasting", "beside")
    assert found.weights.shape == (16, 3)
    assert {left.uav: left.reason for left in found.left_out} == {
        "stale": "its track is stale",
        "lost": "its track is lost",
        "here": "it is within 1 m of the array",
    }


def test_without_a_carrier_there_are_no_beams() -> None:
    found = pointed([track("a", (100, 0, 0)), track("b", (0, 100, 0), "stale")], None)
    assert (found.beams, found.weights.shape, found.condition_number) == ((), (16, 0), None)
    assert [left.uav for left in found.left_out] == ["a", "b"]
    assert {left.reason for left in found.left_out} == {
        "the carrier's position or attitude is unknown"
    }


@pytest.mark.parametrize("tracks", [[], [track("a", (5, 0, 0), "stale")]])
def test_no_live_tracks_give_no_beams(tracks: list[Track]) -> None:
    found = pointed(tracks, carrier())
    assert (found.beams, found.weights.shape) == ((), (16, 0))
    assert len(found.left_out) == len(tracks)


def test_mirror_directions_are_regularised() -> None:
    found = pointed([track("ahead", (80, 60, 0)), track("behind", (-80, 60, 0))], carrier())
    assert found.regularised
    assert np.all(np.isfinite(found.weights))
    assert all(math.isfinite(beam.gain_db) for beam in found.beams)


def assert_same_beams(a: BeamSet, b: BeamSet) -> None:
    # Nulls between nearly equal directions lose digits: 3e-9 at a condition number of 29 000.
    exact = max(1e-9, 1e-12 * (a.condition_number or 0.0))
    assert a.weights == pytest.approx(b.weights, abs=exact)
    for one, other in zip(a.beams, b.beams, strict=True):
        assert one.azimuth_rad == pytest.approx(other.azimuth_rad, abs=1e-9)
        assert one.elevation_rad == pytest.approx(other.elevation_rad, abs=1e-9)
        assert one.range_m == pytest.approx(other.range_m)
        assert one.pointing_bound_rad == pytest.approx(other.pointing_bound_rad)


@settings(max_examples=examples(50))
@given(st.integers(0, 2**32 - 1))
def test_carrier_rotation_equals_inverse_world_rotation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, mount, pose = (m.as_matrix() for m in Rotation.random(3, rng=rng))
    shift = rng.uniform(-500, 500, 3)
    place = rng.uniform(-50, 50, 3)
    array = uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=mount)
    tracks = [track(uav, np.array(p)) for uav, p in PLACES.items()]
    plain = pointed(tracks, carrier(tuple(place), pose), array)
    # The world, carrier included, rotated and translated.
    moved = [track(uav, turn @ np.array(p) + shift) for uav, p in PLACES.items()]
    turned = carrier(tuple(turn @ place + shift), pose @ turn.T)
    assert_same_beams(plain, pointed(moved, turned, array))
    # The mount rotated one way and the carrier the other.
    other = uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=mount @ turn)
    assert_same_beams(plain, pointed(tracks, carrier(tuple(place), turn.T @ pose), other))
    # The mount alone or the carrier alone: equal, since the rotations are composed.
    straight = uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
    assert_same_beams(plain, pointed(tracks, carrier(tuple(place), mount @ pose), straight))


def test_array_mounted_to_the_right_has_boresight_at_the_right() -> None:
    """Array yawed by 90 degrees: its boresight is the body's right."""
    right = Rotation.from_euler("ZYX", [math.pi / 2, 0, 0]).as_matrix().T
    array = uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=right)
    (beam,) = pointed([track("a", (0, 100, 0))], carrier(), array).beams
    assert beam.azimuth_rad == pytest.approx(0.0, abs=1e-12)


# --- array on its carrier -----------------------------------------------------------------------


@settings(max_examples=examples(50))
@given(st.integers(0, 2**32 - 1))
def test_lever_arm_rotates_with_the_carrier(seed: int) -> None:
    """An array with a lever arm equals an array at the resulting position."""
    rng = np.random.default_rng(seed)
    pose = Rotation.random(rng=rng).as_matrix()
    lever = rng.uniform(-3, 3, 3)
    array = uniform_linear(
        16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, lever_arm_m=lever
    )
    place = rng.uniform(-50, 50, 3)
    tracks = [track(uav, np.array(p)) for uav, p in PLACES.items()]
    found = pointed(tracks, carrier(place, pose), array)
    there = pointed(tracks, carrier(place + pose.T @ lever, pose), ARRAY)
    assert_same_beams(found, there)


def test_the_lever_arm_is_in_the_body_frame() -> None:
    """The array is two metres below a carrier that lies on its right side and faces north: two
    metres to its west."""
    array = uniform_linear(
        16,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=EYE,
        lever_arm_m=np.array([0.0, 0.0, 2.0]),
    )
    on_its_right = Rotation.from_euler("x", math.pi / 2).as_matrix().T
    (beam,) = pointed([track("a", (0, 100, 0))], carrier(turn=on_its_right), array).beams
    assert beam.range_m == pytest.approx(102.0)
    (other,) = pointed([track("a", (0, -2.5, 0))], carrier(turn=on_its_right), array).left_out
    assert other.reason == "it is within 1 m of the array"


@settings(max_examples=examples(50))
@given(st.integers(0, 2**32 - 1))
def test_rotation_invariance_holds_for_every_array(seed: int) -> None:
    """Weights included: any geometry, directional elements, a lever arm."""
    rng = np.random.default_rng(seed)
    turn, mount, pose = (m.as_matrix() for m in Rotation.random(3, rng=rng))
    elements = rng.uniform(-0.02, 0.02, (12, 3))
    outward, lever = rng.standard_normal((12, 3)), rng.uniform(-2, 2, 3)
    element = Element(ElementPattern.TR38901)
    array = listed(
        elements, 30e9, array_from_body=mount, element=element, lever_arm_m=lever, outward=outward
    )
    place, shift = rng.uniform(-50, 50, 3), rng.uniform(-500, 500, 3)
    tracks = [track(uav, np.array(p)) for uav, p in PLACES.items()]
    plain = pointed(tracks, carrier(place, pose), array)
    moved = [track(uav, turn @ np.array(p) + shift) for uav, p in PLACES.items()]
    world = carrier(turn @ place + shift, pose @ turn.T)
    assert_same_beams(plain, pointed(moved, world, array))
    # Renamed body axes: mount and lever arm rotate with them.
    other = listed(
        elements,
        30e9,
        array_from_body=mount @ turn,
        element=element,
        lever_arm_m=turn.T @ lever,
        outward=outward,
    )
    assert_same_beams(plain, pointed(tracks, carrier(place, turn.T @ pose), other))


# --- UAVs without a beam ------------------------------------------------------------------------


def test_uav_behind_forward_elements_gets_no_beam() -> None:
    array = uniform_linear(
        16,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=EYE,
        element=Element(ElementPattern.COSINE),
    )
    tracks = [track("ahead", (80, 60, 0)), track("behind", (-80, 60, 0))]
    found = pointed(tracks, carrier(), array)
    assert found.uavs == ("ahead",)
    assert found.method is Method.ZERO_FORCING
    (out,) = found.left_out
    assert (out.uav, out.reason) == ("behind", "no element of the array radiates there")


def test_uav_faced_only_by_dead_elements_gets_no_beam() -> None:
    ring = uniform_circular(
        8, 5e9, spacing_wavelengths=0.5, array_from_body=EYE, element=Element(ElementPattern.COSINE)
    )
    array = replace(ring, live=np.isin(np.arange(8), (3, 4, 5)))
    tracks = [track("ahead", (100, 0, 0)), track("behind", (-100, 20, 0))]
    for widen in Widen:
        found = aim(
            7,
            valid_at_ns=9,
            tracks=tracks,
            carrier=carrier(),
            array=array,
            precoder=Precoder(widen=widen),
        )
        assert found.uavs == ("behind",)
        (out,) = found.left_out
        assert (out.uav, out.reason) == ("ahead", "no element of the array radiates there")


@pytest.mark.parametrize("policy", Policy)
def test_coincident_uavs_give_finite_weights_under_every_policy(policy: Policy) -> None:
    tracks = [track("a", (80, 60, 0)), track("b", (80, 60, 0)), track("c", (80, -60, 0))]
    found = aim(
        7,
        valid_at_ns=9,
        tracks=tracks,
        carrier=carrier(),
        array=ARRAY,
        precoder=Precoder(policy=policy, priority=("b",)),
    )
    assert np.all(np.isfinite(found.weights))
    match policy:
        case Policy.REGULARISE:
            assert (found.uavs, found.method) == (("a", "b", "c"), Method.REGULARISED)
            assert found.weights[:, 0] == pytest.approx(found.weights[:, 1], abs=1e-9)
            assert found.groups == 1
        case Policy.GROUP:
            assert (found.uavs, found.method) == (("a", "b", "c"), Method.ZERO_FORCING)
            assert found.groups == 2
            one, other, _ = found.beams
            assert one.group != other.group
        case Policy.DROP:
            assert found.uavs == ("b", "c")
            (out,) = found.left_out
            assert out.uav == "a"
            assert out.reason.startswith("too close to a UAV of higher priority")


def test_uav_straight_above_gets_a_beam() -> None:
    """A line along y sees it broadside; its azimuth is meaningless."""
    tracks = [track("up", (0, 0, -100)), track("right", (0, 100, 0))]
    found = pointed(tracks, carrier())
    assert found.uavs == ("up", "right")
    assert found.beams[0].elevation_rad == pytest.approx(math.pi / 2)
    a = np.stack([np.ones(16), np.exp(1j * np.pi * np.arange(16))], axis=1)
    assert np.abs(a.T @ found.weights - np.eye(2)).max() < 1e-9


def test_uav_at_zero_range_gets_no_beam() -> None:
    found = pointed([track("here", (0, 0, 0))], carrier())
    assert (found.beams, found.weights.shape) == ((), (16, 0))
    assert [out.reason for out in found.left_out] == ["it is within 1 m of the array"]


def test_beam_loss_is_relative_to_a_single_uav_beam() -> None:
    found = pointed(
        [track("a", (80, 60, 0), bound_m=0), track("b", (80, 67, 0), bound_m=0)], carrier()
    )
    for column, beam in enumerate(found.beams):
        power = np.sum(np.abs(found.weights[:, column]) ** 2)
        assert beam.loss_db == pytest.approx(10 * math.log10(16 * power))
        assert beam.loss_db > 0.1
    (alone,) = pointed([track("a", (80, 60, 0), bound_m=0)], carrier()).beams
    assert alone.loss_db == pytest.approx(0.0, abs=1e-9)


def test_widened_beams_are_marked() -> None:
    tracks = [track("sure", (100, 0, 0), bound_m=0.5), track("vague", (0, 100, 0), bound_m=30.0)]
    sure, vague = pointed(tracks, carrier(turn=Rotation.from_euler("z", 0.7).as_matrix())).beams
    assert (sure.widened, vague.widened) == (False, True)
    turned = carrier(turn=Rotation.from_euler("z", 0.7).as_matrix())
    sharp = aim(
        7,
        valid_at_ns=9,
        tracks=tracks,
        carrier=turned,
        array=ARRAY,
        precoder=Precoder(widen=Widen.NO),
    )
    assert [beam.widened for beam in sharp.beams] == [False, False]


def test_unbounded_uav_gets_a_narrow_beam() -> None:
    """No floor gain could be guaranteed, so the beam is not widened."""
    tracks = [track("a", (100, 20, 0), bound_m=0.1), track("b", (100, -60, 0), bound_m=500.0)]
    near, anywhere = pointed(tracks, carrier()).beams
    assert (near.widened, anywhere.widened) == (False, False)
    assert anywhere.pointing_bound_rad is None
    assert anywhere.loss_db < 1.0


def test_pointing_p95_combines_position_and_attitude_errors() -> None:
    """Root sum of squares; an unknown term counts as a quarter of its bound; the sum is at most the
    bound."""
    known = replace(track("a", (100, 0, 0), bound_m=8.0), error_p95_m=3.0)
    at = carrier(bound_m=6.0, attitude_bound_rad=0.2)
    at = replace(at, error_p95_m=4.0, attitude_p95_rad=0.04)
    (beam,) = pointed([known], at).beams
    assert beam.pointing_p95_rad == pytest.approx(math.hypot(math.asin(0.05), 0.04))
    (beam,) = pointed([track("a", (100, 0, 0), bound_m=8.0)], carrier(attitude_bound_rad=0.2)).beams
    assert beam.pointing_p95_rad == pytest.approx(math.hypot(math.asin(0.02), 0.05))
    (beam,) = pointed([replace(known, bound_m=0.5)], carrier()).beams
    assert beam.pointing_p95_rad == beam.pointing_bound_rad == pytest.approx(math.asin(0.005))


def test_beam_values_stay_with_their_uav_when_others_are_dropped() -> None:
    """The first UAV is dropped: bounds, widths and gains must not shift by one position."""
    tracks = [
        track("twin", (80, 60, 0), bound_m=3.0),
        track("kept", (80, 60, 0), bound_m=0.2),
        track("vague", (80, -20, 0), bound_m=30.0),
    ]
    array = uniform_linear(
        16,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=EYE,
        element=Element(ElementPattern.COSINE),
    )
    how = Precoder(policy=Policy.DROP, priority=("kept", "vague"))
    found = aim(7, valid_at_ns=9, tracks=tracks, carrier=carrier(), array=array, precoder=how)
    assert found.uavs == ("kept", "vague")
    for beam, one in zip(found.beams, tracks[1:], strict=True):
        (alone,) = aim(
            7, valid_at_ns=9, tracks=[one], carrier=carrier(), array=array, precoder=Precoder()
        ).beams
        assert beam.pointing_bound_rad == alone.pointing_bound_rad
        assert beam.widened is alone.widened
        assert beam.gain_db - alone.gain_db == pytest.approx(0.0, abs=3.0)
        assert beam.loss_db >= -1e-9
    assert [beam.widened for beam in found.beams] == [False, True]
    cosine = Element(ElementPattern.COSINE).amplitude(np.array([[0.8, 0.6, 0.0]]))[0]
    most_db = 10 * math.log10(16 * cosine**2)
    assert found.beams[0].gain_db + found.beams[0].loss_db == pytest.approx(most_db)


def test_coverage_limits_apply_in_their_own_frames() -> None:
    """Array yawed right on a carrier heading east: steering limits rotate with the array, airframe
    shadows with the carrier."""
    right = Rotation.from_euler("z", math.pi / 2).as_matrix().T
    array = uniform_linear(
        16,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=right,
        element=Element(ElementPattern.COSINE),
    )
    east = carrier(turn=right)
    hidden = Sector(
        azimuth_from_rad=math.radians(80),
        azimuth_to_rad=math.radians(100),
        elevation_from_rad=-math.pi / 2,
        elevation_to_rad=math.pi / 2,
    )
    tracks = [
        track("ahead", (-100, 0, 0)),  # south: to the right of the nose, on the array's boresight
        track("aside", (-60, 80, 0)),
        track("behind", (100, 0, 0)),
    ]
    reasons = {
        out.uav: out.reason
        for out in aim(
            7,
            valid_at_ns=9,
            tracks=tracks,
            carrier=east,
            array=array,
            precoder=Precoder(),
            coverage=Coverage(hidden=(hidden,)),
        ).left_out
    }
    assert reasons.keys() == {"ahead", "behind"}
    assert reasons["ahead"].startswith("hidden by the airframe")
    assert reasons["behind"] == "no element of the array radiates there"
    limits = Coverage(azimuth_limits_rad=(-0.5, 0.5))
    found = aim(
        7,
        valid_at_ns=9,
        tracks=tracks,
        carrier=east,
        array=array,
        precoder=Precoder(),
        coverage=limits,
    )
    assert found.uavs == ("ahead",)
    assert [out.uav for out in found.left_out] == ["aside", "behind"]
    assert all("outside the steering limits" in out.reason for out in found.left_out)


# --- angle rates --------------------------------------------------------------------------------


def integrated(rates: FloatArray, seconds: float) -> FloatArray:
    """Integrate axes that rotate at constant body rates, seen from their initial frame."""
    turned: FloatArray = Rotation.from_rotvec(rates * seconds).as_matrix().T
    return turned


@settings(max_examples=examples(200))
@given(st.integers(0, 2**32 - 1))
def test_angle_rates_match_central_differences(seed: int) -> None:
    """Central differences of the angles a moment earlier and later."""
    rng = np.random.default_rng(seed)
    pose, mount = (m.as_matrix() for m in Rotation.random(2, rng=rng))
    array = uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=mount)
    place, here = rng.uniform(-300, 300, 3), rng.uniform(-50, 50, 3)
    velocity, own, rates = rng.normal(0, 30, 3), rng.normal(0, 30, 3), rng.normal(0, 1.0, 3)

    def at(t_s: float) -> Beam | None:
        there = carrier(
            here + own * t_s, integrated(rates, t_s) @ pose, 0.0, velocity=own, rates=rates
        )
        tracks = [track("a", place + velocity * t_s, velocity=velocity)]
        return next(iter(pointed(tracks, there, array).beams), None)

    h_s = 1e-5
    before, beam, after = at(-h_s), at(0.0), at(h_s)
    if beam is None or abs(beam.elevation_rad) > 1.5 or beam.range_m < 10.0:
        return  # a finite difference is inaccurate there
    assert before is not None
    assert after is not None
    turned = (after.azimuth_rad - before.azimuth_rad + math.pi) % (2 * math.pi) - math.pi
    assert beam.azimuth_rate_radps == pytest.approx(turned / (2 * h_s), rel=1e-4, abs=1e-5)
    raised = (after.elevation_rad - before.elevation_rad) / (2 * h_s)
    assert beam.elevation_rate_radps == pytest.approx(raised, rel=1e-4, abs=1e-5)
    farther = (after.range_m - before.range_m) / (2 * h_s)
    assert beam.range_rate_mps == pytest.approx(farther, rel=1e-4, abs=1e-4)


def test_carrier_rotation_alone_gives_opposite_beam_rates() -> None:
    """Yaw to the right moves the UAV ahead to the left; roll to the right raises the UAV on the
    right."""
    ahead, right = track("a", (100, 0, 0), velocity=STILL), track("b", (0, 100, 0), velocity=STILL)
    at = carrier(velocity=STILL, rates=np.array([0.2, 0.0, 0.3]))
    one, other = pointed([ahead, right], at).beams
    assert one.azimuth_rate_radps == pytest.approx(-0.3)
    assert one.elevation_rate_radps == pytest.approx(0.0)
    assert other.azimuth_rate_radps == pytest.approx(-0.3)
    assert other.elevation_rate_radps == pytest.approx(0.2)  # the right wing drops below it
    assert (one.range_rate_mps, other.range_rate_mps) == (0.0, 0.0)


def test_lever_arm_adds_to_rates_of_a_turning_carrier() -> None:
    """10 m ahead of the centre at 0.3 rad/s to the right: the array moves sideways at 3 m/s, to the
    right."""
    array = uniform_linear(
        16,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=EYE,
        lever_arm_m=np.array([10.0, 0.0, 0.0]),
    )
    at = carrier(velocity=STILL, rates=np.array([0.0, 0.0, 0.3]))
    (beam,) = pointed([track("a", (10, 50, 0), velocity=STILL)], at, array).beams
    assert beam.range_rate_mps == pytest.approx(-3.0)
    assert beam.azimuth_rate_radps == pytest.approx(-0.3)
    (beam,) = pointed([track("a", (60, 0, 0), velocity=STILL)], at, array).beams
    assert beam.azimuth_rate_radps == pytest.approx(-0.3 - 3.0 / 50.0)


def test_angle_rates_are_undefined_near_the_zenith() -> None:
    at = carrier(velocity=STILL)
    up = track("a", (1e-6, 0, -50), velocity=np.array([0.0, 1.0, 0.0]))
    (beam,) = pointed([up], at).beams
    assert (beam.azimuth_rate_radps, beam.elevation_rate_radps) == (None, None)
    assert beam.range_rate_mps == pytest.approx(0.0)


def test_rates_are_none_without_velocity_or_body_rates() -> None:
    velocity = np.array([0.0, 0.0, 7.0])
    for moving, own in ((None, STILL), (velocity, None)):
        (beam,) = pointed([track("a", (99, 0, 0), velocity=moving)], carrier(velocity=own)).beams
        assert (beam.azimuth_rate_radps, beam.elevation_rate_radps) == (None, None)
        assert beam.range_rate_mps is None
    (beam,) = pointed([track("a", (0, 0, 50), velocity=velocity)], carrier(velocity=STILL)).beams
    assert (beam.azimuth_rate_radps, beam.elevation_rate_radps) == (None, None)
    assert beam.range_rate_mps == pytest.approx(7.0)


def test_uav_outside_field_of_view_gets_neither_beam_nor_null() -> None:
    """UAVs in view get the beam that they would have alone: no gain is spent on the others."""
    view = Coverage(field_of_view_rad=math.radians(120))
    ahead = track("ahead", (80, 60, 0))
    tracks = [ahead, track("aside", (10, 99, 0)), track("behind", (-80, 60, 0))]
    found = aim(
        7,
        valid_at_ns=9,
        tracks=tracks,
        carrier=carrier(),
        array=ARRAY,
        precoder=Precoder(),
        coverage=view,
    )
    alone = aim(
        7,
        valid_at_ns=9,
        tracks=[ahead],
        carrier=carrier(),
        array=ARRAY,
        precoder=Precoder(),
        coverage=view,
    )
    assert found.uavs == ("ahead",)
    assert np.array_equal(found.weights, alone.weights)
    assert {out.uav: out.reason for out in found.left_out} == {
        "aside": "84.2 degrees off boresight, outside the field of view of 120",
        "behind": "143.1 degrees off boresight, outside the field of view of 120",
    }


@pytest.mark.parametrize("normalisation", ["total", "antenna"])
def test_protected_uav_gets_a_null_and_no_power(normalisation: str) -> None:
    tracks = [track(uav, place) for uav, place in PLACES.items()]
    precoder = Precoder(widen=Widen.NO, normalisation=Normalisation(normalisation))
    full = aim(1, valid_at_ns=2, tracks=tracks, carrier=carrier(), array=ARRAY, precoder=precoder)
    spared = without(full, {"2:1"})
    assert spared.uavs == ("1:1", "3:1")
    towards = steering.steering_matrix(ARRAY, directions(full))
    responses = np.abs(towards.T @ spared.weights)
    assert responses[1].max() < 1e-9
    power = np.abs(spared.weights) ** 2
    used = power.sum() if normalisation == "total" else power.sum(axis=1).max() * ARRAY.size
    assert used == pytest.approx(1.0)
    np.testing.assert_allclose(  # the power shares of the remaining UAVs are unchanged
        np.linalg.norm(spared.weights, axis=0)[0] / np.linalg.norm(spared.weights, axis=0)[1],
        np.linalg.norm(full.weights, axis=0)[0] / np.linalg.norm(full.weights, axis=0)[2],
    )
    assert full.uavs == ("1:1", "2:1", "3:1")  # the original beams are unchanged


def test_time_slot_of_only_protected_uavs_is_removed() -> None:
    twins = [track("1:1", (100, 0, 0)), track("2:1", (101, 0, 0)), track("3:1", (102, 0, 0))]
    precoder = Precoder(policy=Policy.GROUP, widen=Widen.NO, normalisation=Normalisation.TOTAL)
    full = aim(1, valid_at_ns=2, tracks=twins, carrier=carrier(), array=ARRAY, precoder=precoder)
    assert [beam.group for beam in full.beams] == [0, 1, 2]
    spared = without(full, {"2:1"})
    assert [beam.group for beam in spared.beams] == [0, 1]
    assert spared.groups == 2
    np.testing.assert_allclose(np.linalg.norm(spared.weights, axis=0), 1.0)


def test_protecting_all_uavs_leaves_no_beams() -> None:
    full = aim(
        1,
        valid_at_ns=2,
        tracks=[track("1:1", (100, 0, 0))],
        carrier=carrier(),
        array=ARRAY,
        precoder=Precoder(),
    )
    spared = without(full, {"1:1"})
    assert (spared.uavs, spared.groups, spared.weights.shape) == ((), 0, (16, 0))


def test_precoding_receives_snr_and_rate_weight_of_each_uav(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[Radio] = []

    def precoded(*arguments: Any, radio: Radio, **more: Any) -> Any:
        given.append(radio)
        return precode(*arguments, radio=radio, **more)

    monkeypatch.setattr("companion.beams.aim.precode", precoded)
    how = Precoder(method=Method.MMSE, rate_weights={"b": 4.0})
    tracks = [track("a", (100, 0, 0)), track("b", (0, 200, 0))]
    coverage = Coverage()
    aim(
        7,
        valid_at_ns=9,
        tracks=tracks,
        carrier=carrier(),
        array=ARRAY,
        precoder=how,
        coverage=coverage,
    )
    (radio,) = given
    assert radio.rate_weights.tolist() == [1.0, 4.0]
    assert radio.snr[0] == pytest.approx(4 * radio.snr[1])  # half the distance
