"""Devices driven by real processes: the service's own device, and a remote one over HTTP."""

import json
import os
import re
import signal
import socket
import subprocess
import threading
from pathlib import Path
from typing import Any

import pytest
from support import BIN, HANG_S, line_of, started

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
EIGHT = "[array]\nelements = 8\nfrequency_hz = 10.5e9\n"


def where_deg(port: int) -> tuple[float, float]:
    """The rotator's direction, queried alongside the driver."""
    with socket.create_connection(("127.0.0.1", port), HANG_S) as line:
        line.sendall(b"p\n")
        answer = b""
        while answer.count(b"\n") < 2:
            answer += line.recv(100)
    azimuth, elevation = map(float, answer.split()[:2])
    return azimuth, elevation


def fly(port: int, seconds: float) -> Any:
    to = f"udpout:127.0.0.1:{port}"
    command = [BIN / "sitl-replay", "fly", "racetrack", "--to", to, "--duration", str(seconds)]
    return started(command, stdout=subprocess.DEVNULL)


def test_service_drives_its_rotator_and_reconnects(
    start_node: Any, tmp_path: Path, rotctld: int
) -> None:
    config = tmp_path / "settings.toml"
    config.write_text(f'[drive]\ntarget = "rotctld:127.0.0.1:{rotctld}"\nuavs = ["1:1"]\n')
    node = start_node(*RUN, "--config", str(config))

    def told(text: str) -> Any:
        return lambda answer: [one for one in answer["events"] if text in one["text"]]

    node.wait_until("/v1/events", told("hold: no report yet"))
    with fly(node.udp_port, 30):
        node.wait_until("/v1/events", told("beams are applied"))
        beams = node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        (wanted,) = [one for one in beams["beams"] if one["uav"] == "1:1"]
        assert -10 < wanted["above_horizon_deg"] < 90
        first = where_deg(rotctld)
        waiting = threading.Event()
        while abs(where_deg(rotctld)[0] - first[0]) < 0.3:
            waiting.wait(0.1)  # the dummy restarts its slow turn at each command
        assert node.stop(signal.SIGTERM)[0] == 0


def test_remote_beams_are_applied_over_http_until_shutdown(start_node: Any, tmp_path: Path) -> None:
    config = tmp_path / "settings.toml"
    config.write_text(EIGHT)
    node = start_node(*RUN, "--config", str(config))
    with fly(node.udp_port, 30):
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        command = [BIN / "companion", "drive", "none:adar1000", "--service", node.url]
        command += ["--uav", "3:1", "--rate", "50", "--on-stale", "mute", "--dry-run"]
        with started(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            for _ in range(30):
                line = line_of(process, process.stdout)
                assert re.match(r"3:1: element:phase/gain 0:\d+/\d+a? .*7:\d+/\d+", line), line
            node.stop()
            while line_of(process, process.stdout) != "safe state: mute\n":
                pass
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=HANG_S)
    assert process.returncode == 0, err
    assert "no answer from the service" in err


def ran(*words: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(
        words,
        capture_output=True,
        text=True,
        check=False,
        timeout=HANG_S,
        env={**os.environ, **environment},
    )


def test_drive_status_is_reported_each_second(start_node: Any, tmp_path: Path) -> None:
    config = tmp_path / "settings.toml"
    config.write_text(EIGHT)
    node = start_node(*RUN, "--config", str(config))
    with fly(node.udp_port, 30):
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        command = [BIN / "companion", "drive", "none:adar1000", "--service", node.url]
        done = ran(*command, "--json", "--seconds", "2.5")
    assert done.returncode == 0
    told = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert [one["failures"] for one in told] == [0] * len(told)
    assert told[-1]["applied"] > 5
    assert told[-1]["p99_ms"] >= told[-1]["p50_ms"] > 0


def test_what_a_library_prints_is_not_among_the_json(tmp_path: Path) -> None:
    (tmp_path / "spidev.py").write_text("print('SPI 1.0')\n")
    command = [BIN / "companion", "drive", "adar1000:0.0", "--service", "http://127.0.0.1:9"]
    done = ran(*command, "--json", "--seconds", "0.5", PYTHONPATH=str(tmp_path))
    assert "SPI 1.0" in done.stderr
    assert [line for line in done.stdout.splitlines() if not line.startswith("{")] == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["laser:1"], "is not a device; give one of rotctld:"),
        (
            ["rotctld:127.0.0.1:1", "--on-stale", "mute"],
            "does not support mute; choose hold or boresight",
        ),
    ],
)
def test_command_error_is_one_line(words: list[str], said: str) -> None:
    done = ran(BIN / "companion", "drive", *words)
    assert done.returncode == 1
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
