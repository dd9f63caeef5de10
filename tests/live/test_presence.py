"""The service as a MAVLink component: pymavlink connections receive, answer and miss it."""

import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mav_vehicle import Vehicle

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
PRESENCE = """[presence]
enabled = true
position_hz = 10.0
attitude_hz = 20.0
"""


@pytest.fixture
def settings(tmp_path: Path) -> str:
    path = tmp_path / "settings.toml"
    path.write_text(PRESENCE)
    return str(path)


def is_heartbeat(message: Any) -> bool:
    return bool(message.get_type() == "HEARTBEAT" and message.get_srcSystem() == 5)


def test_service_sends_heartbeats_and_acknowledged_requests(
    start_node: Any, settings: str, tmp_path: Path
) -> None:
    node = start_node(*RUN, "--config", settings, "--record", str(tmp_path))
    address = f"udpout:127.0.0.1:{node.udp_port}"
    with Vehicle(address, 5, 2.0, 5.0) as carrier, Vehicle(address, 1, 2.0, 1.0) as uav:
        beat = uav.wait_for(is_heartbeat)
        assert (beat.get_srcSystem(), beat.get_srcComponent()) == (5, 191)
        assert (beat.type, beat.autopilot, beat.system_status) == (18, 8, 4)
        asked = uav.wait_for(lambda m: m.get_type() == "COMMAND_LONG")
        assert (asked.target_system, asked.target_component) == (1, 1)
        assert (asked.command, asked.param1, asked.param2) == (511, 33, 100_000)

        def in_order(links: Any) -> bool:
            found = {(r["uav"], r["msgid"]): r for r in links["message_rates"]}
            return all(
                found.get(key, {}).get("state") == "accepted"
                and (found[key]["observed_hz"] or 0) > 0.8 * found[key]["wanted_hz"]
                for key in (("1:1", 33), ("5:1", 33), ("5:1", 30))
            )

        node.wait_until("/v1/links", in_order, 40.0)
        assert carrier.rates_hz == {33: 10.0, 30: 20.0}
        assert uav.rates_hz == {33: 10.0, 30: 1.0}  # its attitude is not needed

        seen = node.wait_until("/v1/uavs/1:1", lambda u: u["clock"]["kind"] == "timesync")
        assert seen["clock"]["uncertainty_s"] < 0.05
        asked_of = Counter(m.get_type() for _, m in carrier.heard)
        assert asked_of["COMMAND_LONG"] <= 4  # one request per message, with few repeats
        assert {m.get_srcSystem() for _, m in uav.heard} == {5}  # never a ground station's 255

        carrier.silent = True
        node.wait_until("/readyz", lambda answer: not answer["ready"])
        last_s = time.monotonic()
        time.sleep(3.0)  # checks for the absence of messages
        assert not [m for t_s, m in uav.heard if t_s > last_s + 0.3 and is_heartbeat(m)]
        carrier.silent = False
        uav.wait_for(is_heartbeat)
    code, _, err = node.stop()
    assert code == 0, err


@pytest.mark.parametrize("how", ["by default", "--silent"])
def test_service_sends_nothing_unless_enabled(start_node: Any, settings: str, how: str) -> None:
    silent = ("--config", settings, "--silent") if how == "--silent" else ()
    node = start_node(*RUN, *silent)
    address = f"udpout:127.0.0.1:{node.udp_port}"
    with Vehicle(address, 5, 10.0, 10.0) as carrier, Vehicle(address, 1, 10.0, 1.0) as uav:
        node.wait_until("/readyz", lambda answer: answer["ready"])
        time.sleep(2.5)  # long enough for heartbeats, if any were sent
        assert carrier.heard == uav.heard == []
