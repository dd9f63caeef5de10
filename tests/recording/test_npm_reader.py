"""The MCAP reader of web viewers finds all messages in our recordings."""

import hashlib
import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from support import HANG_S

from companion.recording.parts import Hole, Part
from companion.recording.recover import recover
from companion.recording.writer import Writer
from companion.values import Event

PACKAGES = ("@mcap/core@2.2.2", "fzstd@0.1.1")
SCRIPT = Path(__file__).with_name("read_with_npm.mjs")


@pytest.fixture(scope="module")
def packages(pytestconfig: pytest.Config) -> Path:
    """Folder of the packages, kept between runs; the test is skipped if they are unavailable."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("there is no node and npm here")
    assert pytestconfig.cache is not None
    folder = pytestconfig.cache.mkdir("npm-" + "-".join(PACKAGES).replace("/", "-"))
    if not (folder / "done").exists():
        install = [npm, "install", "--no-audit", "--no-fund", "--silent", "--ignore-scripts"]
        try:
            subprocess.run(
                [*install, "--prefix", folder, *PACKAGES],
                check=True, capture_output=True, timeout=HANG_S,
            )  # fmt: skip
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
            pytest.skip("npm cannot fetch the packages")
        (folder / "done").touch()
    return folder


def read_with_npm(packages: Path, path: Path) -> Any:
    """The output of the script."""
    done = subprocess.run(
        ["node", SCRIPT, path],
        env=os.environ | {"PACKAGES": str(packages)},
        capture_output=True,
        check=False,
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stdout)


def read_with_python(path: Path) -> dict[str, dict[str, Any]]:
    """The same output from the Python package."""
    topics: dict[str, dict[str, Any]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            new = {"schema": schema.name, "count": 0, "hash": hashlib.sha256()}
            found = topics.setdefault(channel.topic, new)
            found["count"] += 1
            found["hash"].update(message.data)
    return {topic: found | {"hash": found["hash"].hexdigest()} for topic, found in topics.items()}


def test_npm_reader_finds_every_message(
    tmp_path: Path, packages: Path, record: Callable[..., list[Event]]
) -> None:
    part = Part("abc", 2, "one.mcap")
    writer = Writer(
        where=tmp_path,
        settings_toml='[a]\nb = "é"\n',
        versions={"companion": "1"},
        weights_hz=None,
        started_ns=0,
        part=part,
    )
    record(writer, 300, 100)
    writer.hole(Hole(7, 5, "why"))
    record(writer, 10)
    writer.flush()
    cut = tmp_path / "cut.mcap.active"
    shutil.copy(writer.path, cut)
    path = writer.close({"digest": "d"})
    told = {"companion": "1"}
    hole = {"t_ns": "7", "events": "5", "why": "why"}
    for log, end in ((path, {"summary": {"digest": "d"}}), (recover(cut).path, {})):
        found = read_with_npm(packages, log)
        assert found["topics"] == read_with_python(log)
        assert len(found["topics"]) == 11
        assert found["attachments"] == {"settings.toml": '[a]\nb = "é"\n'}
        assert found["metadata"] == {
            "versions": told, "part": part.metadata(), "hole": hole, **end,
        }  # fmt: skip
