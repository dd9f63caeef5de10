"""The service's own component: heartbeats, TIMESYNC, and detection of a duplicate id."""

import random
import struct
import tracemalloc
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect
from support import examples

from companion.mavlink.clock.sender_clock import ClockKind, SenderClock
from companion.mavlink.voice.component import ACCEPTED_IDS, HELD_NS, ComponentSpec, ServiceComponent
from companion.mavlink.wire.encode import Outgoing, pack
from companion.mavlink.wire.framing import Splitter
from companion.values import Frame, Notice, Reason, Rejection, RoundTrip, Severity, Source

MS = 1_000_000
S = 1_000_000_000
EPOCH_NS = 1_790_000_000 * S
OURS, CARRIER, UAV, GCS = Source(5, 191), Source(5, 1), Source(3, 1), Source(255, 190)
BOOT_NS = EPOCH_NS - 1000 * S
"""Boot time of the UAV on the node timeline."""
TIMESYNC, HEARTBEAT = 111, 0

Said = list[RoundTrip | Rejection | Notice]


def component(**changed: Any) -> ServiceComponent:
    values = {"source": OURS, "carrier": None, "position_hz": None, "attitude_hz": None}
    return ServiceComponent(ComponentSpec(**{**values, **changed}))


def frame(t_ns: int, source: Source, message: Any, link: str = "a", *, v1: bool = False) -> Frame:
    raw = bytes(message.pack(dialect.MAVLink(None, *source), force_mavlink1=v1))
    (found,) = Splitter(link).feed(t_ns, raw)
    assert isinstance(found, Frame)
    return found


def echo(t_ns: int, message: Outgoing, *, version: int = 2, seq: int = 9) -> Frame:
    (found,) = Splitter("a").feed(t_ns, pack(message, seq, version))
    assert isinstance(found, Frame)
    return found


def position(t_ns: int, source: Source = UAV, boot_ns: int = BOOT_NS) -> Frame:
    boot_ms = (t_ns - boot_ns) // MS % (1 << 32)
    message = dialect.MAVLink_global_position_int_message(
        boot_ms, 473977419, 85455938, 488_000, 25_000, 0, 0, 0, 0
    )
    return frame(t_ns, source, message)


def answer(t_ns: int, sent_ns: int, remote_ns: int, source: Source = UAV) -> Frame:
    return frame(t_ns, source, dialect.MAVLink_timesync_message(remote_ns, sent_ns))


def addressed(t_ns: int, sent_ns: int, remote_ns: int, target: Source) -> Frame:
    """Answer as newer programs do: the present dialect has no target fields yet."""
    payload = struct.pack("<qqBB", remote_ns, sent_ns, *target)
    return echo(t_ns, Outgoing(UAV, TIMESYNC, payload))


def heard(node: ServiceComponent, one: Frame) -> Said:
    """Return the outputs for a frame once nothing can contradict it any more."""
    settled = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    return node.hear(one) + node.hear(frame(one.t_ns + HELD_NS, GCS, settled))


def ticks(start_ns: int, seconds: float, every_ms: int = 100) -> Iterator[int]:
    return iter(range(start_ns, start_ns + round(seconds * S), every_ms * MS))


def request(node: ServiceComponent, now_ns: int) -> int:
    """Return ``ts1`` of the TIMESYNC request that is due now."""
    (sent,) = (m for m, _ in node.due(now_ns, False, []) if m.msgid == TIMESYNC)
    (message,) = dialect.MAVLink(None).parse_buffer(pack(sent, 0))
    assert message.tc1 == 0
    return int(message.ts1)


