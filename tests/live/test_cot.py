"""Cursor on Target links over UDP and TCP: shown, recorded, and replayed identically."""

import json
import socket
import subprocess
from pathlib import Path
from typing import Any

from support import BIN, HANG_S, read_metadata

EVENT = (
    '<event version="2.0" uid="{}" type="a-f-A" time="2026-11-22T10:00:{:02d}Z" how="m-g">'
    '<point lat="51.4774{:02d}" lon="-0.0015" hae="120.5" ce="4.5" le="9.0"/></event>\n'
)


def test_cot_events_are_received_and_replay_identically(start_node: Any, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(HANG_S)
        node = start_node(
            *("run", "--link", "udpin:127.0.0.1:0", "--link", "cot:udp:127.0.0.1:0"),
            *("--link", f"cot:tcp:127.0.0.1:{server.getsockname()[1]}"),
            *("--center", "51.47,-0.001,100", "--listen", "127.0.0.1:0", "--record", str(tmp_path)),
        )
        listening = node.json("/v1/links")["links"][1]["url"]
        assert listening.startswith("cot:udp:127.0.0.1:")
        peer, _ = server.accept()
        with peer, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(("127.0.0.1", int(listening.rpartition(":")[2])))
            for number in range(3):  # the first of each is not confirmed
                sender.send(EVENT.format("A", number, number).encode())
            b = [EVENT.format("B", number, number).encode() for number in range(3)]
            peer.sendall(b[0] + b"noise" + b[1] + b[2])
            answer = node.wait_until(
                "/v1/uavs",
                lambda answer: sorted(one["reports"] for one in answer["uavs"]) == [2, 2],
            )
            status, _, errors = node.stop()
            peer.settimeout(HANG_S)
            assert peer.recv(1) == b""  # the service sent nothing to it
    assert status == 0, errors
    assert {one["id"] for one in answer["uavs"]} == {"cot:A", "cot:B"}
    (recording,) = tmp_path.glob("*.mcap")
    done = subprocess.run(
        [BIN / "companion", "replay", recording, "--no-record", "--json"],
        capture_output=True, text=True, check=False, timeout=HANG_S,
    )  # fmt: skip
    summary = json.loads(done.stdout)
    assert summary["reports"] == {"cot:A": 2, "cot:B": 2}
    assert summary["rejected"] == {"garbage": 5, "unplaced-stamp": 2}
    assert summary["digest"] == read_metadata(recording)["summary"]["digest"]
