"""Binary records from a running service: over UDP, and in shared memory by the example."""

import itertools
import json
import re
import shutil
import socket
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import BIN, HANG_S, ROOT, line_of, started

from companion.client import Client
from companion.views import records

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")


def sequence(record: bytes) -> int:
    return int(np.frombuffer(record, records.HEADER, 1)[0]["sequence"])


def test_records_follow_each_update_and_match_the_api(start_node: Any, tmp_path: Path) -> None:
    follower, ring = tmp_path / "follow_ring", tmp_path / "ring"
    source = ROOT / "examples" / "c" / "follow_ring.cpp"
    if shutil.which("g++") is None:
        pytest.skip("no g++ on this machine")
    subprocess.run(["g++", "-O2", "-o", follower, source], check=True, timeout=HANG_S)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.bind(("127.0.0.1", 0))
        heard.settimeout(HANG_S)
        address = f"127.0.0.1:{heard.getsockname()[1]}"
        config = tmp_path / "settings.toml"
        config.write_text(
            f'[records]\nudp = ["{address}"]\nshared_memory = "{ring}"\nguaranteed = true\n'
            "[beams]\nupdate_hz = 50\n[observer]\nlag_s = [0.0, 0.0]\nspeed_max_mps = 151.0\n"
            "acceleration_max_mps2 = 190.0\nposition_noise_m = 1.0\nvelocity_noise_mps = 0.1\n"
        )
        node = start_node(*RUN, "--config", str(config))
        following = started([follower, ring], stdout=subprocess.PIPE, text=True)
        command = [BIN / "sitl-replay", "fly", "paper", "--duration", "5"]
        to = f"udpout:127.0.0.1:{node.udp_port}"
        with following as process, started([*command, "--to", to], stdout=subprocess.DEVNULL):
            assert line_of(process, process.stdout) == "open\n"
            before, full = -1, 0
            while full < 50:
                body = heard.recv(1 << 16)
                head = np.frombuffer(body, records.HEADER, 1)[0]
                assert head["sequence"] > before
                before = head["sequence"]
                beams = np.frombuffer(body, records.BEAM, head["beams"], head["beams_at"])
                full += len(beams) == 4
            told = node.json("/v1/beams")
            with closing(Client(node.url).records()) as stream:
                streamed = {sequence(record): record for record in itertools.islice(stream, 20)}
            count, last = len(streamed), max(streamed)
            while sequence(body) < last:
                body = heard.recv(1 << 16)
                assert streamed.pop(sequence(body), body) == body  # identical, byte for byte
            assert len(streamed) < count  # either path may have skipped some
            node.stop()
            said = process.communicate(timeout=HANG_S)[0]
    assert [name.decode() for name in beams["uav"]] == [one["uav"] for one in told["beams"]]
    for one, beam in zip(told["beams"], beams, strict=True):
        assert abs(one["gain_db"] - beam["gain_db"]) < 3.0  # of another update
        if not np.isnan(beam["guaranteed_gain_db"]):
            assert beam["guaranteed_gain_db"] <= beam["gain_db"] + 1e-9
    count, lost = re.findall(r"(\d+) records, (\d+) lost", said)[0]
    assert int(count) > 50
    assert int(lost) == 0
    assert not ring.exists()


def test_missing_udp_listener_is_reported_once(start_node: Any, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    config = tmp_path / "settings.toml"
    config.write_text(f'[records]\nudp = ["127.0.0.1:{port}"]\n[beams]\nupdate_hz = 100\n')
    node = start_node(*RUN, "--config", str(config))

    def told(answer: Any) -> list[Any]:
        return [one for one in answer["events"] if one["subject"] == "records"]

    assert "refused" in json.dumps(told(node.wait_until("/v1/events", told)))
    node.wait_until("/v1/status", lambda answer: answer["uptime_s"] > 1)
    assert len(told(node.json("/v1/events"))) == 1  # not for each datagram
