"""UDP for a link: one socket that serves all senders, or one that is connected.          [shell]"""

import asyncio
import contextlib
import errno
import socket
import struct
import sys
from collections.abc import Collection, Hashable
from typing import Final, cast

from companion.mavlink.endpoints import Address, Upcalls, bound, resolved, settle
from companion.mavlink.link_status import LinkStatus
from companion.mavlink.urls import LinkUrl

RECEIVE_BUFFER_BYTES: Final = 4 << 20
"""Stock socket buffers lose frames from about 20 000 a second on (measured)."""
OVERFLOW_CHECK_S: Final = 1.0
OVERFLOW_CHECK_DATAGRAMS: Final = 1024

_SO_MEMINFO: Final = 55  # Linux, include/uapi/asm-generic/socket.h
_SK_MEMINFO_BYTES: Final = 36  # nine 32-bit numbers, include/uapi/linux/sock_diag.h
_NOT_THIS_SOCKET: Final = (errno.EAGAIN, errno.ENOBUFS, errno.ECONNREFUSED)
"""Errors after which a socket is as good as before: it is full, or nobody listens over there."""


def dropped_by_system(sock: socket.socket) -> int | None:
    """Datagrams that the system has dropped at a socket so far, modulo 2³²: nearly always because
    its buffer was full. None where the system does not say (others than Linux)."""
    if sys.platform != "linux":
        return None
    try:
        numbers = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _SK_MEMINFO_BYTES)
    except OSError:  # Linux before 4.12 has no SO_MEMINFO
        return None
    if len(numbers) < _SK_MEMINFO_BYTES:
        return None
    return cast(int, struct.unpack_from("=I", numbers, _SK_MEMINFO_BYTES - 4)[0])


def _size_buffer(sock: socket.socket, status: LinkStatus) -> None:
    with contextlib.suppress(OSError):  # what is granted is said, be it less
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    status.receive_buffer_bytes = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


class UdpIn:
    """Listens for datagrams. One socket serves all its senders; their addresses are the keys."""

    def __init__(self, url: LinkUrl, status: LinkStatus, upcalls: Upcalls) -> None:
        self._url = url
        self._status = status
        self._upcalls = upcalls
        self._socket: socket.socket | None = None

    def open(self) -> int:
        """Bind; ``OSError`` where the address cannot be had."""
        self._socket = self._bound()
        port = cast(int, self._socket.getsockname()[1])
        self._url = LinkUrl(self._url.scheme, self._url.host, port)
        return port

    async def serve(self) -> None:
        """Read datagrams; no error that a peer can cause ends this."""
        self._socket = self._socket or self._bound()
        try:
            await _Datagrams(self._socket, self._status, self._upcalls, connected=False).serve()
        finally:
            self._socket = None

    def _bound(self) -> socket.socket:
        sock = bound(self._url, socket.SOCK_DGRAM)
        _size_buffer(sock, self._status)
        return sock

    def peers(self) -> None:
        """A socket that listens has no peers but those who were heard lately."""

    def write(self, key: Hashable, raw: bytes) -> bool:
        """A datagram to an address."""
        if self._socket is None:
            return False
        try:
            self._socket.sendto(raw, cast(Address, key))
        except OSError:  # it is full, or there is no way to that peer: the others are as before
            return False
        return True


class UdpOut:
    """Sends datagrams to one peer and hears what it answers, nobody else: its socket is connected.

    That nobody listens over there (ICMP) is no error: the peer may come yet. After an error of
    this end, such as a network that is gone, the socket is made anew: it would keep the address
    that it had.
    """

    def __init__(self, url: LinkUrl, status: LinkStatus, upcalls: Upcalls) -> None:
        self._url = url
        self._status = status
        self._upcalls = upcalls
        self._datagrams: _Datagrams | None = None

    def open(self) -> None:
        """Nothing can be known yet."""

    async def serve(self) -> None:
        """Read what the peer sends. ``OSError`` where its name is not found or no way leads
        there."""
        while True:
            family, address = (await resolved(self._url, socket.SOCK_DGRAM))[0]
            sock = socket.socket(family, socket.SOCK_DGRAM)
            try:
                _size_buffer(sock, self._status)
                sock.setblocking(False)
                sock.connect(address)
            except OSError:
                sock.close()
                raise
            self._datagrams = _Datagrams(sock, self._status, self._upcalls, connected=True)
            try:
                await self._datagrams.serve()
            finally:
                self._datagrams = None

    def peers(self) -> Collection[Hashable]:
        """The one, while there is a socket."""
        return () if self._datagrams is None else (None,)

    def write(self, key: Hashable, raw: bytes) -> bool:
        """A datagram to the one peer; its key is None."""
        return self._datagrams is not None and self._datagrams.send(raw)


class _Datagrams(asyncio.DatagramProtocol):
    """A UDP socket at work: it is read by the loop, and written to directly, for a transport
    would keep what the system does not take."""

    def __init__(
        self, sock: socket.socket, status: LinkStatus, upcalls: Upcalls, *, connected: bool
    ) -> None:
        self._socket = sock
        self._status = status
        self._upcalls = upcalls
        self._connected = connected
        self._unfit = False
        self._lost: asyncio.Future[Exception] = asyncio.get_running_loop().create_future()
        self._dropped = 0
        self._unchecked = 0

    async def serve(self) -> None:
        """Read until the socket is to be made anew; raises what the transport broke by."""
        loop = asyncio.get_running_loop()
        transport, _ = await loop.create_datagram_endpoint(lambda: self, sock=self._socket)
        self._upcalls.up()
        try:
            while not self._unfit:
                if (await asyncio.wait((self._lost,), timeout=OVERFLOW_CHECK_S))[0]:
                    raise self._lost.result()
                self._count_dropped()
        finally:
            transport.abort()

    def send(self, raw: bytes) -> bool:
        """To the peer of a connected socket."""
        for _ in range(2):
            try:
                self._socket.send(raw)
            except ConnectionRefusedError:  # the answer to a datagram before; this one stayed here
                continue
            except OSError as error:
                self.error_received(error)
                return False
            return True
        return False

    def datagram_received(self, data: bytes, addr: Address) -> None:
        try:
            self._upcalls.take(None if self._connected else addr, data)
        except Exception as fault:  # the loops differ in what they do with it: so it is done here
            self.connection_lost(fault)
        self._unchecked += 1
        if self._unchecked >= OVERFLOW_CHECK_DATAGRAMS:
            self._count_dropped()

    def error_received(self, exc: Exception) -> None:
        # A socket that listens is not bound to a way: it stays as it is, whatever comes.
        if isinstance(exc, OSError) and exc.errno not in _NOT_THIS_SOCKET and self._connected:
            self._unfit = True

    def connection_lost(self, exc: Exception | None) -> None:
        settle(self._lost, exc or ConnectionError("the socket was closed"))

    def _count_dropped(self) -> None:
        self._unchecked = 0
        dropped = dropped_by_system(self._socket)
        if dropped is None:
            return
        more = (dropped - self._dropped) & 0xFFFF_FFFF
        self._dropped = dropped
        self._status.overflowed = (self._status.overflowed or 0) + more
        if more:
            self._upcalls.overflow(more)