# --- settings -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"source": Source(255, 191)}, "source is 255:191, allowed system ids: 1 to 254"),
        ({"source": Source(0, 191)}, "source is 0:191"),
        ({"source": Source(5, 0)}, "source is 5:0, allowed component ids"),
        ({"source": Source(5, 1)}, "source is 5:1, allowed component ids"),
        ({"source": Source(5, 190)}, "source is 5:190, allowed component ids"),
        ({"source": Source(5, 256)}, "source is 5:256, allowed component ids"),
        ({"carrier": OURS}, "carrier 5:191"),
        ({"position_hz": 0.0}, "position_hz is 0.0, allowed: 0.1 to 100"),
        ({"position_hz": float("nan")}, "position_hz is nan"),
        ({"attitude_hz": 101.0}, "attitude_hz is 101.0"),
    ],
)
def test_invalid_component_settings_are_rejected(changed: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        component(**changed)


def test_valid_component_settings_are_accepted() -> None:
    for sysid, compid in ((1, 191), (254, 255), (5, 2)):
        component(source=Source(sysid, compid), carrier=CARRIER, position_hz=0.1, attitude_hz=100.0)


# --- heartbeat ----------------------------------------------------------------------------------


def beats(node: ServiceComponent, times: Iterator[int], fit: bool = True) -> list[int]:
    found = []
    for t_ns in times:
        for message, to in node.due(t_ns, fit, []):
            if message.msgid == HEARTBEAT:
                assert to is None
                found.append(t_ns)
    return found


def test_heartbeat_announces_an_onboard_controller() -> None:
    sent = component().due(EPOCH_NS, True, [])
    (beat,) = (m for m, _ in sent if m.msgid == HEARTBEAT)
    (message,) = dialect.MAVLink(None).parse_buffer(pack(beat, 0))
    assert (message.get_srcSystem(), message.get_srcComponent()) == OURS
    assert message.type == dialect.MAV_TYPE_ONBOARD_CONTROLLER
    assert message.autopilot == dialect.MAV_AUTOPILOT_INVALID
    assert message.system_status == dialect.MAV_STATE_ACTIVE


def test_heartbeat_is_sent_each_second_only_while_fit() -> None:
    node = component()
    assert beats(node, ticks(EPOCH_NS, 10)) == [EPOCH_NS + n * S for n in range(10)]
    assert beats(node, ticks(EPOCH_NS + 10 * S, 10), fit=False) == []
    again = EPOCH_NS + 20 * S + 300 * MS
    assert beats(node, ticks(again, 2)) == [again, again + S]


def test_missed_heartbeats_are_not_sent_later() -> None:
    node = component()
    assert beats(node, iter([EPOCH_NS, EPOCH_NS + 60 * S, EPOCH_NS + 60 * S + 100 * MS])) == [
        EPOCH_NS,
        EPOCH_NS + 60 * S,
    ]


@settings(max_examples=examples(100), deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3000), st.booleans()), max_size=60))
def test_heartbeats_are_at_least_a_second_apart_and_only_while_fit(
    steps: list[tuple[int, bool]],
) -> None:
    """Always with its own id, and at once if a second has passed."""
    node, now_ns, last_ns = component(), EPOCH_NS, 0
    for gap_ms, fit in steps:
        now_ns += gap_ms * MS
        sent = [m for m, _ in node.due(now_ns, fit, [UAV])]
        assert all(m.source == OURS for m in sent)
        beat = [m for m in sent if m.msgid == HEARTBEAT]
        assert len(beat) == (fit and now_ns - last_ns >= S)
        last_ns = now_ns if beat else last_ns


# --- timesync -----------------------------------------------------------------------------------


def test_timesync_requests_are_frequent_at_first_and_unconditional() -> None:
    node, times, stamps = component(), [], []
    for t_ns in ticks(EPOCH_NS, 60):
        for message, to in node.due(t_ns, False, []):
            assert (message.source, message.msgid, to) == (OURS, TIMESYNC, None)
            times.append(t_ns)
            (decoded,) = dialect.MAVLink(None).parse_buffer(pack(message, 0))
            stamps.append(decoded.ts1)
            assert decoded.tc1 == 0
    assert {round((b - a) / S) for a, b in pairwise(times[:10])} == {1}
    assert {round((b - a) / S) for a, b in pairwise(times[9:])} == {5}
    assert all(0 <= t_ns - stamp < 1000 for t_ns, stamp in zip(times, stamps, strict=True))
    assert {stamp % 1000 for stamp in stamps} == {OURS.sysid}
    assert len(set(stamps)) == len(stamps)


