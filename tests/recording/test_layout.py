"""The documented layout is complete and names only what a recording contains."""

import json
import re
import subprocess
from collections import defaultdict
from typing import Any

import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from mcap.reader import make_reader
from support import BIN, HANG_S, ROOT

from companion.recording import entries, schemas
from companion.recording.scene import CARRIER, MAP

LAYOUT = json.loads((ROOT / "docs" / "lichtblick-layout.json").read_text())
PANELS = {"3D", "map", "Plot", "RosOut"}


def leaves(node: Any) -> list[str]:
    """The panels in a tree of splits."""
    if isinstance(node, str):
        return [node]
    assert node["direction"] in ("row", "column")
    return [*leaves(node["first"]), *leaves(node["second"])]


def test_layout_places_every_panel_once() -> None:
    placed = leaves(LAYOUT["layout"])
    assert sorted(placed) == sorted(LAYOUT["configById"])
    assert {panel.split("!")[0] for panel in placed} == PANELS


def test_layout_names_only_existing_topics_fields_and_frames() -> None:
    panels = LAYOUT["configById"]
    topics = dict(entries.NAMED)
    assert topics[panels["RosOut!log"]["topicToRender"]] is schemas.LOG
    assert {topics[topic] for topic in panels["3D!beams"]["topics"]} == {schemas.SCENE_UPDATE}
    assert panels["3D!beams"]["followTf"] == CARRIER
    assert panels["3D!beams"]["layers"]["grid"]["frameId"] == MAP
    fields = schemas.message_class("Track").DESCRIPTOR.fields_by_name
    paths = [path["value"] for name in panels for path in panels[name].get("paths", [])]
    assert len(paths) == 8
    for path in paths:
        found = re.fullmatch(r'(/\w+)\{(\w+)=="\d+:\d+"\}\.(\w+)', path)
        assert found is not None, path
        assert topics[found[1]] is schemas.schema("Track")
        assert found[2] in fields and found[3] in fields


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], list[bytes]]:
    """The messages of a recorded flight by topic and schema."""
    file = tmp_path_factory.mktemp("layout") / "flight.mcap"
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    command = [BIN / "companion", "replay", log, "--center", "5:1", "--out", file]
    subprocess.run(command, check=True, capture_output=True, timeout=HANG_S)
    found = defaultdict[tuple[str, str], list[bytes]](list)
    with file.open("rb") as opened:
        for schema, channel, message in make_reader(opened).iter_messages():
            found[channel.topic, "" if schema is None else schema.name].append(message.data)
    return found


def test_panels_find_what_they_support_in_a_recording(
    recorded: dict[tuple[str, str], list[bytes]],
) -> None:
    """Schemas by Lichtblick's panels: Log, Map, 3D with its transforms, and the plotted UAVs."""
    panels = LAYOUT["configById"]
    assert (panels["RosOut!log"]["topicToRender"], "foxglove.Log") in recorded
    (scene,) = panels["3D!beams"]["topics"]
    assert (scene, "foxglove.SceneUpdate") in recorded
    mapped = {topic for topic, schema in recorded if schema == "foxglove.LocationFix"}
    assert {f"/uav/{number}:1/fix" for number in range(1, 6)} <= mapped
    tracks = [
        schemas.message_class("Track").FromString(data)
        for data in recorded["/tracks", "companion.Track"]
    ]
    for path in (path["value"] for panel in panels.values() for path in panel.get("paths", [])):
        (uav, field) = re.findall(r'"(.+)"\}\.(\w+)$', path)[0]
        values = [getattr(track, field) for track in tracks if track.uav == uav]
        assert values and all(isinstance(value, float) for value in values), path


def test_transforms_of_one_moment_are_preloaded(
    recorded: dict[tuple[str, str], list[bytes]],
) -> None:
    """A moment has several messages on one topic, and a viewer that jumps there reads only the
    last. Without preloading Lichtblick then shows no scene.
    """
    transforms = [
        FrameTransform.FromString(data) for data in recorded["/tf", "foxglove.FrameTransform"]
    ]
    frames = {one.parent_frame_id for one in transforms} | {
        one.child_frame_id for one in transforms
    }
    assert {MAP, CARRIER} <= frames
    assert len({one.child_frame_id for one in transforms}) > 1
    assert LAYOUT["configById"]["3D!beams"]["scene"]["transforms"]["enablePreloading"] is True


def test_plots_have_titles_in_lichtblick_and_foxglove() -> None:
    plots = [config for name, config in LAYOUT["configById"].items() if name.startswith("Plot!")]
    titles = [{config["lichtblickPanelTitle"], config["foxglovePanelTitle"]} for config in plots]
    assert titles == [{"Position bounds (m)"}, {"Latency (s)"}]
