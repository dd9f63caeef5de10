"""A gimbal by MAVLink: ``gimbal:HOST:PORT:SYSID:COMPID``, and ``gimbal-roi:``.

GIMBAL_MANAGER_SET_PITCHYAW points it, with yaw from north and pitch from the horizon
(https://mavlink.io/en/services/gimbal_v2.html). DO_SET_ROI_LOCATION sends the position of the UAV
instead, and the gimbal points there by its own position and attitude: for a gimbal away from the
array, or on a moving carrier. If the gimbal reports its attitude (GIMBAL_DEVICE_ATTITUDE_STATUS),
its lag is estimated from it. Messages are sent as MAV_COMP_ID_ONBOARD_COMPUTER of that system.
Never tested on hardware: the tests decode the messages with pymavlink.
"""

import math
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable
from typing import Final

from companion.mavlink.wire.encode import Outgoing, pack
from companion.mavlink.wire.framing import SplitLimits, Splitter, search_budget
from companion.node.drive.lag import MountLag
from companion.node.drive.loop import Device, DeviceCommand, DeviceError, DeviceInput, SafeState
from companion.values import Frame, Reason, Rejection, Source

COMMAND_INT: Final = 75
DO_SET_ROI_LOCATION: Final = 195
DO_SET_ROI_NONE: Final = 197
SET_PITCHYAW: Final = 287
ATTITUDE_STATUS: Final = 285
IN_EARTH_FRAME: Final = 4 | 8 | 16 | 64
"""GIMBAL_MANAGER_FLAGS of a command: roll, pitch and yaw locked, and yaw from north."""
YAW_LOCKED: Final = 16
YAW_FROM_VEHICLE: Final = 32
YAW_FROM_NORTH: Final = 64
"""GIMBAL_DEVICE_FLAGS. Without either frame, as in older gimbals, a locked yaw is from north."""
ONBOARD_COMPUTER: Final = 191
RECEIVED_MAX: Final = 1000  # datagrams read in one update; more are a failure of the gimbal
REPORTER_SILENT_NS: Final = 2_000_000_000
"""Silence after which another gimbal of the target's system is followed."""
UNIT_ERROR_MAX: Final = 0.1  # largest deviation of an attitude's quaternion from length 1


