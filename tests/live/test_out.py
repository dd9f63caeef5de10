"""Output to other programs over real sockets: steady and never backwards, whatever the delay."""

import json
import math
import socket
import subprocess
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
import takproto
from pymavlink.dialects.v20 import all as dialect
from support import BIN, HANG_S, end

from companion.mavlink.wire.cot import from_xml
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from sitl_replay.flight import scenario
from sitl_replay.flight.vehicles import schedule
from sitl_replay.traffic.recorder import TlogWriter

START_NS = 1_760_000_000_000_000_000
ORIGIN = (47.4, 8.55, 500.0)


def bound() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.settimeout(HANG_S)
    return sock


def flown(log: Path, seconds: float) -> dict[int, Any]:
    """Write a flight to a log; return boot time and position of each report by system."""
    mav: Any = dialect.MAVLink(None)
    reports: dict[int, list[tuple[float, ...]]] = defaultdict(list)
    with TlogWriter(log) as writer:
        for t_s, _, raw in schedule(scenario.racetrack(3), 1, START_NS, seconds):
            writer.write(START_NS + round(t_s * 1e9), raw)
            if raw[7] == GLOBAL_POSITION_INT:
                said = mav.decode(bytearray(raw))
                place = pymap3d.geodetic2ned(
                    said.lat * 1e-7, said.lon * 1e-7, said.alt * 1e-3, *ORIGIN
                )
                reports[said.get_srcSystem()].append((said.time_boot_ms, *map(float, place)))
    return {sysid: np.array(rows) for sysid, rows in reports.items()}


@pytest.mark.full
def test_packets_ten_seconds_late_move_no_uav_backwards(start_node: Any, tmp_path: Path) -> None:
    """The same traffic over two links, one of them ten seconds late (mavlink-router, issue 457).

    Forwarding every packet would move each vehicle back by ten seconds at each late one. The output
    matches the logged position at its stated time.
    """
    truth = flown(tmp_path / "flight.tlog", 30.0)
    heard: dict[int, list[tuple[float, Any]]] = defaultdict(list)
    mav: Any = dialect.MAVLink(None)
    with bound() as far_end:
        config = tmp_path / "config.toml"
        url = f"udpout:127.0.0.1:{far_end.getsockname()[1]}"
        config.write_text(f'[out]\nurls = ["{url}"]\nrate_hz = 10\n')
        node = start_node(
            *("run", "--config", str(config), "--link", "udpin:127.0.0.1:0"),
            *("--link", "udpin:127.0.0.1:0", "--center", "home", "--listen", "127.0.0.1:0"),
        )
        links = [link["url"].replace("udpin", "udpout") for link in node.json("/v1/links")["links"]]
        player = [BIN / "sitl-replay", "play", tmp_path / "flight.tlog", "--to"]
        playing = [
            subprocess.Popen([*player, links[0]], stdout=subprocess.DEVNULL),
            subprocess.Popen([*player, links[1], "--fault", "delay=10"], stdout=subprocess.DEVNULL),
        ]
        try:
            while (
                min((len(said) for said in heard.values()), default=0) < 260
            ):  # after 20 s both links are known
                said = mav.decode(bytearray(far_end.recv(1000)))
                heard[said.get_srcSystem()].append((time.monotonic(), said))
        finally:
            for process in playing:
                end(process)
        late = [link["reports"] for link in node.json("/v1/links")["links"]]
        node.stop()
    assert late[1]["latency_p50_s"] == pytest.approx(10, abs=1)  # they arrived, with that delay
    assert len(heard) >= 3
    for sysid, said in heard.items():
        stamps = np.array([one.time_boot_ms for _, one in said])
        assert (np.diff(stamps) > 0).all()
        gaps_s = np.diff([at for at, _ in said])
        assert np.median(gaps_s) == pytest.approx(0.1, abs=0.02)
        places = np.array(
            [
                pymap3d.geodetic2ned(one.lat * 1e-7, one.lon * 1e-7, one.alt * 1e-3, *ORIGIN)
                for _, one in said
            ]
        )
        rows = truth[sysid]
        inside = stamps < rows[-1, 0]
        there = np.array([np.interp(stamps, rows[:, 0], column) for column in rows[:, 1:].T]).T
        off_m = np.linalg.norm(places - there, axis=1)[inside]
        assert inside.sum() > 150
        assert off_m.max() < 10  # ten seconds back is 200 m


def test_output_events_are_readable_by_takproto(start_node: Any, tmp_path: Path) -> None:
    """Over UDP and TCP; a stop ends the output, and --silent sends nothing."""
    with bound() as far_end, socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(HANG_S)
        config = tmp_path / "config.toml"
        urls = [
            f"cot:udp:127.0.0.1:{far_end.getsockname()[1]}",
            f"cot:tcp:127.0.0.1:{server.getsockname()[1]}",
        ]
        config.write_text(f'[out]\nurls = {json.dumps(urls)}\nuavs = ["3:*"]\nstale_s = 7\n')
        node = start_node(
            *("run", "--config", str(config), "--link", "udpin:127.0.0.1:0"),
            *("--center", "47.4,8.55,500", "--listen", "127.0.0.1:0"),
        )
        connection, _ = server.accept()
        mav = dialect.MAVLink(None, srcSystem=3, srcComponent=1)
        with connection, bound() as sender:
            connection.settimeout(HANG_S)
            port = int(node.json("/v1/links")["links"][0]["url"].rpartition(":")[2])
            for boot_ms, sysid in ((1000, 3), (1000, 4), (1500, 3)):
                mav.srcSystem = sysid
                place = (474_000_000, 85_500_000 + 1000 * sysid, 520_000, 20_000)
                message = dialect.MAVLink_global_position_int_message(
                    boot_ms, *place, 0, 0, 0, 65_535
                )
                sender.sendto(bytes(message.pack(mav)), ("127.0.0.1", port))
            text = far_end.recv(4000)
            streamed = connection.makefile("rb").readline()
            out = node.wait_until(
                "/v1/links", lambda answer: all(one["sent"] for one in answer["out"])
            )["out"]
            assert [one["url"] for one in out] == urls
            assert {one["state"] for one in out} == {"up"}
        status, _, errors = node.stop()
    assert status == 0, errors
    for one in (text, streamed):
        event = from_xml(one)
        assert event.uid == "uav-companion-beams.3.1"
        assert event.ce_m is not None and event.le_m is not None
        assert (event.lat_deg, event.lon_deg) == pytest.approx((47.4, 8.5503), abs=1e-6)
        assert math.isclose(event.hae_m or 0, 520, abs_tol=0.1)
    packed = takproto.xml2proto(text.decode(), takproto.TAKProtoVer.MESH)
    theirs = takproto.parse_proto(packed).cotEvent
    assert theirs.staleTime - theirs.sendTime == 7000
    assert "guaranteed bounds" in text.decode()


def test_silent_service_opens_no_output_connection(start_node: Any, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        config = tmp_path / "config.toml"
        config.write_text(f'[out]\nurls = ["cot:tcp:127.0.0.1:{server.getsockname()[1]}"]\n')
        node = start_node(
            *("run", "--config", str(config), "--link", "udpin:127.0.0.1:0", "--silent"),
            *("--center", "47.4,8.55,500", "--listen", "127.0.0.1:0"),
        )
        node.wait_until("/v1/status", lambda answer: answer["updates"] > 5)
        node.stop()
        server.settimeout(0)
        with pytest.raises(BlockingIOError):
            server.accept()
