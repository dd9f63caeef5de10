"""A serial port as an endpoint: pyserial sets it up, then asyncio watches its descriptor."""

import asyncio
import contextlib
import os
from typing import Final

from serial import Serial

from companion.mavlink.urls import LinkError, LinkUrl
from sitl_replay.endpoints import LINGER_S, FlowControl, Receive

SERIAL_BUFFER_BYTES: Final = 4096
"""Kept for the port beyond what the system takes: at its speed more would be stale."""
_READ_BYTES: Final = 1 << 16


class SerialPeer(FlowControl):
    """A serial port, ours alone. Unplugged, it is lost."""

    def __init__(self, url: LinkUrl, receive: Receive, port: Serial) -> None:
        super().__init__(url, receive)
        self._port = port
        self._loop = asyncio.get_running_loop()
        self._unsent = bytearray()
        self._loop.add_reader(port.fileno(), self._read)

    def send(self, raw: bytes) -> None:
        if self.has_room():
            self._unsent += raw
            self._write()

    async def close(self) -> None:
        """Send what is buffered, within a second, and close."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LINGER_S):
                while self._unsent and not self.lost:
                    self.pause_writing()
                    await self.writable()
        if not self.lost:
            self._hang_up(None)

    def _read(self) -> None:
        try:
            data = os.read(self._port.fileno(), _READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            self._hang_up(error)
            return
        if data:
            self._receive(self, data)
        else:
            self._hang_up(OSError("the device is gone"))

    def _write(self) -> None:
        """Write what the system takes, and come again for the rest when it takes more."""
        try:
            del self._unsent[: os.write(self._port.fileno(), self._unsent)]
        except BlockingIOError:
            pass
        except OSError as error:
            self._hang_up(error)
            return
        if len(self._unsent) >= SERIAL_BUFFER_BYTES:
            self.pause_writing()
        if self._unsent:
            self._loop.add_writer(self._port.fileno(), self._write)
        else:
            self._loop.remove_writer(self._port.fileno())
            self.resume_writing()

    def _hang_up(self, error: OSError | None) -> None:
        self._loop.remove_reader(self._port.fileno())
        self._loop.remove_writer(self._port.fileno())
        self._port.close()
        self.connection_lost(error)


def open_port(url: LinkUrl, receive: Receive) -> SerialPeer:
    """Open a serial link. ``OSError`` or ``LinkError`` where that is not possible."""
    try:
        port = Serial(url.host, url.port, timeout=0, exclusive=True)
    except ValueError as error:
        raise LinkError(f"{url}: {error}") from error
    return SerialPeer(url, receive, port)