@pytest.mark.parametrize("trip_ms", [0, 3, 400, 9_999])
def test_timesync_answer_becomes_a_round_trip(trip_ms: int) -> None:
    node = component()
    sent_ns = request(node, EPOCH_NS)
    t_ns = EPOCH_NS + trip_ms * MS
    node.hear(position(t_ns))
    remote_ns = t_ns - BOOT_NS - trip_ms * MS // 2
    assert heard(node, answer(t_ns, sent_ns, remote_ns)) == [
        RoundTrip(t_ns=t_ns, source=UAV, sent_ns=sent_ns, remote_ns=remote_ns)
    ]


def test_overdue_timesync_answer_is_rejected_then_ignored() -> None:
    node = component()
    sent_ns = request(node, EPOCH_NS)
    for late_s, reasons in ((10.001, [Reason.OUT_OF_ORDER]), (29.0, [Reason.OUT_OF_ORDER])):
        t_ns = EPOCH_NS + round(late_s * S)
        node.hear(position(t_ns))
        said = heard(node, answer(t_ns, sent_ns, t_ns - BOOT_NS))
        assert [r.reason for r in said if isinstance(r, Rejection)] == reasons
    node.due(EPOCH_NS + 40 * S, False, [])
    t_ns = EPOCH_NS + 41 * S
    node.hear(position(t_ns))
    assert heard(node, answer(t_ns, sent_ns, t_ns - BOOT_NS)) == []


def test_foreign_timesync_messages_are_ignored() -> None:
    node = component()
    sent_ns = request(node, EPOCH_NS)
    t_ns = EPOCH_NS + 5 * MS
    node.hear(position(t_ns))
    for ts1 in (sent_ns - 1, sent_ns + 1, 0, -1):
        assert heard(node, answer(t_ns, ts1, t_ns - BOOT_NS)) == []
    assert heard(node, answer(t_ns, sent_ns, 0)) == []
    for target in (GCS, Source(5, 1), Source(9, 191)):
        assert heard(node, addressed(t_ns, sent_ns, t_ns - BOOT_NS, target)) == []
    assert len(heard(node, addressed(t_ns, sent_ns, t_ns - BOOT_NS, OURS))) == 1


def test_first_timesync_answer_of_each_source_is_used() -> None:
    node = component()
    sent_ns = request(node, EPOCH_NS)
    t_ns = EPOCH_NS + 5 * MS
    for source in (UAV, CARRIER):
        node.hear(position(t_ns, source))
        said = heard(node, answer(t_ns, sent_ns, t_ns - BOOT_NS, source))
        assert [type(x) for x in said] == [RoundTrip]
    (again,) = heard(node, answer(t_ns + 90 * MS, sent_ns, t_ns - BOOT_NS + 40 * MS))
    assert isinstance(again, Rejection)
    assert (again.reason, again.source, again.msgid) == (Reason.DUPLICATE, "3:1", TIMESYNC)
    later_ns = request(node, EPOCH_NS + S)
    t_ns += S
    assert [type(x) for x in heard(node, answer(t_ns, later_ns, t_ns - BOOT_NS))] == [RoundTrip]


