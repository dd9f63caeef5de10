"""An unmodified mavlink-routerd routes between the vehicles, the service and a ground station."""

import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mav_vehicle import Vehicle
from pymavlink import mavutil
from support import BIN, HANG_S, ROOT, end

PROGRAM = shutil.which("mavlink-routerd")
pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(PROGRAM is None, reason="no mavlink-routerd on the PATH"),
]


def documented() -> str:
    """The configuration of docs/links.md."""
    text = (ROOT / "docs" / "links.md").read_text(encoding="utf-8")
    (found,) = (block.split("```")[0] for block in text.split("```ini\n")[1:])
    return found


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@pytest.fixture
def routed(tmp_path: Path, start_node: Any) -> Iterator[tuple[Any, int, int]]:
    """The service behind the documented router: node, port of the vehicles, of the station."""
    settings = tmp_path / "settings.toml"
    settings.write_text(
        "[presence]\nenabled = true\nposition_hz = 10.0\nverdicts = true\n"
        "[link]\nneeded_db = 60.0\n"
    )
    node = start_node(
        "run", "--link", "udpin:127.0.0.1:0", "--center", "5:1", "--listen", "127.0.0.1:0",
        "--config", str(settings),
    )  # fmt: skip
    vehicles, station = free_port(), free_port()
    text = documented()
    for before, after in (
        ("Address = 0.0.0.0\nPort = 14540\n", f"Address = 127.0.0.1\nPort = {vehicles}\n"),
        ("Port = 14550\n", f"Port = {node.udp_port}\n"),
        ("Address = 192.168.2.20\nPort = 14551\n", f"Address = 127.0.0.1\nPort = {station}\n"),
    ):
        assert text.count(before) == 1, before
        text = text.replace(before, after)
    (tmp_path / "main.conf").write_text(text)
    command = [str(PROGRAM), "-c", str(tmp_path / "main.conf")]
    with (tmp_path / "router.txt").open("wb") as log:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    yield node, vehicles, station
    end(process)


def test_beams_and_verdicts_pass_through_the_documented_router(
    routed: tuple[Any, int, int],
) -> None:
    """Positions to the service; its verdicts to a ground station that has only a port."""
    node, vehicles, station = routed
    pilot = mavutil.mavlink_connection(f"udpin:127.0.0.1:{station}", source_system=255)
    command = [BIN / "sitl-replay", "fly", "waypoints", "--uavs", "4", "--duration", "60"]
    sender = subprocess.Popen(
        [*command, "--to", f"udpout:127.0.0.1:{vehicles}"], stdout=subprocess.PIPE
    )
    try:
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4, 40.0)
        (link,) = node.json("/v1/links")["links"]
        assert {"1:1", "2:1", "3:1", "4:1", "5:1"} <= {one["id"] for one in link["components"]}
        assert link["bad_crc"] == 0
        pilot.mav.heartbeat_send(6, 8, 0, 0, 4)
        found = None
        while found is None or not found.text.startswith("Link "):
            pilot.mav.heartbeat_send(6, 8, 0, 0, 4)
            found = pilot.recv_match(type="STATUSTEXT", blocking=True, timeout=HANG_S)
            assert found is not None
        assert " none: " in found.text
        values = pilot.recv_match(type="NAMED_VALUE_FLOAT", blocking=True, timeout=HANG_S)
        assert (values.name, values.value) == ("linksgood", 0.0)
    finally:
        pilot.close()
        end(sender)


def test_requests_and_clocks_pass_through_the_documented_router(
    routed: tuple[Any, int, int],
) -> None:
    """A rate request and its acknowledgement, and TIMESYNC round trips."""
    node, vehicles, _ = routed
    with Vehicle(f"udpout:127.0.0.1:{vehicles}", 1, 2.0, 1.0) as uav:
        uav.wait_for(lambda m: m.get_type() == "COMMAND_LONG" and m.command == 511, HANG_S)
        node.wait_until(
            "/v1/links",
            lambda answer: "accepted" in [rate["state"] for rate in answer["message_rates"]],
        )
        seen = node.wait_until("/v1/uavs/1:1", lambda one: one["clock"]["kind"] == "timesync", 30.0)
        assert seen["clock"]["uncertainty_s"] < 0.5
