"""Five attacks at once on a service: beams in each look, no broken bound, and an end in time."""

import threading
from typing import Any

import attacks
import pytest
from siege import attacked, besieged
from support import HANG_S

SECONDS = 4.0
ROUNDS = 3  # most attacks until one costs no beam
AT_ONCE = (
    attacks.pipelined(2),
    attacks.pings(5),
    attacks.forged_carrier(0.5),
    attacks.drifting(2.0, 10.0, fresh_ports=True, ahead_s=0.05),
    attacks.ghosts(1000.0),
)


def all_at_once(node: Any, until: threading.Event) -> None:
    """Run all attacks, each on a thread."""
    running = [
        threading.Thread(target=attack, args=(node, until), daemon=True) for attack in AT_ONCE
    ]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join(HANG_S)


@pytest.mark.full  # a slow machine that runs other tests too cannot fly the honest vehicles
def test_attacks_at_once_cost_no_beam_and_no_bound(start_node: Any) -> None:
    with besieged(start_node) as node:
        for _ in range(ROUNDS):  # other load may keep the carrier's own frames from being sent
            seen = attacked(all_at_once, node, SECONDS)
            assert seen.looks
            assert seen.broken == []
            if not seen.without_beams:
                break
        code, _, err = node.stop()
    assert seen.without_beams == []
    assert code == 0
    assert "Traceback" not in err


def test_service_ends_while_answers_are_computed(start_node: Any) -> None:
    """Requests that nobody awaits any more leave no thread that keeps the process."""
    with besieged(start_node) as node:
        until = threading.Event()
        attacker = threading.Thread(
            target=attacks.distinct_requests(20), args=(node, until), daemon=True
        )
        attacker.start()
        before = node.json("/v1/status")["updates"]
        node.wait_until("/v1/status", lambda status: status["updates"] > before + 10)
        code, _, err = node.stop()
        until.set()
        attacker.join(HANG_S)
    assert code == 0, err
    assert "Traceback" not in err
