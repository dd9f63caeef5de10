"""A vehicle of pymavlink's own making, on a thread: it flies, answers, and keeps what it heard."""

import os

os.environ.setdefault("MAVLINK20", "1")  # before mavutil is loaded, or it speaks MAVLink 1

import math
import threading
import time
from collections.abc import Callable
from typing import Any

from pymavlink import mavutil
from support import HANG_S

Message = Any


def place(sysid: int, boot_s: float) -> tuple[float, float, float]:
    """Latitude, longitude (degrees) and height (m) of a vehicle at a time of its own clock."""
    angle = 0.1 * boot_s + sysid
    lat = 47.3977 + 50 * math.cos(angle) / 111_195
    lon = 8.5456 + 50 * math.sin(angle) / 75_270
    return lat, lon, 550.0


class Vehicle:
    """Reports a circle of 50 m about 47.3977 N 8.5456 E over ``mavutil``.

    ``position_hz`` and ``attitude_hz`` follow SET_MESSAGE_INTERVAL, which is acknowledged; TIMESYNC
    is answered with nanoseconds since boot. ``heard`` holds what came, with its time. ``clock``
    gives the time since boot of a time of ``time.monotonic``; where it flies is by its own clock.
    """

    def __init__(
        self,
        address: str,
        sysid: int,
        position_hz: float,
        attitude_hz: float,
        clock: Callable[[float], float] | None = None,
    ) -> None:
        self.rates_hz = {33: position_hz, 30: attitude_hz}
        self.heard: list[tuple[float, Message]] = []
        self.silent = False
        self.link = mavutil.mavlink_connection(address, source_system=sysid, source_component=1)
        self._sysid = sysid
        begun_s = time.monotonic() - 100.0
        self._clock = clock or (lambda now_s: now_s - begun_s)
        self._changed = threading.Condition()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._fly, daemon=True)

    def __enter__(self) -> "Vehicle":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(HANG_S)
        self.link.close()

    def wait_for(self, wanted: Callable[[Message], bool], seconds: float = HANG_S) -> Message:
        """The first message heard from now on that is wanted; an assertion error without one."""
        begin = len(self.heard)
        with self._changed:
            found = self._changed.wait_for(
                lambda: next((m for _, m in self.heard[begin:] if wanted(m)), None), seconds
            )
        assert found is not None, f"not heard, but {[str(m) for _, m in self.heard[-5:]]}"
        return found

    def _fly(self) -> None:
        due_s = dict.fromkeys((0, 30, 33), time.monotonic())
        while not self._end.is_set():
            now_s = time.monotonic()
            for msgid, hz in ((0, 1.0), *self.rates_hz.items()):
                if now_s >= due_s[msgid] and not self.silent:
                    due_s[msgid] = max(due_s[msgid] + 1 / hz, now_s - 1 / hz)
                    self._say(msgid, self._clock(time.monotonic()))
            message = self.link.recv_match(blocking=True, timeout=0.005)
            if message is not None and message.get_type() != "BAD_DATA":
                self._answer(message)

    def _say(self, msgid: int, boot_s: float) -> None:
        mav, boot_ms = self.link.mav, round(boot_s * 1e3)
        if msgid == 0:
            mav.heartbeat_send(2, 3, 217, 4, 4)
        elif msgid == 30:
            mav.attitude_send(boot_ms, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
        else:
            # As of the time that is stamped, which is in whole milliseconds.
            lat, lon, alt_m = place(self._sysid, boot_ms / 1e3)
            angle = 0.1 * boot_ms / 1e3 + self._sysid
            velocity = (round(-500 * math.sin(angle)), round(500 * math.cos(angle)), 0)
            there = (round(lat * 1e7), round(lon * 1e7), round(1e3 * alt_m), 40_000)
            mav.global_position_int_send(boot_ms, *there, *velocity, 65535)

    def _answer(self, message: Message) -> None:
        mav = self.link.mav
        if message.get_type() == "COMMAND_LONG" and message.target_system == self._sysid:
            if message.command == mavutil.mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                self.rates_hz[int(message.param1)] = 1e6 / message.param2
            mav.command_ack_send(message.command, mavutil.mavlink.MAV_RESULT_ACCEPTED)
        elif message.get_type() == "TIMESYNC" and message.tc1 == 0 and not self.silent:
            mav.timesync_send(round(self._clock(time.monotonic()) * 1e9), message.ts1)
        with self._changed:
            self.heard.append((time.monotonic(), message))
            self._changed.notify_all()
