"""An unmodified MAVProxy draws verdicts on its map, in a window on a virtual screen.

Needs Xvfb and a ``mavproxy.py`` on the PATH with wxPython, OpenCV and matplotlib, which the map
needs, and websockets, which the client of the service needs.
"""

import os
import re
import shlex
import shutil
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from support import BIN, HANG_S, ROOT, end, free_port

XVFB = shutil.which("Xvfb")
NONE_RGB = (255, 90, 90)
MATCHES = """
import sys, cv2, numpy as np
from MAVProxy.modules.mavproxy_map import mp_slipmap
coloured = np.load(sys.argv[1]).astype("float32")
for text in sys.argv[2:]:
    image = np.zeros((40, 200, 3), "uint8")
    label = mp_slipmap.SlipLabel("", (0, 0), text, layer="", colour=(255, 255, 255))
    label.draw(image, lambda point: (10, 30), None)
    drawn = (image[:, :, 0] == 255).astype("float32")
    rows, columns = np.nonzero(drawn)
    drawn = drawn[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    most = cv2.matchTemplate(coloured, drawn, cv2.TM_CCORR).max()
    if most < drawn.sum() - 0.5:
        print(f"{text}: {most:.0f} of {drawn.sum():.0f} pixels")
"""
"""Prints each text that the map has not drawn in the pixels of one colour. MAVProxy draws it."""


def interpreter_with_map() -> list[str]:
    """The Python of the ``mavproxy.py`` on the PATH, as its first line names it; empty unless
    MAVProxy's map and the client run there.
    """
    program = shutil.which("mavproxy.py")
    if program is None:
        return []
    python = shlex.split(
        Path(program).read_text(encoding="utf-8").splitlines()[0].removeprefix("#!")
    )
    command = [*python, "-c", "import cv2, matplotlib, websockets, wx"]
    done = subprocess.run(command, capture_output=True, check=False, timeout=HANG_S)
    return [] if done.returncode else python


@pytest.fixture
def screen(tmp_path: Path) -> Iterator[str]:
    """A virtual screen, as the value of DISPLAY; its pixels are in a file."""
    assert XVFB is not None
    reads, writes = os.pipe()
    process = subprocess.Popen(
        [XVFB, "-displayfd", str(writes), "-screen", "0", "1000x800x24", "-fbdir", tmp_path],
        pass_fds=[writes],
        stderr=subprocess.DEVNULL,
    )
    os.close(writes)
    with os.fdopen(reads) as answer:
        yield f":{answer.readline().strip()}"
    end(process)


def coloured(folder: Path, rgb: tuple[int, int, int]) -> npt.NDArray[np.bool_]:
    """Which pixels of the screen have a colour. The file is in the XWD format, version 7."""
    data = (folder / "Xvfb_screen0").read_bytes()
    header = struct.unpack(">25I", data[:100])
    start, width, height = header[0] + 12 * header[19], header[4], header[5]
    assert header[1] == 7 and header[11] == 32 and header[12] == 4 * width
    kind = ">u4" if header[7] else "<u4"
    pixels = np.frombuffer(data, kind, offset=start, count=width * height).reshape(height, width)
    found: npt.NDArray[np.bool_] = pixels & 0xFFFFFF == rgb[0] << 16 | rgb[1] << 8 | rgb[2]
    return found


def wait_until(condition: Callable[[], bool], what: Callable[[], str]) -> None:
    """Wait for a condition of a program that announces nothing."""
    end_s = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end_s, what()
        time.sleep(0.2)


def with_map(
    command: list[str | Path], environment: dict[str, str], log: Path
) -> "subprocess.Popen[str]":
    """Start MAVProxy; again, if its window was not there within the 5 s that it allows."""
    for _ in range(3):
        with log.open("wb") as output:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=output, stderr=output, env=environment,
                text=True, bufsize=1,
            )  # fmt: skip
        wait_until(lambda: bool(re.search("Loaded module map|not ready", log.read_text())), str)
        if "not ready" not in log.read_text():
            return process
        end(process)
    raise AssertionError(log.read_text())


@pytest.mark.full
@pytest.mark.skipif(XVFB is None, reason="no Xvfb on the PATH")
def test_verdicts_are_labels_on_the_map(start_node: Any, tmp_path: Path, screen: str) -> None:
    """Labels appear, with their texts, and go with the module and with the service."""
    python = interpreter_with_map()
    if not python:
        pytest.skip("no mavproxy.py with wxPython, OpenCV, matplotlib and websockets on the PATH")
    (tmp_path / "settings.toml").write_text("[link]\nneeded_db = 60.0\n")
    node = start_node(
        "run", "--link", "udpin:127.0.0.1:0", "--center", "5:1", "--listen", "127.0.0.1:0",
        "--config", str(tmp_path / "settings.toml"),
    )  # fmt: skip
    master, log = free_port(socket.SOCK_DGRAM), tmp_path / "mavproxy.txt"
    command = [
        *python, str(shutil.which("mavproxy.py")), f"--master=udpin:127.0.0.1:{master}",
        f"--out=udpout:127.0.0.1:{node.udp_port}", "--streamrate=-1",
        f"--state-basedir={tmp_path}", "--default-modules=output,link", "--cmd=module load map",
    ]  # fmt: skip
    nowhere = "http://127.0.0.1:9"  # instead of servers with map tiles
    environment = {
        "HOME": str(tmp_path), "PATH": os.environ["PATH"], "MAVLINK20": "1", "DISPLAY": screen,
        "PYTHONPATH": f"{ROOT / 'examples' / 'mavproxy'}:{ROOT}", "no_proxy": "127.0.0.1",
        "http_proxy": nowhere, "https_proxy": nowhere,
    }  # fmt: skip
    mavproxy = with_map(command, environment, log)
    fly = [BIN / "sitl-replay", "fly", "hover", "--to", f"udpout:127.0.0.1:{master}"]
    sender = subprocess.Popen([*fly, "--duration", "120"], stdout=subprocess.DEVNULL)

    def enter(line: str) -> None:
        assert mavproxy.stdin is not None
        mavproxy.stdin.write(line + "\n")

    def missing() -> str:
        np.save(tmp_path / "coloured.npy", coloured(tmp_path, NONE_RGB))
        texts = [*(f"{number}:1 none" for number in range(1, 5)), " dB"]
        return subprocess.run(
            [*python, "-c", MATCHES, tmp_path / "coloured.npy", *texts],
            capture_output=True, check=True, text=True, timeout=HANG_S,
        ).stdout  # fmt: skip

    def shown() -> str:
        return missing() + log.read_text()[-2000:]

    try:
        assert not coloured(tmp_path, NONE_RGB).any()
        for _ in range(2):
            enter("module load mavproxy_companion")
            enter(f"companion {node.url}")
            wait_until(lambda: not missing(), shown)
            enter("module unload companion")
            wait_until(lambda: not coloured(tmp_path, NONE_RGB).any(), shown)
        enter("module load mavproxy_companion")
        enter(f"companion {node.url}")
        wait_until(lambda: not missing(), shown)
        assert node.stop()[0] == 0
        wait_until(lambda: not coloured(tmp_path, NONE_RGB).any(), shown)
        assert "Traceback" not in log.read_text()
    finally:
        end(sender)
        end(mavproxy)
