"""One node of a fleet: the state that it keeps of other nodes, and what it forgets."""

import struct

from pymavlink.dialects.v20 import common

from companion.pipeline.fleet.member import (
    FORGET_NS,
    GONE_MAX,
    NODES_MAX,
    UAVS_GUARANTEED,
    UAVS_MAX,
    FleetMember,
)
from companion.pipeline.fleet.trust import CONTRADICTIONS, PHANTOM_AFTER_NS, Witness
from companion.settings.fleet import FleetSettings
from companion.values import Offer, Shared, SharedFrame, Standing

MS = 1_000_000
S = 1000 * MS
START_NS = 1_800_000_000 * S


def member(**settings: object) -> FleetMember:
    return FleetMember(
        name="a",
        settings=FleetSettings.model_validate({"node": "a", **settings}),
        elements=16,
        started_ns=START_NS,
    )


def standing(node: str, serves: tuple[str, ...] = ()) -> Standing:
    each = tuple((uav, 20.0) for uav in serves)
    return Standing(node=node, place=(47.0, 8.0, 0.0), reach_m=500.0, most=16, serves=each)


def word(now_ns: int, number: int) -> Shared:
    """Return what a node on the same clock received 2 ms ago."""
    mav = common.MAVLink(None, srcSystem=1, srcComponent=1)
    message = common.MAVLink_global_position_int_message(
        1000 + number, 473977000, 85456000, 0, 0, 0, 0, 0, 0
    )
    return Shared(now_ns, (SharedFrame(now_ns - 2 * MS, bytes(message.pack(mav))),))


def test_node_announces_position_reach_and_capacity() -> None:
    node = member(most=5)
    said = node.own_standing(START_NS + 3 * S, (47.0, 8.0, 400.0), 750.0)
    assert said.node == "a"
    assert (said.place, said.reach_m, said.most) == ((47.0, 8.0, 400.0), 750.0, 5)
    assert (said.serves, said.handing) == ((), ())


def test_message_after_node_departure_is_eventually_forgotten() -> None:
    node = member()
    node.node_joined(START_NS, "b")
    assert [notice.text for notice in node.node_left(START_NS + S, "b")] == ["node b disconnected"]
    assert node.gone == {"b": (START_NS + S, None)}
    node.take_standing(START_NS + 2 * S, standing("b"))
    assert list(node.neighbours) == ["b"]
    assert not node.gone
    node.decide(START_NS + FORGET_NS)
    assert list(node.neighbours) == ["b"]
    node.decide(START_NS + 2 * FORGET_NS)
    assert not node.neighbours


def test_departed_nodes_are_remembered_in_bounded_number() -> None:
    node = member()
    for number in range(GONE_MAX + 6):
        node.node_joined(START_NS, str(number))
        node.node_left(START_NS + number, str(number))
    assert list(node.gone) == [str(number) for number in range(6, GONE_MAX + 6)]
    node.decide(START_NS + FORGET_NS + 8)
    assert next(iter(node.gone)) == "8"


def test_clock_answer_of_a_departed_node_does_not_revive_it() -> None:
    """Zenoh's threads answer for the clock while the node's own loop is stalled."""
    node = member()
    node.read_clock("b", START_NS, START_NS, START_NS + MS, START_NS)
    assert not node.neighbours
    node.node_joined(START_NS, "b")
    node.read_clock("b", START_NS, START_NS + S, START_NS + S + MS, START_NS + S)
    assert node.neighbours["b"].heard_ns == START_NS


def test_invented_nodes_expire() -> None:
    node = member()
    for number in range(NODES_MAX + 10):
        node.take_standing(START_NS, standing(f"n{number}"))
    node.take_standing(START_NS, standing("b"))
    assert len(node.neighbours) == NODES_MAX
    assert "b" not in node.neighbours
    node.decide(START_NS + 2 * FORGET_NS)
    node.take_standing(START_NS + 2 * FORGET_NS, standing("b"))
    assert list(node.neighbours) == ["b"]


