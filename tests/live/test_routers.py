"""Unmodified routers, as documented, between the vehicles, the service and a ground station.

MAVProxy, which is a Python package, has a file of its own.
"""

import re
import shlex
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from mav_vehicle import Vehicle
from pymavlink import mavutil
from support import BIN, HANG_S, ROOT, end, free_port

pytestmark = pytest.mark.full
PROGRAMS = ("mavlink-routerd", "mavp2p")
PRESENCE = (
    "[presence]\nenabled = true\nposition_hz = 10.0\nverdicts = true\n[link]\nneeded_db = 60.0\n"
)


def documented(pattern: str) -> str:
    """The only match of a pattern in docs/links.md."""
    text = (ROOT / "docs" / "links.md").read_text(encoding="utf-8")
    (found,) = re.findall(pattern, text, re.DOTALL | re.MULTILINE)
    return str(found)


def replaced(text: str, *pairs: tuple[str, str]) -> str:
    """``text`` with each of the pairs replaced, which must be there once."""
    for before, after in pairs:
        assert text.count(before) == 1, before
        text = text.replace(before, after)
    return text


def command_of(program: str, *, vehicles: int, service: int, station: int, folder: Path) -> str:
    """The documented command, with other ports."""
    if program == "mavp2p":
        return replaced(
            documented(r"^    (mavp2p .*?)$"),
            ("udps:0.0.0.0:14540", f"udps:127.0.0.1:{vehicles}"),
            ("udpc:127.0.0.1:14550", f"udpc:127.0.0.1:{service}"),
            ("udpc:192.168.2.20:14551", f"udpc:127.0.0.1:{station}"),
        )
    configuration = replaced(
        documented(r"```ini\n(.*?)```"),
        ("Address = 0.0.0.0\nPort = 14540\n", f"Address = 127.0.0.1\nPort = {vehicles}\n"),
        ("Port = 14550\n", f"Port = {service}\n"),
        ("Address = 192.168.2.20\nPort = 14551\n", f"Address = 127.0.0.1\nPort = {station}\n"),
    )
    (folder / "main.conf").write_text(configuration)
    return f"mavlink-routerd -c {folder / 'main.conf'}"


@dataclass(frozen=True)
class Routed:
    """The service behind a router, and the router's ports of the vehicles and the station."""

    node: Any
    vehicles: int
    station: int


@pytest.fixture(params=PROGRAMS)
def routed(request: pytest.FixtureRequest, tmp_path: Path, start_node: Any) -> Iterator[Routed]:
    """Start the service and the router."""
    program = shutil.which(request.param)
    if program is None:
        pytest.skip(f"no {request.param} on the PATH")
    settings = tmp_path / "settings.toml"
    presence = PRESENCE
    if request.param == "mavp2p":
        presence = presence.replace("[link]", documented(r"`(system_id = \d+)`") + "\n[link]")
    settings.write_text(presence)
    node = start_node(
        "run", "--link", "udpin:127.0.0.1:0", "--center", "5:1", "--listen", "127.0.0.1:0",
        "--config", str(settings),
    )  # fmt: skip
    vehicles, station = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    command = command_of(
        request.param, vehicles=vehicles, service=node.udp_port, station=station, folder=tmp_path
    )
    words = [program, *shlex.split(command)[1:]]
    with (tmp_path / "router.txt").open("wb") as log:
        process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    yield Routed(node, vehicles, station)
    end(process)


def test_beams_and_verdicts_pass_through_the_documented_router(routed: Routed) -> None:
    """Positions to the service; its verdicts to a ground station that has only a port."""
    pilot = mavutil.mavlink_connection(f"udpin:127.0.0.1:{routed.station}", source_system=255)
    command = [BIN / "sitl-replay", "fly", "waypoints", "--uavs", "4", "--duration", "60"]
    sender = subprocess.Popen(
        [*command, "--to", f"udpout:127.0.0.1:{routed.vehicles}"], stdout=subprocess.PIPE
    )
    try:
        routed.node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4, 40.0)
        (link,) = routed.node.json("/v1/links")["links"]
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


def test_requests_and_clocks_pass_through_the_documented_router(routed: Routed) -> None:
    """A rate request and its acknowledgement, and TIMESYNC round trips."""
    with Vehicle(f"udpout:127.0.0.1:{routed.vehicles}", 1, 2.0, 1.0) as uav:
        uav.wait_for(lambda m: m.get_type() == "COMMAND_LONG" and m.command == 511, HANG_S)
        routed.node.wait_until(
            "/v1/links",
            lambda answer: "accepted" in [rate["state"] for rate in answer["message_rates"]],
        )
        seen = routed.node.wait_until(
            "/v1/uavs/1:1", lambda one: one["clock"]["kind"] == "timesync", 30.0
        )
        assert seen["clock"]["uncertainty_s"] < 0.5


def test_commands_of_the_station_reach_the_carrier(routed: Routed) -> None:
    """Also those to all components of its system, whose id the service may share; and the old
    requests for streams.
    """
    pilot = mavutil.mavlink_connection(f"udpin:127.0.0.1:{routed.station}", source_system=255)
    try:
        with Vehicle(f"udpout:127.0.0.1:{routed.vehicles}", 5, 5.0, 5.0) as carrier:
            routed.node.wait_until("/readyz", lambda answer: answer["ready"])
            beats = (m for m in iter(lambda: pilot.recv_match(blocking=True, timeout=HANG_S), None))
            assert next(m for m in beats if m.get_srcComponent() == 191)
            for number in range(40):
                pilot.mav.command_long_send(5, 0, 400, 0, number, *[0] * 6)
            pilot.mav.request_data_stream_send(5, 1, 6, 4, 1)
            end_s = time.monotonic() + 20.0
            arrived = set[Any]()
            while len(arrived) < 41 and time.monotonic() < end_s:
                time.sleep(0.05)
                received = [m for _, m in carrier.heard if m.get_srcSystem() == 255]
                arrived = {m.param1 for m in received if m.get_type() == "COMMAND_LONG"}
                arrived |= {m.get_type() for m in received} & {"REQUEST_DATA_STREAM"}
            assert arrived >= {*range(40), "REQUEST_DATA_STREAM"}
    finally:
        pilot.close()
