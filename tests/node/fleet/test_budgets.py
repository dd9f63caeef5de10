"""Budgets of other nodes: a node under many names takes nothing from the others."""

import pytest

from companion.node.fleet.budgets import (
    ALL_BYTES_PER_S,
    BYTES_SAVED,
    GUARANTEED_BYTES_PER_S,
    NODE_BYTES_PER_S,
    PRESENCE_PER_S,
    PRESENCE_SAVED,
    NodeBudgets,
)
from companion.node.fleet.messages import FleetMessageError
from companion.pipeline.fleet.member import NODES_MAX

LARGE = 50_000


def parsed(budgets: NodeBudgets, node: str, size: int, now_s: float) -> int:
    """Return the bytes of a message that are parsed."""
    try:
        budgets.spend(node, size, now_s)
    except FleetMessageError:
        return 0
    return size


def test_a_node_has_half_a_megabyte_each_second() -> None:
    budgets = NodeBudgets()
    took = sum(parsed(budgets, "a", LARGE, at / 100) for at in range(3000))
    rates = NODE_BYTES_PER_S + GUARANTEED_BYTES_PER_S
    assert took == pytest.approx(30 * rates + BYTES_SAVED, rel=0.02)


def test_many_names_share_one_budget_and_delay_no_small_node() -> None:
    """Two hundred names, each well within the budget of a single node."""
    budgets = NodeBudgets()
    took = 0
    for at in range(3000):
        took += parsed(budgets, f"n{at % 200}", LARGE, at / 100)
        if at % 20 == 0:  # five times a second, as a standing
            assert parsed(budgets, "honest", 3000, at / 100)
    sure = 200 * 100_000 + 30 * 200 * GUARANTEED_BYTES_PER_S
    assert took <= 30 * ALL_BYTES_PER_S + BYTES_SAVED + sure
    with pytest.raises(FleetMessageError, match="of all nodes"):
        for number in range(200):
            budgets.spend(f"n{number}", LARGE, 30.0)


def test_names_beyond_the_limit_share_the_budget_of_one() -> None:
    budgets = NodeBudgets()
    for number in range(NODES_MAX):
        budgets.spend(f"n{number}", 1, 0.0)
    took = sum(parsed(budgets, f"more{number}", LARGE, 0.0) for number in range(1000))
    assert took <= 2 * BYTES_SAVED


def test_nodes_may_come_and_go_at_a_limited_rate() -> None:
    budgets = NodeBudgets()
    processed = sum(budgets.spend_presence(at / 1000) for at in range(60_000))
    assert processed == pytest.approx(PRESENCE_SAVED + 60 * PRESENCE_PER_S, abs=2)
