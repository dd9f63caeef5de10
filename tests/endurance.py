"""Faults for endurance tests: senders that lie, floods of connections, a clock that steps.

Each attack is a function that runs until an event is set, as in ``attacks``.
"""

import asyncio
import contextlib
import itertools
import mmap
import random
import socket
import struct
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from attacks import Attack
from load_sender import GLOBAL_POSITION_INT, frame
from siege_flight import LAT0, LON0, UAVS, boot_ms, degrees, place, report, velocity
from support import HANG_S, Node, run_async

from companion.mavlink.links.zenoh_bus import Bus
from companion.mavlink.links.zenoh_config import BusConfig
from companion.mavlink.wire.mode_s import parity
from companion.mavlink.wire.transponder import ADSB_VEHICLE
from companion.node.fleet import messages
from companion.values import Offer, Shared, SharedFrame, Standing

KEY: Final = bytes(range(32))


# --- a wall clock that steps ----------------------------------------------------------------------

STEPPED: Final = """
import mmap, struct, sys, time
from companion.mavlink.links import kernel_time
file = open(sys.argv.pop(1), "r+b")
step = mmap.mmap(file.fileno(), 8)
wall_ns, wall_s, stamp_in = time.time_ns, time.time, kernel_time.stamp_in
offset_ns = lambda: struct.unpack("<q", step[:8])[0]
time.time_ns = lambda: wall_ns() + offset_ns()
time.time = lambda: wall_s() + offset_ns() * 1e-9
def stamped(control):
    found = stamp_in(control)
    return None if found is None else found + offset_ns()
kernel_time.stamp_in = stamped
from companion.cli.main import main
main()
"""
"""A service whose wall clock, with the stamps of datagrams, is ahead by the number in a file."""


class Steps:
    """The file of ``STEPPED``: sets how far the wall clock of a service is ahead."""

    def __init__(self, path: Path) -> None:
        path.write_bytes(bytes(8))
        with path.open("r+b") as file:
            self._number = mmap.mmap(file.fileno(), 8)

    def set_s(self, ahead_s: float) -> None:
        """Step the clock."""
        self._number[:8] = struct.pack("<q", round(ahead_s * 1e9))

    def close(self) -> None:
        """Release the file."""
        self._number.close()


# --- MAVLink --------------------------------------------------------------------------------------


def relayed(icao: int, sysid: int, at_s: float, number: int, off_m: float = 0.0) -> bytes:
    """ADSB_VEHICLE of an aircraft that flies as an honest UAV does, from a receiver 200:156."""
    north_m, east_m, alt_m = place(sysid, at_s)
    lat, lon = degrees(north_m + off_m, east_m)
    vn, ve = velocity(sysid, at_s)
    speed = (vn**2 + ve**2) ** 0.5
    payload = struct.pack(
        "<IiiiHHhHHB9sBB", icao, round(lat * 1e7), round(lon * 1e7), round(alt_m * 1e3),
        0, round(speed * 100), 0, 0xF, 7000, 1, b"GHOST", 14, 1,
    )  # fmt: skip
    return frame((200, 156), number % 256, ADSB_VEHICLE, payload)


def twins(per_s: float, icaos: int) -> Attack:
    """Relayed aircraft around the honest UAVs, each of ``icaos`` addresses in turn."""

    def attack(node: Node, until: threading.Event) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.connect(("127.0.0.1", node.udp_port))
            begun_s, sent = time.monotonic(), 0
            while not until.is_set():
                while sent < per_s * (time.monotonic() - begun_s):
                    icao, sysid = 1 + sent % icaos, UAVS[sent % len(UAVS)]
                    one.send(relayed(icao, sysid, time.time(), sent, off_m=sent % 7 - 3.0))
                    sent += 1
                until.wait(0.002)

    return attack


def datagrams(scheme: str, blob: bytes, per_s: float) -> Attack:
    """One datagram, again and again, to the service's link with that scheme."""

    def attack(node: Node, until: threading.Event) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.connect(("127.0.0.1", port_of(node, scheme)))
            while not until.wait(1.0 / per_s):
                one.send(blob)

    return attack


# --- TCP links ------------------------------------------------------------------------------------


