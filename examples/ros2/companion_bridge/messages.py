"""Answers of the service as ROS 2 messages. Pure: message classes and answers are arguments.

Frames (REP 103):

    companion_enu    x east, y north, z up; origin at the array
    companion_array  x boresight, y left, z up, of the array on its mount

Covariances are estimates, not bounds: a bound has no distribution. They are those of a Gaussian
that has 95 % of its horizontal errors within ``error_p95_m``, or within a quarter of the bound as
long as no error is known.
"""

import math
import re
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any, Final

ENU: Final = "companion_enu"
ARRAY: Final = "companion_array"
RAYLEIGH_95: Final = 2.4477  # 95th percentile of the norm of two unit Gaussians
UNKNOWN_SHARE: Final = 0.25
UNKNOWN_VARIANCE: Final = 1e6
LEVELS: Final = {"good": 0, "weak": 1, "none": 2}  # DiagnosticStatus: OK, WARN, ERROR
COLOURS: Final = {0: (0.0, 0.7, 0.3), 1: (0.9, 0.6, 0.0), 2: (0.9, 0.2, 0.2)}
ARROW: Final = 0  # Marker.ARROW
BEAM_M: Final = 50.0  # shown length of a beam

Json = Mapping[str, Any]
Types = Mapping[str, Callable[..., Any]]
"""Constructors by ROS name, such as ``nav_msgs/msg/Odometry``; ``byte`` and ``array`` convert."""


def topic(uav: str) -> str:
    """Return the topic of a UAV's track; ids may contain characters that names of topics may not.

    Source: https://design.ros2.org/articles/topic_and_service_names.html
    """
    name = re.sub("__+", "_", re.sub("[^A-Za-z0-9]", "_", uav)).strip("_")
    return f"uav_{name}/odometry"


def odometry(types: Types, uav: Json) -> Any | None:
    """Return nav_msgs/Odometry of a UAV of ``/v1/uavs``; None without a place or a carrier."""
    if uav["north_m"] is None:
        return None
    velocity = uav["velocity_ned_mps"]
    sigma_m = (uav["error_p95_m"] or UNKNOWN_SHARE * uav["bound_m"]) / RAYLEIGH_95
    position = (uav["east_m"], uav["north_m"], -uav["down_m"])
    speeds = (0.0, 0.0, 0.0) if velocity is None else (velocity[1], velocity[0], -velocity[2])
    turned = UNKNOWN_VARIANCE
    moving = UNKNOWN_VARIANCE if velocity is None else 1.0
    return types["nav_msgs/msg/Odometry"](
        header=_header(types, uav["valid_at"], ENU),
        child_frame_id=f"uav_{uav['id'].replace(':', '_')}",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](
            pose=_pose(types, position), covariance=_covariance(types, sigma_m**2, turned)
        ),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](
                linear=_vector(types, speeds), angular=_vector(types, (0.0, 0.0, 0.0))
            ),
            covariance=_covariance(types, moving, turned),
        ),
    )


def diagnostics(types: Types, status: Json, uavs: list[Json]) -> Any:
    """Return diagnostic_msgs/DiagnosticArray: the service, and the link to each UAV."""
    behind = status["health"]["behind"]
    unfit = status["center"]["unfit"]
    found = [
        _status(
            types,
            "companion",
            2 if behind or unfit else 0,
            behind or unfit or status["health"]["headline"],
            {"version": status["version"], "updates_hz": status["rates"]["updates_hz"]},
        )
    ]
    for uav in uavs:
        if uav["verdict"] is None:
            continue
        health = uav["health"] or {}
        values = {
            name: health.get(name)
            for name in (
                "cause",
                "remedy",
                "needed_gain_db",
                "guaranteed_gain_db",
                "likely_gain_db",
            )
        }
        values |= {name: uav[name] for name in ("bound_m", "age_s", "state")}
        message = health.get("reason") or uav["verdict"]
        found.append(
            _status(
                types, f"companion: link to {uav['id']}", LEVELS[uav["verdict"]], message, values
            )
        )
    return types["diagnostic_msgs/msg/DiagnosticArray"](
        header=_header(types, status["time"], ""), status=found
    )


def beams(types: Types, answer: Json, levels: Mapping[str, int]) -> Any:
    """Return visualization_msgs/MarkerArray: an arrow for each beam of ``/v1/beams``.

    ``levels`` gives the colour of each UAV's beam: the level of its link, as in ``LEVELS``.
    """
    header = _header(types, answer["valid_at"], ARRAY)
    markers = []
    for number, beam in enumerate(answer["beams"]):
        azimuth, elevation = (
            math.radians(beam[f"{name}_deg"]) for name in ("azimuth", "elevation")
        )
        end = (
            BEAM_M * math.cos(elevation) * math.cos(azimuth),
            -BEAM_M * math.cos(elevation) * math.sin(azimuth),  # right of boresight is -y
            BEAM_M * math.sin(elevation),
        )
        markers.append(_arrow(types, header, number, end, levels.get(beam["uav"], 2)))
    return types["visualization_msgs/msg/MarkerArray"](markers=markers)


def _arrow(types: Types, header: Any, number: int, end: tuple[float, ...], level: int) -> Any:
    point, colour = types["geometry_msgs/msg/Point"], types["std_msgs/msg/ColorRGBA"]
    red, green, blue = COLOURS[level]
    return types["visualization_msgs/msg/Marker"](
        header=header,
        ns="beams",
        id=number,
        type=ARROW,
        action=0,
        pose=_pose(types, (0.0, 0.0, 0.0)),
        scale=_vector(types, (0.5, 1.0, 2.0)),
        color=colour(r=red, g=green, b=blue, a=1.0),
        lifetime=types["builtin_interfaces/msg/Duration"](sec=1, nanosec=0),
        points=[point(x=0.0, y=0.0, z=0.0), point(x=end[0], y=end[1], z=end[2])],
    )


def _header(types: Types, at: str, frame: str) -> Any:
    moment = datetime.fromisoformat(at)
    stamp = types["builtin_interfaces/msg/Time"](
        sec=math.floor(moment.timestamp()), nanosec=moment.microsecond * 1000
    )
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def _pose(types: Types, position: tuple[float, ...]) -> Any:
    x, y, z = position
    return types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=x, y=y, z=z),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )


def _vector(types: Types, values: tuple[float, ...]) -> Any:
    x, y, z = values
    return types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def _covariance(types: Types, linear: float, angular: float) -> Any:
    """Return a diagonal covariance (36,): x, y, z, then rotations about them."""
    diagonal = [linear] * 3 + [angular] * 3
    return types["array"](
        [diagonal[row] if row == column else 0.0 for row in range(6) for column in range(6)]
    )


def _status(types: Types, name: str, level: int, message: str, values: Json) -> Any:
    pair = types["diagnostic_msgs/msg/KeyValue"]
    return types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=types["byte"](level),
        name=name,
        message=message,
        hardware_id="companion",
        values=[pair(key=key, value=_text(value)) for key, value in values.items()],
    )


def _text(value: object) -> str:
    return (
        "unknown" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)
    )
