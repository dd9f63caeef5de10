"""A rotator behind hamlib's rotctld: ``rotctld:HOST:PORT``.

The protocol is lines of text (rotctld(1) of hamlib): ``P AZ EL`` points, ``p`` returns the
direction, ``S`` stops; answers end with ``RPRT 0``, or another number for an error.
"""

import contextlib
import math
import re
import socket
import time
from collections.abc import Callable
from typing import Final

from companion.node.drive.lag import MountLag
from companion.node.drive.loop import Device, DeviceCommand, DeviceError, DeviceInput, SafeState
from companion.values import shown

TIMEOUT_S: Final = 2.0  # for a whole answer
ANSWER_MAX_BYTES: Final = 65_536
_NUMBER: Final = r"(-?\d{1,6}(?:\.\d{0,12})?)(?![\d.])"


class Rotator(Device):
    """Rotator as a device, led by its own lag and kept within its limits.

    Its boresight is azimuth and elevation 0.
    """

    name = "a rotator"
    takes = DeviceInput.POINTING
    safe_states = (SafeState.HOLD, SafeState.BORESIGHT)  # a rotator does not radiate

    def __init__(self, host: str, port: int, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._address = host, port
        self._now_ns = now_ns
        self._lag = MountLag()
        self._socket: socket.socket | None = None
        self._limits_deg = (0.0, 360.0, 0.0, 90.0)
        self._last_deg = 0.0
        self._unread = b""

    @property
    def lead_s(self) -> float:
        """Lag estimated from the rotator's reports; 0 before it has moved."""
        return self._lag.lag_s

    def open(self) -> None:
        """Connect to rotctld, and read the rotator's limits."""
        try:
            self._socket = socket.create_connection(self._address, TIMEOUT_S)
        except OSError as error:
            host, port = self._address
            raise DeviceError(f"rotctld at {host}:{port}: {error.strerror or error}") from error
        self._unread = b""
        text = self._ask("+\\dump_caps")
        found = [re.search(rf"{name}:\s*{_NUMBER}", text) for name in _LIMITS]
        if all(found):
            low, high, least, most = (float(one[1]) for one in found if one)
            if low < high and least < most:
                self._limits_deg = low, high, least, most
        self._last_deg = self._where_deg()[0]

    def apply(self, command: DeviceCommand) -> None:
        """Read the rotator's direction, and point the rotator.

        The direction is read first: a rotator that restarts its motion at each command has then had
        the whole interval.
        """
        seen_deg = self._where_deg()[0]
        self._lag.note_report(self._now_ns(), math.radians(seen_deg))
        azimuth_deg = self._near(math.degrees(command.bearing_rad))
        self._point(azimuth_deg, math.degrees(command.above_rad))
        self._lag.note_command(self._now_ns(), math.radians(azimuth_deg))

    def rest(self, safe: SafeState) -> None:
        """Stop the rotator, or point it to boresight."""
        if safe is SafeState.HOLD:
            self._ask("+S")
        else:
            self._point(0.0, 0.0)

    def close(self) -> None:
        """Disconnect from rotctld."""
        if self._socket:
            self._socket.close()
            self._socket = None

    def _near(self, azimuth_deg: float) -> float:
        """Return the same azimuth within the limits; of two, the one by the shorter rotation."""
        low, high, _, _ = self._limits_deg
        turns = [azimuth_deg + 360.0 * n for n in (-2, -1, 0, 1, 2)]
        within = [one for one in turns if low <= one <= high]
        near = min(within or [low, high], key=lambda one: abs(one - self._last_deg))
        self._last_deg = near
        return near

    def _point(self, azimuth_deg: float, elevation_deg: float) -> None:
        _, _, low, high = self._limits_deg
        self._ask(f"+P {azimuth_deg:.3f} {min(max(elevation_deg, low), high):.3f}")

    def _where_deg(self) -> tuple[float, float]:
        text = self._ask("+p")
        found = re.search(rf"Azimuth:\s*{_NUMBER}\s+Elevation:\s*{_NUMBER}", text)
        if found is None:
            raise DeviceError(f"rotctld reports no direction: {shown(text)}")
        return float(found[1]), float(found[2])

    def _ask(self, command: str) -> str:
        """Return rotctld's answer to a command in the extended form, which ends with RPRT."""
        if self._socket is None:
            raise DeviceError("not connected")
        ends_s = time.monotonic() + TIMEOUT_S
        try:
            self._check_silent(self._socket)
            self._socket.settimeout(TIMEOUT_S)
            self._socket.sendall(command.encode() + b"\n")
            while not (found := re.search(rb"RPRT (-?\d{1,6})\n", self._unread)):
                left_s = ends_s - time.monotonic()
                if left_s <= 0 or len(self._unread) > ANSWER_MAX_BYTES:
                    raise DeviceError(f"rotctld does not end its answer to {command!r}")
                self._socket.settimeout(left_s)
                more = self._socket.recv(4096)
                if not more:
                    raise DeviceError("rotctld closed the connection")
                self._unread += more
        except OSError as error:
            raise DeviceError(f"rotctld: {error}") from error
        text, self._unread = self._unread[: found.end()], self._unread[found.end() :]
        if found[1] != b"0":
            raise DeviceError(f"rotctld rejects {command!r}: error {found[1].decode()}")
        return text.decode(errors="replace")

    def _check_silent(self, connection: socket.socket) -> None:
        """Raise ``DeviceError`` if an answer waits that belongs to no command.

        It would be taken for the answer to the next one.
        """
        connection.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            more = connection.recv(4096)
            if not more:
                raise DeviceError("rotctld closed the connection")
            self._unread += more
        if self._unread:
            raise DeviceError(f"rotctld sent an answer to no command: {shown(self._unread)}")


_LIMITS: Final = ("Min Azimuth", "Max Azimuth", "Min Elevation", "Max Elevation")
