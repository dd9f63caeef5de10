"""Invented UAVs, by the thousand: their frames, and a process that sends them.

    python tests/crowd.py UDP_PORT UAVS

Each reports its position ``REPORTS`` times, a second apart, and is silent then: its track stays for
minutes. All come from one socket.
"""

import math
import socket
import struct
import sys
import time
from collections.abc import Iterator

from load_sender import GLOBAL_POSITION_INT, HEARTBEAT, frame

REPORTS = 3
FIRST_SYSID, SYSIDS = 10, 240  # the ids below are those of honest vehicles
BATCH = 20


def ids(index: int) -> tuple[int, int]:
    """System and component id of an invented UAV."""
    return index % SYSIDS + FIRST_SYSID, index // SYSIDS + 1


def report(index: int, number: int, boot_ms: int) -> bytes:
    """A frame with the position of an invented UAV."""
    ring, angle = divmod(index, 40)
    lat = 47.3977 + (0.003 + 0.001 * ring) * math.cos(angle * math.tau / 40)
    lon = 8.5456 + (0.004 + 0.0015 * ring) * math.sin(angle * math.tau / 40)
    place = (round(lat * 1e7), round(lon * 1e7), 550_000, 37_000)
    payload = struct.pack("<IiiiihhhH", boot_ms % 2**32, *place, 1, -1, 0, 9000)
    return frame(ids(index), number, GLOBAL_POSITION_INT, payload)


def heartbeat(index: int, number: int) -> bytes:
    """A heartbeat of an invented UAV."""
    payload = struct.pack("<IBBBBB", 4, 2, 3, 217, 4, 3)
    return frame(ids(index), number, HEARTBEAT, payload)


def batches(uavs: int) -> Iterator[tuple[float, range]]:
    """When to send the reports of which UAVs, seconds from the start."""
    for start in range(0, uavs, BATCH):
        yield start / uavs, range(start, min(start + BATCH, uavs))


def main(port: int, uavs: int) -> None:
    """Send the reports of all UAVs, evenly spread."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", port))
        begun_s = time.monotonic()
        for number in range(REPORTS):
            for due_s, some in batches(uavs):
                time.sleep(max(0.0, begun_s + number + due_s - time.monotonic()))
                for index in some:
                    sender.send(report(index, number, round(time.monotonic() * 1000)))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
