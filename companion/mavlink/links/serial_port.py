"""Serial port of a link, by pyserial and the event loop's own readers."""

import asyncio
import contextlib
import errno
import fcntl
import os
import struct
import termios
from collections.abc import Collection, Hashable
from typing import Any, Final, cast

from companion.mavlink.links.endpoints import Upcalls, settle
from companion.mavlink.links.stale_bytes import StaleBytes
from companion.mavlink.links.urls import LinkUrl

WRITE_BUFFER_BYTES: Final = 4096
"""Bytes buffered beyond the system's own buffer: 0.7 s at 57 600 baud.

A larger buffer would deliver outdated frames.
"""
_READ_BYTES: Final = 1 << 16


class SerialPort:
    """Serial device, opened exclusively. It may be unplugged at any time."""

    def __init__(self, url: LinkUrl, upcalls: Upcalls) -> None:
        self._url = url
        self._upcalls = upcalls
        self._descriptor: int | None = None
        self._lost: asyncio.Future[Exception] | None = None
        self._held_up: StaleBytes | None = None
        self._unsent = bytearray()

    def open(self) -> None:
        """Do nothing: the device may be plugged in later."""

    async def serve(self) -> None:
        """Open the device and serve it until it is disconnected."""
        loop = asyncio.get_running_loop()
        port = _opened(self._url.host, self._url.port)
        self._descriptor = descriptor = port.fileno()
        self._lost = loop.create_future()
        self._unsent.clear()
        self._held_up = StaleBytes(descriptor)
        self._held_up.watch()
        loop.add_reader(descriptor, self._read, descriptor)
        self._upcalls.up()
        try:
            raise await self._lost
        finally:
            self._descriptor = None
            self._held_up.close()
            loop.remove_reader(descriptor)
            loop.remove_writer(descriptor)
            _close(port)
            self._upcalls.on_peer_gone(None)

    def peers(self) -> Collection[Hashable]:
        """Return the one peer, None, while the device is open."""
        return () if self._descriptor is None else (None,)

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Write a frame to the port, or to the buffer while it has room; ``key`` is None."""
        descriptor = self._descriptor
        if descriptor is None or len(self._unsent) + len(raw) > WRITE_BUFFER_BYTES:
            return False
        self._unsent += raw
        if len(self._unsent) == len(raw):
            self._write_on(descriptor)
        return True

    def fullness(self, key: Hashable) -> float:
        """Return the filled share of the send buffer, including the system's."""
        if self._descriptor is None:
            return 0.0
        waiting = len(self._unsent) + _waiting(self._descriptor)
        return min(1.0, waiting / WRITE_BUFFER_BYTES)

    def _read(self, descriptor: int) -> None:
        try:
            data = os.read(descriptor, _READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(error)
            return
        if not data:
            self._lose(OSError(errno.ENODEV, os.strerror(errno.ENODEV)))
            return
        assert self._held_up is not None
        self._process(descriptor, data, self._held_up.stale(data))

    def _process(self, descriptor: int, data: bytes, stale: int = 0) -> None:
        """Process what was read, or more of it; read on when all of it is processed.

        stale  bytes at its beginning that waited too long to be used
        """
        if descriptor != self._descriptor:
            return
        loop = asyncio.get_running_loop()
        try:
            if stale:
                self._upcalls.stale(None, data[:stale])
            is_used = not data or len(data) > stale
            has_more = is_used and self._upcalls.take(None, data[stale:], None)
        except Exception as fault:  # a defect must end the link, not disappear
            self._lose(fault)
            return
        if has_more:
            loop.remove_reader(descriptor)
            loop.call_soon(self._process, descriptor, b"")
        elif not data:
            loop.add_reader(descriptor, self._read, descriptor)

    def _write_on(self, descriptor: int) -> None:
        try:
            del self._unsent[: os.write(descriptor, self._unsent)]
        except (BlockingIOError, InterruptedError):
            pass
        except OSError as error:
            self._lose(error)
            return
        loop = asyncio.get_running_loop()
        if self._unsent:
            loop.add_writer(descriptor, self._write_on, descriptor)
        else:
            loop.remove_writer(descriptor)

    def _lose(self, why: Exception) -> None:
        assert self._lost is not None
        settle(self._lost, why)


def _opened(device: str, baud: int) -> Any:
    """Open the serial port: raw, 8N1, exclusive, non-blocking.

    Raises ``OSError`` if it is not available.
    """
    import serial  # only where there is a serial link

    try:
        port = serial.Serial(device, baud, exclusive=True, timeout=0)
    except serial.SerialException as error:
        if error.errno == errno.EAGAIN:  # locked by another process
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY)) from error
        raise
    except (ValueError, termios.error) as error:
        raise OSError(f"{baud} baud is not possible: {error}") from error
    # pyserial sets VMIN 0: an empty read then means either no data or an unplugged device.
    # With VMIN 1, no data gives EAGAIN, and only an unplugged device an empty read.
    settings = termios.tcgetattr(port.fileno())
    settings[6][termios.VMIN] = 1
    termios.tcsetattr(port.fileno(), termios.TCSANOW, settings)
    return port


def _waiting(descriptor: int) -> int:
    """Return the bytes in the system's send buffer; 0 if the device is disconnected."""
    try:
        return cast(int, struct.unpack("i", fcntl.ioctl(descriptor, termios.TIOCOUTQ, bytes(4)))[0])
    except OSError:
        return 0


def _close(port: Any) -> None:
    """Close the serial port without waiting (up to half a minute) for unsent bytes."""
    if _waiting(port.fileno()):
        with contextlib.suppress(termios.error):  # the device is gone, with its unsent bytes
            termios.tcflush(port.fileno(), termios.TCOFLUSH)
    port.close()
