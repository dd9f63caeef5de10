"""Three nodes of a fleet, each in a network of its own, over a link that delays, loses and parts.

    unshare --net python tests/fleet_apart.py COMPANION FOLDER UAVS DELAY_S LOSS PARTED_S

Each node runs in a network namespace with a TUN device; packets between two of them go through this
process, which delays each, loses some, and for a while parts node a from the others. What comes
from here (reports, questions) is neither delayed nor lost. Prints what was seen, as JSON.
"""

import fcntl
import heapq
import json
import os
import random
import select
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from fleet_sky import LAT_DEG, LON_DEG, FleetSky, off_m

NAMES = ("a", "b", "c")
HERE = "10.9.0.100"
TOKEN = "for-the-test-alone"
STARTED_S = 60.0
SETTLED_S = 60.0
HEALED_S = 30.0
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_SIOCSIFADDR, _SIOCSIFNETMASK, _SIOCSIFFLAGS, _IFF_UP = 0x8916, 0x891C, 0x8914, 1


def address(name: str) -> str:
    return f"10.9.0.{1 + NAMES.index(name)}"


def tun(own: str) -> int:
    """A TUN device of this network namespace, up, with an address; its descriptor."""
    device = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH14x", b"fleet", _IFF_TUN | _IFF_NO_PI))
    with socket.socket(type=socket.SOCK_DGRAM) as control:
        for what, text in ((_SIOCSIFADDR, own), (_SIOCSIFNETMASK, "255.255.255.0")):
            place = struct.pack("HH4s8x", socket.AF_INET, 0, socket.inet_aton(text))
            fcntl.ioctl(control, what, struct.pack("16s16s", b"fleet", place))
        for name in (b"fleet", b"lo"):
            fcntl.ioctl(control, _SIOCSIFFLAGS, struct.pack("16sH14x", name, _IFF_UP))
    return device


def inside(own: str, channel: int, command: list[str]) -> None:
    """In a new namespace: hand the device over, and become the command."""
    with socket.socket(fileno=channel) as end:
        socket.send_fds(end, [b"."], [tun(own)])
    os.execv(command[0], command)


class Relay(threading.Thread):
    """Carries packets between the namespaces. ``parted``: node a and the others are apart."""

    def __init__(self, devices: dict[str, int], delay_s: float, loss: float) -> None:
        super().__init__(daemon=True)
        self.parted = False
        self.over = threading.Event()
        self.carried = self.lost = 0  # between two nodes, while they are not parted
        self._devices = devices
        self._delay_s, self._loss = delay_s, loss
        self._chance = random.Random(1)

    def run(self) -> None:
        waiting: list[tuple[float, int, int, bytes]] = []
        owners = {device: own for own, device in self._devices.items()}
        number = 0
        while not self.over.is_set():
            left_s = waiting[0][0] - time.monotonic() if waiting else 0.1
            ready, _, _ = select.select(list(owners), [], [], max(0.0, min(left_s, 0.1)))
            now_s = time.monotonic()
            for device in ready:
                packet = os.read(device, 65536)
                if packet[0] >> 4 != 4:
                    continue
                to = socket.inet_ntoa(packet[16:20])
                wait_s = self._wait_s(owners[device], to)
                if wait_s is not None and to in self._devices:
                    number += 1
                    heapq.heappush(waiting, (now_s + wait_s, number, self._devices[to], packet))
            while waiting and waiting[0][0] <= time.monotonic():
                _, _, device, packet = heapq.heappop(waiting)
                os.write(device, packet)

    def _wait_s(self, one: str, other: str) -> float | None:
        """How long a packet is on its way; None: it is lost."""
        if HERE in (one, other):
            return 0.0
        if self.parted and address("a") in (one, other):
            return None
        self.carried += 1
        if self._chance.random() < self._loss:
            self.lost += 1
            return None
        return self._delay_s


@dataclass(kw_only=True)
class Seen:
    """What was seen, of UAVs that all nodes hear; ``whole``: before the fleet was parted.

    once, twice, none   times that a UAV had one node, several, none
    ways_ms             of each pair of nodes: p99 of a frame's way at most, and the clock's doubt
    heals_s             from the end of the partition until every UAV has one node, for good
    checked, broken     answers held against the truth, and those beyond their bound
    """

    whole: dict[str, int] = field(default_factory=lambda: {"once": 0, "twice": 0, "none": 0})
    parted: dict[str, int] = field(default_factory=lambda: {"once": 0, "twice": 0, "none": 0})
    ways_ms: list[tuple[float, float]] = field(default_factory=list)
    heals_s: float = 0.0
    checked: int = 0
    broken: list[str] = field(default_factory=list)
    carried: int = 0
    lost: int = 0


