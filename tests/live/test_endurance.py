"""Endurance: faults in flight and senders that lie, around four honest UAVs with beams.

The short form runs with the tests; the long one (`make soak`) adds a row to its table for each.
"""

import contextlib
import os
import random
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import attacks
import endurance
import pytest
from attacks import Attack
from endurance import KEY, Liar, LyingServer, Steps
from siege import HONEST, RUN, Looks, attacked, besieged, broken, flight, looking, tcp
from support import BALLAST, HANG_S, Node, end, fill, free_port, read_metadata

from companion.node.replay import replay, settings_for
from companion.recording.parts import UNFOLLOWED, read_recording_info
from companion.recording.reader import read_parts
from companion.recording.recover import recover_leftovers
from companion.values import Frame

SHORT_S, LONG_S = 5.0, 15.0
GROWS_MB = 30.0
MAP_MB = 40.0  # threads that read files, and 64 kB of each answer that is not read
FULL_TABLE_MB = 40.0
"""For 1000 tracks, the limit of ``[tracks] most``: 10 kB each, besides what time alone takes."""
CROWD_MB = 100.0  # of a crowd that is tracked besides, and answers that are computed
UDP = "udpin:127.0.0.1:0"


def check(seen: Looks, grows_mb: float = GROWS_MB) -> None:
    """Assert what holds on any machine: beams in each look, bounds, memory."""
    assert seen.looks, "no look was made: nothing was tested"
    assert seen.without_beams == []
    assert seen.broken == []
    assert seen.grown_mb < grows_mb, str(seen)


def stopped(node: Node) -> str:
    """Stop a service, which must succeed; return what it printed."""
    code, _, err = node.stop()
    assert code == 0, err
    assert "Traceback" not in err
    return err


# --- senders that flood and lie -------------------------------------------------------------------


class Case(NamedTuple):
    """An attack, the service's further arguments, and the most that memory may grow, MB."""

    attack: Attack
    words: tuple[str, ...] = ()
    grows_mb: float = GROWS_MB


def receiver(scheme: str, lie: Any) -> Case:
    """A service that listens to a server that lies."""
    server = LyingServer(lie, 3000.0)
    words = ("--link", f"{scheme}:127.0.0.1:{server.port}")
    return Case(server.attack, words, FULL_TABLE_MB)


def receivers_and_crowd() -> Case:
    """Five loads at once, each of which is harmless alone."""
    servers = [LyingServer(lie, 1600.0) for lie in (endurance.sbs_lies, endurance.beast_lies)]
    urls = zip(("sbs", "readsb"), servers, strict=True)
    words = [word for kind, one in urls for word in ("--link", f"{kind}:127.0.0.1:{one.port}")]
    crowd = (attacks.distinct_requests(40), attacks.ghosts(300.0, 100), attacks.frames(1500.0))
    return Case(endurance.both(*(one.attack for one in servers), *crowd), tuple(words), CROWD_MB)


TCPIN = ("--link", "tcpin:127.0.0.1:0")
CASES: dict[str, Callable[[], Case]] = {
    "valid frames over 20 TCP connections": lambda: Case(
        endurance.tcp_connections(20, endurance.valid_frames), TCPIN
    ),
    "random bytes over 20 TCP connections": lambda: Case(
        endurance.tcp_connections(20, endurance.garbage), TCPIN
    ),
    "half frames over 20 TCP connections": lambda: Case(
        endurance.tcp_connections(20, endurance.half_frames), TCPIN
    ),
    "half frames over 300 TCP connections": lambda: Case(
        endurance.tcp_connections(300, endurance.half_frames), TCPIN
    ),
    "3000 reports/s of 4000 relayed aircraft around the UAVs": lambda: Case(
        endurance.twins(3000.0, 4000), grows_mb=FULL_TABLE_MB
    ),
    "64 kB of one byte to a Cursor on Target port, 30 times a second": lambda: Case(
        endurance.datagrams("cot", b"\xbf" * 65_000, 30.0), ("--link", "cot:udp:127.0.0.1:0")
    ),
    "64 kB of empty objects to a Remote ID port, 5 times a second": lambda: Case(
        endurance.datagrams("rid", b"{}\n" * 21_000, 5.0), ("--link", "rid:udp:127.0.0.1:0")
    ),
    "two receivers that lie, requests, invented UAVs and a flood at once": receivers_and_crowd,
    "an SBS server that lies": lambda: receiver("sbs", endurance.sbs_lies),
    "a Beast server that lies": lambda: receiver("readsb", endurance.beast_lies),
}


