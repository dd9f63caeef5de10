"""Assignment of UAVs to nodes: optimal by exhaustive search, and independent of the order of
offers."""

import itertools
import math
import random
from collections import Counter

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import examples

from companion.pipeline.fleet import assignment
from companion.pipeline.fleet.assignment import LIKELY_PENALTY_DB, assign, offer_value_db
from companion.values import FloatArray, Offer

NODES = ("a", "b", "c")
OFFERS = st.fixed_dictionaries(
    {
        node: st.dictionaries(
            st.sampled_from([f"{n}:1" for n in range(6)]),
            st.integers(-100, 400).map(lambda tenths: tenths / 10),
        )
        for node in NODES
    }
)
ROOM = dict.fromkeys(NODES, 10)


def total_db(found: dict[str, str], offers: dict[str, dict[str, float]]) -> float:
    """Return the total value of an assignment: offer values less the cost of shared power."""
    load = {node: list(found.values()).count(node) for node in offers}
    shared = sum(10 * n * math.log10(n) for n in load.values() if n)
    return sum(offers[node][uav] for uav, node in found.items()) - shared


def best(offers: dict[str, dict[str, float]], room: dict[str, int]) -> tuple[int, float]:
    """Return the largest number of UAVs that can be served, and the best total with that number."""
    uavs = sorted({uav for one in offers.values() for uav in one})
    choices = [[None, *(node for node in offers if uav in offers[node])] for uav in uavs]
    found = []
    for nodes in itertools.product(*choices):
        served = {uav: node for uav, node in zip(uavs, nodes, strict=True) if node is not None}
        load = Counter(served.values())
        if all(load[node] <= room[node] for node in room):
            found.append((len(served), total_db(served, offers)))
    return max(found)


@given(OFFERS, st.fixed_dictionaries({node: st.sampled_from((0, 1, 2, 10)) for node in NODES}))
@settings(max_examples=examples(200))
@example(
    {
        "a": dict.fromkeys(("0:1", "1:1", "2:1"), 0.0),
        "b": {"0:1": 0.0, "1:1": 0.0},
        "c": {"0:1": 0.0},
    },
    ROOM,
)  # two UAVs must move for one
@example(
    {
        "a": {"0:1": 0.0, "1:1": 0.0, "2:1": 10.0, "3:1": 20.0},
        "b": {"0:1": 0.0, "2:1": 5.0, "3:1": 0.0},
        "c": {"0:1": 0.0, "1:1": 0.0, "3:1": 10.0},
    },
    ROOM,
)  # three UAVs swap nodes
def test_assignment_is_optimal(offers: dict[str, dict[str, float]], room: dict[str, int]) -> None:
    found = assign(offers, {}, room, 0.0)
    assert all(uav in offers[node] for uav, node in found.items())
    count, greatest_db = best(offers, room)
    assert len(found) == count
    assert total_db(found, offers) == pytest.approx(greatest_db, abs=1e-6)


@given(
    OFFERS, st.dictionaries(st.sampled_from([f"{n}:1" for n in range(6)]), st.sampled_from(NODES))
)
@settings(max_examples=examples(200))
@example(
    {node: {f"{n}:1": 20.0 for n in range(6)} for node in NODES}, {f"{n}:1": "a" for n in range(6)}
)
def test_assignment_is_optimal_from_any_start(
    offers: dict[str, dict[str, float]], held: dict[str, str]
) -> None:
    found = assign(offers, held, ROOM, 0.0)
    assert (len(found), pytest.approx(total_db(found, offers), abs=1e-6)) == best(offers, ROOM)


@given(OFFERS, st.randoms(use_true_random=False))
@settings(max_examples=examples(100))
def test_assignment_does_not_depend_on_offer_order(
    offers: dict[str, dict[str, float]], random: object
) -> None:
    mixed = {}
    for node in sorted(offers, key=lambda _: random.random()):  # type: ignore[attr-defined]
        items = sorted(offers[node].items(), key=lambda _: random.random())  # type: ignore[attr-defined]
        mixed[node] = dict(items)
    assert assign(mixed, {}, ROOM, 3.0) == assign(offers, {}, ROOM, 3.0)


@given(OFFERS)
@settings(max_examples=examples(100))
def test_assignment_is_stable(offers: dict[str, dict[str, float]]) -> None:
    found = assign(offers, {}, ROOM, 0.0)
    assert assign(offers, found, ROOM, 0.0) == found


