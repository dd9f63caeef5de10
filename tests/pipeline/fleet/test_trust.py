"""Trust in nodes: contradictions exclude a node, a single hidden vehicle does not."""

from collections import Counter

from companion.pipeline.fleet.trust import (
    CONTRADICTIONS,
    EXCLUDED_NS,
    PHANTOM_AFTER_NS,
    Trust,
    UnconfirmedVehicle,
    Witness,
)
from companion.values import Notice

S = 1_000_000_000
HERE = Witness((0.0, 0.0, 0.0), 1000.0, frozenset({"1:1"}))


def look(
    trust: Trust,
    told: list[UnconfirmedVehicle],
    witnesses: dict[str, Witness],
    seconds: int,
    others: int = 0,
) -> list[str]:
    said = []
    for second in range(seconds):
        heard = Counter(one.node for one in told)
        said += trust.check_vehicles(second * S, told, witnesses, heard + Counter({"b": others}))
    return [notice.text for notice in said]


def test_node_is_excluded_after_several_contradictions() -> None:
    trust = Trust()
    for number in range(CONTRADICTIONS - 1):
        assert trust.note_contradiction(number * S, "b", "lies") == []
    assert trust.is_trusted("b")
    assert trust.note_contradiction(100 * S, "b", "lies") == []  # the others are too old
    (notice, *_) = [
        n
        for t in range(CONTRADICTIONS)
        for n in trust.note_contradiction((101 + t) * S, "b", "lies")
    ]
    assert "node b is excluded for 5 minutes: it lies" in notice.text
    assert not trust.is_trusted("b")
    assert trust.is_trusted("c")
    assert trust.readmit(110 * S) == []
    (again,) = trust.readmit(110 * S + EXCLUDED_NS)
    assert "trusted again" in again.text
    assert trust.is_trusted("b")


def test_dispute_of_two_nodes_is_told_once_a_minute_and_excludes_neither() -> None:
    trust, said = Trust(), list[Notice]()
    for number in range(100):
        said += trust.note_dispute(number * S, "6:1", "c", "b")
    assert [one.t_ns for one in said] == [0, 60 * S]
    assert said[0].text == ("node c shares other positions of 6:1 than node b, which is believed")
    assert trust.is_trusted("b") and trust.is_trusted("c")
    trust.forget(200 * S)
    assert trust._disputed_ns == {}


def test_false_reports_of_one_vehicle_exclude_nobody() -> None:
    """The sender here may be a stranger: the node's other vehicles would lose their beams."""
    trust = Trust()
    for number in range(20):
        assert trust.note_false_report(number * S, "6:1", "b") == []
    said = [n for t in range(20, 23) for n in trust.note_false_report(t * S, "7:1", "b")]
    assert [one.text for one in said] == [
        "node b is excluded for 5 minutes: it shares reports that contradict those received here"
    ]
    trust.forget(100 * S)
    assert trust._false_ns == {}


def test_node_sharing_only_unconfirmed_vehicles_is_excluded() -> None:
    trust = Trust()
    phantoms = [
        UnconfirmedVehicle("66:1", "b", (300.0, 0.0, 0.0)),
        UnconfirmedVehicle("67:1", "b", (0.0, 400.0, 0.0)),
    ]
    far = Witness((5000.0, 0.0, 0.0), 1000.0, frozenset())  # it receives nothing and cannot confirm
    said = look(trust, phantoms, {"a": HERE, "c": far}, PHANTOM_AFTER_NS // S + 2)
    assert len(said) == 1
    assert "node b is excluded for 5 minutes" in said[0]
    assert "66:1, 67:1" in said[0]


def test_single_hidden_vehicle_is_unconfirmed_without_exclusion() -> None:
    trust = Trust()
    hidden = [UnconfirmedVehicle("66:1", "b", (300.0, 0.0, 0.0))]
    (said,) = look(trust, hidden, {"a": HERE}, 60)
    assert (
        "node b shares 66:1, which other nodes should receive, but do not: hidden by an obstacle,"
        " or forged"
    ) in said
    assert trust.unconfirmed == {"66:1"}
    assert trust.is_trusted("b")


def test_few_unconfirmed_vehicles_are_reported_without_exclusion() -> None:
    """Only the node beside a team behind a building receives it."""
    trust = Trust()
    hidden = [UnconfirmedVehicle(f"6{n}:1", "b", (100.0 + n, 0.0, 0.0)) for n in range(4)]
    (said,) = look(trust, hidden, {"a": HERE}, 60, others=6)
    assert "60:1, 61:1, 62:1, 63:1" in said
    assert trust.is_trusted("b")


def test_distant_or_confirmed_vehicle_is_not_unconfirmed() -> None:
    trust = Trust()
    far = [UnconfirmedVehicle(f"6{n}:1", "b", (900.0 + n, 0.0, 0.0)) for n in range(5)]
    assert look(trust, far, {"a": HERE}, 60) == []
    near = [UnconfirmedVehicle(f"6{n}:1", "b", (100.0 + n, 0.0, 0.0)) for n in range(5)]
    heard = Witness((0.0, 0.0, 0.0), 1000.0, frozenset(one.uav for one in near))
    assert look(trust, near, {"a": HERE, "c": heard}, 60) == []
    assert look(trust, near, {"b": HERE}, 60) == []  # a node does not confirm its own reports
    deaf = Witness((0.0, 0.0, 0.0), 10.0, frozenset())
    assert look(trust, near, {"a": deaf}, 60) == []
    assert trust.unconfirmed == frozenset()
