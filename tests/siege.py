"""A service under attack, and what its users see of it: looks at health, beams, bounds and memory.

``besieged`` starts the flight of ``siege_flight`` around a service; ``looking`` looks at it from a
thread, as an operator's page would, while an attack runs.
"""

import contextlib
import json
import math
import multiprocessing
import socket
import subprocess
import sys
import threading
import time
import urllib.request
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from siege_flight import CARRIER, UAVS, YAW_RAD, degrees, place
from support import HANG_S, ROOT, Node, end

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
LOOK_S = 0.1
RECENT_S = 5.0  # a warning older than this announces no broken bound
HONEST = frozenset(f"{sysid}:1" for sysid in UAVS)
PAGE_MB = 4096 / 1e6
LEVEL_DEG = 1.0
M_PER_DEG_LAT = 111_195.0


@dataclass
class Looks:
    """What was seen: times of health checks, looks without all beams, bounds broken in silence."""

    health_s: list[float] = field(default_factory=list)
    looks: int = 0
    without_beams: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    rates_hz: list[float] = field(default_factory=list)

    def health_ms(self, percent: float) -> float:
        """Percentile of the time of ``/healthz``, milliseconds."""
        return float(np.percentile(self.health_s, percent)) * 1e3

    @property
    def grown_mb(self) -> float:
        """Largest memory less the first."""
        return max(self.memory_mb) - self.memory_mb[0]

    def __str__(self) -> str:
        return (
            f"health p50 {self.health_ms(50):.0f} p99 {self.health_ms(99):.0f} ms, no beams in"
            f" {len(self.without_beams)} of {self.looks} looks {self.without_beams[:2]},"
            f" {len(self.broken)} broken in silence {self.broken[:2]},"
            f" {self.memory_mb[0]:.0f} + {self.grown_mb:.0f} MB,"
            f" updates {min(self.rates_hz, default=0):.1f} to {max(self.rates_hz, default=0):.1f}/s"
        )


def resident_mb(node: Node) -> float:
    """Resident memory of the service now."""
    return int(Path(f"/proc/{node.process.pid}/statm").read_text().split()[1]) * PAGE_MB


def _ask(url: str, token: str | None) -> Any:
    headers = {"authorization": f"Bearer {token}"} if token else {}
    request = urllib.request.Request(url, headers=headers)
    with urllib.request.urlopen(request, timeout=HANG_S) as answer:
        return json.loads(answer.read())


def broken(uav: Any, at_s: float) -> str | None:
    """How far a UAV shown as good is beyond its bound; None if it is not."""
    sysid = int(uav["id"].partition(":")[0])
    north, east, alt = place(sysid, at_s)
    lat, lon = degrees(north, east)
    off_n = (uav["lat_deg"] - lat) * M_PER_DEG_LAT
    off_e = (uav["lon_deg"] - lon) * M_PER_DEG_LAT * np.cos(np.radians(lat))
    far = float(np.hypot(off_n, off_e))
    # A report has the resolution of its fields.
    if (
        far <= uav["horizontal_bound_m"] + 0.05
        and abs(uav["alt_m"] - alt) <= uav["vertical_bound_m"] + 0.05
    ):
        return None
    return f"{uav['id']} off by {far:.1f} m, bound {uav['horizontal_bound_m']:.1f} m"


