"""Opening of named files: what could block is never opened, wherever it is named."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.mavlink.links.regular_file import open_regular, replace_file
from companion.mavlink.links.signing_store import Timestamps
from companion.mavlink.links.zenoh_config import BusConfig, sections
from companion.node.ring import Ring
from companion.recording.declared_faults import declared_faults
from companion.studies.running import measured_beams
from companion.values import UserError
from sitl_replay.cli import main


def test_file_is_opened_and_anything_else_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"content")
    (tmp_path / "link").symlink_to("file")
    os.mkfifo(tmp_path / "pipe")
    for name in ("file", "link"):
        with open_regular(tmp_path / name) as file:
            assert file.read() == b"content"
    for path, why in (
        (tmp_path / "pipe", "not a file"),
        (Path("/dev/zero"), "not a file"),
        (tmp_path, "Is a directory"),
        (tmp_path / "missing", "No such file"),
    ):
        with pytest.raises(OSError, match=why):
            open_regular(path)
    with pytest.raises(OSError, match="symbolic links"):
        open_regular(tmp_path / "link", follow_links=False)


def _timestamps(pipe: Path) -> None:
    Timestamps(pipe)


def _access_control(pipe: Path) -> None:
    sections(BusConfig(access_control=pipe))


def _ring(pipe: Path) -> None:
    Ring(pipe)


def _faults(pipe: Path) -> None:
    log = pipe.with_name("a.tlog")
    pipe.rename(pipe.with_name("a.tlog.events.json"))
    declared_faults(log)


def _powers(pipe: Path) -> None:
    pipe.rename(pipe.with_suffix(".txt"))
    table = pipe.with_name("table.csv")
    table.write_text("unit2_pos,unit1_beam\npipe.txt,3\n")
    measured_beams.read(table)


def _token(pipe: Path) -> None:
    receiver = ("--receiver", "http://127.0.0.1:1", "--token", str(pipe))
    result = CliRunner().invoke(main, ["fly", "paper", "--to", "udpout:127.0.0.1:1", *receiver])
    assert result.exit_code == 2
    raise UserError(result.stderr)


@pytest.mark.parametrize("read", [_timestamps, _access_control, _ring, _faults, measured_beams.read,
                                  _powers, _token])  # fmt: skip
def test_pipe_is_an_error_wherever_it_is_named(
    read: Callable[[Path], object], tmp_path: Path
) -> None:
    """Opening it would wait for a writer without end."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="not a file"):
        read(tmp_path / "pipe")


@pytest.mark.parametrize("mode", [None, 0o600])
def test_replaced_file_is_whole_and_has_its_permissions(mode: int | None, tmp_path: Path) -> None:
    path = tmp_path / "result"
    path.write_bytes(b"earlier")
    path.chmod(0o640)
    replace_file(path, b"new", mode=mode)
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == (mode or 0o640)
    assert [one.name for one in tmp_path.iterdir()] == ["result"]
