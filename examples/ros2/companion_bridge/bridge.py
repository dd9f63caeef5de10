"""ROS 2 node that publishes what a companion service knows.

    ros2 run companion_bridge bridge --ros-args -p url:=http://127.0.0.1:8080 -p rate_hz:=5.0

Topics: ``uav_SYSID_COMPID/odometry`` (nav_msgs/Odometry), ``beams``
(visualization_msgs/MarkerArray), ``/diagnostics`` (diagnostic_msgs/DiagnosticArray). The
environment variable COMPANION_TOKEN holds the bearer token, if the service requires one.
"""

import importlib
import os
from typing import Any

import rclpy
from rclpy.node import Node

from companion.client import Client, ServiceError
from companion_bridge import messages

NAMES = (
    "builtin_interfaces/Duration", "builtin_interfaces/Time", "diagnostic_msgs/DiagnosticArray",
    "diagnostic_msgs/DiagnosticStatus", "diagnostic_msgs/KeyValue", "geometry_msgs/Point",
    "geometry_msgs/Pose", "geometry_msgs/PoseWithCovariance", "geometry_msgs/Quaternion",
    "geometry_msgs/Twist", "geometry_msgs/TwistWithCovariance", "geometry_msgs/Vector3",
    "nav_msgs/Odometry", "std_msgs/ColorRGBA", "std_msgs/Header", "visualization_msgs/Marker",
    "visualization_msgs/MarkerArray",
)  # fmt: skip


def ros_types() -> dict[str, Any]:
    """Return the constructors of the messages, by name."""
    found: dict[str, Any] = {"byte": lambda value: bytes([value]), "array": list}
    for name in NAMES:
        package, kind = name.split("/")
        found[f"{package}/msg/{kind}"] = getattr(importlib.import_module(f"{package}.msg"), kind)
    return found


class Bridge(Node):  # type: ignore[misc]
    """Node that asks the service at a fixed rate."""

    def __init__(self) -> None:
        super().__init__("companion")
        url = self.declare_parameter("url", "http://127.0.0.1:8080").value
        rate_hz = self.declare_parameter("rate_hz", 5.0).value
        self._client = Client(url, os.environ.get("COMPANION_TOKEN"), timeout_s=2.0)
        self._types = ros_types()
        self._tracks: dict[str, Any] = {}
        types = self._types
        self._beams = self.create_publisher(types["visualization_msgs/msg/MarkerArray"], "beams", 1)
        self._diagnostics = self.create_publisher(
            types["diagnostic_msgs/msg/DiagnosticArray"], "/diagnostics", 1
        )
        self.create_timer(1.0 / rate_hz, self.publish)

    def publish(self) -> None:
        """Ask the service, and publish the answers."""
        try:
            status, uavs, beams = self._client.status(), self._client.uavs(), self._client.beams()
        except ServiceError as error:
            self.get_logger().warning(str(error), throttle_duration_sec=5.0)
            return
        for uav in uavs:
            message = messages.odometry(self._types, uav)
            if message is not None:
                self._track(uav["id"]).publish(message)
        levels = {uav["id"]: messages.LEVELS.get(uav["verdict"], 2) for uav in uavs}
        self._beams.publish(messages.beams(self._types, beams, levels))
        self._diagnostics.publish(messages.diagnostics(self._types, status, uavs))

    def _track(self, uav: str) -> Any:
        if uav not in self._tracks:
            kind = self._types["nav_msgs/msg/Odometry"]
            self._tracks[uav] = self.create_publisher(kind, messages.topic(uav), 5)
        return self._tracks[uav]


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    node = Bridge()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
