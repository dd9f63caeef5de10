"""What carries the array, as the API shows it: where it is and how it is turned."""

from typing import Any

import numpy as np

from companion.pipeline.fold import Pipeline
from companion.settings.center import FixedCenter
from companion.values import Carrier, FloatArray
from companion.views.words import rfc3339

Json = dict[str, Any]


def center(pipeline: Pipeline, now_ns: int) -> Json:
    """Position and attitude of the carrier, as far as they are known."""
    view: Json = {
        "source": str(pipeline.center.place),
        "fixed": isinstance(pipeline.center.place, FixedCenter),
        "lat_deg": None,
        "lon_deg": None,
        "alt_m": None,
        "heading_deg": None,
        "attitude_deg": None,
        "age_s": None,
        "bound_m": None,
        "unfit": None,
        "last_known": None,
    }
    found = pipeline.carrier(now_ns, now_ns)
    if isinstance(found, str):
        last = pipeline.last_carrier
        if last is not None:
            view["last_known"] = {
                "at": rfc3339(pipeline.utc_ns(last.valid_at_ns)),
                **_pose(pipeline, last),
            }
        return view | {"unfit": found}
    return view | _pose(pipeline, found) | {"age_s": found.age_s, "bound_m": found.bound_m}


def _pose(pipeline: Pipeline, carrier: Carrier) -> Json:
    """Where the array is, and how it is turned."""
    assert pipeline.local is not None
    lat, lon, alt = pipeline.local.geodetic(carrier.position_ned_m[np.newaxis])
    roll, pitch, yaw = euler_deg(carrier.body_from_local)
    return {
        "lat_deg": float(lat[0]),
        "lon_deg": float(lon[0]),
        "alt_m": float(alt[0]),
        "heading_deg": yaw % 360,
        "attitude_deg": {"roll": roll, "pitch": pitch, "yaw": yaw},
    }


def euler_deg(body_from_ned: FloatArray) -> tuple[float, float, float]:
    """Roll, pitch and yaw in degrees of a rotation (3, 3), in MAVLink's yaw-pitch-roll order."""
    roll = np.arctan2(body_from_ned[1, 2], body_from_ned[2, 2])
    pitch = np.arcsin(np.clip(-body_from_ned[0, 2], -1.0, 1.0))
    yaw = np.arctan2(body_from_ned[0, 1], body_from_ned[0, 0])
    return float(np.degrees(roll)), float(np.degrees(pitch)), float(np.degrees(yaw))