@pytest.mark.parametrize("forged_first", [False, True])
@pytest.mark.parametrize("off_ms", [1000, -1000, 60])
def test_contradicting_timesync_answers_are_both_discarded(forged_first: bool, off_ms: int) -> None:
    """The true answer took 50 ms; the other comes from its own address, and neither is early."""
    node, said = component(), []
    for number in range(3):
        now_ns = EPOCH_NS + number * 5 * S
        node.hear(position(now_ns))
        sent_ns = request(node, now_ns)
        first_ns, second_ns = now_ns + 30 * MS, now_ns + 50 * MS
        remotes_ns = [now_ns + 25 * MS - BOOT_NS + off_ms * MS, now_ns + 25 * MS - BOOT_NS]
        first, second = remotes_ns if forged_first else remotes_ns[::-1]
        assert node.hear(answer(first_ns, sent_ns, first)) == []
        said += heard(node, answer(second_ns, sent_ns, second))
    refused = [one for one in said if isinstance(one, Rejection)]
    assert [one.reason for one in refused] == [Reason.SHARED_ID] * 6
    (told,) = [one for one in said if isinstance(one, Notice)]
    assert "answer TIMESYNC as 3:1" in told.text
    assert not [one for one in said if isinstance(one, RoundTrip)]


def test_late_contradicting_answer_is_rejected_alone() -> None:
    node = component()
    node.hear(position(EPOCH_NS))
    sent_ns = request(node, EPOCH_NS)
    (trip,) = heard(node, answer(EPOCH_NS + 10 * MS, sent_ns, EPOCH_NS - BOOT_NS))
    assert isinstance(trip, RoundTrip)
    later_ns = EPOCH_NS + 3 * S
    refused, told = heard(node, answer(later_ns, sent_ns, later_ns - BOOT_NS + 50 * S))
    assert isinstance(refused, Rejection) and isinstance(told, Notice)
    assert refused.t_ns == later_ns


@pytest.mark.parametrize(
    ("remote_ns", "good"),
    [
        (1000 * S, True),
        (1059 * S, True),
        (941 * S, True),
        (1061 * S, False),
        (939 * S, False),
        (-1000 * S, False),
        (EPOCH_NS, False),
        (1000 * S + (1 << 32) * MS, True),  # the position stamps in ms wrap
        (1000 * S + (1 << 32) * MS * 100, False),  # not an uptime
    ],
)
def test_timesync_answer_must_match_the_position_clock(remote_ns: int, good: bool) -> None:
    node = component()
    sent_ns = request(node, EPOCH_NS)
    node.hear(position(EPOCH_NS))
    (said,) = heard(node, answer(EPOCH_NS, sent_ns, remote_ns))
    assert isinstance(said, RoundTrip if good else Rejection)
    if isinstance(said, Rejection):
        assert (said.reason, said.source) == (Reason.UNPLACED_STAMP, "3:1")
        good_one = answer(EPOCH_NS + MS, sent_ns, 1000 * S)
        assert isinstance(heard(node, good_one)[0], RoundTrip)  # that one was not used


def test_position_clock_is_extrapolated_to_the_answer() -> None:
    node = component()
    node.hear(position(EPOCH_NS))
    sent_ns = request(node, EPOCH_NS + 25 * S)
    remote_ns = 1000 * S + 25 * S + 55 * S
    (said,) = heard(node, answer(EPOCH_NS + 25 * S, sent_ns, remote_ns))
    assert isinstance(said, RoundTrip)


def test_source_without_positions_has_no_clock() -> None:
    """A ground station answers too, with Unix time."""
    node = component()
    sent_ns = request(node, EPOCH_NS)
    assert heard(node, answer(EPOCH_NS + MS, sent_ns, EPOCH_NS, GCS)) == []
    assert heard(node, answer(EPOCH_NS + MS, sent_ns, 1000 * S, UAV)) == []
    node.hear(position(EPOCH_NS + MS))
    node.due(EPOCH_NS + 40 * S, False, [])
    sent_ns = request(node, EPOCH_NS + 50 * S)
    assert heard(node, answer(EPOCH_NS + 50 * S, sent_ns, 1050 * S, UAV)) == []


