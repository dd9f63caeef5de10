"""UDP endpoints of a link: one socket that serves all senders, or a connected one.

Over 300 lines: both are read alike, and the system calls on a socket belong together.
"""

import asyncio
import contextlib
import errno
import select
import socket
import struct
import sys
import time
from collections import OrderedDict, deque
from collections.abc import Collection, Hashable, Iterator
from dataclasses import dataclass, replace
from typing import Final, cast

from companion.mavlink.links import datagrams, kernel_time
from companion.mavlink.links.connecting import HostLookup
from companion.mavlink.links.endpoints import Address, Upcalls, bound, settle
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.links.to_loop import SLICE_S
from companion.mavlink.links.urls import LinkUrl
from companion.mavlink.trust.newcomers import LATE_NS

RECEIVE_BUFFER_BYTES: Final = 4 << 20
"""Requested receive buffer; with default buffers, frames are lost above about 20 000 a second.

Measured: docs/field-notes.md 3.
"""
OVERFLOW_CHECK_S: Final = 1.0  # longest time between two reads of the system's drop counter
OVERFLOW_CHECK_DATAGRAMS: Final = 1024
"""Number of datagrams after which the drop counter is read, even before its period."""
STALE_NS: Final = 2_000_000_000
"""Age at which a datagram is discarded: a busy machine then processes new data, not a backlog."""
READ_AT_ONCE: Final = 32
"""Most datagrams read before other work runs, as in libuv; ``SLICE_S`` limits them too."""
LATE_READ_AT_ONCE: Final = 1024  # the same while datagrams are late
LATE_SHARE: Final = 0.5
"""Time slice while datagrams are late, in proportion to the time that other work took before it.

With ``SLICE_S`` in each iteration of an event loop that other work keeps busy for 50 ms, links
would have 2 % of the time.
"""
LATE_SLICE_MAX_S: Final = 0.005  # longest such time slice
WAITING_PEERS_MAX: Final = 64  # peers whose datagrams wait; with more, nothing is read
WAITING_MAX_BYTES: Final = 1 << 18  # bytes of a peer that wait; datagrams beyond it are dropped

_SO_MEMINFO: Final = 55  # Linux, include/uapi/asm-generic/socket.h
_SK_MEMINFO_BYTES: Final = 36  # nine 32-bit numbers, include/uapi/linux/sock_diag.h
_NOT_THIS_SOCKET: Final = (errno.EAGAIN, errno.ENOBUFS, errno.ECONNREFUSED)
"""Errors that leave a socket usable: it is full, or no program listens at the other end."""


def dropped_by_system(sock: socket.socket) -> int | None:
    """Return the number of datagrams dropped by the system at a socket, modulo 2³².

    The cause is nearly always a full buffer. None if the system does not report it (only Linux
    does).
    """
    if sys.platform != "linux":
        return None
    try:
        numbers = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _SK_MEMINFO_BYTES)
    except OSError:  # Linux before 4.12 has no SO_MEMINFO
        return None
    if len(numbers) < _SK_MEMINFO_BYTES:
        return None
    return cast(int, struct.unpack_from("=I", numbers, _SK_MEMINFO_BYTES - 4)[0])


def _prepare(sock: socket.socket, status: LinkStatus) -> None:
    """Request a large buffer and arrival stamps, and record what the system grants."""
    status.arrival = "kernel" if kernel_time.stamped(sock) else "read"
    with contextlib.suppress(OSError):  # the granted size is reported below
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    status.receive_buffer_bytes = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def _fullness(sock: socket.socket) -> float:
    """Return 1 if the system would not accept a datagram now, else 0; this program buffers none."""
    if sock.fileno() < 0:  # closed by its transport
        return 0.0
    poll = select.poll()
    poll.register(sock, select.POLLOUT)
    return 0.0 if poll.poll(0) else 1.0


@contextlib.contextmanager
def _readiness(sock: socket.socket) -> Iterator[int]:
    """Yield a file descriptor that is readable while a socket is, or has an error.

    uvloop stops watching a socket that has an error, such as an ICMP refusal. An epoll instance on
    that socket has none.
    """
    if not hasattr(select, "epoll"):
        yield sock.fileno()
        return
    with select.epoll() as epoll:
        epoll.register(sock, select.EPOLLIN)
        yield epoll.fileno()