def test_work_of_a_decision_is_bounded_and_the_next_one_continues(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Names of nodes are free: 256 of them offer the UAVs of one, and more than it can give."""
    rng = random.Random(1)
    uavs = [f"{number}:1" for number in range(12)]
    offers = {f"n{node}": {uav: rng.uniform(0.0, 30.0) for uav in uavs} for node in range(256)}
    room = dict.fromkeys(offers, 64)
    rounds: list[int] = []
    search = assignment._positive_cycle

    def counted(edges: FloatArray) -> tuple[list[tuple[int, int]], int]:
        found = search(edges)
        rounds.append(found[1] * edges.size)
        return found

    monkeypatch.setattr(assignment, "_positive_cycle", counted)
    monkeypatch.setattr(assignment, "WORK_MAX", 3_000_000)
    served = dict.fromkeys(uavs, "n0")
    decisions = 0
    while decisions < 30:
        decisions += 1
        rounds.clear()
        before, served = served, assign(offers, served, room, 0.0)
        assert sum(rounds) < 2 * assignment.WORK_MAX
        if served == before:
            break
    assert decisions > 2
    monkeypatch.setattr(assignment, "WORK_MAX", 1 << 60)
    optimum = assign(offers, dict.fromkeys(uavs, "n0"), room, 0.0)
    assert total_db(served, offers) == pytest.approx(total_db(optimum, offers))


def test_uav_moves_only_for_more_than_the_margin() -> None:
    offers = {"a": {"1:1": 18.0}, "b": {"1:1": 20.5}}
    assert assign(offers, {"1:1": "a"}, ROOM | {"b": 10}, 3.0) == {"1:1": "a"}
    assert assign(offers, {"1:1": "a"}, ROOM, 2.0) == {"1:1": "b"}
    assert assign(offers, {}, ROOM, 3.0) == {"1:1": "b"}


def test_assignment_balances_load() -> None:
    uavs = [f"{n}:1" for n in range(12)]
    offers = {node: dict.fromkeys(uavs, 18.0) for node in NODES}
    found = assign(offers, {}, ROOM, 0.0)
    assert [list(found.values()).count(node) for node in NODES] == [4, 4, 4]
    # UAVs that a node serves besides the offered ones count as well.
    beside = assign(offers, {}, ROOM | {"a": 50}, 0.0, {"a": 8})
    assert list(beside.values()).count("a") == 0


def test_assignment_respects_node_capacity() -> None:
    uavs = [f"{n}:1" for n in range(9)]
    offers = {"a": dict.fromkeys(uavs, 30.0), "b": dict.fromkeys(uavs, 1.0)}
    found = assign(offers, {}, {"a": 2, "b": 4}, 0.0)
    assert sorted(found.values()) == ["a"] * 2 + ["b"] * 4


def test_full_node_makes_room_for_uav_without_alternative() -> None:
    offers = {"a": {"1:1": 30.0, "2:1": 20.0, "3:1": 10.0}, "b": {"1:1": 5.0, "2:1": 12.0}}
    held = {"1:1": "a", "2:1": "a"}
    assert assign(offers, held, {"a": 2, "b": 2}, 3.0) == {"1:1": "a", "2:1": "b", "3:1": "a"}
    assert "3:1" not in assign(offers, held, {"a": 2, "b": 0}, 3.0)


@pytest.mark.parametrize(
    ("sure", "likely", "sinr", "worth"),
    [
        (12.0, 17.0, 25.0, 25.0),
        (None, 17.0, 25.0, 25.0 - LIKELY_PENALTY_DB),
        (None, None, None, None),
    ],
)
def test_likely_gain_is_worth_less_than_guaranteed_gain(
    sure: float | None, likely: float | None, sinr: float | None, worth: float | None
) -> None:
    assert (
        offer_value_db(Offer(uav="1:1", sure_db=sure, likely_db=likely, sinr_db=sinr, heard_s=0.1))
        == worth
    )


def test_limited_capacity_goes_to_uavs_with_most_gain() -> None:
    offers = {"a": {"1:1": 30.0, "2:1": 20.0}, "b": {"1:1": 29.0, "3:1": 5.0}}
    assert assign(offers, {}, {"a": 1, "b": 1}, 0.0) == {"2:1": "a", "1:1": "b"}


def test_departing_uav_frees_capacity() -> None:
    offers = {"a": {"1:1": 10.0, "2:1": 20.0, "3:1": 30.0}, "b": {"1:1": 20.0, "3:1": 10.0}}
    held = {"1:1": "a", "2:1": "a", "3:1": "b"}
    moved = {"1:1": "b", "2:1": "a", "3:1": "a"}
    assert assign(offers, held, {"a": 2, "b": 5}, 3.0) == moved
