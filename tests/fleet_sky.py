"""Vehicles in circles, heard by those nodes that a test chooses, and where they truly are.

    python tests/fleet_sky.py SECONDS HZ UAVS PORT [PORT ...]

Sends to all ports for so long. In a test, ``FleetSky`` does so from a thread of its own.
"""

import math
import socket
import sys
import threading
import time
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import common

LAT_DEG, LON_DEG, ALT_M = 47.3977, 8.5456, 480.0
DEG_M = 111_195.0
STEP_S = 0.005


@dataclass(kw_only=True)
class FleetSky:
    """``uavs`` vehicles that report at ``hz``; each is heard at the ports in ``heard_at``.

    ``hosts`` has those of ports that are not on this machine.
    """

    ports: list[int]
    uavs: int = 6
    hz: float = 10.0
    sent: int = 0
    heard_at: dict[str, set[int]] = field(default_factory=dict)
    hosts: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.names = [f"{number + 1}:1" for number in range(self.uavs)]
        self.heard_at = {name: set(self.ports) for name in self.names}
        self.begun_s = time.monotonic()
        self.utc_s = time.time() - time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "FleetSky":
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(10)
        self._socket.close()

    def at(self, name: str, utc_s: float) -> tuple[float, float, float]:
        """Latitude, longitude and height of a vehicle."""
        return self._state(int(name.split(":", maxsplit=1)[0]) - 1, utc_s - self.utc_s)[0]

    def _state(
        self, number: int, t_s: float
    ) -> tuple[tuple[float, float, float], tuple[float, float]]:
        radius_m, speed_mps = 60.0 + 15 * (number % 10), 8.0 + number % 7
        angle = speed_mps / radius_m * t_s + number
        north_m = 300 * math.cos(number) + radius_m * math.cos(angle)
        east_m = 500 + 400 * math.sin(number) + radius_m * math.sin(angle)
        lat = LAT_DEG + north_m / DEG_M
        lon = LON_DEG + east_m / (DEG_M * math.cos(math.radians(LAT_DEG)))
        velocity = -speed_mps * math.sin(angle), speed_mps * math.cos(angle)
        return (lat, lon, ALT_M + 40 + number), velocity

    def report(self, number: int, t_s: float) -> bytes:
        """A vehicle's report at a time of the monotonic clock, rounded to its milliseconds."""
        boot_ms = round((t_s - self.begun_s) * 1e3) + 10_000 * (number + 1)
        t_s = self.begun_s + (boot_ms - 10_000 * (number + 1)) / 1e3
        (lat, lon, alt_m), (north, east) = self._state(number, t_s)
        mav = common.MAVLink(None, srcSystem=number + 1, srcComponent=1)
        message = common.MAVLink_global_position_int_message(
            boot_ms,
            round(lat * 1e7),
            round(lon * 1e7),
            round(alt_m * 1e3),
            40_000,
            round(north * 100),
            round(east * 100),
            0,
            65535,
        )
        return bytes(message.pack(mav))

    def _heartbeat(self, number: int) -> bytes:
        mav = common.MAVLink(None, srcSystem=number + 1, srcComponent=1)
        beat = common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3)
        return bytes(beat.pack(mav))

    def _run(self) -> None:
        due_s = {
            number: self.begun_s + number / (self.uavs * self.hz) for number in range(self.uavs)
        }
        beat_s = self.begun_s
        while not self._over.is_set():
            now_s = time.monotonic()
            if now_s >= beat_s:
                beat_s += 1.0
                for number in range(self.uavs):
                    self._send(number, self._heartbeat(number))
            for number, at_s in due_s.items():
                if now_s >= at_s:
                    due_s[number] = max(at_s + 1 / self.hz, now_s - 0.5)
                    self._send(number, self.report(number, time.monotonic()))
                    self.sent += 1
            self._over.wait(STEP_S)

    def _send(self, number: int, raw: bytes) -> None:
        for port in self.heard_at[self.names[number]]:
            self._socket.sendto(raw, (self.hosts.get(port, "127.0.0.1"), port))


def off_m(place: tuple[float, float, float], other: tuple[float, float, float]) -> float:
    """Distance of two places that are near each other, metres."""
    north = (place[0] - other[0]) * DEG_M
    east = (place[1] - other[1]) * DEG_M * math.cos(math.radians(place[0]))
    return math.hypot(north, east, place[2] - other[2])


if __name__ == "__main__":
    seconds, hz, uavs, *ports = sys.argv[1:]
    with FleetSky(ports=[int(port) for port in ports], uavs=int(uavs), hz=float(hz)) as sky:
        time.sleep(float(seconds))
    print(sky.sent)