class UdpIn:
    """UDP link that listens. One socket serves all senders, whose addresses are the keys."""

    def __init__(self, url: LinkUrl, status: LinkStatus, upcalls: Upcalls) -> None:
        self._url = url
        self._status = status
        self._upcalls = upcalls
        self._socket: socket.socket | None = None

    def open(self) -> int:
        """Bind; return the port. Raises ``OSError`` if the address is not available."""
        self._socket = self._bound()
        port = cast(int, self._socket.getsockname()[1])
        self._url = replace(self._url, port=port)
        return port

    async def serve(self) -> None:
        """Read datagrams. No error that a peer can cause ends this."""
        self._socket = self._socket or self._bound()
        try:
            await _Datagrams(
                sock=self._socket, status=self._status, upcalls=self._upcalls, connected=False
            ).serve()
        finally:
            self._socket = None

    def _bound(self) -> socket.socket:
        sock = bound(self._url, socket.SOCK_DGRAM)
        _prepare(sock, self._status)
        return sock

    def peers(self) -> None:
        """Return None: a broadcast goes to the peers received recently."""

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send a datagram to an address."""
        if self._socket is None:
            return False
        try:
            self._socket.sendto(raw, cast(Address, key))
        except OSError:  # the buffer is full, or there is no route to that peer
            return False
        return True

    def fullness(self, key: Hashable) -> float:
        """Return 1 if the system would not accept a datagram now, else 0; alike for all peers."""
        return 0.0 if self._socket is None else _fullness(self._socket)


class UdpOut:
    """UDP link with one peer, whose connected socket ignores other senders.

    An ICMP refusal is no error: the peer may start later. After a local error, such as a network
    that is down, the socket is recreated, since the old one would keep its local address.
    """

    def __init__(self, url: LinkUrl, status: LinkStatus, upcalls: Upcalls) -> None:
        self._lookup = HostLookup(url, socket.SOCK_DGRAM)
        self._status = status
        self._upcalls = upcalls
        self._datagrams: _Datagrams | None = None

    def open(self) -> None:
        """Do nothing: ``serve`` opens the socket."""

    async def serve(self) -> None:
        """Read the peer's datagrams.

        Raises ``OSError`` if its name is not found or there is no route.
        """
        while True:
            family, address = (await self._lookup.addresses())[0]
            sock = socket.socket(family, socket.SOCK_DGRAM)
            try:
                _prepare(sock, self._status)
                sock.setblocking(False)
                sock.connect(address)
            except OSError:
                sock.close()
                raise
            self._datagrams = _Datagrams(
                sock=sock, status=self._status, upcalls=self._upcalls, connected=True
            )
            try:
                await self._datagrams.serve()
            finally:
                self._datagrams = None

    def peers(self) -> Collection[Hashable]:
        """Return the one peer, None, while a socket is open."""
        return () if self._datagrams is None else (None,)

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send a datagram to the one peer; ``key`` is None."""
        return self._datagrams is not None and self._datagrams.send(raw)

    def fullness(self, key: Hashable) -> float:
        """Return 1 if the system would not accept a datagram now, else 0."""
        return 0.0 if self._datagrams is None else self._datagrams.fullness()


@dataclass(slots=True)
class _Waiting:
    """Datagrams of a peer that wait, each with its arrival on the monotonic clock, ns.

    Empty bytes stand for the rest of a datagram that the peer's splitter holds.
    """

    datagrams: deque[tuple[bytes, int | None]]
    bytes: int = 0


