"""``[beams] update = "report"``: a report renews the beam of its UAV; a recording of it replays."""

import json
import socket
import subprocess
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from arm import flight
from numpy.typing import NDArray
from support import BIN, HANG_S, read_metadata

from companion.values import Normalisation
from companion.views.records import BEAM, HEADER, NORMALISATIONS

PERIOD_S: Final = 5.0
REPORTS: Final = 24
"""Reports that each renew a beam: by the timer, that many updates would take two minutes."""


def header(record: bytes) -> NDArray[Any]:
    return np.frombuffer(record, HEADER, count=1)[0]


def entries(record: bytes) -> NDArray[Any]:
    head = header(record)
    return np.frombuffer(record, BEAM, count=int(head["beams"]), offset=int(head["beams_at"]))


def received(sock: socket.socket, *, revised: bool) -> bytes:
    """Return the next record that is a renewed beam, or a whole update with beams."""
    while True:
        record = sock.recv(1 << 16)
        head = header(record)
        if head["beams"] and bool(head["revision"]) is revised:
            return record


def test_report_renews_its_beam_between_updates(start_node: Any, tmp_path: Path) -> None:
    config = tmp_path / "config.toml"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as records:
        records.bind(("127.0.0.1", 0))
        records.settimeout(HANG_S)
        config.write_text(
            f'[beams]\nupdate = "report"\nupdate_hz = {1 / PERIOD_S}\n'
            f'[records]\nudp = ["127.0.0.1:{records.getsockname()[1]}"]\n'
            f'[center]\nsource = "{flight.CENTER}"\n'
        )
        run = ("run", "--config", str(config), "--link", "udpin:127.0.0.1:0")
        node = start_node(*run, "--listen", "127.0.0.1:0", "--record", str(tmp_path))
        with flight.socket_to(node.udp_port) as sender:
            number = 0
            while not node.json("/v1/beams")["beams"]:
                sender.send(flight.frames(0, 5 * number))
                sender.send(flight.frames(1, 5 * number))
                number += 1
                time.sleep(0.1)  # reports at 10 Hz, by their own stamps
            whole = header(received(records, revised=False))
            found = list[bytes]()
            for _ in range(REPORTS):
                time.sleep(0.1)
                sender.send(flight.frames(1, 5 * number))
                number += 1
                found.append(received(records, revised=True))
        assert node.stop()[0] == 0
    heads = [header(record) for record in found]
    assert {bytes(entries(record)[0]["uav"]) for record in found} == {b"2:1"}
    assert {(head["beams"], head["first_beam"]) for head in heads} == {(1, 1)}
    assert {head["all_beams"] for head in heads} == {whole["all_beams"]}
    assert {NORMALISATIONS[head["normalisation"]] for head in heads} == {
        Normalisation.UNIT_RESPONSE
    }
    made_ns = [int(head["made_at_ns"]) for head in heads]
    assert made_ns == sorted(made_ns)
    assert all(made > whole["made_at_ns"] for made in made_ns)
    revisions = [(int(head["sequence"]), int(head["revision"])) for head in heads]
    assert revisions == sorted(set(revisions))  # counted anew for each update
    assert revisions[0] == (whole["sequence"], 1)
    assert heads[0]["bytes"] == len(found[0])
    (recording,) = tmp_path.glob("*.mcap")
    replayed = subprocess.run(
        [str(BIN / "companion"), "replay", str(recording), "--no-record", "--json"],
        capture_output=True,
        check=True,
        timeout=HANG_S,
    )
    digest = json.loads(replayed.stdout)["digest"]
    assert digest == read_metadata(recording)["summary"]["digest"]
