"""A flight through the splitter and the pipeline, the same on every machine.

    python tests/arm/flight.py UAVS SECONDS

UAVs fly in circles around a fixed station. Each sends what an autopilot sends: 50 frames a second,
of which 10 are positions and 10 attitudes. Ten times a second, beams are updated. Prints, as JSON,
the digests, the last beams, and their weights as hexadecimal numbers.
"""

import json
import math
import socket
import struct
import sys
from collections.abc import Iterator
from typing import Final

from load_sender import ATTITUDE, GLOBAL_POSITION_INT, HEARTBEAT, RAW_IMU, SIZES, frame

from companion import Pipeline, Settings, Tick
from companion.mavlink.wire.framing import Splitter

FRAMES_HZ: Final = 50
BEGIN_NS: Final = 1_800_000_000_000_000_000
METRES_PER_DEGREE: Final = 111_319.5
CENTER: Final = "47.3977,8.5456,500"


def frames(index: int, number: int) -> bytes:
    """The frame of a UAV's turn."""
    ids, t_s = (index % 250 + 1, 1), number / FRAMES_HZ
    boot_ms = 100_000 + round(1e3 * t_s) + index
    radius_m, speed_mps = 80.0 + 9.0 * index, 5.0 + index % 7
    angle = index * 2.4 + speed_mps / radius_m * t_s
    heading = angle + math.pi / 2
    if number % 5 == 0:
        north, east = radius_m * math.cos(angle), radius_m * math.sin(angle)
        lat = 47.3977 + north / METRES_PER_DEGREE
        lon = 8.5456 + east / METRES_PER_DEGREE / math.cos(math.radians(47.3977))
        velocity = [round(100 * speed_mps * f(heading)) for f in (math.cos, math.sin)]
        payload = struct.pack(
            "<IiiiihhhH", boot_ms, round(lat * 1e7), round(lon * 1e7), 545_000 + 900 * index,
            45_000, *velocity, 0, round(math.degrees(heading) * 100) % 36_000 + 1,
        )  # fmt: skip
        return frame(ids, number % 256, GLOBAL_POSITION_INT, payload)
    if number % 5 == 2:
        payload = struct.pack(
            "<I6f", boot_ms, 0.1, 0.02, math.remainder(heading, math.tau), 0, 0, 1e-3
        )
        return frame(ids, number % 256, ATTITUDE, payload)
    if number % FRAMES_HZ == 1:
        return frame(ids, number % 256, HEARTBEAT, struct.pack("<IBBBBB", 4, 2, 3, 217, 4, 3))
    return frame(ids, number % 256, RAW_IMU, bytes(SIZES[RAW_IMU] - 1) + b"\1")


def socket_to(port: int) -> socket.socket:
    """Return a socket that sends datagrams to a port of this machine."""
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect(("127.0.0.1", port))
    return sender


def arrivals(uavs: int, seconds: float) -> Iterator[tuple[int, int, bytes]]:
    """Time, UAV and bytes of each datagram, in order."""
    for number in range(round(seconds * FRAMES_HZ)):
        for index in range(uavs):
            t_ns = BEGIN_NS + (number * uavs + index) * (1_000_000_000 // (FRAMES_HZ * uavs))
            yield t_ns + 15_000_000, index, frames(index, number)


def fly(uavs: int, seconds: float) -> Pipeline:
    """Return the pipeline after the flight."""
    pipeline = Pipeline(Settings().override(center={"source": CENTER}))
    splitters = [Splitter("flight") for _ in range(uavs)]
    due_ns = BEGIN_NS + 100_000_000
    for t_ns, index, data in arrivals(uavs, seconds):
        while due_ns <= t_ns:
            pipeline.step(Tick(due_ns))
            due_ns += 100_000_000
        for item in splitters[index].feed(t_ns, data):
            pipeline.step(item)
    return pipeline


def main(uavs: int, seconds: float) -> None:
    """Fly, and print what came of it."""
    pipeline = fly(uavs, seconds)
    made = pipeline.last_update
    weights = [] if made is None else made.beams.weights.ravel().tolist()
    found = {
        "digest": pipeline.digest.hexdigest(),
        "estimates": pipeline.digest.of_estimates(),
        "beams": 0 if made is None else len(made.beams.beams),
        "weights": [[one.real.hex(), one.imag.hex()] for one in weights],
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))
