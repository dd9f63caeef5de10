"""Nodes that are present but do not answer."""

from itertools import pairwise

from companion.node.fleet.answering import BLOCKED_NS, SESSION_INTERVAL_MAX_NS, Unanswered

S = 1_000_000_000
PATIENCE_NS = 6 * S


def looks(kept: Unanswered, begin_s: int, end_s: int, heard_ns: dict[str, int]) -> list[int]:
    """Return the seconds at which a node is unresponsive; ``south`` is queried and checked each
    second."""
    found = []
    for second in range(begin_s, end_s):
        kept.asked(second * S, "south")
        if kept.unresponsive(second * S, heard_ns):
            found.append(second)
    return found


def test_unresponsive_node_is_reported_with_growing_intervals() -> None:
    kept = Unanswered(PATIENCE_NS)
    kept.alive.add("south")
    found = looks(kept, 0, 400, {})
    waits = [after - before for before, after in pairwise(found)]
    assert found[0] == 6
    assert waits[:3] == [12, 24, 48]
    assert set(waits[3:]) == {SESSION_INTERVAL_MAX_NS // S}


def test_answering_node_is_not_unresponsive() -> None:
    kept = Unanswered(PATIENCE_NS)
    kept.alive.add("south")
    assert looks(kept, 0, 6, {}) == []
    kept.answered("south")
    assert looks(kept, 6, 14, {}) == [12]


def test_report_interval_resets_after_a_calm_period() -> None:
    kept = Unanswered(PATIENCE_NS)
    kept.alive.add("south")
    assert looks(kept, 0, 7, {}) == [6]
    kept.alive.clear()
    assert looks(kept, 7, 620, {}) == []
    kept.alive.add("south")
    assert looks(kept, 620, 640, {}) == [626, 638]


def test_invented_node_names_cost_at_most_one_session_per_minute() -> None:
    kept = Unanswered(PATIENCE_NS)
    found = 0
    for second in range(600):
        name = f"made-up-{second // 10}"
        kept.alive = {name}
        kept.asked(second * S, name)
        found += bool(kept.unresponsive(second * S, {}))
    assert found <= 13


def test_node_with_messages_but_without_liveliness_counts_as_present() -> None:
    kept = Unanswered(PATIENCE_NS)
    assert looks(kept, 0, 20, {"south": 19 * S}) == [6, 18]


def test_absent_node_is_gone_rather_than_unresponsive() -> None:
    kept = Unanswered(PATIENCE_NS)
    assert looks(kept, 0, 20, {"south": -10 * S}) == []
    assert kept.gone(0, {"south": -PATIENCE_NS, "west": -PATIENCE_NS - 1}) == ["west"]
    kept.alive.add("west")
    assert kept.gone(0, {"west": -PATIENCE_NS - 1}) == []


def test_queued_answers_of_a_suspended_process_are_awaited() -> None:
    kept = Unanswered(PATIENCE_NS)
    kept.alive.add("south")
    assert looks(kept, 0, 3, {}) == []
    stopped_ns = 2 * S + 10 * BLOCKED_NS
    assert kept.unresponsive(stopped_ns, {}) == []
    kept.asked(stopped_ns, "south")
    assert kept.unresponsive(stopped_ns + S, {}) == []
