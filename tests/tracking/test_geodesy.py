"""The local frame against pymap3d and against explicit ellipsoid equations."""

import math

import numpy as np
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymap3d.vincenty import vreckon

from companion.tracking.geodesy import LocalFrame, Place, ned_from_ecef
from companion.values import FloatArray

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1 / 298.257223563
LATITUDES = st.floats(-89.0, 89.0)
LONGITUDES = st.floats(-180.0, 180.0)
HEIGHTS = st.floats(-100.0, 12_000.0)


def ecef_m(lat_deg: float, lon_deg: float, alt_m: float) -> FloatArray:
    """Return WGS84 ECEF coordinates, by the radius of curvature in the prime vertical."""
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    squared = FLATTENING * (2 - FLATTENING)
    prime_m = SEMI_MAJOR_M / math.sqrt(1 - squared * math.sin(lat) ** 2)
    out_m = (prime_m + alt_m) * math.cos(lat)
    up_m = (prime_m * (1 - squared) + alt_m) * math.sin(lat)
    return np.array([out_m * math.cos(lon), out_m * math.sin(lon), up_m])


def axes(lat_deg: float, lon_deg: float) -> FloatArray:
    """Return north, east and down as rows, from derivatives with respect to latitude and
    longitude.
    """
    step_deg = 1e-4
    north = ecef_m(lat_deg + step_deg, lon_deg, 0) - ecef_m(lat_deg - step_deg, lon_deg, 0)
    east = ecef_m(lat_deg, lon_deg + step_deg, 0) - ecef_m(lat_deg, lon_deg - step_deg, 0)
    down = ecef_m(lat_deg, lon_deg, -100.0) - ecef_m(lat_deg, lon_deg, 100.0)
    return np.array([v / np.sqrt(v @ v) for v in (north, east, down)])


@given(LATITUDES, LONGITUDES)
def test_ned_axes_match_the_ellipsoid(lat_deg: float, lon_deg: float) -> None:
    assert ned_from_ecef(lat_deg, lon_deg) == pytest.approx(axes(lat_deg, lon_deg), abs=1e-6)


@given(
    lat_deg=LATITUDES,
    lon_deg=LONGITUDES,
    alt_m=HEIGHTS,
    north_deg=st.floats(-1, 1),
    east_deg=st.floats(-1, 1),
    high_m=HEIGHTS,
)
def test_geodetic_positions_convert_to_local_points(
    *,
    lat_deg: float,
    lon_deg: float,
    alt_m: float,
    north_deg: float,
    east_deg: float,
    high_m: float,
) -> None:
    local = LocalFrame(lat_deg, lon_deg, alt_m)
    lat2_deg = min(89.5, max(-89.5, lat_deg + north_deg))
    there = (lat2_deg, lon_deg + east_deg, high_m)
    found = local.position_ned_m(*there)
    assert found.shape == (3,)
    straight = ecef_m(*there) - ecef_m(lat_deg, lon_deg, alt_m)
    assert found == pytest.approx(ned_from_ecef(lat_deg, lon_deg) @ straight, abs=1e-6)
    assert found == pytest.approx(axes(lat_deg, lon_deg) @ straight, abs=0.2)
    oracle = pymap3d.geodetic2ned(*there, lat_deg, lon_deg, alt_m)
    assert found == pytest.approx(np.array(oracle), abs=1e-8)  # rounding of 6.4e6 m


@given(LATITUDES, LONGITUDES, HEIGHTS, st.lists(st.tuples(*[st.floats(-5e4, 5e4)] * 3), min_size=1))
def test_local_points_round_trip_through_geodetic_positions(
    lat_deg: float, lon_deg: float, alt_m: float, points: list[tuple[float, float, float]]
) -> None:
    local = LocalFrame(lat_deg, lon_deg, alt_m)
    positions_m = np.array(points)
    lats, lons, alts = local.geodetic(positions_m)
    assert lats.shape == lons.shape == alts.shape == (len(points),)
    for row, place in enumerate(zip(lats, lons, alts, strict=True)):
        assert local.position_ned_m(*place) == pytest.approx(positions_m[row], abs=1e-5)


