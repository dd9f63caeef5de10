"""Common parts of onboard logs."""

import numpy as np

from companion.recording.foreign.onboard import Fixes


def test_positions_from_a_receiver_equal_its_fixes() -> None:
    fixes = Fixes(
        boot_us=np.array([1, 2]),
        unix_us=np.array([0, 0]),
        fix_type=np.array([3, 3]),
        satellites=np.array([9, 9]),
        lat_1e7=np.array([470_000_000, 470_000_100]),
        lon_1e7=np.array([80_000_000, 80_000_200]),
        alt_m=np.array([500.0, 503.0]),
        accuracies=np.full((2, 3), np.nan),
        speed_mps=np.array([1.0, 2.0]),
        course_deg=np.array([0.0, 90.0]),
    )
    velocity, heading = np.ones((2, 3)), np.array([10.0, 20.0])
    found = fixes.positions(velocity, heading)
    assert found.boot_us.tolist() == [1, 2]
    assert found.lat_1e7.tolist() == [470_000_000, 470_000_100]
    assert found.lon_1e7.tolist() == [80_000_000, 80_000_200]
    assert found.alt_m.tolist() == [500.0, 503.0]
    assert found.height_m.tolist() == [0.0, 3.0]
    assert found.velocity_ned_mps is velocity
    assert found.heading_deg is heading
