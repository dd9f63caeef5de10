"""Who serves whom: against every assignment there is, and the same from whichever order."""

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.pipeline.fleet.assignment import UNSURE_DB, assign, worth_db
from companion.values import Offer

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
    """What all UAVs have together: their worth, less what shared power costs."""
    load = {node: list(found.values()).count(node) for node in offers}
    shared = sum(10 * n * math.log10(n) for n in load.values() if n)
    return sum(offers[node][uav] for uav, node in found.items()) - shared


def best_db(offers: dict[str, dict[str, float]]) -> float:
    """The greatest total over all assignments that leave nobody out who can be served."""
    uavs = sorted({uav for one in offers.values() for uav in one})
    choices = [[node for node in offers if uav in offers[node]] for uav in uavs]
    return max(
        total_db(dict(zip(uavs, nodes, strict=True)), offers)
        for nodes in itertools.product(*choices)
    )


@given(OFFERS)
@settings(max_examples=examples(200))
def test_nobody_is_left_out_and_little_is_lost(offers: dict[str, dict[str, float]]) -> None:
    found = assign(offers, {}, ROOM, 0.0)
    assert found.keys() == {uav for one in offers.values() for uav in one}
    assert all(uav in offers[node] for uav, node in found.items())
    if found:
        # Single moves end where no single move helps: a swap of two may still.
        assert best_db(offers) - total_db(found, offers) <= 4.0


@given(OFFERS, st.randoms(use_true_random=False))
@settings(max_examples=examples(100))
def test_order_of_arrival_means_nothing(
    offers: dict[str, dict[str, float]], random: object
) -> None:
    mixed = {}
    for node in sorted(offers, key=lambda _: random.random()):  # type: ignore[attr-defined]
        items = sorted(offers[node].items(), key=lambda _: random.random())  # type: ignore[attr-defined]
        mixed[node] = dict(items)
    assert assign(mixed, {}, ROOM, 3.0) == assign(offers, {}, ROOM, 3.0)


@given(OFFERS)
@settings(max_examples=examples(100))
def test_what_is_assigned_stays(offers: dict[str, dict[str, float]]) -> None:
    found = assign(offers, {}, ROOM, 0.0)
    assert assign(offers, found, ROOM, 0.0) == found


def test_a_little_better_is_no_reason_to_move() -> None:
    offers = {"a": {"1:1": 18.0}, "b": {"1:1": 20.5}}
    assert assign(offers, {"1:1": "a"}, ROOM | {"b": 10}, 3.0) == {"1:1": "a"}
    assert assign(offers, {"1:1": "a"}, ROOM, 2.0) == {"1:1": "b"}
    assert assign(offers, {}, ROOM, 3.0) == {"1:1": "b"}


def test_load_is_shared() -> None:
    uavs = [f"{n}:1" for n in range(12)]
    offers = {node: dict.fromkeys(uavs, 18.0) for node in NODES}
    found = assign(offers, {}, ROOM, 0.0)
    assert [list(found.values()).count(node) for node in NODES] == [4, 4, 4]
    # What a node serves beside those of the offers counts as much.
    beside = assign(offers, {}, ROOM | {"a": 50}, 0.0, {"a": 8})
    assert list(beside.values()).count("a") == 0


def test_no_node_has_more_than_its_room() -> None:
    uavs = [f"{n}:1" for n in range(9)]
    offers = {"a": dict.fromkeys(uavs, 30.0), "b": dict.fromkeys(uavs, 1.0)}
    found = assign(offers, {}, {"a": 2, "b": 4}, 0.0)
    assert sorted(found.values()) == ["a"] * 2 + ["b"] * 4


def test_a_full_node_makes_room_for_who_has_no_other() -> None:
    offers = {"a": {"1:1": 30.0, "2:1": 20.0, "3:1": 10.0}, "b": {"1:1": 5.0, "2:1": 12.0}}
    held = {"1:1": "a", "2:1": "a"}
    assert assign(offers, held, {"a": 2, "b": 2}, 3.0) == {"1:1": "a", "2:1": "b", "3:1": "a"}
    assert "3:1" not in assign(offers, held, {"a": 2, "b": 0}, 3.0)


@pytest.mark.parametrize(
    ("sure", "likely", "sinr", "worth"),
    [
        (12.0, 17.0, 25.0, 25.0),
        (None, 17.0, 25.0, 25.0 - UNSURE_DB),
        (None, None, None, None),
    ],
)
def test_what_is_only_likely_is_worth_less(
    sure: float | None, likely: float | None, sinr: float | None, worth: float | None
) -> None:
    assert worth_db(Offer("1:1", sure, likely, sinr, 0.1)) == worth


def test_who_has_no_other_choice_comes_first() -> None:
    offers = {"a": {"1:1": 30.0, "2:1": 20.0}, "b": {"1:1": 29.0, "3:1": 5.0}}
    assert assign(offers, {}, {"a": 1, "b": 1}, 0.0) == {"2:1": "a", "3:1": "b"}


def test_who_moves_away_leaves_a_place() -> None:
    offers = {"a": {"1:1": 10.0, "2:1": 20.0, "3:1": 30.0}, "b": {"1:1": 20.0, "3:1": 10.0}}
    held = {"1:1": "a", "2:1": "a", "3:1": "b"}
    moved = {"1:1": "b", "2:1": "a", "3:1": "a"}
    assert assign(offers, held, {"a": 2, "b": 5}, 3.0) == moved