def port_of(node: Node, scheme: str) -> int:
    """The port of the service's link with that scheme."""
    links = node.json("/v1/links")["links"]
    (url,) = [one["url"] for one in links if one["url"].startswith(scheme + ":")]
    return int(url.rpartition(":")[2])


def tcp_connections(count: int, blob: Callable[[random.Random], bytes]) -> Attack:
    """Connections to ``tcpin`` that send ``blob`` as fast as it is read; a closed one is replaced.

    ``blob`` is called for every connection.
    """

    def attack(node: Node, until: threading.Event) -> None:
        port, rng = port_of(node, "tcpin"), random.Random(5)
        made: dict[int, tuple[socket.socket, bytes]] = {}
        while not until.wait(0.001):
            for number in range(count):
                try:
                    if number not in made:
                        one = socket.create_connection(("127.0.0.1", port), timeout=HANG_S)
                        one.setblocking(False)
                        made[number] = one, blob(rng)
                    made[number][0].send(made[number][1])
                except BlockingIOError:
                    pass
                except OSError:
                    if number in made:
                        made.pop(number)[0].close()
        for one, _ in made.values():
            one.close()

    return attack


def valid_frames(_: random.Random) -> bytes:
    """RAW_IMU of a stranger, 64 kB of them."""
    return b"".join(frame((200, 1), n % 256, 27, bytes(25) + b"\1") for n in range(1700))


def garbage(rng: random.Random) -> bytes:
    """Random bytes, a quarter of them the first byte of a frame."""
    return bytes(
        rng.choice((0xFD, 0xFE, rng.randrange(256), rng.randrange(256))) for _ in range(65536)
    )


def half_frames(rng: random.Random) -> bytes:
    """Frames in the honest UAVs' names, each cut somewhere, so that the next begins within it."""
    at_s = time.time()
    parts = []
    for number in range(1000):
        sysid = UAVS[number % len(UAVS)]
        raw = frame(
            (sysid, 1), number % 256, GLOBAL_POSITION_INT,
            report(sysid, boot_ms(at_s, sysid), at_s, 50.0),
        )  # fmt: skip
        parts.append(raw[: rng.randrange(1, len(raw))])
    return b"".join(parts)


# --- servers of receivers -------------------------------------------------------------------------


def sbs_lies(rng: random.Random, now_s: float) -> bytes:
    """One line of an aircraft that does not exist, at an impossible place, time or speed."""
    day = time.strftime(
        "%Y/%m/%d,%H:%M:%S", time.gmtime(now_s + rng.choice((0, -300, 86_400, 1e8)))
    )
    lat, lon = rng.choice(
        ((LAT0 + rng.gauss(0, 0.01), LON0 + rng.gauss(0, 0.01)), (90.0, 180.0), (-90.0, -180.0),
         (0.0, 0.0), (123.0, 999.0), (rng.uniform(-90, 90), rng.uniform(-180, 180)))
    )  # fmt: skip
    fields = [
        "MSG", str(rng.choice((1, 3, 4))), "1", "1", f"{rng.randrange(1 << 24):06X}", "1",
        f"{day}.000", f"{day}.000", rng.choice(("", "GHOST", "\x1b[2J")),
        str(rng.choice((1800, -99_999, 199_000))), str(rng.choice((0, 600, 99_999))),
        str(rng.uniform(-10, 370)), f"{lat:.5f}", f"{lon:.5f}", "0", "0", "0", "0", "0", "0",
    ]  # fmt: skip
    return ",".join(fields).encode() + b"\r\n"


def beast_lies(rng: random.Random, _: float) -> bytes:
    """Both halves of a position of an aircraft that does not exist; the counter is random."""
    out = b""
    icao = rng.randrange(1 << 24).to_bytes(3, "big")
    for odd in (0, 1):
        bits = 11 << 51 | rng.randrange(1 << 12) << 36 | odd << 34 | rng.getrandbits(34)
        body = b"\x8d" + icao + bits.to_bytes(7, "big")
        message = body + parity(body + bytes(3)).to_bytes(3, "big")
        data = rng.randbytes(6) + b"\x80" + message
        out += b"\x1a3" + data.replace(b"\x1a", b"\x1a\x1a")
    return out