def test_attitude_stamp_also_gives_the_clock() -> None:
    node = component()
    sent_ns = request(node, EPOCH_NS)
    attitude = dialect.MAVLink_attitude_message(1_000_000, 0, 0, 0, 0, 0, 0)
    node.hear(frame(EPOCH_NS, UAV, attitude))
    assert isinstance(heard(node, answer(EPOCH_NS, sent_ns, 1000 * S))[0], RoundTrip)


@settings(max_examples=examples(60), deadline=None)
@given(
    st.integers(0, 2**32),
    st.lists(
        st.tuples(st.integers(0, 4000), st.integers(0, 4000), st.sampled_from([1, 2])),
        min_size=1,
        max_size=20,
    ),
)
def test_every_round_trip_contains_the_true_offset(
    sub_ns: int, ways: list[tuple[int, int, int]]
) -> None:
    """For any latencies, over one link or two, and any actual sending time."""
    node, trips = component(), []
    for n, (out_ms, home_ms, links) in enumerate(ways):
        now_ns = EPOCH_NS + sub_ns + n * 10 * S
        trips += [x for x in node.hear(position(now_ns)) if isinstance(x, RoundTrip)]
        sent_ns = request(node, now_ns)
        for link in range(links):
            answered_ns = now_ns + 300 + out_ms * MS + link * 17 * MS
            t_ns = answered_ns + home_ms * MS
            said = node.hear(answer(t_ns, sent_ns, answered_ns - BOOT_NS))
            trips += [x for x in said if isinstance(x, RoundTrip)]
            refused = [x for x in said if isinstance(x, Rejection)]
            assert all(x.reason is Reason.DUPLICATE for x in refused)
    trips += [x for x in heard(node, position(now_ns + 9 * S)) if isinstance(x, RoundTrip)]
    assert len(trips) == len(ways)
    for trip in trips:
        assert trip.sent_ns - trip.remote_ns <= BOOT_NS <= trip.t_ns - trip.remote_ns


def test_round_trips_let_the_clock_measure_constant_delay() -> None:
    """Combined with ``SenderClock``: the constant part of the latency is measured."""
    node, clock, rng = component(), SenderClock(), random.Random(3)
    for t_ns in ticks(EPOCH_NS, 30):
        seen = position(t_ns)
        arrival_ns = t_ns + 400 * MS + round(rng.random() * 50 * MS)
        for said in node.hear(seen._replace(t_ns=arrival_ns)):
            assert isinstance(said, RoundTrip)
            clock.timesync(said.sent_ns, said.t_ns, said.remote_ns)
        clock.observe(arrival_ns, (t_ns - BOOT_NS) // MS)
        for message, _ in node.due(arrival_ns, False, []):
            (asked,) = dialect.MAVLink(None).parse_buffer(pack(message, 0))
            back_ns = arrival_ns + 30 * MS
            node.hear(answer(back_ns, asked.ts1, arrival_ns + 15 * MS - BOOT_NS))
    known = clock.estimate()
    assert known is not None
    assert known.kind is ClockKind.TIMESYNC
    assert known.offset_ns == pytest.approx(BOOT_NS, abs=known.uncertainty_s * S)
    assert known.uncertainty_s < 0.03


# --- duplicate own id ---------------------------------------------------------------------------


def test_duplicate_own_id_is_announced_every_five_minutes() -> None:
    node = component()
    node.due(EPOCH_NS, True, [])
    theirs = dialect.MAVLink_timesync_message(0, 77)
    times = [EPOCH_NS + n * S for n in range(1, 1000, 3)]
    said: Said = [x for t_ns in times for x in node.hear(frame(t_ns, OURS, theirs, "udp:x"))]
    assert [x.t_ns for x in said] == [EPOCH_NS + s * S for s in (1, 301, 601, 901)]
    assert all(isinstance(x, Notice) and x.severity is Severity.WARNING for x in said)
    assert isinstance(said[0], Notice)
    assert said[0].subject == "5:191"
    assert "udp:x" in said[0].text
    assert "5:191" in said[0].text


@pytest.mark.parametrize(
    "message",
    [
        dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3),
        dialect.MAVLink_timesync_message(5, 6),
        dialect.MAVLink_command_ack_message(511, 0),
        dialect.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0),
    ],
)
def test_unknown_frame_with_own_id_is_announced(message: Any) -> None:
    node = component()
    node.due(EPOCH_NS, True, [])
    assert [type(x) for x in node.hear(frame(EPOCH_NS, OURS, message))] == [Notice]


