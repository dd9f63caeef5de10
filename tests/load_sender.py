"""Sends what many vehicles send, at a rate, from one socket each; run as a process of its own.

    python tests/load_sender.py PORT SENDERS FRAMES_PER_SECOND SECONDS [FIRST]

FIRST counts the vehicles from 0. Prints, as JSON, how many frames were sent and over how many
seconds. Each vehicle hovers in its
own place, reports it at 10 Hz, and sends the rest of what an autopilot sends besides. The frames
are made by hand, for pymavlink's encoder would be the slower one of the two processes.
"""

import contextlib
import json
import math
import socket
import struct
import sys
import time

from fastcrc import crc16

from companion.mavlink.wire.crc_extra import CRC_EXTRA

REPORTS_HZ = 10
HEARTBEAT, SYSTEM_TIME, GPS_RAW_INT, RAW_IMU, ATTITUDE = 0, 2, 24, 27, 30
GLOBAL_POSITION_INT, SERVO_OUTPUT_RAW, VFR_HUD = 33, 36, 74
SIZES = {RAW_IMU: 26, SERVO_OUTPUT_RAW: 21, VFR_HUD: 20}
STEP_S = 0.005


def frame(ids: tuple[int, int], seq: int, msgid: int, payload: bytes) -> bytes:
    """A MAVLink 2 frame; the payload must not end in zeros."""
    head = bytes([len(payload), 0, 0, seq, *ids, msgid & 255, msgid >> 8, 0])
    body = head + payload
    return b"\xfd" + body + struct.pack("<H", crc16.mcrf4xx(body + bytes([CRC_EXTRA[msgid]])))


class Vehicle:
    """One sender: where it is, and what it says when its turn comes."""

    def __init__(self, index: int, port: int, frames_hz: float) -> None:
        self.ids = (index % 250 + 1, index // 250 + 1)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        ring, angle = divmod(index, 40)
        self.lat = 47.3977 + (0.003 + 0.001 * ring) * math.cos(angle * math.tau / 40)
        self.lon = 8.5456 + (0.004 + 0.0015 * ring) * math.sin(angle * math.tau / 40)
        self.sent = 0
        self.turns = self._turns(round(frames_hz))

    @staticmethod
    def _turns(frames_hz: int) -> list[int]:
        """The message of each turn of one second."""
        fill = [RAW_IMU, ATTITUDE, VFR_HUD, SERVO_OUTPUT_RAW, ATTITUDE]
        turns = [fill[number % len(fill)] for number in range(frames_hz)]
        for number in range(REPORTS_HZ):
            turns[number * frames_hz // REPORTS_HZ] = GLOBAL_POSITION_INT
        for place, msgid in zip((1, 2, 3), (HEARTBEAT, SYSTEM_TIME, GPS_RAW_INT), strict=True):
            turns[place * frames_hz // 4 + 1] = msgid
        return turns

    def send(self) -> None:
        """Send the next frame."""
        msgid = self.turns[self.sent % len(self.turns)]
        payload = self._payload(msgid, time.monotonic_ns() // 1_000_000 % 2**32)
        with contextlib.suppress(ConnectionRefusedError):  # who listened has ended
            self.socket.send(frame(self.ids, self.sent % 256, msgid, payload))
        self.sent += 1

    def _payload(self, msgid: int, boot_ms: int) -> bytes:
        place = (round(self.lat * 1e7), round(self.lon * 1e7))
        match msgid:
            case 0:
                return struct.pack("<IBBBBB", 4, 2, 3, 217, 4, 3)
            case 2:
                return struct.pack("<QI", time.time_ns() // 1000, boot_ms | 1 << 24)
            case 24:
                return struct.pack(
                    "<QiiiHHHHBBiIII", boot_ms * 1000, *place, 550_000, 60, 90, 0, 0, 6, 17, 0,
                    20, 30, 50,
                )  # fmt: skip
            case 30:
                return struct.pack("<Iffffff", boot_ms, 0.01, 0.02, 0.5, 0.1, 0.2, 0.3)
            case 33:
                return struct.pack("<IiiiihhhH", boot_ms, *place, 550_000, 37_000, 1, -1, 0, 9000)
            case _:
                return bytes(SIZES[msgid] - 1) + b"\1"


def main(port: int, senders: int, rate_hz: float, seconds: float, first: int = 0) -> None:
    """Send, evenly spread, and say how much."""
    vehicles = [Vehicle(index, port, rate_hz / senders) for index in range(first, first + senders)]
    start = time.monotonic()
    sent, due = 0, 0
    while due < round(rate_hz * seconds):
        due = min(round(rate_hz * (time.monotonic() - start)), round(rate_hz * seconds))
        while sent < due:
            vehicles[sent % senders].send()
            sent += 1
        time.sleep(STEP_S)
    took_s = time.monotonic() - start
    for vehicle in vehicles:
        vehicle.socket.close()
    print(json.dumps({"frames": sent, "seconds": took_s}))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]), *map(float, sys.argv[3:5]), *map(int, sys.argv[5:]))
