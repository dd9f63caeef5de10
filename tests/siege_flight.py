"""Five honest vehicles in a process of their own: four UAVs on circles, and the carrier.

    python tests/siege_flight.py UDP_PORT [KEY]

They fly until the process is stopped, each from a socket of its own, with ``HZ`` positions and
attitudes a second, signed if a key in hexadecimal is given. ``place`` is where each is at a time of
the wall clock, so that another process can compare.
"""

import contextlib
import hashlib
import json
import math
import signal
import socket
import struct
import sys
import time

from fastcrc import crc16
from load_sender import ATTITUDE, GLOBAL_POSITION_INT, HEARTBEAT, SYSTEM_TIME, frame

from companion.mavlink.wire.crc_extra import CRC_EXTRA

HZ = 10
CARRIER = 5
UAVS = (1, 2, 3, 4)
YAW_RAD = 0.5  # heading of all, which are nearly level
LAT0, LON0, ALT0_M = 47.3977, 8.5456, 550.0
RADIUS_M, RATE_RADPS = 60.0, 0.1
M_PER_DEG = 111_195.0
BOOT_S = 1000.0  # time since boot when the flight begins
STEP_S = 0.005
SIGNED = 1  # incompatibility flag
STAMPS_BEGIN_S = 1_420_070_400  # 2015, from where signatures count their time


def place(sysid: int, at_s: float) -> tuple[float, float, float]:
    """North, east of the first position and height above the sea, metres; velocity follows."""
    if sysid == CARRIER:
        return 0.0, 0.0, ALT0_M - 50.0
    angle = RATE_RADPS * at_s + sysid * math.tau / 4
    far = 200.0 + 40.0 * sysid
    bearing = sysid * math.tau / 4
    return (
        far * math.cos(bearing) + RADIUS_M * math.cos(angle),
        far * math.sin(bearing) + RADIUS_M * math.sin(angle),
        ALT0_M,
    )


def velocity(sysid: int, at_s: float) -> tuple[float, float]:
    """North and east velocity, m/s."""
    if sysid == CARRIER:
        return 0.0, 0.0
    angle = RATE_RADPS * at_s + sysid * math.tau / 4
    speed = RADIUS_M * RATE_RADPS
    return -speed * math.sin(angle), speed * math.cos(angle)


def degrees(north_m: float, east_m: float) -> tuple[float, float]:
    """Latitude and longitude of a place."""
    return (LAT0 + north_m / M_PER_DEG, LON0 + east_m / (M_PER_DEG * math.cos(math.radians(LAT0))))


def report(sysid: int, boot_ms: int, at_s: float, shift_m: float = 0.0) -> bytes:
    """Payload of GLOBAL_POSITION_INT; ``shift_m`` to the north of the truth."""
    north_m, east_m, alt_m = place(sysid, at_s)
    lat, lon = degrees(north_m + shift_m, east_m)
    vn, ve = velocity(sysid, at_s)
    return struct.pack(
        "<IiiiihhhH", boot_ms, round(lat * 1e7), round(lon * 1e7), round(alt_m * 1e3), 50_000,
        round(vn * 100), round(ve * 100), 0, 9000,
    )  # fmt: skip


def boot_ms(at_s: float, sysid: int) -> int:
    """Time since boot of a vehicle's clock, which begins at a time of its own."""
    return round((at_s % 1e6 + BOOT_S * sysid) * 1000) % 2**32


def signed(raw: bytes, at_s: float, key: bytes) -> bytes:
    """Sign a frame of ``load_sender`` (https://mavlink.io/en/guide/message_signing.html)."""
    body = raw[1:2] + bytes([SIGNED]) + raw[3:-2]
    extra = bytes([CRC_EXTRA[int.from_bytes(raw[7:10], "little")]])
    whole = raw[:1] + body + struct.pack("<H", crc16.mcrf4xx(body + extra))
    stamp = b"\1" + round((at_s - STAMPS_BEGIN_S) * 1e5).to_bytes(6, "little")
    return whole + stamp + hashlib.sha256(key + whole + stamp).digest()[:6]


class Vehicle:
    """One honest sender; ``sent`` counts its frames, which a ``key`` signs."""

    def __init__(self, sysid: int, port: int, key: bytes | None = None) -> None:
        self.sysid, self.sent, self._key = sysid, 0, key
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))

    def send(self, msgid: int, payload: bytes) -> None:
        raw = frame((self.sysid, 1), self.sent % 256, msgid, payload)
        if self._key is not None:
            raw = signed(raw, time.time() + self.sent * 1e-5, self._key)  # no stamp twice
        with contextlib.suppress(ConnectionRefusedError):
            self._socket.send(raw)
        self.sent += 1

    def step(self, number: int) -> None:
        """Send what is due in the step of that number."""
        at_s = time.time()
        boot = boot_ms(at_s, self.sysid)
        self.send(GLOBAL_POSITION_INT, report(self.sysid, boot, at_s))
        self.send(ATTITUDE, struct.pack("<Iffffff", boot, 0.01, 0.02, YAW_RAD, 0.01, 0.01, 0.01))
        if number % HZ == 0:
            kind = 2 if self.sysid != CARRIER else 10
            self.send(HEARTBEAT, struct.pack("<IBBBBB", 4, kind, 3, 217, 4, 3))
            self.send(SYSTEM_TIME, struct.pack("<QI", round(at_s * 1e6), boot))


def main(port: int, key: bytes | None = None) -> None:
    """Fly until SIGTERM, and print the number of frames sent by each."""
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGTERM, stop)
    vehicles = [Vehicle(sysid, port, key) for sysid in (*UAVS, CARRIER)]
    begun_s, number = time.monotonic(), 0
    while not stopped:
        for index, vehicle in enumerate(vehicles):
            due_s = begun_s + (number + index / len(vehicles)) / HZ
            time.sleep(max(0.0, due_s - time.monotonic()))
            vehicle.step(number)
        number += 1
    print(json.dumps({vehicle.sysid: vehicle.sent for vehicle in vehicles}))


if __name__ == "__main__":
    main(int(sys.argv[1]), *map(bytes.fromhex, sys.argv[2:]))
