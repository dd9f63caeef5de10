"""Three nodes as real processes over real Zenoh: allocation, reception, false nodes, node
failure."""

import asyncio
import json
import re
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import pytest
from fleet_sky import LAT_DEG, LON_DEG, FleetSky, off_m
from pymavlink.dialects.v20 import common
from support import HANG_S, Node, end, free_port, run_async

from companion.mavlink.links.zenoh_bus import Bus
from companion.mavlink.links.zenoh_config import BusConfig
from companion.node.fleet import messages
from companion.values import Offer, Shared, SharedFrame, Standing

pytest.importorskip("zenoh")
pytestmark = pytest.mark.full
NAMES = ("a", "b", "c")
UAVS = 6


@dataclass(kw_only=True)
class Fleet:
    """The nodes, what each UAV receives, and every answer checked against the truth."""

    nodes: dict[str, Node]
    sky: FleetSky
    ports: dict[str, int]
    checked: int = 0
    broken: list[str] = field(default_factory=list)
    over: threading.Event = field(default_factory=threading.Event)

    def watch(self) -> None:
        """Check every position of every living node against the truth until the end of the run."""
        while not self.over.is_set():
            for name, node in list(self.nodes.items()):
                if node.process.poll() is None:
                    self._check(name, node)
            self.over.wait(0.2)

    def _check(self, name: str, node: Node) -> None:
        try:
            answer = node.json("/v1/uavs")
        except OSError:
            return  # the node stopped meanwhile
        utc_s = datetime.fromisoformat(answer["valid_at"]).timestamp()
        utc_s -= AHEAD_S if name == "c" else 0.0
        for uav in answer["uavs"]:
            if uav["id"] not in self.sky.heard_at or uav["bound_m"] is None:
                continue
            place = uav["lat_deg"], uav["lon_deg"], uav["alt_m"]
            error_m = off_m(place, self.sky.at(uav["id"], utc_s))
            self.checked += 1
            if error_m > uav["bound_m"] + 0.05:  # the answer's time is in milliseconds
                self.broken.append(f"{name} {uav['id']} {error_m:.2f} > {uav['bound_m']:.2f}")

    def served_by(self, *names: str) -> dict[str, set[str]]:
        """The nodes that report serving each UAV."""
        found: dict[str, set[str]] = {uav: set() for uav in self.sky.names}
        for name in names or self.nodes:
            for uav in self.nodes[name].json("/v1/fleet")["uavs"]:
                if name in uav["served_by"] and uav["uav"] in found:
                    found[uav["uav"]].add(name)
        return found

    def until(self, what: Any, seconds: float = HANG_S) -> None:
        """Wait until the condition holds."""
        limit = time.monotonic() + seconds
        while not what():
            assert time.monotonic() < limit, self.served_by()
            time.sleep(0.05)  # between two requests to other processes


AHEAD_S = 3.0
"""By how much the clock of node c is wrong."""
WRONG_CLOCK = (
    "import time; t = time.time_ns; time.time_ns = lambda: t() + 3_000_000_000;"
    " from companion.cli.main import main; main()"
)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    folder = tmp_path_factory.mktemp("fleet")
    ports = {name: free_port() for name in NAMES}
    nodes: dict[str, Node] = {}
    try:
        for number, name in enumerate(NAMES):
            config = folder / f"{name}.toml"
            connect = [f"tcp/127.0.0.1:{ports[other]}" for other in NAMES[:number]]
            config.write_text(
                f"""
                [center]
                source = "{LAT_DEG},{LON_DEG + 0.006 * number},480,{(90, 0, 270)[number]}"
                [array]
                elements = 16
                frequency_hz = 5.8e9
                [fleet]
                node = "{name}"
                listen = ["tcp/127.0.0.1:{ports[name]}"]
                connect = {json.dumps(connect)}
                [recording]
                directory = "{folder / name}"
                """
            )
            run = ("run", "--config", str(config), "--link", "udpin:127.0.0.1:0")
            nodes[name] = Node(
                *run, "--listen", "127.0.0.1:0", code=WRONG_CLOCK if name == "c" else None
            )
        with FleetSky(ports=[node.udp_port for node in nodes.values()], uavs=UAVS) as sky:
            made = Fleet(nodes=nodes, sky=sky, ports=ports)
            watcher = threading.Thread(target=made.watch)
            watcher.start()
            try:
                yield made
            finally:
                made.over.set()
                watcher.join(HANG_S)
    finally:
        for node in nodes.values():
            end(node.process)


def test_every_uav_has_one_node(fleet: Fleet) -> None:
    def shared() -> bool:
        by = list(fleet.served_by().values())
        return all(len(one) == 1 for one in by) and len(set.union(*by)) >= 2

    fleet.until(shared)  # the first node hands over UAVs that others serve better
    by = fleet.served_by()
    answer = fleet.nodes["a"].json("/v1/fleet")
    assert [node["node"] for node in answer["nodes"]] == ["a", "b", "c"]
    beams = {beam["uav"] for beam in fleet.nodes["a"].json("/v1/beams")["beams"]}
    assert beams == {uav for uav, one in by.items() if one == {"a"}}


