"""Effective settings in the API, each with its source."""

from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.node.replay import layers_for, settings_for, writer_for
from companion.settings.files import layered, load
from companion.settings.model import Settings
from companion.settings.origins import Origin, Origins, given
from companion.views import settings


def told(shown: Settings, origins: Origins) -> dict[str, tuple[str, str | None]]:
    """Return source and file of every setting that differs from its default."""
    sections = settings.show(shown, origins)["sections"]
    assert set(sections) == set(Settings.model_fields)
    return {
        f"{section}.{key}": (said["source"], said["file"])
        for section, keys in sections.items()
        for key, said in keys.items()
        if said["source"] != "default"
    }


def test_every_setting_is_shown_with_its_default() -> None:
    sections = settings.show(Settings().override(link={"needed_db": 6.0}), {})["sections"]
    assert sections["link"]["needed_db"] == {
        "value": 6.0, "default": 0.0, "source": "program", "file": None,
    }  # fmt: skip
    assert sections["link"]["needed_sinr_db"] == {
        "value": None, "default": None, "source": "default", "file": None,
    }  # fmt: skip


def test_settings_from_file_and_options_are_distinguished(tmp_path: Path) -> None:
    path = tmp_path / "mast.toml"
    # A key that the file sets to its default still has the file as source.
    path.write_text(
        "[center]\nsource = '1:1'\n[link]\nneeded_db = 6.0\n[beams]\nupdate_hz = 10.0\n"
    )
    loaded = load(path)
    assert loaded.beams.update_hz == Settings().beams.update_hz
    options: dict[str, dict[str, Any]] = {
        "center": {"source": "5:1"}, "server": {"listen": None, "foxglove": 9000},
    }  # fmt: skip
    assert told(*layered(path, options)) == {
        "center.source": ("option", None),
        "link.needed_db": ("file", str(path)),
        "beams.update_hz": ("file", str(path)),
        "server.foxglove": ("option", None),
    }


def test_only_keys_in_the_file_have_file_source(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "elements.txt", [[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]])
    path = tmp_path / "mast.toml"
    gains = resources.files("companion.tracking.design") / "kinematic_default.json"
    path.write_text(
        f"[array]\nkind = 'list'\npositions = '{tmp_path}/elements.txt'\n"
        f"[observer]\ndesign = '{gains}'\n"
    )
    loaded = load(path)
    shown = told(loaded, given(loaded, Origin("file", "mast.toml")))
    assert sorted(shown) == ["array.kind", "array.positions_m", "observer.design"]
    assert shown["array.positions_m"] == ("file", "mast.toml")


def test_no_file_source_without_a_file() -> None:
    assert told(load(None), given(load(None), Origin("file", "None"))) == {}


@pytest.mark.parametrize("center", [None, "5:1"])
def test_replayed_recording_is_named_as_source(
    cut_log: Path, tmp_path: Path, center: str | None
) -> None:
    held = settings_for([cut_log], None, "1:1").override(link={"needed_db": 6.0})
    recording = tmp_path / "flight.mcap"
    with writer_for([cut_log], held, recording) as writer:
        writer.close({})
    shown = told(*layers_for([recording], None, center))
    named = ("recording", str(recording))
    assert shown["link.needed_db"] == named
    assert shown["center.source"] == (("option", None) if center else named)
    assert "beams.update_hz" not in shown
