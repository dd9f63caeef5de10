"""An unmodified MAVProxy routes between the vehicles and the service."""

import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mav_vehicle import Vehicle
from pymavlink import mavutil
from support import BIN, HANG_S, ROOT, end, free_port, read_metadata

Router = Callable[..., None]


@pytest.fixture
def router(tmp_path: Path) -> Iterator[Router]:
    """Start MAVProxy with a master and outputs, in its own folder."""
    started: list[subprocess.Popen[bytes]] = []

    def start(master: str, *outputs: str) -> None:
        home = tmp_path / "mavproxy"
        (home / ".mavproxy").mkdir(parents=True)
        command = [sys.executable, BIN / "mavproxy.py", f"--master={master}", "--streamrate=-1"]
        command += [f"--out={output}" for output in outputs]
        command += ["--daemon", "--non-interactive", f"--state-basedir={home}"]
        command += ["--default-modules=output,link"]
        with (tmp_path / "mavproxy.txt").open("wb") as log:
            started.append(
                subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=home,
                    env={"HOME": str(home), "PATH": str(BIN), "MAVLINK20": "1"},
                )
            )  # fmt: skip

    yield start
    for process in started:
        end(process)


@pytest.fixture
def fly() -> Iterator[Callable[..., "subprocess.Popen[str]"]]:
    """Start ``sitl-replay fly``."""
    started: list[subprocess.Popen[str]] = []

    def start(scenario: str, to: str, seconds: float) -> "subprocess.Popen[str]":
        command = [BIN / "sitl-replay", "fly", scenario, "--to", to, "--duration", str(seconds)]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        end(process)


def test_mavproxy_over_udp_and_tcp_counts_each_report_once(
    start_node: Any, router: Router, fly: Any, tmp_path: Path
) -> None:
    """Both router outputs lead to the service: every report arrives twice and counts once.

    What the second one brings besides positions is used after these have agreed for 5 s.
    """
    master, out = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
    node = start_node(
        "run", "--link", "udpin:127.0.0.1:0", "--link", f"tcp:127.0.0.1:{out}",
        "--center", "5:1", "--listen", "127.0.0.1:0", "--record", str(tmp_path / "recordings"),
    )  # fmt: skip
    router(
        f"udpin:127.0.0.1:{master}", f"udpout:127.0.0.1:{node.udp_port}", f"tcpin:127.0.0.1:{out}"
    )
    fly("hover", f"udpout:127.0.0.1:{master}", 60.0)
    node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4, 40.0)
    links = node.wait_until(
        "/v1/links", lambda answer: all(link["frames"] > 200 for link in answer["links"]), 40.0
    )["links"]
    assert [link["state"] for link in links] == ["up", "up"]
    heard = [{one["id"] for one in link["components"]} for link in links]
    assert all({"1:1", "2:1", "3:1", "4:1", "5:1"} <= ids for ids in heard), heard
    assert [link["bad_crc"] for link in links] == [0, 0]
    reports = [link["reports"] for link in links]
    assert all(one["latency_p50_s"] < 1.0 for one in reports)
    assert {uav["id"] for uav in node.json("/v1/uavs")["uavs"]} == {"1:1", "2:1", "3:1", "4:1"}
    rejected = node.json("/v1/status")["rejected"]
    assert set(rejected) <= {"duplicate", "stranger"}
    assert rejected["duplicate"] > 0.3 * min(one["total"] for one in reports)

    assert node.stop()[0] == 0
    (recording,) = (tmp_path / "recordings").iterdir()
    replayed = subprocess.run(
        [BIN / "companion", "replay", recording, "--no-record", "--json"],
        capture_output=True,
        check=True,
        timeout=HANG_S,
    )
    summary = json.loads(replayed.stdout)
    assert summary["digest"] == read_metadata(recording)["summary"]["digest"]
    assert set(summary["uavs"]) == {"1:1", "2:1", "3:1", "4:1"}


