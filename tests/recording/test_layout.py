"""The documented layout is complete and names only what a recording contains."""

import json
import re
from typing import Any

from support import ROOT

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
    fields = schemas.TrackMessage.DESCRIPTOR.fields_by_name
    paths = [path["value"] for name in panels for path in panels[name].get("paths", [])]
    assert len(paths) == 8
    for path in paths:
        found = re.fullmatch(r'(/\w+)\{(\w+)=="\d+:\d+"\}\.(\w+)', path)
        assert found is not None, path
        assert topics[found[1]] is schemas.TRACK
        assert found[2] in fields and found[3] in fields
