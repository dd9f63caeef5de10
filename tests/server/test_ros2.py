"""The ROS 2 bridge of the examples: its messages by ROS 2's own definitions, through CDR.

``rosbags`` has the definitions of ROS 2 Jazzy. The node itself needs rclpy, which is not on PyPI.
"""

import ast
import configparser
import re
import sys
import tomllib
import types as python_types
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from starlette.testclient import TestClient
from support import ROOT

from companion.server.app import create_app

PACKAGE = ROOT / "examples" / "ros2"
STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture(scope="module")
def messages() -> Any:
    sys.path.insert(0, str(PACKAGE))
    try:
        from companion_bridge import messages as found
    finally:
        sys.path.remove(str(PACKAGE))
    return found


def constructors() -> dict[str, Any]:
    """Constructors by ROS name; fields that are left out have ROS's defaults."""

    def constructor(name: str) -> Any:
        def make(**fields: Any) -> Any:
            known = {field: default(kind) for field, kind in STORE.get_msgdef(name).fields}
            assert fields.keys() <= known.keys(), (name, fields.keys() - known.keys())
            return STORE.types[name](**{**known, **fields})

        return make

    found = {name: constructor(name) for name in STORE.types}
    return {**found, "byte": int, "array": np.array}


def default(kind: Any) -> Any:
    nature, detail = kind
    if nature.name == "BASE":
        return "" if detail[0] == "string" else False if detail[0] == "bool" else 0
    if nature.name == "NAME":
        return empty_message(detail)
    if nature.name == "SEQUENCE" and detail[0][0].name == "BASE" and detail[0][1][0] != "string":
        return np.array([], dtype=detail[0][1][0])
    return []


def empty_message(name: str) -> Any:
    return STORE.types[name](
        **{field: default(kind) for field, kind in STORE.get_msgdef(name).fields}
    )


def through_cdr(message: Any) -> Any:
    raw = STORE.serialize_cdr(message, message.__msgtype__)
    return STORE.deserialize_cdr(raw, message.__msgtype__)


@pytest.fixture
def answers(make_node: Any) -> dict[str, Any]:
    node = make_node()
    node.tick()
    with TestClient(create_app(node)) as client:
        return {path: client.get(f"/v1/{path}").json() for path in ("status", "uavs", "beams")}


def test_tracks_are_odometry_in_enu(messages: Any, answers: Any) -> None:
    uavs = answers["uavs"]["uavs"]
    found = [through_cdr(messages.odometry(constructors(), uav)) for uav in uavs]
    assert found
    for uav, message in zip(uavs, found, strict=True):
        place = message.pose.pose.position
        assert (place.x, place.y, place.z) == (uav["east_m"], uav["north_m"], -uav["down_m"])
        variance = message.pose.covariance[0]
        assert message.pose.covariance[7] == variance > 0
        # 95 of 100 errors of this covariance lie within the usual error.
        rng = np.random.default_rng(1)
        errors = np.hypot(*rng.normal(0, np.sqrt(variance), (2, 20_000)))
        usual_m = uav["error_p95_m"] or 0.25 * uav["bound_m"]
        assert np.percentile(errors, 95) == pytest.approx(usual_m, rel=0.05)
        if uav["velocity_ned_mps"] is not None:
            north, east, down = uav["velocity_ned_mps"]
            linear = message.twist.twist.linear
            assert (linear.x, linear.y, linear.z) == (east, north, -down)
        assert message.header.frame_id == messages.ENU
        assert message.header.stamp.sec > 1_500_000_000


def test_beams_are_arrows_in_their_directions(messages: Any, answers: Any) -> None:
    levels = {uav["id"]: messages.LEVELS.get(uav["verdict"], 2) for uav in answers["uavs"]["uavs"]}
    found = through_cdr(messages.beams(constructors(), answers["beams"], levels))
    assert len(found.markers) == len(answers["beams"]["beams"]) > 0
    for beam, marker in zip(answers["beams"]["beams"], found.markers, strict=True):
        end = marker.points[1]
        assert np.degrees(np.arctan2(-end.y, end.x)) == pytest.approx(beam["azimuth_deg"], abs=1e-6)
        up = np.degrees(np.arcsin(end.z / messages.BEAM_M))
        assert up == pytest.approx(beam["elevation_deg"], abs=1e-6)
        assert (marker.type, marker.color.a) == (0, 1.0)


def test_verdicts_are_diagnostics(messages: Any, answers: Any) -> None:
    found = through_cdr(
        messages.diagnostics(constructors(), answers["status"], answers["uavs"]["uavs"])
    )
    judged = [uav for uav in answers["uavs"]["uavs"] if uav["verdict"] is not None]
    assert [one.name for one in found.status[1:]] == [
        f"companion: link to {uav['id']}" for uav in judged
    ]
    for uav, one in zip(judged, found.status[1:], strict=True):
        assert one.level == {"good": 0, "weak": 1, "none": 2}[uav["verdict"]]
        assert {pair.key for pair in one.values} >= {"cause", "remedy", "bound_m"}


def test_topics_have_valid_names(messages: Any) -> None:
    """For every kind of id: rclpy refuses other characters, double underscores, and one at the end.

    Source: https://design.ros2.org/articles/topic_and_service_names.html
    """
    assert messages.topic("3:1") == "uav_3_1/odometry"
    for uav in ("icao:4CA7B3", "rid:1581F5.a-7_", "cot:ANDROID-35._x.", "cot:a__b"):
        name = messages.topic(uav)
        assert re.fullmatch(r"uav_[A-Za-z0-9_]*[A-Za-z0-9]/odometry", name), name
        assert "__" not in name


def node_types() -> set[str]:
    """The message types that the node imports."""
    tree = ast.parse((PACKAGE / "companion_bridge" / "bridge.py").read_text())
    (names,) = (
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "NAMES"
    )
    return set(names)


def test_package_installs_where_ros_looks_for_it() -> None:
    """Programs in lib/PACKAGE, as `ros2 run` expects; and what they import is declared."""
    setup = configparser.ConfigParser(interpolation=None)
    setup.read(PACKAGE / "setup.cfg")
    folder = "$base/lib/companion_bridge"
    assert setup["develop"]["script_dir"] == setup["install"]["install_scripts"] == folder
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (required,) = re.findall(r"install_requires=(\[.*\])", (PACKAGE / "setup.py").read_text())
    assert ast.literal_eval(required) == [project["name"]]
    manifest = ElementTree.parse(PACKAGE / "package.xml")
    assert manifest.findtext("license") == project["license"]
    declared = {str(one.text) for one in manifest.iter("exec_depend")}
    assert declared == {name.split("/")[0] for name in node_types()} | {"rclpy"}


def test_node_builds_all_types_that_the_messages_need(messages: Any) -> None:
    """The list of names in the node is that of the constructors called."""
    text = (PACKAGE / "companion_bridge" / "messages.py").read_text()
    used = {
        node.slice.value
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Name)
        and node.value.id == "types"
        and isinstance(node.slice, ast.Constant)
    } - {"byte", "array"}
    assert {name.replace("/", "/msg/") for name in node_types()} == used
    assert isinstance(messages, python_types.ModuleType)