def test_origin_has_zero_coordinates() -> None:
    local = LocalFrame(47.4, 8.5, 500.0)
    assert local.position_ned_m(47.4, 8.5, 500.0) == pytest.approx(np.zeros(3), abs=1e-8)
    assert local.position_ned_m(47.4, 8.5, 510.0) == pytest.approx([0, 0, -10], abs=1e-6)


@given(LATITUDES, LONGITUDES, LATITUDES, LONGITUDES)
def test_local_from_ned_is_a_rotation(lat: float, lon: float, lat2: float, lon2: float) -> None:
    turn = LocalFrame(lat, lon, 0.0).local_from_ned(lat2, lon2)
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    back = LocalFrame(lat2, lon2, 0.0).local_from_ned(lat, lon)
    assert turn @ back == pytest.approx(np.eye(3), abs=1e-12)
    assert LocalFrame(lat, lon, 0.0).local_from_ned(lat, lon) == pytest.approx(np.eye(3))


@pytest.mark.parametrize("azimuth_deg", [0.0, 33.0, 90.0, 200.0, 315.0])
@pytest.mark.parametrize(("lat_deg", "lon_deg"), [(47.4, 8.6), (52.0, -3.0), (-33.0, 151.0)])
def test_distant_velocity_is_rotated_into_the_local_frame(
    lat_deg: float, lon_deg: float, azimuth_deg: float
) -> None:
    """Along a great circle by Vincenty's formulae: 10 m in 1 s."""
    local = LocalFrame(47.4, 8.5, 0.0)
    before, after = (
        local.position_ned_m(*_reached(lat_deg, lon_deg, distance_m, azimuth_deg), 0.0)
        for distance_m in (-5.0, 5.0)
    )
    course = math.radians(azimuth_deg)
    velocity = np.array([10 * math.cos(course), 10 * math.sin(course), 0.0])
    turned = local.local_from_ned(lat_deg, lon_deg) @ velocity
    assert after - before == pytest.approx(turned, abs=1e-4)


def _reached(lat: float, lon: float, distance_m: float, azimuth: float) -> tuple[float, float]:
    lat2, lon2 = vreckon(lat, lon, abs(distance_m), azimuth + (180.0 if distance_m < 0 else 0.0))
    return float(lat2), float(lon2)


# --- single positions, against pymap3d's different algorithm (You, 2000) ------------------------

METRES = st.floats(-60_000.0, 60_000.0)


@given(
    lat_deg=st.floats(-80.0, 80.0),
    lon_deg=st.floats(-180.0, 180.0),
    alt_m=st.floats(-400.0, 9000.0),
    north_m=METRES,
    east_m=METRES,
    down_m=st.floats(-12_000.0, 1_000.0),
)
def test_geodetic_positions_match_pymap3d(
    *, lat_deg: float, lon_deg: float, alt_m: float, north_m: float, east_m: float, down_m: float
) -> None:
    """pymap3d converts back to the local plane: metres, anywhere on Earth and across 180° E."""
    origin = Place(lat_deg, lon_deg, alt_m)
    place = LocalFrame(*origin).place(north_m, east_m, down_m)
    # Back into the plane by the other program: metres, wherever on Earth and across 180° E.
    back_ned_m = pymap3d.geodetic2ned(*place, *origin)
    assert back_ned_m == pytest.approx((north_m, east_m, down_m), abs=5e-6)


def test_origin_converts_back_to_itself() -> None:
    origin = Place(47.3977419, 8.5455938, 513.0)
    assert LocalFrame(*origin).place(0.0, 0.0, 0.0) == pytest.approx(origin, abs=1e-9)
    assert LocalFrame(*origin).place(0.0, 0.0, -10.0).alt_m == pytest.approx(523.0)
