"""Attacks on a service from outside, each a function that runs until an event is set.

They know what a stranger can know: the ports, the ids and where the UAVs are.
"""

import contextlib
import itertools
import math
import random
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from load_sender import ATTITUDE, GLOBAL_POSITION_INT, frame
from siege import tcp
from siege_flight import CARRIER, UAVS, YAW_RAD, boot_ms, place, report
from support import Node

Attack = Callable[[Node, threading.Event], None]

PING = b"\x89\x80\0\0\0\0"
MANY = 5000  # requests or pings sent at once


def _get(path: str, *headers: str) -> bytes:
    lines = [f"GET {path} HTTP/1.1", "Host: 127.0.0.1", *headers]
    return "\r\n".join([*lines, "", ""]).encode()


UPGRADE = _get(
    "/v1/stream?topic=uavs&topic=beams&topic=status&rate_hz=10", "Connection: Upgrade",
    "Upgrade: websocket", "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
)  # fmt: skip


# --- HTTP -----------------------------------------------------------------------------------------


class _Flood:
    """Connections that send as fast as they are read; a closed one is opened again."""

    def __init__(self, node: Node, count: int, first: bytes, then: bytes, reads: bool) -> None:
        self._node, self._first, self._then, self._reads = node, first, then, reads
        self._open: list[socket.socket | None] = [None] * count

    def run(self, until: threading.Event) -> None:
        while not until.is_set():
            if sum(self._step(index) for index in range(len(self._open))) == 0:
                until.wait(0.005)
        for one in self._open:
            if one is not None:
                one.close()

    def _step(self, index: int) -> bool:
        one = self._open[index]
        try:
            if one is None:
                one = self._open[index] = tcp(self._node)
                one.send(self._first)
                one.setblocking(False)
            if self._reads:
                with contextlib.suppress(BlockingIOError):
                    one.recv(1 << 20)
            return bool(self._then) and one.send(self._then) > 0
        except BlockingIOError:
            return False
        except OSError:
            if one is not None:
                one.close()
            self._open[index] = None
            return True


def pipelined(connections: int, path: str = "/v1/uavs", reads: bool = True) -> Attack:
    """Requests that do not wait for answers."""
    flood = _get(path) * MANY

    def attack(node: Node, until: threading.Event) -> None:
        _Flood(node, connections, b"", flood, reads).run(until)

    return attack


def pings(connections: int) -> Attack:
    """Floods of WebSocket pings."""

    def attack(node: Node, until: threading.Event) -> None:
        _Flood(node, connections, UPGRADE, PING * MANY, True).run(until)

    return attack


def unread_streams(count: int) -> Attack:
    """WebSockets that read nothing."""

    def attack(node: Node, until: threading.Event) -> None:
        _Flood(node, count, UPGRADE, b"", False).run(until)

    return attack


def requests(threads: int, path: str = "/v1/uavs") -> Attack:
    """A new connection for each request."""

    def attack(node: Node, until: threading.Event) -> None:
        def one() -> None:
            while not until.is_set():
                with contextlib.suppress(OSError), tcp(node) as made:
                    made.send(_get(path))
                    made.recv(1 << 16)

        running = [threading.Thread(target=one, daemon=True) for _ in range(threads)]
        for thread in running:
            thread.start()
        for thread in running:
            thread.join()

    return attack


def distinct_requests(threads: int) -> Attack:
    """Requests whose answers nobody shares, each over a new connection."""
    paths = (
        "/v1/beams?lead_ms={:.3f}", "/v1/pattern?points=1801&cut_deg={:.3f}",
        "/v1/beams/weights?lead_ms={:.3f}", "/v1/uavs",
    )  # fmt: skip

    def attack(node: Node, until: threading.Event) -> None:
        def one(number: int) -> None:
            rng = random.Random(number)
            while not until.is_set():
                with contextlib.suppress(OSError), tcp(node) as made:
                    made.send(_get(rng.choice(paths).format(rng.uniform(0.0, 90.0))))
                    made.recv(1 << 16)

        running = [threading.Thread(target=one, args=(n,), daemon=True) for n in range(threads)]
        for thread in running:
            thread.start()
        for thread in running:
            thread.join()

    return attack


def handshakes(per_s: float) -> Attack:
    """New WebSockets, each closed by its client a moment later."""

    def attack(node: Node, until: threading.Event) -> None:
        begun_s, made = time.monotonic(), 0
        opened = deque[socket.socket]()
        while not until.wait(0.002):
            while made < per_s * (time.monotonic() - begun_s):
                made += 1
                with contextlib.suppress(OSError):
                    opened.append(tcp(node))
                    opened[-1].send(UPGRADE)
            while len(opened) > per_s / 10:
                opened.popleft().close()
        for one in opened:
            one.close()

    return attack


# --- MAVLink --------------------------------------------------------------------------------------


@contextlib.contextmanager
def _sockets(node: Node) -> Iterator[Callable[[], socket.socket]]:
    """Yield a function that opens sockets, each with a port of its own; the newest 200 stay."""
    made: list[socket.socket] = []

    def another() -> socket.socket:
        one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        one.connect(("127.0.0.1", node.udp_port))
        made.append(one)
        if len(made) > 200:
            made.pop(0).close()
        return one

    try:
        yield another
    finally:
        for one in made:
            one.close()