def under(start_node: Any, case: Case, seconds: float) -> Looks:
    """Return what was seen during an attack on a service."""
    with besieged(start_node, *case.words) as node:
        seen = attacked(case.attack, node, seconds)
        stopped(node)
    return seen


@pytest.mark.parametrize("name", CASES)
def test_flood_or_lies_cost_no_beam(start_node: Any, name: str) -> None:
    case = CASES[name]()
    check(under(start_node, case, SHORT_S), case.grows_mb)


@pytest.mark.soak
@pytest.mark.parametrize("name", CASES)
def test_flood_or_lies_are_withstood_for_longer(start_node: Any, table: Any, name: str) -> None:
    case = CASES[name]()
    told(table, name, under(start_node, case, LONG_S), case.grows_mb)


def told(table: Any, name: str, seen: Looks, grows_mb: float = GROWS_MB) -> None:
    """Add the rows of a long run to the table, and check it."""
    table.add(f"{name}: looks without beams", len(seen.without_beams), "", "0")
    table.add(f"{name}: bounds broken unannounced", len(seen.broken), "", "0")
    table.add(f"{name}: memory", seen.grown_mb, "MB", f"+{grows_mb:g} MB")
    check(seen, grows_mb)


# --- senders under one id, signed and unsigned ----------------------------------------------------


FORGED = endurance.both(attacks.forged_carrier(0.1), attacks.drifting(5.0, 10.0, fresh_ports=True))


@pytest.mark.parametrize("unsigned", [False, True], ids=["keyed", "allow_unsigned"])
@pytest.mark.parametrize("seconds", [SHORT_S, pytest.param(LONG_S, marks=pytest.mark.soak)])
def test_unsigned_forgeries_beside_signed_senders_cost_no_beam(
    start_node: Any, tmp_path: Path, table: Any, unsigned: bool, seconds: float
) -> None:
    (tmp_path / "radio.key").write_bytes(KEY)
    (tmp_path / "radio.key").chmod(0o600)
    settings = tmp_path / "settings.toml"
    settings.write_text(
        f'[signing]\nkeys = {{"{UDP}" = "{tmp_path / "radio.key"}"}}\n'
        f'timestamps = "{tmp_path / "timestamps.json"}"\n'
        + (f'allow_unsigned = ["{UDP}"]\n' if unsigned else "")
    )
    with besieged(start_node, "--config", str(settings), key=KEY) as node:
        seen = attacked(FORGED, node, seconds)
        rejected = node.json("/v1/status")["rejected"]
        stopped(node)
    assert rejected["stranger" if unsigned else "unsigned"] > 100
    told(table, f"unsigned forgeries, allow_unsigned {unsigned}", seen)


# --- the disk -------------------------------------------------------------------------------------


def remount(folder: Path, options: str) -> None:
    """Change the options of a mounted file system."""
    command = ["mount", "-o", f"remount,{options}", str(folder)]
    subprocess.run(command, check=True, capture_output=True, timeout=HANG_S)


def parts_of(folder: Path) -> list[Path]:
    """The files of one run, in order; those cut short are recovered, as the next start does."""
    recover_leftovers(folder)
    return sorted(
        folder.glob("*.mcap"), key=lambda path: getattr(read_recording_info(path).part, "number", 0)
    )


