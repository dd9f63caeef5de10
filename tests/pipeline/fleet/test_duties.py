"""Claims, leases and handovers of two nodes whose messages the test passes or drops."""

from dataclasses import dataclass

import pytest

from companion.pipeline.fleet import duties as duties_module
from companion.pipeline.fleet.duties import (
    ASSIGNMENTS_PER_S,
    ASSIGNMENTS_SAVED,
    CLAIM_DELAY_NS,
    SETTLED_NS,
    WITHHELD_NS,
    Duties,
    Handover,
)
from companion.values import Standing

MS = 1_000_000
S = 1000 * MS
LEASE_NS = 1500 * MS
NODES = frozenset("ab")


@dataclass
class Pair:
    """Nodes a and b with 18 dB plus a test value per UAV; ``talk`` passes their messages."""

    offers: dict[str, dict[str, float]]
    now_ns: int = 1000 * S

    def __post_init__(self) -> None:
        self.nodes = {
            name: Duties(name=name, most=50, lease_ns=LEASE_NS, hysteresis_db=3.0)
            for name in sorted(NODES)
        }
        self.changes: list[Handover] = []

    def says(self, name: str) -> Standing:
        duties = self.nodes[name]
        serves, handing = tuple(duties.serves.items()), tuple(duties.handing.items())
        return Standing(
            node=name, place=None, reach_m=None, most=50, serves=serves, handing=handing
        )

    def step(self, talk: bool = True, alive: str = "ab") -> list[list[str]]:
        """Run one tick of 100 ms; return the serving nodes after each node's decision."""
        self.now_ns += 100 * MS
        seen = []
        words = {name: self.says(name) for name in alive}
        for name in alive:
            other = "b" if name == "a" else "a"
            if talk and other in alive:
                self.nodes[name].hear(self.now_ns, words[other])
            self.changes += self.nodes[name].decide(self.now_ns, self.offers, NODES - {name})
            seen.append([one for one in alive if self.nodes[one].serves])
        return seen

    def run(self, seconds: float, talk: bool = True, alive: str = "ab") -> list[list[str]]:
        """Run for some seconds."""
        return [one for _ in range(round(10 * seconds)) for one in self.step(talk, alive)]


