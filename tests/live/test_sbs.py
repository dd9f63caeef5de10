"""An ADS-B receiver on a link: shown, recorded, and replayed to the same digest."""

import json
import socket
import subprocess
from pathlib import Path
from typing import Any

from support import BIN, HANG_S, read_metadata

LINE = (
    "MSG,3,5,211,4CA2D6,1,2008/11/28,14:53:50.594,2008/11/28,14:53:50.594,,37000,,,51.{:05d},"
    "-1.02826,,,0,0,0,0\r\n"
)


def test_receiver_data_is_tracked_and_replays_identically(start_node: Any, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(HANG_S)
        url = f"sbs:127.0.0.1:{server.getsockname()[1]}"
        node = start_node(
            *("run", "--link", "udpin:127.0.0.1:0", "--link", url, "--center", "51.4,-1.0,100"),
            *("--listen", "127.0.0.1:0", "--record", str(tmp_path)),
        )
        receiver, _ = server.accept()
        with receiver:
            receiver.sendall(LINE.format(45735).encode() + b"noise\n")
            node.wait_until("/v1/uavs", lambda answer: answer["uavs"])
            receiver.sendall(LINE.format(45935).encode())
            answer = node.wait_until("/v1/uavs", lambda answer: answer["uavs"][0]["reports"] == 2)
            (seen,) = answer["uavs"]
            links = node.json("/v1/links")["links"]
            status, _, errors = node.stop()
            receiver.settimeout(HANG_S)
            assert receiver.recv(1) == b""  # the service sent nothing to it
    assert status == 0, errors
    assert (seen["id"], seen["alt_m"] > 11_000) == ("icao:4CA2D6", True)
    (link,) = [one for one in links if one["url"] == url]
    assert link["state"] == "up"
    assert link["lost"] == {"garbage": 6}
    (recording,) = tmp_path.glob("*.mcap")
    done = subprocess.run(
        [BIN / "companion", "replay", recording, "--no-record", "--json"],
        capture_output=True, text=True, check=False, timeout=HANG_S,
    )  # fmt: skip
    summary = json.loads(done.stdout)
    assert summary["reports"] == {"icao:4CA2D6": 2}
    assert summary["rejected"] == {"garbage": 6}
    assert summary["digest"] == read_metadata(recording)["summary"]["digest"]
