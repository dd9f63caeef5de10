"""The hardware page of the docs: its ten commands run against simulated devices and one service."""

import importlib.util
import json
import os
import re
import shlex
import socket
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as dialect
from support import BIN, HANG_S, ROOT, Node, dummy_rotator, end, started

from companion.settings.model import Settings

PAGE = (ROOT / "docs" / "hardware.md").read_text(encoding="utf-8")
LINES = re.findall(r"^    (companion (?:run|drive) .+|sitl-replay .+)$", PAGE, re.MULTILINE)
DRIVES = [line for line in LINES if line.startswith("companion drive")]
SETTINGS = next(
    re.sub("^    ", "", block, flags=re.MULTILINE)
    for block in re.findall(r"(?:^    .*\n|^\n(?=    ))+", PAGE, re.MULTILINE)
    if block.lstrip("\n").startswith("    [array]")
)
pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Node, Path]]:
    """The page's service with the page's traffic, and the folder with the page's settings."""
    folder = tmp_path_factory.mktemp("hardware")
    (folder / "phaser.toml").write_text(SETTINGS)
    run, fly = (shlex.split(line, comments=True) for line in LINES[:2])
    run = [word.replace(":14550", ":0") for word in run]
    run[run.index("phaser.toml")] = str(folder / "phaser.toml")
    node = Node(*run[1:], "--listen", "127.0.0.1:0")
    fly = [word.replace("127.0.0.1:14550", f"127.0.0.1:{node.udp_port}") for word in fly]
    try:
        with started([BIN / fly[0], *fly[1:]], stdout=subprocess.DEVNULL):
            node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
            yield node, folder
    finally:
        end(node.process)


Check = Callable[[subprocess.CompletedProcess[str], dict[str, Any]], None]


@contextmanager
def rotator(words: list[str]) -> Iterator[tuple[str, Check]]:
    """Hamlib's dummy rotator: it has left its rest position."""
    with dummy_rotator() as port:

        def check(done: subprocess.CompletedProcess[str], told: dict[str, Any]) -> None:
            with socket.create_connection(("127.0.0.1", port), HANG_S) as line:
                line.sendall(b"p\n")
                assert abs(float(line.recv(100).split()[0])) > 0.01

        yield f"rotctld:127.0.0.1:{port}", check


@contextmanager
def gimbal(words: list[str]) -> Iterator[tuple[str, Check]]:
    """A port that receives frames with pymavlink."""
    kind = words[2].split(":")[0]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.bind(("127.0.0.1", 0))
        heard.setblocking(False)

        def check(done: subprocess.CompletedProcess[str], told: dict[str, Any]) -> None:
            said = Counter[str]()
            while True:
                try:
                    frame = dialect.MAVLink(None).decode(bytearray(heard.recv(2048)))
                except BlockingIOError:
                    break
                said[frame.get_type()] += 1
                if kind == "gimbal-roi":
                    assert frame.command == dialect.MAV_CMD_DO_SET_ROI_LOCATION
                    assert abs(frame.x * 1e-7 - 47.3977) < 0.1
            wanted = "COMMAND_INT" if kind == "gimbal-roi" else "GIMBAL_MANAGER_SET_PITCHYAW"
            assert set(said) == {wanted}
            assert said[wanted] > 3

        yield f"{kind}:127.0.0.1:{heard.getsockname()[1]}:1:154", check


@contextmanager
def phaser(words: list[str]) -> Iterator[tuple[str, Check]]:
    """Analog Devices' own class over a libiio stub that records writes."""
    if importlib.util.find_spec("adi") is None:
        pytest.skip("no pyadi-iio")

    def check(done: subprocess.CompletedProcess[str], told: dict[str, Any]) -> None:
        written = Counter(name for _, name, _ in told["iio"])
        if "--dry-run" in words:
            assert not written
            assert len(re.findall(r"^\d:1: element:phase/gain 0:\d+", done.stdout, re.M)) > 3
            return
        (updates,) = re.findall(r"^(\d+) updates", done.stdout, re.M)
        assert written["rx_load_spi"] == 2 * int(updates) + 2  # and once at the start
        if words[2].startswith("phaser-memory"):
            assert written["beam_pos_save"] == 8 * (8 + 2)
            assert written["beam_pos_load"] >= 8
            assert written["phase"] == 0
        else:
            assert written["phase"] >= 8
            assert written["beam_pos_load"] == 0

    yield words[2], check


@contextmanager
def chips(words: list[str]) -> Iterator[tuple[str, Check]]:
    """Two chips that decode their registers, switched off at the end."""

    def check(done: subprocess.CompletedProcess[str], told: dict[str, Any]) -> None:
        assert words[-2:] == ["--on-stale", "mute"]
        (updates,) = re.findall(r"^(\d+) updates", done.stdout, re.M)
        assert set(told["chips"]) == {"0.0", "0.1"}
        for loads, radiates in told["chips"].values():
            assert loads == int(updates) + 1
            assert all(gain == 0 for gain, _, _ in radiates)

    yield words[2], check


STAND_INS = {
    "rotctld": rotator,
    "gimbal": gimbal,
    "gimbal-roi": gimbal,
    "phaser": phaser,
    "phaser-memory": phaser,
    "adar1000": chips,
}


def kind_of(line: str) -> str:
    return line.split()[2].partition(":")[0]


@pytest.mark.parametrize("line", DRIVES)
def test_each_page_command_drives_its_device(
    served: tuple[Node, Path], tmp_path: Path, line: str
) -> None:
    node, folder = served
    words = shlex.split(line, comments=True)
    told = tmp_path / "told.json"
    (tmp_path / "sitecustomize.py").write_text(
        f"import device_stand_ins\ndevice_stand_ins.in_process({str(told)!r})\n"
    )
    paths = [str(tmp_path), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")]
    with STAND_INS[kind_of(line)](words) as (target, check):
        command = [BIN / "companion", "drive", target]
        done = subprocess.run(
            [*command, *words[3:], "--service", node.url, "--seconds", "2"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            timeout=HANG_S,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))},
        )
        assert done.returncode == 0, done.stderr
        check(done, json.loads(told.read_text()))


def test_page_covers_every_device_with_valid_settings() -> None:
    assert len(LINES) <= 10
    assert {kind_of(line) for line in DRIVES} == set(STAND_INS)
    assert sum("--dry-run" in line for line in DRIVES) == 1
    assert Settings.from_toml(SETTINGS, "hardware.md").array.elements == 8