def test_new_fleet_listens_before_one_node_serves() -> None:
    pair = Pair({"a": {"1:1": 20.0}, "b": {"1:1": 25.0}})
    seen = pair.run(5)
    assert not any(seen[: 2 * LEASE_NS // (100 * MS) - 2])
    assert seen[-1] == ["b"]
    assert ["a", "b"] not in seen


def test_handover_is_make_before_break() -> None:
    pair = Pair({"a": {"1:1": 20.0}, "b": {"1:1": 10.0}})
    pair.run(5)
    assert list(pair.nodes["a"].serves) == ["1:1"]
    pair.offers["b"]["1:1"] = 22.0  # better, but by less than the margin
    assert set(map(tuple, pair.run(5))) == {("a",)}
    pair.offers["b"]["1:1"] = 25.0
    began_ns = pair.now_ns
    seen = pair.run(5)
    assert [] not in seen
    assert seen[-1] == ["b"]
    assert seen.count(["a", "b"]) <= 2
    taken = [one for one in pair.changes if one.t_ns > began_ns and one.after == "b"]
    assert taken[0].before == "a"
    assert SETTLED_NS <= taken[0].t_ns - began_ns <= SETTLED_NS + S


def test_uavs_of_a_failed_node_are_taken_over_at_once() -> None:
    pair = Pair({"a": {"1:1": 20.0}, "b": {"1:1": 10.0}})
    pair.run(5)
    died_ns = pair.now_ns
    pair.nodes["b"].gone(died_ns, "a")
    pair.run(1, talk=False, alive="b")
    (taken,) = [one for one in pair.changes if one.t_ns > died_ns]
    assert (taken.before, taken.after) == (None, "b")
    assert taken.t_ns - died_ns <= 200 * MS


def test_uavs_of_a_silent_node_are_taken_over_after_its_lease() -> None:
    pair = Pair({"a": {"1:1": 20.0}, "b": {"1:1": 10.0}})
    pair.run(5)
    silent_ns = pair.now_ns
    pair.run(3, talk=False, alive="b")
    (taken,) = [one for one in pair.changes if one.t_ns > silent_ns]
    assert LEASE_NS <= taken.t_ns - silent_ns <= LEASE_NS + 300 * MS


def test_partition_lets_both_nodes_serve_and_reunion_leaves_one() -> None:
    for worth in (8.0, 20.0, 26.0):  # less than, equal to and more than the other's
        pair = Pair({"a": {"1:1": 20.0}, "b": {"1:1": worth}})
        pair.run(5)
        pair.offers["a"]["1:1"] = 5.0  # it appears during the partition
        seen = pair.run(5, talk=False)
        assert [] not in seen
        assert seen[-1] == ["a", "b"]
        healed = pair.run(1)
        assert [] not in healed
        assert len(healed[-1]) == 1
        assert [] not in pair.run(6)


def test_node_that_cannot_serve_hands_over_at_once() -> None:
    pair = Pair({"a": {"1:1": 20.0}, "b": {"1:1": 10.0}})
    pair.run(5)
    del pair.offers["a"]["1:1"]
    seen = pair.run(1.5)
    assert [] not in seen
    assert seen[-1] == ["b"]
    del pair.offers["b"]["1:1"]
    assert pair.run(1)[-1] == []


def test_full_node_accepts_no_more_uavs() -> None:
    pair = Pair({"a": {}, "b": {f"{n}:1": 10.0 for n in range(5)}})
    pair.nodes["b"] = Duties(name="b", most=3, lease_ns=LEASE_NS, hysteresis_db=3.0)
    pair.run(6)
    assert len(pair.nodes["b"].serves) == 3


def test_full_node_serves_the_uavs_that_come_first_in_its_offers() -> None:
    """Those that came later displace others of a lower rank, and no others."""
    duties = Duties(name="a", most=3, lease_ns=LEASE_NS, hysteresis_db=3.0)

    def run(offers: dict[str, float], begin_s: int) -> list[str]:
        for tick in range(60):
            duties.decide((begin_s * 10 + tick) * 100 * MS, {"a": offers}, frozenset())
        return sorted(duties.serves)

    invented = {f"{number}:1": 30.0 for number in range(11, 21)}
    assert run(invented, 1000) == ["11:1", "12:1", "13:1"]
    assert run(invented | {"1:1": 10.0}, 1010) == ["11:1", "12:1", "13:1"]
    assert run({"1:1": 10.0, **invented}, 1020) == ["11:1", "12:1", "1:1"]


def test_assignments_are_limited_however_often_nodes_come_and_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[int] = []
    monkeypatch.setattr(duties_module, "assign", lambda *_: made.append(1) or {})
    duties = Duties(name="a", most=3, lease_ns=LEASE_NS, hysteresis_db=3.0)
    for tick in range(300):
        now_ns = 1000 * S + tick * 100 * MS
        duties.hear(now_ns, said(f"n{tick}"))
        duties.gone(now_ns, f"n{tick - 5}")
        duties.decide(now_ns, {"a": {"1:1": 9.0}}, frozenset(f"n{n}" for n in range(300)))
    assert len(made) <= ASSIGNMENTS_SAVED + 30 * ASSIGNMENTS_PER_S + 1


def test_second_node_serves_what_the_assigned_node_does_not() -> None:
    """The assigned node may not receive the UAV: the other does not wait for it forever."""
    pair = Pair({"a": {"1:1": 20.0}, "b": {"1:1": 10.0}})
    for _ in range(60):
        pair.now_ns += 100 * MS
        pair.nodes["b"].hear(pair.now_ns, said("a"))
        pair.nodes["b"].decide(pair.now_ns, pair.offers, frozenset("a"))
    assert list(pair.nodes["b"].serves) == ["1:1"]
    assert CLAIM_DELAY_NS < LEASE_NS


def said(node: str, *serves: tuple[str, float]) -> Standing:
    return Standing(node=node, place=None, reach_m=None, most=50, serves=serves)


class Alone:
    """Node a of several; the test gives the other nodes' messages."""

    def __init__(self, **offers: float) -> None:
        self.duties = Duties(name="a", most=50, lease_ns=LEASE_NS, hysteresis_db=3.0)
        self.now_ns = 1000 * S
        self.worth = offers

    def run(self, seconds: float, *words: Standing, trusted: str = "bc") -> None:
        """Run for some seconds in which the others repeat their messages."""
        for _ in range(round(10 * seconds)):
            self.now_ns += 100 * MS
            for word in words:
                self.duties.hear(self.now_ns, word)
            offers = {node: {"1:1": worth} for node, worth in self.worth.items()}
            self.duties.decide(self.now_ns, offers, frozenset(trusted))


def test_claims_of_an_excluded_node_are_ignored() -> None:
    node = Alone(a=20.0, b=30.0)
    node.run(5, said("b", ("1:1", 30.0)))
    assert not node.duties.serves
    node.run(5, said("b", ("1:1", 30.0)), trusted="c")
    assert list(node.duties.serves) == ["1:1"]


def test_handover_is_released_only_to_its_target() -> None:
    node = Alone(a=20.0, b=10.0, c=10.0)
    node.run(4, said("b"), said("c"))
    node.worth["b"] = 30.0
    node.run(3, said("b"), said("c"))
    assert node.duties.handing == {"1:1": "b"}
    node.run(
        0.5, said("b"), said("c", ("1:1", 10.0))
    )  # after a partition in which it also served the UAV
    assert list(node.duties.serves) == ["1:1"]
    node.run(0.1, said("b", ("1:1", 30.0)), said("c"))
    assert not node.duties.serves


def test_alternating_best_node_starts_no_handover() -> None:
    node = Alone(a=10.0, b=1.0, c=1.0)
    node.run(4, said("b"), said("c"))
    for better, other in ("bc", "cb", "bc"):
        node.worth |= {better: 25.0, other: 1.0}
        node.run(1.5, said("b"), said("c"))
        assert not node.duties.handing
    node.run(1.0, said("b"), said("c"))
    assert node.duties.handing == {"1:1": "b"}


def test_claims_without_a_similar_offer_take_no_uav() -> None:
    """Otherwise a node takes every UAV by claiming impossible values."""
    node = Alone(a=20.0)
    node.run(4, said("b"))
    node.run(1, said("b", ("1:1", 200.0)))  # no offer at all
    assert list(node.duties.serves) == ["1:1"]
    node.worth["b"] = 179.0
    node.run(0.1, said("b", ("1:1", 200.0)))
    assert list(node.duties.serves) == ["1:1"]
    node.worth["b"] = 181.0
    node.run(0.1, said("b", ("1:1", 200.0)))
    assert not node.duties.serves


def test_equal_claims_are_kept_by_the_first_node_by_name() -> None:
    node = Alone(a=20.0, b=20.0)
    node.run(4, said("b"))
    node.run(1, said("b", ("1:1", 20.0)))
    assert list(node.duties.serves) == ["1:1"]
    node.run(0.1, said("b", ("1:1", 20.1)))
    assert not node.duties.serves


def test_uav_that_a_worse_node_keeps_is_taken() -> None:
    """It claimed the UAV before any other node received it, and offers next to nothing."""
    node = Alone(b=-290.0)
    node.run(4, said("b", ("1:1", -290.0)))
    node.worth["a"] = 20.0
    node.run(WITHHELD_NS / S - 0.5, said("b", ("1:1", -290.0)))
    assert not node.duties.serves
    node.run(2, said("b", ("1:1", -290.0)))
    assert list(node.duties.serves) == ["1:1"]


@pytest.mark.parametrize("worth", [18.0, 20.0, 25.0])
def test_uav_that_a_similar_node_keeps_is_left_to_it(worth: float) -> None:
    node = Alone(a=20.0, b=worth)
    node.run(20, said("b", ("1:1", worth)))
    assert not node.duties.serves
