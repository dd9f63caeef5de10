"""Observations of a running service: recorded and replayed in order, and a flood of them."""

import json
import multiprocessing
import socket
import subprocess
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from observed import POWER
from siege import attacked, besieged
from support import BIN, HANG_S, free_port, read_metadata

from companion.client import Client
from companion.recording.reader import read_log
from companion.values import Observation, Reason, Rejection
from companion.views.observation_records import encode

PER_S = 10_000
FLOOD_S = 4.0


def flood(port: int, per_s: float, until: threading.Event, sent: Any) -> None:
    """Send observations of changing UAVs, every fourth one malformed; add their number."""
    records = [encode(replace(POWER, uav=f"{n}:1")) for n in range(250)]
    records[::4] = [record[:-1] for record in records[::4]]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", port))
        begun_s = time.monotonic()
        while not until.is_set():
            while sent.value < per_s * (time.monotonic() - begun_s):
                sender.send(records[sent.value % len(records)])
                sent.value += 1
            until.wait(0.002)


@pytest.mark.full
def test_flood_of_observations_costs_no_beam_and_all_are_recorded_in_order(
    start_node: Any, tmp_path: Path
) -> None:
    port, settings = free_port(socket.SOCK_DGRAM), tmp_path / "settings.toml"
    settings.write_text(f'[observations]\nenabled = true\nudp = "127.0.0.1:{port}"\n')
    words = ("--config", str(settings), "--record", str(tmp_path / "recordings"))
    with besieged(start_node, *words) as node:
        sent = multiprocessing.RawValue("q", 0)  # the attack runs in a process of its own
        seen = attacked(lambda _, until: flood(port, PER_S, until, sent), node, FLOOD_S)
        assert seen.looks
        assert seen.without_beams == []
        assert seen.broken == []
        assert seen.grown_mb < 60.0
        answer = node.wait_until(  # each datagram is counted once, even if the kernel dropped it
            "/v1/status", lambda answer: sum(answer["observations"].values()) == sent.value
        )
        assert min(answer["observations"].values()) > 0, answer  # received, malformed and dropped
        found = Client(node.url).observe(
            {"uav": "3:1", "age_s": 0.01, "azimuth_deg": 1, "elevation_deg": 2, "bound_deg": 3}
        )
        assert found == {"accepted": 1, "dropped": 0, "errors": []}
        counted = node.json("/v1/status")["observations"]
        assert node.stop()[0] == 0
    (recording,) = (tmp_path / "recordings").iterdir()
    events = list(read_log(recording))
    observed = [one for one in events if isinstance(one, Observation)]
    assert len(observed) == counted["received"]
    assert [one.t_ns for one in observed] == sorted(one.t_ns for one in observed)
    assert observed[-1].uav == "3:1"
    assert observed[-1].azimuth_rad == pytest.approx(0.01745329)
    assert 9e6 <= observed[-1].t_ns - observed[-1].measured_ns < 1e9
    rejected = dict.fromkeys(Reason, 0)
    for one in events:
        if isinstance(one, Rejection) and one.source.startswith("observations udp:"):
            rejected[one.reason] += one.count
    assert rejected[Reason.MALFORMED] == counted["malformed"]
    dropped = rejected[Reason.TOO_FREQUENT] + rejected[Reason.SOCKET_OVERFLOW]
    assert dropped == counted["dropped"]
    done = subprocess.run(
        [BIN / "companion", "replay", recording, "--no-record", "--json"],
        capture_output=True,
        check=True,
        timeout=HANG_S,
    )
    assert json.loads(done.stdout)["digest"] == read_metadata(recording)["summary"]["digest"]