def test_full_and_then_read_only_disk_costs_no_beam_and_no_event(
    start_node: Any, small_disk: Path, table: Any
) -> None:
    """The disk fills, gets larger but read-only, and is writable again: all waits in memory."""

    def until(node: Node, state: str) -> Any:
        return node.wait_until("/v1/status", lambda a: a["recording"]["state"] == state)

    with besieged(start_node, "--record", str(small_disk)) as node:
        node.wait_until("/v1/status", lambda a: a["recording"]["bytes"] > 20_000)
        with looking(node) as seen:
            fill(small_disk)
            until(node, "degraded")
            remount(small_disk, "ro,size=40m")
            failed = node.json("/v1/status")["frames"]
            node.wait_until("/v1/status", lambda a: a["frames"] > failed + 250)  # two retries
            assert node.json("/v1/status")["recording"]["state"] == "degraded"
            remount(small_disk, "rw")
            status = until(node, "recording")
            (small_disk / BALLAST).unlink()
        err = stopped(node)
    news = [line for line in err.splitlines() if "record" in line]
    assert len(news) == 2 and "nothing is recorded" in news[0] and "recording again" in news[1]
    assert status["recording"]["dropped"] == 0
    logs = parts_of(small_disk)
    summary = replay(logs, settings_for(logs, None, None))
    assert summary["missing"] == []
    assert summary["frames"] >= status["frames"]
    assert summary["digest"] == read_metadata(logs[-1])["summary"]["digest"]
    told(table, "disk full and read-only", seen)


def killed_near_a_rotation(folder: Path, rng: random.Random) -> tuple[float, float]:
    """Kill a service as a file ends and the next begins.

    Returns the seconds of traffic lost, and how long after the rotation the service was killed.
    """
    folder.mkdir()
    (folder / "settings.toml").write_text("[recording]\nrotate_s = 1.0\n")
    kept = folder / "kept"
    node = Node(*RUN, "--config", str(folder / "settings.toml"), "--record", str(kept))
    try:
        with flight(node.udp_port):
            node.wait_until("/v1/status", lambda a: a["recording"]["messages"] > 0)
            files = len(list(kept.iterdir()))
            end_s = time.monotonic() + HANG_S
            while len(list(kept.iterdir())) == files:  # the moment of a rotation: nothing tells it
                assert time.monotonic() < end_s
            after_s = rng.choice((0.0, rng.uniform(0.0, 0.005), rng.uniform(0.9, 1.1)))
            time.sleep(after_s)  # a random time
            killed_ns = time.time_ns()
            node.process.send_signal(signal.SIGKILL)
            node.process.wait(HANG_S)
    finally:
        end(node.process)
    logs = parts_of(kept)
    assert not list(kept.glob("*.active"))
    summary = replay(logs, settings_for(logs, None, None))
    assert all(line.endswith(UNFOLLOWED) for line in summary["missing"])
    frames = [event for event in read_parts(logs) if isinstance(event, Frame)]
    assert summary["frames"] == len(frames) > 0
    return (killed_ns - frames[-1].t_ns) * 1e-9, after_s


@pytest.mark.parametrize("count", [4, pytest.param(50, marks=pytest.mark.soak)])
def test_service_killed_within_a_rotation_loses_at_most_a_second(
    tmp_path: Path, table: Any, count: int
) -> None:
    """A flush each second, plus the time between two frames and delays of a busy machine."""
    rng = random.Random(11)
    with ThreadPoolExecutor(2) as pool:
        runs = [
            pool.submit(killed_near_a_rotation, tmp_path / str(number), rng)
            for number in range(count)
        ]
        lost = sorted(run.result() for run in runs)
    table.add(f"lost by {count} kills near a rotation, most", lost[-1][0], "s", "< 1.1 s")
    assert lost[-1][0] < 1.1


# --- the wall clock -------------------------------------------------------------------------------


def test_steps_of_the_wall_clock_cost_no_beam(start_node: Any, tmp_path: Path, table: Any) -> None:
    """As by NTP, forward and back, small and large; the recording replays to the same digest."""
    steps = Steps(tmp_path / "ahead")
    node = Node(
        str(tmp_path / "ahead"), *RUN, "--record", str(tmp_path / "kept"), code=endurance.STEPPED
    )
    try:
        with flight(node.udp_port):
            node.wait_until("/v1/beams", lambda a: {b["uav"] for b in a["beams"]} >= HONEST)
            with looking(node) as seen:
                seen.broken = Ignored()  # the looks compare with this process's clock
                for number, ahead_s in enumerate((0.5, -0.5, 3600.0, 86_400.0 * 365, -1e9, 0.0), 1):
                    steps.set_s(ahead_s)
                    node.wait_until("/v1/events", lambda a, n=number: clock_notices(a) >= n)
                    check_places(node, ahead_s)
            err = stopped(node)
    finally:
        end(node.process)
        steps.close()
    assert err.count("clock was set") == 6
    (log,) = (tmp_path / "kept").glob("*.mcap")
    summary = replay([log], settings_for([log], None, None))
    assert summary["digest"] == read_metadata(log)["summary"]["digest"]
    told(table, "steps of the wall clock", seen)