class LyingServer:
    """A receiver's server that lies ``per_s`` times a second; each hundredth lie is cut short."""

    def __init__(self, lie: Callable[[random.Random, float], bytes], per_s: float) -> None:
        rng, now_s = random.Random(8), time.time()
        self._lies = [lie(rng, now_s) for _ in range(20_000)]
        self._per_s = per_s
        self._listener = socket.create_server(("127.0.0.1", 0))
        weakref.finalize(self, self._listener.close)  # the attack runs in another process
        self.port = int(self._listener.getsockname()[1])

    def attack(self, _: Node, until: threading.Event) -> None:
        """Serve one connection until the event is set."""
        self._listener.settimeout(HANG_S)
        with self._listener:
            peer, _ = self._listener.accept()
            with peer, contextlib.suppress(OSError):
                begun_s, sent = time.monotonic(), 0
                while not until.is_set():
                    while sent < self._per_s * (time.monotonic() - begun_s):
                        lie = self._lies[sent % len(self._lies)]
                        sent += 1
                        peer.sendall(lie if sent % 100 else lie[:1])
                    until.wait(0.002)


# --- a node of a fleet that lies ------------------------------------------------------------------


class Liar:
    """A node that speaks the fleet's protocol. ``lie`` chooses what it is false about."""

    def __init__(self, port: int, lie: str, off_m: float = 80.0) -> None:
        self._port, self._lie, self._off_m = port, lie, off_m
        self._names = [f"{sysid}:1" for sysid in UAVS]

    def attack(self, _: Node, until: threading.Event) -> None:
        """Publish lies until the event is set."""
        run_async(self._publish(until))

    async def _publish(self, until: threading.Event) -> None:
        connect = (f"tcp/127.0.0.1:{self._port}",)
        bus = Bus(BusConfig(listen=(), connect=connect), asyncio.get_running_loop())
        await asyncio.to_thread(bus.open)
        started = time.time_ns()
        try:
            bus.serve("companion/site/liar/time", lambda *_: _clock(started))
            bus.alive("companion/site/liar/alive")
            for number in itertools.count():
                if until.is_set():
                    return
                if self._lie == "positions":
                    bus.put("companion/site/liar/heard", messages.shared(self._frames(number)))
                bus.put("companion/site/liar/offers", messages.offers(self._offers()))
                bus.put("companion/site/liar/standing", messages.standing(self._standing()))
                await asyncio.sleep(0.1)
        finally:
            await asyncio.to_thread(bus.close)

    def _frames(self, number: int) -> Shared:
        at_s, frames = time.time(), list[SharedFrame]()
        for sysid in UAVS:
            payload = report(sysid, boot_ms(at_s, sysid), at_s, self._off_m)
            raw = frame((sysid, 1), number % 256, GLOBAL_POSITION_INT, payload)
            frames.append(SharedFrame(time.time_ns(), raw))
        return Shared(time.time_ns(), tuple(frames))

    def _offers(self) -> dict[str, Offer]:
        gain_db = {"gains": 290.0}.get(self._lie, -100.0)
        return {
            uav: Offer(uav=uav, sure_db=gain_db, likely_db=gain_db, sinr_db=gain_db, heard_s=0.1)
            for uav in self._names
        }

    def _standing(self) -> Standing:
        serves = tuple((uav, 290.0) for uav in self._names) if self._lie == "duties" else ()
        return Standing(
            node="liar", place=(LAT0, LON0, 550.0), reach_m=None, most=1000, serves=serves
        )


def _clock(started_ns: int) -> bytes:
    return started_ns.to_bytes(8, "little") + time.time_ns().to_bytes(8, "little")


@contextlib.contextmanager
def running(attack: Attack, node: Node) -> Iterator[None]:
    """Run an attack on a thread while the block runs."""
    until = threading.Event()
    thread = threading.Thread(target=attack, args=(node, until), daemon=True)
    thread.start()
    try:
        yield
    finally:
        until.set()
        thread.join(HANG_S)


def both(*given: Attack) -> Attack:
    """Attacks at the same time."""

    def attack(node: Node, until: threading.Event) -> None:
        with contextlib.ExitStack() as stack:
            for one in given:
                stack.enter_context(running(one, node))
            until.wait()

    return attack
