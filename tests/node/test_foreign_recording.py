"""Recorded settings are data: a replay of a foreign recording touches no file that it names."""

import base64
import json
import os
import subprocess
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from mcap.records import Attachment
from support import BIN, HANG_S

from companion.beams.hardware.devices import Mode
from companion.beams.hardware.unit_gains import UnitGains
from companion.node.replay import replay, settings_for, writer_for
from companion.pipeline import assembly
from companion.recording.container import Walk
from companion.recording.reader import read_log, read_settings
from companion.recording.writer import Writer
from companion.settings.files import load
from companion.settings.model import NAMED_FILES, REPLAYED_SECTIONS, Settings
from companion.settings.section import ConfigError
from companion.values import Frame

PATHS = {
    "recording": {"directory": "{}/written", "rotate_s": 1.0},
    "page": {"map": "{}/fifo"},
    "signing": {
        "keys": {"udpin:0.0.0.0:14550": "{}/fifo"}, "timestamps": "{}/written/timestamps.json",
    },
    "links": {"urls": ["serial:{}/fifo:57600"]},
    "server": {"listen": "0.0.0.0:1"},
    "presence": {"enabled": True, "system_id": 7},
    "out": {"urls": ["tcp:192.0.2.1:1"]},
    "drive": {"target": "rotctld:192.0.2.1:1"},
    "fleet": {"node": "north", "ca": "{}/fifo", "certificate": "{}/fifo", "key": "{}/fifo"},
    "records": {"udp": ["192.0.2.1:1"], "shared_memory": "{}/written/ring"},
}  # fmt: skip
"""Recorded settings that a replay must not use."""
SHORT = "companion: no beam was computed: the log is shorter than one update\n"


def foreign(cut_log: Path, path: Path, sections: dict[str, Any]) -> Path:
    """Return a recording of a real flight with foreign settings."""
    text = tomli_w.dumps({"center": {"source": "5:1"}, **sections}).replace("{}", str(path.parent))
    with Writer(
        where=path, settings_toml=text, versions={}, weights_hz=None, started_ns=0
    ) as writer:
        for event in read_log(cut_log):
            if isinstance(event, Frame):
                writer.event(event)
        writer.close({})
    return path


def replayed(folder: Path, *arguments: object) -> "subprocess.CompletedProcess[str]":
    """Run ``companion replay`` in a folder; it ends within ``HANG_S`` or fails."""
    command = [BIN / "companion", "replay", *map(str, arguments), "--json"]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=HANG_S, cwd=folder
    )