class Gimbal(Device):
    """Gimbal as a device; its boresight is north and level."""

    name = "a gimbal"
    takes = DeviceInput.POINTING
    safe_states = (SafeState.HOLD, SafeState.BORESIGHT)  # a gimbal does not radiate

    def __init__(
        self, *, host: str, port: int, target: Source, now_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._address = host, port
        self.target = target
        self._now_ns = now_ns
        self._lag = MountLag()
        self._socket: socket.socket | None = None
        self._splitter = Splitter(
            "gimbal", frozenset((ATTITUDE_STATUS,)), SplitLimits(search=search_budget())
        )
        self.rejected: Counter[str] = Counter()
        self._sequence = 0
        self._last_rad = self._seen_rad = 0.0
        self._reporter: Frame | None = None  # newest attitude, of the gimbal that is followed

    @property
    def lead_s(self) -> float:
        """Lag estimated from the gimbal's attitude reports; 0 without reports."""
        return self._lag.lag_s

    def open(self) -> None:
        """Open a UDP socket; the gimbal may be absent."""
        host, port = self._address
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(found[0], socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            self._socket.connect(found[4])
        except OSError as error:
            self.close()
            raise DeviceError(f"gimbal at {host}:{port}: {error.strerror or error}") from error

    def apply(self, command: DeviceCommand) -> None:
        """Read the attitudes reported so far, and point the gimbal."""
        self._receive()
        yaw_rad = _near(command.bearing_rad, self._last_rad)
        self._last_rad = yaw_rad
        self._point(command)
        self._lag.note_command(self._now_ns(), yaw_rad)

    def rest(self, safe: SafeState) -> None:
        """Keep the last direction, or point to boresight."""
        if safe is SafeState.BORESIGHT:
            self._point(DeviceCommand(valid_at_ns=0, unfit=None))

    def close(self) -> None:
        """Close the gimbal's socket."""
        if self._socket:
            self._socket.close()
            self._socket = None

    def _point(self, command: DeviceCommand) -> None:
        yaw_rad = math.remainder(command.bearing_rad, 2 * math.pi)
        rates = math.nan, math.nan  # pitch and yaw rates are not commanded
        recipient = *self.target, 0  # every gimbal of that manager
        angles = command.above_rad, yaw_rad
        self.say(SET_PITCHYAW, struct.pack("<I4f3B", IN_EARTH_FRAME, *angles, *rates, *recipient))

    def say(self, msgid: int, payload: bytes) -> None:
        """Send a MAVLink message to the gimbal."""
        own = Source(self.target[0], ONBOARD_COMPUTER)
        raw = pack(Outgoing(own, msgid, payload), self._sequence)
        self._sequence = (self._sequence + 1) & 0xFF
        try:
            if self._socket is None:
                raise DeviceError("no socket to the gimbal")
            self._socket.send(raw)
        except OSError as error:
            raise DeviceError(f"gimbal: {error.strerror or error}") from error

    def _receive(self) -> None:
        """Read the attitudes received so far. A datagram contains whole messages."""
        for _ in range(RECEIVED_MAX):
            if self._socket is None:
                return
            try:
                data = self._socket.recv(2048)
            except BlockingIOError:
                return
            except OSError as error:
                raise DeviceError(f"gimbal: {error.strerror or error}") from error
            now_ns = self._now_ns()
            for found in self._splitter.feed(now_ns, data) + self._splitter.finish(now_ns):
                if isinstance(found, Rejection):
                    self.rejected[found.reason] += found.count
                elif found.source.sysid == self.target.sysid:
                    self._note(found)
        raise DeviceError(f"gimbal sent more than {RECEIVED_MAX} messages between two updates")

    def _is_followed(self, frame: Frame) -> bool:
        """Return whether an attitude is of the target, or of the gimbal that reported first."""
        last = self._reporter
        is_followed = (
            last is None
            or frame.source in (last.source, self.target)
            or frame.t_ns - last.t_ns > REPORTER_SILENT_NS
        )
        if is_followed:
            self._reporter = frame
        return is_followed

    def _note(self, frame: Frame) -> None:
        payload = frame.raw[10 : 10 + frame.raw[1]].ljust(40, b"\0")
        w, x, y, z = struct.unpack_from("<4f", payload, 4)
        (flags,) = struct.unpack_from("<H", payload, 36)
        if not abs(math.hypot(w, x, y, z) - 1) <= UNIT_ERROR_MAX:
            self.rejected[Reason.MALFORMED] += 1
            return
        yaw_rad = math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
        is_locked = flags & (YAW_LOCKED | YAW_FROM_VEHICLE) == YAW_LOCKED
        if (is_locked or flags & YAW_FROM_NORTH) and self._is_followed(frame):
            self._seen_rad = _near(yaw_rad, self._seen_rad)
            self._lag.note_report(frame.t_ns, self._seen_rad)


class RoiGimbal(Gimbal):
    """A gimbal that gets positions instead of directions; boresight cancels the position."""

    def _point(self, command: DeviceCommand) -> None:
        lat_deg, lon_deg, alt_m = command.place or (0.0, 0.0, 0.0)
        number = DO_SET_ROI_NONE if command.place is None else DO_SET_ROI_LOCATION
        where = round(lat_deg * 1e7), round(lon_deg * 1e7), alt_m
        recipient = *self.target, 0, 0, 0  # MAV_FRAME_GLOBAL: above mean sea level; no mission
        self.say(
            COMMAND_INT, struct.pack("<4f2ifH5B", 0.0, 0.0, 0.0, 0.0, *where, number, *recipient)
        )


def _near(angle_rad: float, other_rad: float) -> float:
    """Return the angle plus full turns, within half a turn of a reference angle."""
    return other_rad + math.remainder(angle_rad - other_rad, 2 * math.pi)