class Nodes:
    """The nodes' processes, each in its namespace, and what they answer."""

    def __init__(self, companion: str, folder: Path) -> None:
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.devices = {HERE: tun(HERE)}
        for name in NAMES:
            config = folder / f"{name}.toml"
            config.write_text(self._settings(name))
            mine, theirs = socket.socketpair()
            command = [companion, "run", "--config", str(config)]
            child = f"import fleet_apart as f; f.inside({address(name)!r}, {theirs.fileno()}, "
            with mine, theirs, (folder / f"{name}.log").open("wb") as log:
                self.processes[name] = subprocess.Popen(
                    ["unshare", "--net", sys.executable, "-c", f"{child}{command!r})"],
                    pass_fds=(theirs.fileno(),),
                    env={**os.environ, "COMPANION_TOKEN": TOKEN},
                    stdout=log,
                    stderr=log,
                )
                theirs.close()
                _, (device,), _, _ = socket.recv_fds(mine, 1, 1)
            self.devices[address(name)] = device

    @staticmethod
    def _settings(name: str) -> str:
        number = NAMES.index(name)
        ends = [f"{way}/{{}}:7447?rel={rel}" for way, rel in (("tcp", 1), ("udp", 0))]
        connect = [end.format(address(other)) for other in NAMES[:number] for end in ends]
        return f"""
            [center]
            source = "{LAT_DEG},{LON_DEG + 0.006 * number},480,{(90, 0, 270)[number]}"
            [array]
            elements = 64
            frequency_hz = 5.8e9
            [links]
            urls = ["udpin:0.0.0.0:{15550 + number}"]
            [server]
            listen = "{address(name)}:8080"
            [fleet]
            node = "{name}"
            listen = {json.dumps([end.format(address(name)) for end in ends])}
            connect = {json.dumps(connect)}
            """

    def ask(self, name: str, path: str) -> Any:
        request = urllib.request.Request(
            f"http://{address(name)}:8080/v1/{path}", headers={"Authorization": f"Bearer {TOKEN}"}
        )
        with urllib.request.urlopen(request, timeout=10) as answer:
            return json.load(answer)

    def served_by(self, uavs: list[str]) -> dict[str, int]:
        """By how many nodes each UAV is served, as they say of themselves."""
        found = dict.fromkeys(uavs, 0)
        for name in NAMES:
            for uav in self.ask(name, "fleet")["uavs"]:
                found[uav["uav"]] += name in uav["served_by"]
        return found

    def until(self, what: Any, seconds: float) -> None:
        limit_s = time.monotonic() + seconds
        while not what():
            assert time.monotonic() < limit_s, "it does not come true"
            time.sleep(0.05)

    def answer(self) -> bool:
        try:
            return all(self.ask(name, "fleet") for name in NAMES)
        except OSError:
            return False

    def end(self) -> None:
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def count(nodes: Nodes, sky: FleetSky, seen: Seen, into: dict[str, int], seconds: float) -> None:
    """Look at who serves whom for so long, and hold every position against the truth."""
    ends_s = time.monotonic() + seconds
    while time.monotonic() < ends_s:
        for served in nodes.served_by(sky.names).values():
            into[("none", "once", "twice")[min(served, 2)]] += 1
        for name in NAMES:
            answer = nodes.ask(name, "uavs")
            utc_s = datetime.fromisoformat(answer["valid_at"]).timestamp()
            for uav in answer["uavs"]:
                if uav["bound_m"] is not None and uav["lat_deg"] is not None:
                    place = uav["lat_deg"], uav["lon_deg"], uav["alt_m"]
                    error_m = off_m(place, sky.at(uav["id"], utc_s))
                    seen.checked += 1
                    if error_m > uav["bound_m"] + 0.05:  # the answer's time is in milliseconds
                        seen.broken.append(f"{name} {uav['id']} {error_m} > {uav['bound_m']}")
        time.sleep(0.2)


def healed_s(nodes: Nodes, sky: FleetSky) -> float:
    """Time until every UAV has one node, and has it for two seconds."""
    began_s = last_s = time.monotonic()
    while time.monotonic() - last_s < 2.0:
        assert time.monotonic() - began_s < HEALED_S, "it does not heal"
        if set(nodes.served_by(sky.names).values()) != {1}:
            last_s = time.monotonic()
    return last_s - began_s


def fly(
    companion: str, folder: Path, uavs: int, *, delay_s: float, loss: float, parted_s: float
) -> Seen:
    nodes, seen = Nodes(companion, folder), Seen()
    relay = Relay(nodes.devices, delay_s, loss)
    relay.start()
    try:
        nodes.until(nodes.answer, STARTED_S)
        ports = [15550 + number for number in range(len(NAMES))]
        hosts = {port: address(name) for port, name in zip(ports, NAMES, strict=True)}
        with FleetSky(ports=ports, uavs=uavs, hosts=hosts) as sky:
            nodes.until(
                lambda: (
                    all(len(nodes.ask(name, "fleet")["uavs"]) == uavs for name in NAMES)
                    and set(nodes.served_by(sky.names).values()) == {1}
                ),
                SETTLED_S,
            )
            count(nodes, sky, seen, seen.whole, 20.0)
            for name in NAMES:
                for one in nodes.ask(name, "fleet")["nodes"]:
                    if one["way_p99_ms"] is not None:
                        seen.ways_ms.append((one["way_p99_ms"], 1e3 * one["clock_doubt_s"]))
            relay.parted = True
            count(nodes, sky, seen, seen.parted, parted_s)
            relay.parted = False
            seen.heals_s = healed_s(nodes, sky)
            count(nodes, sky, seen, seen.whole, 3.0)
    finally:
        nodes.end()
        relay.over.set()
        relay.join()
    seen.carried, seen.lost = relay.carried, relay.lost
    return seen


if __name__ == "__main__":
    companion, folder, *numbers = sys.argv[1:]
    uavs, delay_s, loss, parted_s = map(float, numbers)
    print(
        json.dumps(
            asdict(
                fly(
                    companion,
                    Path(folder),
                    int(uavs),
                    delay_s=delay_s,
                    loss=loss,
                    parted_s=parted_s,
                )
            )
        )
    )