class Looking(threading.Thread):
    """Look at a service until stopped; ``seen`` has the results."""

    def __init__(self, node: Node, token: str | None = None) -> None:
        super().__init__(daemon=True)
        self.seen = Looks(memory_mb=[resident_mb(node)])
        self.until = threading.Event()
        self._node, self._token = node, token
        self._announced: set[str] = set()

    def run(self) -> None:
        while not self.until.wait(LOOK_S):
            try:
                self._look()
            except OSError as error:
                self.seen.looks += 1
                self.seen.without_beams.append(f"{type(error).__name__}: {error}")

    def _look(self) -> None:
        url, seen = self._node.url, self.seen
        started_s = time.monotonic()
        try:
            _ask(url + "/healthz", None)
        finally:
            seen.health_s.append(time.monotonic() - started_s)
        seen.memory_mb.append(resident_mb(self._node))
        beams = _ask(url + "/v1/beams", self._token)
        seen.looks += 1
        missing = HONEST - {beam["uav"] for beam in beams["beams"]}
        if missing:
            said = [(left["uav"], left["reason"]) for left in beams["left_out"]]
            seen.without_beams.append(f"{sorted(missing)} {said[:4]}")
        status = _ask(url + "/v1/status", self._token)
        if status["rates"]["updates_hz"] is not None:
            seen.rates_hz.append(status["rates"]["updates_hz"])
        self._check_attitude(status["center"])
        self._check_bounds()

    def _check_attitude(self, center: Any) -> None:
        """Look at the carrier, whose heading is ``YAW_RAD`` and which is level to a degree."""
        if center["yaw_deg"] is None:
            return  # nothing is stated; without an attitude there are no beams, which a look counts
        off_deg = abs(math.remainder(center["yaw_deg"] - math.degrees(YAW_RAD), 360.0))
        if off_deg > center["attitude_bound_deg"] + LEVEL_DEG:
            bound_deg = center["attitude_bound_deg"]
            self.seen.broken.append(f"heading off by {off_deg:.1f}, bound {bound_deg:.1f} degrees")

    def _check_bounds(self) -> None:
        for uav in HONEST:
            try:
                shown = _ask(f"{self._node.url}/v1/uavs/{uav}", self._token)
            except urllib.error.HTTPError:
                continue  # not tracked: no beam, which the look counts
            at_s = datetime.fromisoformat(shown["valid_at"]).timestamp()
            found = broken(shown, at_s)
            if found and shown["verdict"] == "good" and not self._is_announced(uav, at_s):
                self.seen.broken.append(found)

    def _is_announced(self, uav: str, at_s: float) -> bool:
        """Return whether a warning about a UAV was published shortly before."""
        events = _ask(f"{self._node.url}/v1/events", self._token)["events"]
        recent = [
            one for one in events if datetime.fromisoformat(one["at"]).timestamp() > at_s - RECENT_S
        ]
        return any(one["subject"] == uav and one["severity"] != "info" for one in recent)


class Losses(NamedTuple):
    """Frames received and missing of each honest vehicle."""

    frames: dict[str, int]
    gaps: dict[str, int]

    def __sub__(self, before: "Losses") -> "Losses":
        return Losses(
            {key: self.frames[key] - before.frames.get(key, 0) for key in self.frames},
            {key: self.gaps[key] - before.gaps.get(key, 0) for key in self.gaps},
        )

    @property
    def share(self) -> float:
        """Largest share of a vehicle's frames that is missing."""
        return max(
            self.gaps[key] / max(1, self.gaps[key] + self.frames[key]) for key in self.frames
        )


def honest_losses(node: Node) -> Losses:
    """Read the counts of the honest vehicles from the first link."""
    components = node.json("/v1/links")["links"][0]["components"]
    names = HONEST | {f"{CARRIER}:1"}
    kept = [one for one in components if one["id"] in names]
    return Losses(
        {one["id"]: one["frames"] for one in kept}, {one["id"]: one["gaps"] for one in kept}
    )


@contextlib.contextmanager
def besieged(start_node: Any, *words: str, key: bytes | None = None) -> Iterator[Node]:
    """Run a service around which five honest vehicles fly, until all four UAVs have beams."""
    node = start_node(*RUN, *words)
    with flight(node.udp_port, key):
        node.wait_until(
            "/v1/beams", lambda answer: {beam["uav"] for beam in answer["beams"]} >= HONEST
        )
        yield node


@contextlib.contextmanager
def flight(udp_port: int, key: bytes | None = None) -> Iterator["subprocess.Popen[str]"]:
    """Fly the honest vehicles in a process of their own; with a key, their frames are signed."""
    sender = [sys.executable, str(ROOT / "tests" / "siege_flight.py"), str(udp_port)]
    sender += [] if key is None else [key.hex()]
    process = subprocess.Popen(sender, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        end(process)


@contextlib.contextmanager
def looking(node: Node, token: str | None = None) -> Iterator[Looks]:
    """Look at a service for as long as the block runs."""
    thread = Looking(node, token)
    thread.start()
    try:
        yield thread.seen
    finally:
        thread.until.set()
        thread.join(HANG_S)


def attacked(attack: Callable[[Node, threading.Event], None], node: Node, seconds: float) -> Looks:
    """Run an attack for some seconds in a process of its own, and return what was seen meanwhile.

    On a thread it would delay the looks, which share its interpreter.
    """
    context = multiprocessing.get_context("fork")
    until = context.Event()
    attacker = context.Process(target=attack, args=(node, until), daemon=True)
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        attacker.start()  # Python 3.12 warns of threads; the looks have none yet
    with looking(node) as seen:
        time.sleep(seconds)  # the length of the attack, which nothing ends earlier
    until.set()
    attacker.join(HANG_S)
    assert attacker.exitcode == 0
    return seen


def tcp(node: Node) -> socket.socket:
    """A connection to the service's HTTP port."""
    host, _, port = node.url.removeprefix("http://").partition(":")
    made = socket.create_connection((host, int(port)), timeout=HANG_S)
    made.settimeout(1.0)
    return made