def test_replay_opens_no_file_that_a_recording_names(cut_log: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")  # opening it blocks forever
    (tmp_path / "written").mkdir()
    log = foreign(cut_log, tmp_path / "theirs.mcap", PATHS)
    here = tmp_path / "here"
    here.mkdir()
    done = replayed(here, log)
    assert done.stderr == SHORT
    assert list((tmp_path / "written").iterdir()) == []
    assert Path(json.loads(done.stdout)["recording"]).parent == Path("recordings")
    assert [file.suffix for file in (here / "recordings").iterdir()] == [".mcap"]


@pytest.mark.full
def test_recorded_paths_do_not_overwrite_files(cut_log: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.mcap"
    mine.write_bytes(b"years of work")
    theirs = {"recording": {"directory": str(mine)}}
    log = foreign(cut_log, tmp_path / "theirs.mcap", theirs)
    assert replayed(tmp_path, log).stderr == SHORT
    assert mine.read_bytes() == b"years of work"


@pytest.mark.parametrize("file", ["fifo", "/dev/zero", "settings.toml"])
@pytest.mark.parametrize(
    "named",
    [
        {"observer": {"design": "{}/FILE"}},
        {"array": {"kind": "list", "positions": "{}/FILE"}},
        {"codebook": {"kind": "file", "file": "{}/FILE"}},
        {"hardware": {"calibration": "{}/FILE"}},
    ],
    ids=["design", "positions", "codebook", "calibration"],
)
def test_equipment_file_missing_from_recording_is_rejected(
    cut_log: Path, tmp_path: Path, named: dict[str, Any], file: str
) -> None:
    os.mkfifo(tmp_path / "fifo")
    wanted = file if file.startswith("/") else f"{{}}/{file}"
    sections = json.loads(json.dumps(named).replace("{}/FILE", wanted))
    log = foreign(cut_log, tmp_path / "theirs.mcap", sections)
    with pytest.raises(ConfigError, match=r"is not in the recording; give the settings with"):
        settings_for([log], None, None)
    config = tmp_path / "mine.toml"
    config.write_text("[center]\nsource = '5:1'\n")
    assert settings_for([log], config, None).center.source == "5:1"


def equipped(folder: Path) -> Settings:
    """Return settings that name a file of every kind; the files are deleted after loading."""
    np.save(folder / "beams.npy", np.exp(1j * np.arange(12.0)).reshape(4, 3))
    np.save(folder / "mixed.npy", np.eye(4) + 0.1j)
    lines = [f"{c},{3 - c},{10 * c},0" for c in range(4)]
    (folder / "measured.csv").write_text("channel,element,phase_deg,gain_db\n" + "\n".join(lines))
    (folder / "unit.toml").write_text(
        "mode = 'RX'\ncommon_db = [[0, 9], [0, 9], [0, 9], [0, 9]]\nelement_db = [4, 4, 4, 4]\n"
    )
    shipped = resources.files("companion.tracking.design") / "kinematic_default.json"
    (folder / "gains.json").write_text(json.dumps(json.loads(shipped.read_text())))
    (folder / "settings.toml").write_text(
        f"[center]\nsource = '5:1'\n[array]\nelements = 4\ncoupling = '{folder}/mixed.npy'\n"
        f"[codebook]\nkind = 'file'\nfile = '{folder}/beams.npy'\n"
        f"[hardware]\ncalibration = '{folder}/measured.csv'\nunit = '{folder}/unit.toml'\n"
        f"[observer]\ndesign = '{folder}/gains.json'\n"
    )
    given = load(folder / "settings.toml")
    for file in folder.iterdir():
        file.unlink()
    return given


def same_equipment(one: Settings, other: Settings) -> bool:
    """Return whether all files have the same contents in both settings."""
    array, again = assembly.array(one), assembly.array(other)
    kept, found = assembly.equipment(one, array), assembly.equipment(other, again)
    assert kept.codebook is not None
    assert found.codebook is not None
    assert found.calibration is not None
    return (
        np.array_equal(kept.codebook.weights, found.codebook.weights)
        and np.array_equal(array.coupling, again.coupling)
        and found.calibration.order == (3, 2, 1, 0)
        and found.unit_gains == kept.unit_gains == UnitGains(Mode.RX, 13.0, 4.0)
    )


def test_files_named_in_settings_are_attached_to_the_recording(
    cut_log: Path, tmp_path: Path
) -> None:
    given, log = equipped(tmp_path), tmp_path / "kept.mcap"
    digest = replay([cut_log], given, lambda: writer_for([cut_log], given, log))["digest"]
    attached = [one for one in Walk(log, frozenset()) if isinstance(one, Attachment)]
    assert {one.name: one.media_type for one in attached} == {
        "coupling.npy": "application/x-npy", "codebook.npy": "application/x-npy",
        "calibration.csv": "text/csv", "unit.toml": "application/toml",
        "design.json": "application/json", "settings.toml": "application/toml",
    }  # fmt: skip

    held = settings_for([log], None, None)
    assert same_equipment(given, held)
    assert replay([log], held)["digest"] == digest
    assert (held.codebook.file, held.hardware.calibration) == ("codebook.npy", "calibration.csv")
    again = tmp_path / "again.mcap"  # a recording of the replay is as complete
    with writer_for([log], held, again) as writer:
        writer.event(next(read_log(log)))
        writer.close({})
    assert settings_for([again], None, None) == held


@pytest.mark.parametrize("paths", [True, False])
def test_files_embedded_in_older_recorded_settings_are_used(
    cut_log: Path, tmp_path: Path, paths: bool
) -> None:
    """The first recording also had the paths; the recording of its replay had none."""
    given, log = equipped(tmp_path), tmp_path / "older.mcap"
    sections = given.model_dump(mode="json", exclude_none=True)
    for file in NAMED_FILES:
        data = given.files[file.attachment]
        binary = file.attachment.endswith(".npy")
        kept = base64.b64encode(data) if binary else data
        sections[file.section][file.former_key] = kept.decode()
        if not paths:
            del sections[file.section][file.key]
    digest = replay(
        [cut_log],
        given,
        lambda: Writer(
            where=log,
            settings_toml=tomli_w.dumps(sections),
            versions={},
            weights_hz=None,
            started_ns=0,
        ),
    )["digest"]
    held = settings_for([log], None, None)
    assert held.files == given.files
    assert same_equipment(given, held)
    assert replay([log], held)["digest"] == digest
    assert Settings.from_toml(tomli_w.dumps(sections), "x").files == given.files


@pytest.mark.parametrize("content", ["'%'", "7"])
def test_invalid_embedded_file_contents_are_rejected(content: str) -> None:
    for section, key in (("codebook", "stored"), ("array", "coupling_stored")):
        with pytest.raises(ConfigError, match=rf"^x: {section}\.{key} = .*: not base64$"):
            Settings.from_recording(f"[{section}]\n{key} = {content}\n", "x", {})


def test_attachments_not_named_in_settings_are_discarded(cut_log: Path, tmp_path: Path) -> None:
    given, log = equipped(tmp_path), tmp_path / "x.mcap"
    files = {"codebook.npy": b"1", "other.csv": b"2"}
    with Writer(
        where=log,
        settings_toml="[codebook]\nkind = 'file'\nfile = 'mine.npy'\n",
        files=files,
        versions={},
        weights_hz=None,
        started_ns=0,
    ) as writer:
        writer.close({})
    recorded = read_settings(log)
    assert recorded is not None
    assert recorded.files == {"codebook.npy": b"1"}
    assert settings_for([log], None, None).files == recorded.files
    assert Settings.from_recording("", "x", given.files).files == {}
    assert given.override(codebook={"file": "new.npy"}).files.keys() == given.files.keys() - files


def test_names_that_no_uav_can_have_are_dropped_from_a_recording() -> None:
    """Earlier versions accepted them, to no effect."""
    text = (
        '[observer.uav]\n3 = {lag_s = [0, 1]}\n"3:1" = {lag_s = [0, 1]}\n'
        '[clocks.apart_s]\na = 1\n"3:1" = 1\n[beams]\npriority = ["b", "3:1", "300:1"]\n'
    )
    found = Settings.from_recording(text, "x", {})
    assert list(found.observer.uav) == list(found.clocks.apart_s) == ["3:1"]
    assert found.beams.priority == ("3:1",)
    with pytest.raises(ConfigError):
        Settings.from_toml(text, "x")


def test_every_file_setting_is_registered() -> None:
    """A new key must name its attachment or be excluded from a replay."""
    paths = {
        (section, key)
        for section in REPLAYED_SECTIONS
        for key, field in type(getattr(Settings(), section)).model_fields.items()
        if field.annotation == str | None and field.metadata == []
    }
    named = {(file.section, file.key) for file in NAMED_FILES}
    assert paths - {("center", "source"), ("array", "positions")} == named
    assert Settings().model_fields_set == set()
    assert set(Settings.model_fields) - REPLAYED_SECTIONS == set(PATHS)


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 100_000,
        "a = " + "{a = " * 100_000,
        "x." * 100_000 + "x = 1",
        "[" + '"=".' * 100_000 + "x]",
        'a = """# """"\n' + "'\"'." * 100_000 + 'x = 1 # "',
        "".join(f"a{number} = 1\n" for number in range(200_000)),
    ],
    ids=["arrays", "tables", "key", "header", "quotes", "many"],
)
def test_deeply_nested_settings_are_rejected_in_one_line(text: str) -> None:
    for read in (Settings.from_toml, partial(Settings.from_recording, attached={})):
        with pytest.raises(ConfigError, match=r"^there: ") as caught:
            read(text, "there")
        assert len(str(caught.value).splitlines()) == 1


def test_largest_array_is_accepted_in_recorded_settings() -> None:
    """On one line, as a user may write it, and as recorded."""
    rows = np.random.default_rng(1).uniform(-1e4, 1e4, (4096, 6)).tolist()
    text = f"[array]\nkind = 'list'\npositions_m = {rows}\n"
    found = Settings.from_toml(text, "x")
    assert Settings.from_recording(found.to_toml(), "x", {}) == found


def test_unbounded_file_is_rejected(tmp_path: Path) -> None:
    config, large = tmp_path / "settings.toml", tmp_path / "large"
    with large.open("wb") as file:
        file.truncate(1 << 40)
    for name, why in ((large, "larger than [24] MiB"), ("/dev/zero", "not a file")):
        config.write_text(f"[observer]\ndesign = '{name}'\n")
        with pytest.raises(ConfigError, match=f"{name}.*{why}"):
            load(config)
        with pytest.raises(ConfigError, match=why):
            load(Path(name))
