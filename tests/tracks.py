"""Tracks for tests that are about what is done with a track."""

from typing import Any

import numpy as np

from companion.values import FloatArray, Limits, Track, TrackState

STILL = np.zeros(3)


def track(position_ned_m: FloatArray, *, bound_m: float = 2.0, **given: Any) -> Track:
    """A live track whose every bound is ``bound_m``; of the rest, what is not given is unknown."""
    usual: dict[str, Any] = {
        "uav": "1:1",
        "state": TrackState.LIVE,
        "valid_at_ns": 0,
        "age_s": 0.1,
        "velocity_ned_mps": None,
        "unknown_input_mps": None,
        "acceleration_ned_mps2": None,
        "horizontal_bound_m": bound_m,
        "vertical_bound_m": bound_m,
        "set_center_ned_m": STILL,
        "set_radius_m": bound_m,
        "limits": Limits(60.0, 5.0),
        "error_p95_m": None,
        "clock_bound_s": 0.0,
        "dt_s": None,
        "latency_s": None,
        "gamma": None,
        "innovation_m": None,
        "reports": 1,
    }
    return Track(position_ned_m=position_ned_m, bound_m=bound_m, **usual | given)