class Ignored(list[str]):
    """A list that stays empty."""

    def append(self, _: str) -> None:
        """Ignore it."""


def clock_notices(answer: Any) -> int:
    """How many notices say that the clock was set."""
    return sum("clock was set" in one["text"] for one in answer["events"])


def check_places(node: Node, ahead_s: float) -> None:
    """Assert that UAVs are within their bounds, at times of a clock that is ahead."""
    for uav in node.json("/v1/uavs")["uavs"]:
        if uav["id"] in HONEST:
            at_s = datetime.fromisoformat(uav["valid_at"]).timestamp() - ahead_s
            assert broken(uav, at_s) is None


# --- a fleet's node that lies ---------------------------------------------------------------------


@pytest.mark.parametrize("lie", ["positions", "gains", "duties"])
def test_fleet_node_that_lies_costs_no_beam(
    start_node: Any, tmp_path: Path, table: Any, lie: str
) -> None:
    pytest.importorskip("zenoh")
    port = free_port()
    (tmp_path / "settings.toml").write_text(
        f'[fleet]\nnode = "honest"\nlisten = ["tcp/127.0.0.1:{port}"]\n'
    )
    with besieged(start_node, "--config", str(tmp_path / "settings.toml")) as node:
        seen = attacked(Liar(port, lie).attack, node, SHORT_S)
        stopped(node)
    told(table, f"a node that lies about {lie}", seen)


# --- files ----------------------------------------------------------------------------------------

RANGES = (
    "", "Range: bytes=0-", "Range: bytes=0-99999999999999", "Range: bytes=-99999999999999",
    "Range: bytes=" + ",".join(f"{number}-" for number in range(99)),
    "Range: bytes=9-1", "Range: bytes=x-", "Range: bytes=" + "9" * 4000 + "-",
)  # fmt: skip


def reads_of_a_map(area: Path) -> Attack:
    """Requests for parts of a map of 64 GB, which is cut short and replaced meanwhile."""

    def attack(node: Node, until: Any) -> None:
        begun_s = time.monotonic()
        changes = [(1.0, lambda: os.truncate(area, 100_000)), (2.0, lambda: os.truncate(area, 8)),
                   (3.0, lambda: (area.unlink(), os.mkfifo(area)))]  # fmt: skip
        held = list[socket.socket]()  # open, and they read no more
        with contextlib.ExitStack() as stack:
            while not until.wait(0.05):  # between two rounds
                if changes and time.monotonic() - begun_s > changes[0][0]:
                    changes.pop(0)[1]()
                for wanted in RANGES:
                    asked = f"GET /v1/map/tiles HTTP/1.1\r\nHost: 127.0.0.1\r\n{wanted}"
                    with contextlib.suppress(OSError), tcp(node) as made:
                        made.send(f"{asked.strip()}\r\n\r\n".encode())
                        made.recv(1 << 20)
                        if wanted == RANGES[1] and len(held) < 8:
                            held.append(stack.enter_context(made.dup()))

    return attack


def test_reads_of_a_hostile_map_cost_no_beam(start_node: Any, tmp_path: Path, table: Any) -> None:
    area = tmp_path / "area.pmtiles"
    area.write_bytes(b"PMTiles\x03" + random.Random(2).randbytes(100_000))
    os.truncate(area, 64 << 30)  # sparse: it takes no space
    (tmp_path / "settings.toml").write_text(f'[page]\nmap = "{area}"\n')
    with besieged(start_node, "--config", str(tmp_path / "settings.toml")) as node:
        seen = attacked(reads_of_a_map(area), node, SHORT_S)
        assert node.get("/v1/map/tiles")[0] == 404
        stopped(node)
    told(table, "a hostile map", seen, MAP_MB)