def test_wrong_node_clock_is_estimated_and_reported(fleet: Fleet) -> None:
    def found(answer: Any) -> Any:
        nodes = [one for one in answer["nodes"] if one["node"] == "c"]
        return nodes and nodes[0]["clock_doubt_s"] is not None and nodes[0]

    def reported_s() -> list[str]:
        return re.findall(r"node c's clock is (\d+\.\d+) s", fleet.nodes["a"].errors())

    answer = fleet.nodes["a"].wait_until("/v1/fleet", found)
    node = found(answer)
    assert abs(node["clock_offset_s"] - AHEAD_S) <= node["clock_doubt_s"] + 0.001
    fleet.until(reported_s)  # the least difference: a slow answer proves less than all of it
    assert AHEAD_S - 1.0 < float(reported_s()[0]) < AHEAD_S + 0.01
    fleet.until(lambda: found(fleet.nodes["a"].json("/v1/fleet"))["state"] == "there")


def test_uav_received_only_by_another_node_keeps_a_small_bound(fleet: Fleet) -> None:
    uav = fleet.sky.names[0]
    port = fleet.nodes["a"].udp_port

    def bound(name: str) -> float:
        return float(fleet.nodes[name].json(f"/v1/uavs/{uav}")["bound_m"])

    def used() -> int:
        nodes = fleet.nodes["a"].json("/v1/fleet")["nodes"]
        return sum(node["used"] or 0 for node in nodes)

    fleet.until(lambda: bound("a") < 10)
    fleet.sky.heard_at[uav].discard(port)
    try:
        began = used()
        fleet.until(lambda: used() > began + 50)
        ratios = []
        for _ in range(20):
            ratios.append(bound("a") / bound("b"))
            fleet.nodes["a"].wait_until("/v1/status", lambda _: True)
        assert sorted(ratios)[len(ratios) // 2] <= 2.0
        assert fleet.nodes["a"].json(f"/v1/uavs/{uav}")["state"] == "live"
    finally:
        fleet.sky.heard_at[uav].add(port)


def test_node_that_invents_vehicles_is_excluded(fleet: Fleet) -> None:
    """It speaks Zenoh like a node, and reports vehicles that do not exist."""

    async def lie() -> None:
        loop = asyncio.get_running_loop()
        connect = tuple(f"tcp/127.0.0.1:{port}" for port in fleet.ports.values())
        bus = Bus(BusConfig(listen=(), connect=connect), loop)
        await asyncio.to_thread(bus.open)
        started = time.time_ns()
        told: dict[str, int] = {}
        try:
            bus.serve("companion/site/liar/time", lambda *_: _clock(started))
            bus.alive("companion/site/liar/alive")
            while not await asyncio.to_thread(_put_aside, fleet):
                for number in range(4):
                    raw = _phantom(66 + number, told)
                    said = Shared(time.time_ns(), (SharedFrame(time.time_ns(), raw),))
                    bus.put("companion/site/liar/heard", messages.shared(said))
                bus.put("companion/site/liar/offers", messages.offers(_offers()))
                bus.put("companion/site/liar/standing", messages.standing(_standing(started)))
                await asyncio.sleep(0.1)
        finally:
            await asyncio.to_thread(bus.close)

    run_async(lie())
    assert "node liar is excluded for" in fleet.nodes["b"].errors()


def test_uavs_of_a_killed_node_are_taken_over(fleet: Fleet) -> None:
    """Runs second to last: the killed node is not restarted."""
    fleet.until(lambda: all(len(by) == 1 for by in fleet.served_by().values()))
    by = fleet.served_by()
    victim = max(NAMES, key=lambda name: sum(name in one for one in by.values()))
    rest = [name for name in NAMES if name != victim]
    fleet.nodes[victim].process.send_signal(signal.SIGKILL)
    fleet.nodes[victim].process.wait(HANG_S)
    fleet.until(lambda: all(fleet.served_by(*rest).values()))
    fleet.until(lambda: all(len(one) == 1 for one in fleet.served_by(*rest).values()))


def test_no_bound_was_violated_during_the_run(fleet: Fleet) -> None:
    assert fleet.checked > 100
    assert fleet.broken == []


def _put_aside(fleet: Fleet) -> bool:
    """Whether every node has excluded the false node."""
    answers = [node.json("/v1/fleet")["nodes"] for node in fleet.nodes.values()]
    return all(
        any(one["node"] == "liar" and one["state"] == "aside" for one in nodes) for nodes in answers
    )


def _clock(started_ns: int) -> bytes:
    return started_ns.to_bytes(8, "little") + time.time_ns().to_bytes(8, "little")


def _phantom(sysid: int, told: dict[str, int]) -> bytes:
    told["boot"] = told.get("boot", 5000) + 20
    mav = common.MAVLink(None, srcSystem=sysid, srcComponent=1)
    lat, lon = LAT_DEG + 0.0004 * (sysid - 66), LON_DEG + 0.003
    message = common.MAVLink_global_position_int_message(
        told["boot"], round(lat * 1e7), round(lon * 1e7), 520_000, 40_000, 0, 0, 0, 65535
    )
    return bytes(message.pack(mav))


def _offers() -> Any:
    return {
        f"{n}:1": Offer(uav=f"{n}:1", sure_db=17.0, likely_db=17.0, sinr_db=90.0, heard_s=0.1)
        for n in range(66, 70)
    }


def _standing(started_ns: int) -> Any:
    return Standing(node="liar", place=None, reach_m=None, most=10, serves=())
