"""Remote ID datagrams on a link: shown, recorded, and replayed to the same digest."""

import json
import socket
import subprocess
from pathlib import Path
from typing import Any

from support import BIN, HANG_S, read_metadata

SAID = (
    '{{ "mac" : "ac:67:b2:09:50:d4", "uav id" : "SERIAL.1", "uav latitude" : 51.5{:05d}, '
    '"uav longitude" : -0.1, "uav altitude" : 120, "uav heading" : 0, "uav speed" : 5, '
    '"seconds" : {} }}\n'
)


def test_receiver_data_is_tracked_and_replays_identically(start_node: Any, tmp_path: Path) -> None:
    node = start_node(
        *("run", "--link", "udpin:127.0.0.1:0", "--link", "rid:udp:127.0.0.1:0"),
        *("--center", "51.5,-0.1,100"),
        *("--listen", "127.0.0.1:0", "--record", str(tmp_path)),
    )
    url = node.json("/v1/links")["links"][1]["url"]
    assert url.startswith("rid:udp:127.0.0.1:") and not url.endswith(":0")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.connect(("127.0.0.1", int(url.rpartition(":")[2])))
        receiver.send(SAID.format(0, 100).encode())
        receiver.send(b"noise\n")
        node.wait_until("/v1/uavs", lambda answer: answer["uavs"])
        receiver.send(SAID.format(45, 101).encode())
        answer = node.wait_until("/v1/uavs", lambda answer: answer["uavs"][0]["reports"] == 2)
        (seen,) = answer["uavs"]
        detail = node.json("/v1/uavs/rid:SERIAL.1")
        status, _, errors = node.stop()
    assert status == 0, errors
    assert (seen["id"], detail["id"]) == ("rid:SERIAL.1", "rid:SERIAL.1")
    (recording,) = tmp_path.glob("*.mcap")
    done = subprocess.run(
        [BIN / "companion", "replay", recording, "--no-record", "--json"],
        capture_output=True, text=True, check=False, timeout=HANG_S,
    )  # fmt: skip
    summary = json.loads(done.stdout)
    assert summary["reports"] == {"rid:SERIAL.1": 2}
    assert summary["rejected"] == {"garbage": 6}
    assert summary["digest"] == read_metadata(recording)["summary"]["digest"]