def test_uavs_in_the_messages_of_all_nodes_are_bounded() -> None:
    """A node may publish under many names. What others published before is kept."""
    node = member()
    many = tuple(f"{number}:1" for number in range(UAVS_MAX // 4))
    for name in "cdef":
        assert node.take_standing(START_NS, standing(name, many))
    assert not node.take_standing(START_NS, standing("g", many))
    assert node.take_standing(START_NS, standing("g", many[:UAVS_GUARANTEED]))
    offers = tuple(
        Offer(uav=uav, sure_db=None, likely_db=None, sinr_db=None, heard_s=0.1) for uav in many
    )
    assert not node.take_offers(START_NS, "c", offers)
    assert node.take_offers(START_NS, "c", offers[:UAVS_GUARANTEED])
    assert node.take_standing(START_NS, standing("c", many))  # replaces one as large
    node.node_left(START_NS, "d")
    assert node.take_offers(START_NS, "c", offers[: UAVS_MAX // 8])


def test_first_clock_answers_do_not_suffice_to_use_frames() -> None:
    """The uncertainty with which a frame was placed stays with its sender's clock."""
    node, now_ns = member(), START_NS
    node.node_joined(now_ns, "b")
    for number, wide_ms in enumerate((900, 4, 4)):
        now_ns += 500 * MS
        events, _ = node.take_shared(now_ns, "b", word(now_ns, number))
        assert events == []
        node.read_clock("b", START_NS, now_ns - wide_ms * MS, now_ns, now_ns - wide_ms * MS // 2)
    (frame,), _ = node.take_shared(now_ns + MS, "b", word(now_ns + MS, 3))
    (boot_ms,) = struct.unpack_from("<I", frame.raw, 10)
    assert boot_ms == 1003
    assert frame.doubt_ns < 6 * MS


def test_unconfirmed_vehicle_is_reported_with_its_node() -> None:
    node = member()
    own = Witness((0.0, 0.0, 0.0), 1000.0, frozenset())
    offer = Offer(uav="66:1", sure_db=None, likely_db=None, sinr_db=None, heard_s=0.1)
    said = []
    for now_ns in range(START_NS, START_NS + 2 * PHANTOM_AFTER_NS, S):
        node.take_standing(now_ns, standing("b"))
        node.take_offers(now_ns, "b", (offer,))
        places = {"66:1": (300.0, 0.0, 0.0)}
        said += node.check_vehicles(now_ns, places, own, lambda _: (5000.0, 0.0, 0.0))
    assert node.trust.unconfirmed == {"66:1"}
    assert [(one.subject, one.text) for one in said] == [
        (
            "node b",
            "node b shares 66:1, which other nodes should receive, but do not: hidden by an"
            " obstacle, or forged",
        )
    ]


def test_uavs_of_other_nodes_are_protected_when_configured() -> None:
    for nulls, spares in ((True, ("2:1",)), (False, ())):
        node = member(nulls=nulls)
        node.take_standing(START_NS, standing("b", ("2:1",)))
        duty, _ = node.decide(START_NS + MS)
        assert duty is not None
        assert duty.spares == spares


def test_offers_of_distant_nodes_are_discarded() -> None:
    node = member()
    for name, place in (("b", (47.0, 8.0, 0.0)), ("c", (48.0, 8.0, 0.0))):
        node.take_standing(
            START_NS, Standing(node=name, place=place, reach_m=900.0, most=16, serves=())
        )
        node.take_offers(
            START_NS,
            name,
            (Offer(uav="1:1", sure_db=10.0, likely_db=10.0, sinr_db=10.0, heard_s=0.1),),
        )
    assert node.near == frozenset()
    node.own_standing(START_NS, (47.0, 8.01, 0.0), 900.0)
    assert node.near == {"b"}
    assert node.neighbours["b"].offers is not None
    assert node.neighbours["c"].offers is None


def answered(
    node: FleetMember, now_ns: int, ahead_s: float, started_ns: int, times: int = 3
) -> list[str]:
    """Feed answers of a node whose clock lags by that much, 4 ms apart; return the notices."""
    notices = []
    node.node_joined(now_ns, "b")
    for number in range(times):
        sent_ns = now_ns + number * 500 * MS
        remote_ns = sent_ns + 2 * MS - round(ahead_s * S)
        notices += node.read_clock("b", started_ns, sent_ns, sent_ns + 4 * MS, remote_ns)
    return [notice.text for notice in notices]


def test_restarted_node_gets_a_new_clock() -> None:
    node = member()
    assert answered(node, START_NS, 0.0, 1) == []
    (text,) = answered(node, START_NS + 10 * S, 100.0, 2)
    assert text.startswith("node b's clock is 99.998 s behind this one's")
    now_ns = START_NS + 12 * S
    said = word(now_ns - 100 * S, 1)
    (frame,), _ = node.take_shared(now_ns + MS, "b", said)
    assert frame.doubt_ns < 6 * MS
    assert node.trust.is_trusted("b")


def test_clock_ahead_is_reported() -> None:
    (text,) = answered(member(), START_NS, -5.0, 1)
    assert text.startswith("node b's clock is 4.998 s ahead of this one's")


def test_reports_of_an_excluded_node_are_not_used() -> None:
    node = member()
    answered(node, START_NS, 0.0, START_NS)
    now_ns = START_NS + 2 * S
    assert len(node.take_shared(now_ns, "b", word(now_ns, 1))[0]) == 1
    for _ in range(CONTRADICTIONS):
        node.trust.note_contradiction(now_ns, "b", "tells what cannot be")
    assert node.take_shared(now_ns, "b", word(now_ns, 2)) == ([], [])


def test_offers_expire() -> None:
    node, now_ns = member(), START_NS
    node.set_offers(
        {"1:1": Offer(uav="1:1", sure_db=10.0, likely_db=10.0, sinr_db=10.0, heard_s=0.1)}
    )

    def run(seconds: int) -> None:
        nonlocal now_ns
        for _ in range(10 * seconds):
            now_ns += 100 * MS
            node.take_standing(now_ns, standing("b"))
            node.decide(now_ns)

    run(3)
    assert list(node.duties.serves) == ["1:1"]
    node.take_offers(
        now_ns, "b", (Offer(uav="1:1", sure_db=25.0, likely_db=25.0, sinr_db=25.0, heard_s=0.1),)
    )
    run(4)
    assert node.duties.handing == {"1:1": "b"}
    run(8)
    assert not node.duties.handing