class _Datagrams:
    """UDP socket, read by the loop's own readers and written to directly.

    An asyncio transport would not deliver arrival stamps, and would buffer what the system rejects.
    """

    def __init__(
        self, *, sock: socket.socket, status: LinkStatus, upcalls: Upcalls, connected: bool
    ) -> None:
        self._socket = sock
        self._next = datagrams.reader(sock)
        self._status = status
        self._upcalls = upcalls
        self._connected = connected
        self._unfit = False
        self._lost: asyncio.Future[Exception] = asyncio.get_running_loop().create_future()
        self._wall_clock = kernel_time.SetWatch()
        self._waiting: OrderedDict[Hashable, _Waiting] = OrderedDict()
        self._continues: asyncio.Handle | None = None
        self._dropped = 0
        self._stale = 0
        self._unchecked = 0
        self._is_late = False  # whether the newest datagram was
        self._ended_s = 0.0  # when reading last ended

    async def serve(self) -> None:
        """Read until the socket must be recreated; raise the exceptions of ``take``."""
        loop = asyncio.get_running_loop()
        try:
            with _readiness(self._socket) as descriptor:
                loop.add_reader(descriptor, self._read)
                try:
                    self._upcalls.up()
                    while not self._unfit:
                        if (await asyncio.wait((self._lost,), timeout=OVERFLOW_CHECK_S))[0]:
                            raise self._lost.result()
                        self._count_dropped()
                finally:
                    loop.remove_reader(descriptor)
        finally:
            self._socket.close()

    def send(self, raw: bytes) -> bool:
        """Send a datagram to the peer of a connected socket."""
        for _ in range(2):
            try:
                self._socket.send(raw)
            except ConnectionRefusedError:  # refers to an earlier datagram; this one was not sent
                continue
            except OSError as error:
                self._note_error(error)
                return False
            return True
        return False

    def fullness(self) -> float:
        """Return 1 if the system would not accept a datagram now, else 0."""
        return _fullness(self._socket)

    def _read(self) -> None:
        most, slice_s = READ_AT_ONCE, SLICE_S
        if self._is_late:
            others_s = time.monotonic() - self._ended_s
            most = LATE_READ_AT_ONCE
            slice_s = max(SLICE_S, min(LATE_SLICE_MAX_S, LATE_SHARE * others_s))
        if len(self._waiting) < WAITING_PEERS_MAX:
            self._read_some(most, slice_s)
        self._ended_s = time.monotonic()

    def _read_some(self, most: int, slice_s: float) -> None:
        was_set = self._wall_clock.was_set()
        until_s = time.thread_time() + slice_s  # waits for the interpreter do not count
        for _ in range(most):
            if time.thread_time() > until_s:
                return
            try:
                data, stamp_ns, address = self._next()
            except (BlockingIOError, InterruptedError):
                self._wall_clock.note()
                self._is_late = False
                return
            except OSError as error:
                self._note_error(error)
                return
            age_ns = self._age_ns(stamp_ns, was_set)
            self._is_late = age_ns is not None and age_ns > LATE_NS
            if age_ns is not None and age_ns > STALE_NS:
                self._stale += 1
                continue
            self._process(None if self._connected else address, data, age_ns)
            if self._lost.done():
                return
            self._unchecked += 1
            if self._unchecked >= OVERFLOW_CHECK_DATAGRAMS:
                self._count_dropped()

    def _process(self, key: Hashable, data: bytes, age_ns: int | None) -> None:
        """Pass a datagram on; it waits behind earlier ones of its peer, with its arrival time."""
        arrived_ns = None if age_ns is None else time.monotonic_ns() - age_ns
        waiting = self._waiting.get(key)
        if waiting is None:
            if self._take(key, data, age_ns):
                self._waiting[key] = _Waiting(deque([(b"", arrived_ns)]))
                self._continue_soon()
        elif waiting.bytes + len(data) > WAITING_MAX_BYTES:
            self._stale += 1
        else:
            waiting.datagrams.append((data, arrived_ns))
            waiting.bytes += len(data)

    def _take(self, key: Hashable, data: bytes, age_ns: int | None) -> bool:
        """Pass bytes on; return whether the datagram has more frames."""
        try:
            return self._upcalls.take(key, data, age_ns)
        except Exception as fault:  # a defect must end the link, not disappear
            settle(self._lost, fault)
            return False

    def _continue_soon(self) -> None:
        if self._continues is None:
            self._continues = asyncio.get_running_loop().call_soon(self._continue)

    def _continue(self) -> None:
        """Process datagrams that wait, of each peer in turn; new ones are read in between."""
        self._continues = None
        if self._socket.fileno() < 0 or self._lost.done():
            return
        until_s = time.monotonic() + SLICE_S
        while self._waiting and time.monotonic() <= until_s:
            key, waiting = self._waiting.popitem(last=False)
            data, arrived_ns = waiting.datagrams.popleft()
            waiting.bytes -= len(data)
            age_ns = None if arrived_ns is None else time.monotonic_ns() - arrived_ns
            if data and age_ns is not None and age_ns > STALE_NS:
                self._stale += 1
            elif self._take(key, data, age_ns):
                waiting.datagrams.appendleft((b"", arrived_ns))
            if waiting.datagrams:
                self._waiting[key] = waiting
        if self._waiting:
            self._continue_soon()

    def _age_ns(self, stamp_ns: int | None, was_set: bool) -> int | None:
        """Return how long a datagram has waited, ns; None without a valid time stamp."""
        if stamp_ns is None:
            self._status.arrival = "read"
            return None
        age_ns = time.time_ns() - stamp_ns
        if was_set or age_ns < 0 or (age_ns > STALE_NS and self._wall_clock.was_set()):
            self._status.misstamped += 1
            return None
        return age_ns

    def _note_error(self, error: OSError) -> None:
        # A listening socket is not bound to a route: no error requires a new one.
        if error.errno not in _NOT_THIS_SOCKET and self._connected:
            self._unfit = True

    def _count_dropped(self) -> None:
        self._unchecked = 0
        dropped = dropped_by_system(self._socket)
        if dropped is None:
            return
        more = (dropped - self._dropped) & 0xFFFF_FFFF
        self._dropped = dropped
        more, self._stale = more + self._stale, 0
        self._status.overflowed = (self._status.overflowed or 0) + more
        if more:
            self._upcalls.overflow(more)