def test_mavproxy_routes_requests_and_answers(
    start_node: Any, router: Router, tmp_path: Path
) -> None:
    """A rate request, its acknowledgement and TIMESYNC, both ways through a router."""
    master = free_port(socket.SOCK_DGRAM)
    settings = tmp_path / "settings.toml"
    settings.write_text(
        "[presence]\nenabled = true\nsystem_id = 200\nposition_hz = 10.0\n", encoding="utf-8"
    )
    node = start_node(
        "run", "--link", "udpin:127.0.0.1:0", "--center", "47.3977,8.5456,500",
        "--listen", "127.0.0.1:0", "--config", str(settings),
    )  # fmt: skip
    router(f"udpin:127.0.0.1:{master}", f"udpout:127.0.0.1:{node.udp_port}")
    with Vehicle(f"udpout:127.0.0.1:{master}", 1, 2.0, 1.0) as uav:
        asked = uav.wait_for(lambda m: m.get_type() == "COMMAND_LONG" and m.command == 511, HANG_S)
        assert (asked.get_srcSystem(), asked.get_srcComponent()) == (200, 191)
        node.wait_until(
            "/v1/links",
            lambda answer: [rate["state"] for rate in answer["message_rates"]] == ["accepted"],
        )
        seen = node.wait_until("/v1/uavs/1:1", lambda one: one["clock"]["kind"] == "timesync", 30.0)
        assert seen["clock"]["uncertainty_s"] < 0.5
        beat = uav.wait_for(lambda m: m.get_type() == "HEARTBEAT" and m.get_srcSystem() == 200)
        assert beat.get_srcComponent() == 191


def test_verdicts_reach_mavproxy_and_a_ground_station(
    start_node: Any, fly: Any, tmp_path: Path
) -> None:
    """By the module of the examples, which asks the service; and as STATUSTEXT over MAVLink."""
    master, station = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
    (tmp_path / "settings.toml").write_text(
        "[presence]\nenabled = true\nverdicts = true\n[link]\nneeded_db = 60.0\n"
    )
    node = start_node(
        "run", "--link", "udpin:127.0.0.1:0", "--link", f"tcpin:127.0.0.1:{station}",
        "--center", "5:1", "--listen", "127.0.0.1:0", "--config", str(tmp_path / "settings.toml"),
    )  # fmt: skip
    shown = tmp_path / "mavproxy.txt"
    command = [
        sys.executable, str(BIN / "mavproxy.py"), f"--master=udpin:127.0.0.1:{master}",
        f"--out=udpout:127.0.0.1:{node.udp_port}", "--streamrate=-1", "--non-interactive",
        "--daemon", f"--state-basedir={tmp_path}", "--default-modules=output,link",
        f"--cmd=module load mavproxy_companion; companion {node.url}",
    ]  # fmt: skip
    path = f"{ROOT / 'examples' / 'mavproxy'}:{ROOT}"
    environment = {"HOME": str(tmp_path), "PATH": str(BIN), "MAVLINK20": "1", "PYTHONPATH": path}
    with shown.open("wb") as log:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment
        )
    pilot = mavutil.mavlink_connection(f"tcp:127.0.0.1:{station}", source_system=255)
    try:
        fly("hover", f"udpout:127.0.0.1:{master}", 60.0)
        texts = list[str]()
        while not (texts and "Link" in texts[-1]):
            texts.append(pilot.recv_match(type="STATUSTEXT", blocking=True, timeout=HANG_S).text)
        assert texts[-1].startswith("Link ") and " none: " in texts[-1]
        values = pilot.recv_match(type="NAMED_VALUE_FLOAT", blocking=True, timeout=HANG_S)
        assert (values.name, values.value) == ("linksgood", 0.0)
        node.wait_until("/v1/status", lambda answer: answer["health"]["none"] == 4, 40.0)
        end_s = time.monotonic() + HANG_S
        while not all(f"companion: {n}:1 none: " in shown.read_text() for n in range(1, 5)):
            assert process.poll() is None and time.monotonic() < end_s, shown.read_text()[-2000:]
            time.sleep(0.1)  # the console is a file: nothing tells when it grows
        assert "Traceback" not in shown.read_text()
    finally:
        pilot.close()
        end(process)
