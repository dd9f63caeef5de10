"""Endurance: faults in flight and senders that lie, around four honest UAVs with beams.

The short form runs with the tests; the long one (`make soak`) adds a row to its table for each.
"""

import json
import random
import signal
import subprocess
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import attacks
import endurance
import pytest
from attacks import Attack
from endurance import KEY, LyingServer
from siege import HONEST, Looks, attacked, besieged, broken, looking
from support import BALLAST, HANG_S, Node, fill, free_port, read_metadata

from companion.node.replay import replay, settings_for
from companion.recording.parts import read_recording_info
from companion.recording.recover import recover_leftovers

SHORT_S, LONG_S = 5.0, 30.0
GROWS_MB = 30.0
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
    """An attack, and the service's further arguments."""

    attack: Attack
    words: tuple[str, ...] = ()


def receiver(scheme: str, lie: Any) -> Case:
    """A service that listens to a server that lies."""
    server = LyingServer(lie, 3000.0)
    return Case(server.attack, ("--link", f"{scheme}:127.0.0.1:{server.port}"))


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
        endurance.twins(3000.0, 4000)
    ),
    "an SBS server that lies": lambda: receiver("sbs", endurance.sbs_lies),
    "a Beast server that lies": lambda: receiver("readsb", endurance.beast_lies),
}


def under(start_node: Any, case: Case, seconds: float) -> Looks:
    """Return what was seen during an attack on a service."""
    with besieged(start_node, *case.words) as node:
        seen = attacked(case.attack, node, seconds)
        print(json.dumps(node.json("/v1/status")["rejected"]))
        stopped(node)
    print(seen)
    return seen


@pytest.mark.parametrize("name", CASES)
def test_flood_or_lies_cost_no_beam(start_node: Any, name: str) -> None:
    check(under(start_node, CASES[name](), SHORT_S))


@pytest.mark.soak
@pytest.mark.parametrize("name", CASES)
def test_flood_or_lies_are_withstood_for_longer(start_node: Any, table: Any, name: str) -> None:
    told(table, name, under(start_node, CASES[name](), LONG_S))


def told(table: Any, name: str, seen: Looks) -> None:
    """Add the rows of a long run to the table, and check it."""
    table.add(f"{name}: looks without beams", len(seen.without_beams), "", "0")
    table.add(f"{name}: bounds broken unannounced", len(seen.broken), "", "0")
    table.add(f"{name}: memory", seen.grown_mb, "MB", f"+{GROWS_MB:g} MB")
    check(seen)
