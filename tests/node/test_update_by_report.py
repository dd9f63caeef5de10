"""``[beams] update = "report"``: a report starts an update; a recording of it replays."""

import asyncio
import contextlib
import json
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from arm import flight
from support import BIN, HANG_S, read_metadata, run_async
from websockets.asyncio.client import connect

PERIOD_S: Final = 5.0
REPORTS: Final = 24
"""Reports of which each starts an update: by the timer, that many would take two minutes."""


@contextlib.contextmanager
def service(start_node: Any, folder: Path) -> Iterator[Any]:
    """A recorded service whose timer is slow."""
    config = folder / "config.toml"
    config.write_text(
        f'[beams]\nupdate = "report"\nupdate_hz = {1 / PERIOD_S}\n'
        f'[center]\nsource = "{flight.CENTER}"\n'
    )
    run = ("run", "--config", str(config), "--link", "udpin:127.0.0.1:0")
    yield start_node(*run, "--listen", "127.0.0.1:0", "--record", str(folder))


async def updates_by_reports(node: Any) -> list[int]:
    """Send reports of one UAV, each after the update that the last one started."""
    address = node.url.replace("http", "ws") + "/v1/stream?topic=beams&rate_hz=100"
    found, number = list[int](), 0
    async with connect(address, max_size=None) as stream:
        with flight.socket_to(node.udp_port) as sock:
            while not node.json("/v1/beams")["beams"] or number < 5:
                sock.send(flight.frames(0, 5 * number))
                number += 1
                time.sleep(0.1)  # reports at 10 Hz, by their own stamps
            while not json.loads(await stream.recv())["beams"]:
                sock.send(flight.frames(0, 5 * number))
                number += 1
            async with asyncio.timeout(REPORTS * PERIOD_S / 2):
                for _ in range(REPORTS):
                    time.sleep(0.1)
                    sock.send(flight.frames(0, 5 * number))
                    number += 1
                    found.append(json.loads(await stream.recv())["update"])
    return found


def test_each_report_starts_an_update(start_node: Any, tmp_path: Path) -> None:
    with service(start_node, tmp_path) as node:
        assert len(run_async(updates_by_reports(node))) == REPORTS
        assert node.stop()[0] == 0
    (recording,) = tmp_path.glob("*.mcap")
    replayed = subprocess.run(
        [str(BIN / "companion"), "replay", str(recording), "--no-record", "--json"],
        capture_output=True,
        check=True,
        timeout=HANG_S,
    )
    digest = json.loads(replayed.stdout)["digest"]
    assert digest == read_metadata(recording)["summary"]["digest"]