def forged_carrier(every_s: float, off_m: float = 50.0, msgid: int = GLOBAL_POSITION_INT) -> Attack:
    """Datagrams in the carrier's name, from another port."""

    def attack(node: Node, until: threading.Event) -> None:
        with _sockets(node) as another:
            one = another()
            for number in itertools.count():
                at_s = time.time()
                boot = boot_ms(at_s, CARRIER)
                payload = report(CARRIER, boot, at_s, off_m)
                if msgid == ATTITUDE:
                    payload = struct.pack("<Iffffff", boot, 0.5, -0.4, -2.0, 0.01, 0.01, 0.01)
                one.send(frame((CARRIER, 1), number % 256, msgid, payload))
                if until.wait(every_s):
                    return

    return attack


def drifting(
    rate_mps: float, hz: float, fresh_ports: bool, ahead_s: float = 0.0, exact_s: float = 0.0
) -> Attack:
    """Positions in the UAVs' names with their clocks, which drift away from the truth.

    ``exact_s`` seconds of true positions come first.
    """

    def attack(node: Node, until: threading.Event) -> None:
        with _sockets(node) as another:
            one, begun_s = another(), time.monotonic()
            for number in itertools.count():
                if fresh_ports:
                    one = another()
                for sysid in UAVS:
                    at_s = time.time()
                    boot = boot_ms(at_s + ahead_s, sysid)
                    off_m = rate_mps * max(0.0, time.monotonic() - begun_s - exact_s)
                    payload = report(sysid, boot, at_s + ahead_s, off_m)
                    one.send(frame((sysid, 1), number % 256, GLOBAL_POSITION_INT, payload))
                if until.wait(1 / hz):
                    return

    return attack


def turning(rate_radps: float, hz: float, ahead_s: float, exact_s: float) -> Attack:
    """Attitudes of the carrier that turn away, after ``exact_s`` seconds of its true position."""

    def attack(node: Node, until: threading.Event) -> None:
        with _sockets(node) as another:
            one, begun_s = another(), time.monotonic()
            for number in itertools.count():
                at_s = time.time()
                boot = boot_ms(at_s + ahead_s, CARRIER)
                turned_rad = rate_radps * (time.monotonic() - begun_s - exact_s)
                if number % 10 == 0:
                    raw = report(CARRIER, boot_ms(at_s, CARRIER), at_s)
                    one.send(frame((CARRIER, 1), number % 256, GLOBAL_POSITION_INT, raw))
                if turned_rad > 0.0:
                    yaw_rad = math.remainder(YAW_RAD + turned_rad, math.tau)
                    raw = struct.pack("<I6f", boot, 0.01, 0.02, yaw_rad, 0.01, 0.01, rate_radps)
                    one.send(frame((CARRIER, 1), number % 256, ATTITUDE, raw))
                if until.wait(1 / hz):
                    return

    return attack


def garbage(per_s: float, raw: bytes) -> Attack:
    """Datagrams that hold no frame."""

    def attack(node: Node, until: threading.Event) -> None:
        with _sockets(node) as another:
            one, begun_s, sent = another(), time.monotonic(), 0
            while not until.wait(0.002):
                while sent < per_s * (time.monotonic() - begun_s):
                    with contextlib.suppress(OSError):
                        one.send(raw)
                    sent += 1

    return attack


def ghosts(per_s: float, ids: int = 250 * 250, ports: int = 1) -> Attack:
    """Positions of UAVs that do not exist, each with another id."""

    def attack(node: Node, until: threading.Event) -> None:
        rng = random.Random(3)
        with _sockets(node) as another:
            senders = [another() for _ in range(ports)]
            begun_s, sent = time.monotonic(), 0
            while not until.is_set():
                while sent < per_s * (time.monotonic() - begun_s):
                    number = rng.randrange(ids)
                    sysid, compid = 10 + number % 240, 1 + number // 240 % 250
                    at_s = time.time()
                    north_m, east_m, _ = place(1, at_s + sysid + compid)
                    payload = report(1, boot_ms(at_s, sysid), at_s, north_m + east_m)
                    raw = frame((sysid, compid), sent % 256, GLOBAL_POSITION_INT, payload)
                    with contextlib.suppress(OSError):
                        senders[sent % ports].send(raw)
                    sent += 1
                until.wait(0.002)

    return attack


def frames(per_s: float, msgid: int = 27, ports: int = 1) -> Attack:
    """Valid frames that nobody asked for, from strangers."""

    def attack(node: Node, until: threading.Event) -> None:
        with _sockets(node) as another:
            senders = [another() for _ in range(ports)]
            raws = [frame((200, 1), number, msgid, bytes(25) + b"\1") for number in range(256)]
            begun_s, sent = time.monotonic(), 0
            while not until.is_set():
                while sent < per_s * (time.monotonic() - begun_s):
                    with contextlib.suppress(OSError):
                        senders[sent % ports].send(raws[sent % 256])
                    sent += 1
                until.wait(0.002)

    return attack


def tcp_flood() -> Attack:
    """Frames as fast as they are read, over ten connections of a TCP link."""

    def attack(node: Node, until: threading.Event) -> None:
        (link,) = [
            one for one in node.json("/v1/links")["links"] if one["url"].startswith("tcpin:")
        ]
        port = int(link["url"].rpartition(":")[2])
        raws = [frame((200, 1), number % 256, 27, bytes(25) + b"\1") for number in range(4096)]
        blob = b"".join(raws)
        with contextlib.ExitStack() as stack:
            made = [
                stack.enter_context(socket.create_connection(("127.0.0.1", port)))
                for _ in range(10)
            ]
            for one in made:
                one.setblocking(False)
            while not until.is_set():
                for one in made:
                    with contextlib.suppress(BlockingIOError):
                        one.send(blob)
                until.wait(0.001)

    return attack
