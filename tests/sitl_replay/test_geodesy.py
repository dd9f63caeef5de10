"""The local plane against pymap3d, which goes another way (You, 2000)."""

import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl_replay.geodesy import LocalPlane, Place

METRES = st.floats(-60_000.0, 60_000.0)


@given(
    st.floats(-80.0, 80.0), st.floats(-180.0, 180.0), st.floats(-400.0, 9000.0),
    METRES, METRES, st.floats(-12_000.0, 1_000.0),
)  # fmt: skip
def test_places_are_those_of_pymap3d(
    lat_deg: float, lon_deg: float, alt_m: float, north_m: float, east_m: float, down_m: float
) -> None:
    origin = Place(lat_deg, lon_deg, alt_m)
    place = LocalPlane.at(origin).place((north_m, east_m, down_m))
    # Back into the plane by the other program: metres, wherever on Earth and across 180° E.
    back_ned_m = pymap3d.geodetic2ned(*place, *origin)
    assert back_ned_m == pytest.approx((north_m, east_m, down_m), abs=5e-6)


def test_the_origin_is_where_it_is() -> None:
    origin = Place(47.3977419, 8.5455938, 513.0)
    assert LocalPlane.at(origin).place((0.0, 0.0, 0.0)) == pytest.approx(origin, abs=1e-9)
    assert LocalPlane.at(origin).place((0.0, 0.0, -10.0)).alt_m == pytest.approx(523.0)