@pytest.mark.parametrize("version", [1, 2])
def test_echoed_own_frames_are_ignored(version: int) -> None:
    """A router forwards them with other sequence numbers, perhaps in the other version."""
    node = component(position_hz=5.0)
    node.due(EPOCH_NS, True, [UAV])
    kinds = set()
    for t_ns in ticks(EPOCH_NS, 30):
        if t_ns % S == 0:
            assert node.hear(position(t_ns)) == []
        for message, _ in node.due(t_ns, True, [UAV]):
            kinds.add(message.msgid)
            assert node.hear(echo(t_ns + 200 * MS, message, version=version)) == []
    assert kinds == {HEARTBEAT, TIMESYNC, 76, 66}


def test_heartbeat_long_after_our_last_is_foreign() -> None:
    node = component()
    (beat,) = (m for m, _ in node.due(EPOCH_NS, True, []) if m.msgid == HEARTBEAT)
    for t_ns in ticks(EPOCH_NS + S, 40):
        node.due(t_ns, False, [])
        said = node.hear(echo(t_ns, beat))
        assert bool(said) == (t_ns - EPOCH_NS > 30 * S)
        if said:
            return
    pytest.fail("nothing was said")


# --- arbitrary input ----------------------------------------------------------------------------


@settings(max_examples=examples(300), deadline=None)
@given(
    st.sampled_from(sorted(ACCEPTED_IDS)),
    st.binary(max_size=60),
    st.integers(0, 255),
    st.booleans(),
)
def test_component_survives_any_payload(msgid: int, payload: bytes, sysid: int, ours: bool) -> None:
    """Infinities, NaN, truncated fields and fields beyond the end."""
    node = component(position_hz=5.0, carrier=CARRIER, attitude_hz=5.0)
    node.due(EPOCH_NS, True, [UAV])
    source = OURS if ours else Source(sysid, 1)
    for payload_ in (payload, payload + struct.pack("<2f", float("inf"), float("nan")) * 4):
        raw = pack(Outgoing(source, msgid, payload_), 0)
        node.hear(Frame(t_ns=EPOCH_NS, link="a", source=source, msgid=msgid, raw=raw))
    node.due(EPOCH_NS + S, True, [UAV])


@pytest.mark.parametrize("interval", [float("nan"), float("inf"), -0.0, 1e-30])
@pytest.mark.parametrize("msgid", [33.0, float("nan"), float("inf"), 33.5])
def test_component_ignores_any_command_value(msgid: float, interval: float) -> None:
    node = component(position_hz=5.0)
    command = dialect.MAVLink_command_long_message(*UAV, 511, 0, msgid, interval, 0, 0, 0, 0, 0)
    assert node.hear(frame(EPOCH_NS, GCS, command)) == []


@pytest.mark.full
def test_component_memory_is_bounded() -> None:
    node, sizes = component(position_hz=5.0), []
    tracemalloc.start()
    try:
        for n, t_ns in enumerate(ticks(EPOCH_NS, 1200)):
            source = Source(n % 254 + 1, 1 + n // 254 % 200)
            node.hear(position(t_ns, source))
            for message, _ in node.due(t_ns, True, [source]):
                if message.msgid == TIMESYNC:
                    (asked,) = dialect.MAVLink(None).parse_buffer(pack(message, 0))
                    node.hear(answer(t_ns, asked.ts1, t_ns - BOOT_NS, source))
            if n in (2000, 11_999):
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert sizes[1] < 1.2 * sizes[0]
