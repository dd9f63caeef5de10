"""A service under attack from outside: its users see health, beams and honest bounds throughout.

The short form runs with the tests; the long one (`make soak`) adds a row to its table for each.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import attacks
import pytest
from attacks import Attack
from load_sender import ATTITUDE
from siege import Looks, attacked, besieged, honest_losses

SHORT_S, LONG_S = 5.0, 12.0


class Case(NamedTuple):
    """An attack, and the most that memory may grow meanwhile, MB."""

    attack: Attack
    grows_mb: float = 30.0
    words: tuple[str, ...] = ()


CASES: dict[str, Case] = {
    "one pipelining connection": Case(attacks.pipelined(1)),
    "50 pipelining connections": Case(attacks.pipelined(50)),
    "300 connections that read nothing of the page": Case(
        attacks.pipelined(300, "/main.js", reads=False), 45.0
    ),
    "a new connection for each request, 8 at once": Case(attacks.requests(8), 80.0),
    "distinct requests, 20 at once": Case(attacks.distinct_requests(20)),
    "pings over one WebSocket": Case(attacks.pings(1)),
    "pings over 20 WebSockets": Case(attacks.pings(20)),
    "500 WebSocket handshakes/s": Case(attacks.handshakes(500.0), 60.0),
    "256 streams that read nothing": Case(attacks.unread_streams(256), 60.0),
    "positions of the carrier from another port": Case(attacks.forged_carrier(1.0)),
    "attitudes of the carrier from another port": Case(attacks.forged_carrier(0.2, msgid=ATTITUDE)),
    "attitudes of the carrier that turn, from a peer whose positions agreed": Case(
        attacks.turning(0.35, 100.0, 0.09, SHORT_S + 1.0)
    ),
    "2500 datagrams/s of starts of frames": Case(attacks.garbage(2500.0, b"\xfe\x01" * 736)),
    "80 datagrams/s of 64 kB of starts of frames": Case(
        attacks.garbage(80.0, b"\xfe\x00\xfd" * 21_600)
    ),
    "drifting positions from fresh ports": Case(attacks.drifting(2.0, 10.0, fresh_ports=True)),
    "drifting positions ahead of time": Case(
        attacks.drifting(3.0, 10.0, fresh_ports=True, ahead_s=0.05)
    ),
    "positions that agree and then drift": Case(
        attacks.drifting(2.0, 10.0, fresh_ports=False, exact_s=SHORT_S + 1.0)
    ),
    "3000 positions/s of invented ids": Case(attacks.ghosts(3000.0), 150.0),
    "10 000 positions/s of invented ids from 50 ports": Case(
        attacks.ghosts(10_000.0, ports=50), 150.0
    ),
    "10 000 frames/s of strangers": Case(attacks.frames(10_000.0, ports=20)),
    "a flood over TCP": Case(attacks.tcp_flood(), words=("--link", "tcpin:127.0.0.1:0")),
}


def check(seen: Looks, case: Case) -> None:
    """Assert what holds on any machine: beams in each look, bounds, memory."""
    assert seen.looks, "no look was made: nothing was tested"
    assert seen.without_beams == []
    assert seen.broken == []
    assert seen.grown_mb < case.grows_mb


def stopped_in_time(node: Any) -> None:
    """Assert that SIGTERM ends the service."""
    code, _, err = node.stop()
    assert code == 0, err
    assert "Traceback" not in err


def under(start_node: Callable[..., Any], case: Case, seconds: float) -> tuple[Looks, float]:
    """Return what was seen during an attack, and the largest share of lost honest frames."""
    with besieged(start_node, *case.words) as node:
        before = honest_losses(node)
        seen = attacked(case.attack, node, seconds)
        lost = honest_losses(node) - before
        stopped_in_time(node)
    return seen, lost.share


@pytest.mark.parametrize("name", CASES)
def test_attack_costs_no_beam_and_no_bound(start_node: Any, name: str) -> None:
    seen, lost = under(start_node, CASES[name], SHORT_S)
    check(seen, CASES[name])
    assert lost < 0.05, str(seen)


@pytest.mark.soak
@pytest.mark.parametrize("name", CASES)
def test_attack_is_withstood_for_longer(start_node: Any, table: Any, name: str) -> None:
    seen, lost = under(start_node, CASES[name], LONG_S)
    table.add(f"{name}: /healthz, p99", seen.health_ms(99), "ms", "<= 100 ms")
    table.add(f"{name}: looks without beams", len(seen.without_beams), "", "0")
    table.add(f"{name}: bounds broken unannounced", len(seen.broken), "", "0")
    table.add(f"{name}: memory", seen.grown_mb, "MB", f"+{CASES[name].grows_mb:g} MB")
    table.add(f"{name}: honest frames lost", 100 * lost, "%", "<= 1 %")
    check(seen, CASES[name])
    assert lost <= 0.01
    assert seen.health_ms(99) <= 100
