"""From the arrival of a report to new weights in shared memory, for each report: ``make bench``.

A thread sends the reports of all UAVs, evenly over time; another one watches the shared memory. A
report's latency ends when a record with that UAV's beam is there that was made after the report was
sent.
"""

import contextlib
import mmap
import os
import statistics
import struct
import threading
import time
from bisect import bisect_left
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from arm import flight
from figures import Figures
from load_sender import GLOBAL_POSITION_INT
from support import started

from companion.node.ring import HEAD_BYTES, SLOT_BYTES, SLOT_HEAD_BYTES, SLOTS
from companion.views.records import HEADER

pytestmark = pytest.mark.benchmark
HZ: Final = 10
BEFORE: Final = 30  # reports of each UAV until all have beams, and the service runs evenly
MEASURED: Final = 100
WRITTEN_AT: Final = 24  # where a ring says how many records it has
MADE_AT: Final = HEADER.fields["made_at_ns"][1]  # type: ignore[index]
REVISION_AT: Final = HEADER.fields["revision"][1]  # type: ignore[index]
POLL_S: Final = 20e-6
BUSY: Final = "while True: pass"


class Watched:
    """Records of a ring: when each was made and seen, UTC, and the UAV of a beam that was renewed.

    An empty name stands for all UAVs.
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            self._map = mmap.mmap(
                file.fileno(), os.fstat(file.fileno()).st_size, prot=mmap.PROT_READ
            )
        self.seen = list[tuple[int, int, bytes]]()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        known = 0
        while not self._end.is_set():
            (written,) = struct.unpack_from("<Q", self._map, WRITTEN_AT)
            if written == known:
                time.sleep(POLL_S)
                continue
            now_ns = time.time_ns()
            for number in range(known, written):
                at = HEAD_BYTES + number % SLOTS * SLOT_BYTES + SLOT_HEAD_BYTES
                (made_ns,) = struct.unpack_from("<q", self._map, at + MADE_AT)
                (revision,) = struct.unpack_from("<Q", self._map, at + REVISION_AT)
                uav = self._map[at + HEADER.itemsize :][:72].rstrip(b"\0") if revision else b""
                self.seen.append((made_ns, now_ns, uav))
            known = written

    def __enter__(self) -> "Watched":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()


def fly(port: int, uavs: int, reports: int) -> list[tuple[int, bytes]]:
    """Send so many reports of UAVs in circles; return when each was sent, UTC, and its UAV."""
    sent, begun_s = list[tuple[int, bytes]](), time.monotonic()
    with flight.socket_to(port) as sock:
        for number in range(reports):
            for index in range(uavs):
                wait_s = begun_s + (number + index / uavs) / HZ - time.monotonic()
                if wait_s > 0:
                    time.sleep(wait_s)
                if number % HZ == 0:
                    sock.send(flight.frames(index, number * 5 + 1))  # a heartbeat
                data = flight.frames(index, number * 5)
                assert data[7] == GLOBAL_POSITION_INT
                sent.append((time.time_ns(), b"%d:%d" % (data[5], data[6])))
                sock.send(data)
    return sent


def latencies_ms(sent: list[tuple[int, bytes]], seen: list[tuple[int, int, bytes]]) -> list[float]:
    """From each report to the first record with its UAV that was made after it."""
    found = []
    for uav in {uav for _, uav in sent}:
        records = [(made, at) for made, at, of in seen if of in (b"", uav)]
        made_ns = [made for made, _ in records]
        for sent_ns in [at for at, of in sent if of == uav]:
            place = bisect_left(made_ns, sent_ns)
            if place < len(records):
                found.append((records[place][1] - sent_ns) * 1e-6)
    return found


@pytest.mark.parametrize("busy", [False, True])
@pytest.mark.parametrize("uavs", [4, 20, 100])
def test_from_a_report_to_weights_in_shared_memory(
    uavs: int, busy: bool, start_node: Any, tmp_path: Path, figures: Figures
) -> None:
    medians = {}
    for update in ("timer", "report"):
        ring, config = tmp_path / f"ring-{update}", tmp_path / f"{update}.toml"
        config.write_text(
            f'[beams]\nupdate = "{update}"\n[records]\nshared_memory = "{ring}"\n'
            f'[center]\nsource = "{flight.CENTER}"\n'
        )
        run = ("run", "--config", str(config), "--link", "udpin:127.0.0.1:0")
        node = start_node(*run, "--listen", "127.0.0.1:0", "--silent")
        with Watched(ring) as watched, contextlib.ExitStack() as load:
            for _ in range(2 * busy):
                load.enter_context(started(["nice", "python3", "-c", BUSY]))
            sent = fly(node.udp_port, uavs, BEFORE + MEASURED)[BEFORE * uavs :]
            time.sleep(0.5)
        node.stop()
        took_ms = latencies_ms(sent, watched.seen)
        assert len(took_ms) > 0.9 * len(sent)
        name = f"report to shared memory, {uavs} UAVs, {update}{', busy' if busy else ''}"
        medians[update] = figures.note(f"{name}, median", statistics.median(took_ms), "ms", "less")
        figures.note(f"{name}, p99", float(np.percentile(took_ms, 99)), "ms", "less")
    assert medians["report"] < medians["timer"] / 2
