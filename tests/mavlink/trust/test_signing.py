"""Signatures against pymavlink's dialect and hashlib; timestamp rules against brute force; crashes
against the full history of accepted and sent frames."""

import hashlib
import statistics
import struct
import time
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect
from support import examples

from companion.mavlink.trust.signing import (
    FOLLOWED_MAX,
    LATEST,
    STREAMS_MAX,
    LinkSigning,
    NewestTimestamps,
    State,
    StoredStream,
    fingerprint,
)
from companion.mavlink.wire import encode
from companion.mavlink.wire.framing import Splitter
from companion.values import Frame, Reason, Source

KEY = hashlib.sha256(b"correct horse").digest()
OTHER_KEY = hashlib.sha256(b"battery staple").digest()
S = 1_000_000_000
UNITS = 100_000  # timestamp units per second
NOW_NS = 1_790_000_000 * S
NOW = (1_790_000_000 - 1_420_070_400) * UNITS
OURS = Source(5, 191)


def units(t_ns: int) -> int:
    return (t_ns - 1_420_070_400 * S) // 10_000


def position(boot_ms: int = 0) -> object:
    return dialect.MAVLink_global_position_int_message(
        boot_ms, 473977419, 85455938, 488_000, 25_000, -300, 400, -5, 0
    )


def vehicle(key: bytes | None, stamp: int, link_id: int = 0, sysid: int = 1) -> dialect.MAVLink:
    """Return pymavlink's end of a link: it signs its frames and accepts only signed ones."""
    mav = dialect.MAVLink(None, sysid, 1)
    mav.signing.secret_key = key
    mav.signing.timestamp = stamp
    mav.signing.link_id = link_id
    mav.signing.sign_outgoing = key is not None
    return mav


def framed(raw: bytes, t_ns: int = NOW_NS) -> Frame:
    """Return the frame that a link makes of these bytes."""
    (item,) = Splitter("a").feed(t_ns, raw)
    assert isinstance(item, Frame)
    return item


def sent(
    stamp: int,
    *,
    key: bytes = KEY,
    stream: tuple[int, int, int] = (1, 1, 0),
    t_ns: int = NOW_NS,
    payload: bytes = bytes(27) + b"\1",
) -> Frame:
    """Return a hand-made signed GLOBAL_POSITION_INT."""
    sysid, compid, link_id = stream
    raw = b"\xfd" + bytes([len(payload), 1, 0, 7, sysid, compid, 33, 0, 0]) + payload
    crc = dialect.x25crc(raw[1:] + bytes([104])).crc
    raw += struct.pack("<HB", crc, link_id) + struct.pack("<Q", stamp)[:6]
    return Frame(
        t_ns=t_ns,
        link="a",
        source=Source(sysid, compid),
        msgid=33,
        raw=raw + hashlib.sha256(key + raw).digest()[:6],
    )


def guard(**changes: object) -> LinkSigning:
    return LinkSigning(**({"key": KEY, "link_id": 9} | changes))  # type: ignore[arg-type]


def stamp_of(raw: bytes) -> int:
    return int.from_bytes(raw[-12:-6], "little")


# --- signatures ---------------------------------------------------------------------------------


@pytest.mark.parametrize("link_id", [0, 1, 255])
def test_frames_signed_by_pymavlink_are_accepted(link_id: int) -> None:
    mav, ours = vehicle(KEY, NOW, link_id), guard()
    for boot_ms in range(300):
        raw = bytes(position(boot_ms).pack(mav))  # type: ignore[attr-defined]
        assert ours.refusal(framed(raw)) is None
    assert ours.state(NOW_NS).streams == {(1, 1, link_id): (NOW + 299, 299, None)}


def test_signatures_match_pymavlink() -> None:
    """Byte-identical for each message of the service, and accepted by pymavlink's parser."""
    listener = vehicle(KEY, NOW)
    ours = guard(link_id=3)
    messages = (
        encode.heartbeat(OURS),
        encode.set_message_interval(OURS, Source(1, 1), 33, 100_000),
        encode.request_data_stream(OURS, Source(1, 1), 6, 10),
        encode.timesync(OURS, 1_790_000_000_123_456_789),
    )
    for seq, message in enumerate(messages):
        unsigned = encode.pack(message, seq)
        signed = ours.sign(unsigned, NOW_NS + seq * S)
        (heard,) = listener.parse_buffer(signed)
        assert heard.get_type() == dialect.mavlink_map[message.msgid].msgname

        reference = vehicle(KEY, NOW + seq * UNITS, 3)
        reference.srcSystem, reference.srcComponent, reference.seq = *OURS, seq
        (again,) = dialect.MAVLink(None).parse_buffer(unsigned)
        assert signed == bytes(again.pack(reference))
    assert listener.signing.goodsig_count == len(messages)


def test_wrong_key_is_rejected_at_both_ends() -> None:
    raw = bytes(position().pack(vehicle(OTHER_KEY, NOW)))  # type: ignore[attr-defined]
    assert guard().refusal(framed(raw)) is Reason.BAD_SIGNATURE
    assert guard(key=OTHER_KEY).refusal(framed(raw)) is None

    signed = guard().sign(encode.pack(encode.heartbeat(OURS), 0), NOW_NS)
    with pytest.raises(dialect.MAVError, match="signature"):
        vehicle(OTHER_KEY, NOW).parse_buffer(signed)


@pytest.mark.parametrize("allow_unsigned", [False, True])
def test_any_flipped_bit_is_rejected(allow_unsigned: bool) -> None:
    good = sent(NOW).raw
    ours = guard(allow_unsigned=allow_unsigned)
    before = ours.state(NOW_NS)
    for bit in range(8 * len(good)):
        raw = bytearray(good)
        raw[bit // 8] ^= 1 << bit % 8
        if not allow_unsigned:  # with or without a checksum test
            assert (
                ours.refusal(
                    Frame(t_ns=NOW_NS, link="a", source=Source(1, 1), msgid=33, raw=bytes(raw))
                )
                is not None
            ), bit
        splitter = Splitter("a")
        for item in splitter.feed(NOW_NS, bytes(raw)) + splitter.finish(NOW_NS):
            if isinstance(item, Frame):
                assert ours.refusal(item) is Reason.BAD_SIGNATURE, bit
    assert ours.state(NOW_NS) == before
    assert ours.refusal(framed(good)) is None


# --- fail closed --------------------------------------------------------------------------------


def unsigned(*, v1: bool, seq: int = 0) -> Frame:
    mav = vehicle(None, 0)
    mav.seq = seq  # at this position of a version 1 frame, version 2 has the signature flag
    return framed(bytes(position().pack(mav, force_mavlink1=v1)))  # type: ignore[attr-defined]


@pytest.mark.parametrize("v1", [False, True])
def test_unsigned_frames_are_always_rejected(v1: bool) -> None:
    """pymavlink's mavutil creates a new parser on the first MAVLink 2 byte after MAVLink 1, and
    that one has no key."""
    ours = guard()
    for n in range(3):
        before, moves = ours.state(NOW_NS), ours.moves
        assert ours.refusal(unsigned(v1=v1, seq=n)) is Reason.UNSIGNED
        assert (ours.state(NOW_NS), ours.moves) == (before, moves)
        assert ours.refusal(sent(NOW + n, key=OTHER_KEY)) is Reason.BAD_SIGNATURE
        assert ours.refusal(sent(NOW + n)) is None
        assert ours.refusal(sent(NOW + n)) is Reason.REPLAYED


@pytest.mark.parametrize("v1", [False, True])
def test_allowing_unsigned_frames_still_rejects_wrong_signatures(v1: bool) -> None:
    ours = guard(allow_unsigned=True)
    for n in range(3):
        before = ours.state(NOW_NS)
        assert ours.refusal(unsigned(v1=v1, seq=n)) is None
        assert ours.state(NOW_NS) == before
        assert ours.refusal(sent(NOW + n, key=OTHER_KEY)) is Reason.BAD_SIGNATURE
        assert ours.refusal(sent(NOW + n)) is None
        assert ours.refusal(sent(NOW + n)) is Reason.REPLAYED


def test_setup_signing_does_not_change_the_key() -> None:
    ours, mav = guard(), vehicle(KEY, NOW)
    setup = dialect.MAVLink_setup_signing_message(*OURS, list(OTHER_KEY), NOW + 9)
    plain = bytes(setup.pack(vehicle(None, 0)))
    assert ours.refusal(framed(plain)) is Reason.UNSIGNED
    ours.refusal(framed(bytes(setup.pack(mav))))
    assert ours.refusal(sent(NOW + 10, key=OTHER_KEY)) is Reason.BAD_SIGNATURE
    assert ours.refusal(sent(NOW + 10)) is None


def test_rejected_frame_does_not_change_timestamps() -> None:
    """A sender without the key must not block a stream. pymavlink stores the timestamp before it
    checks the signature, and then rejects every frame of that sender."""
    ours = guard()
    assert ours.refusal(sent(NOW)) is None
    before, moves = ours.state(NOW_NS), ours.moves
    assert ours.refusal(sent(LATEST, key=OTHER_KEY)) is Reason.BAD_SIGNATURE
    assert ours.refusal(sent(LATEST, key=OTHER_KEY, stream=(2, 1, 0))) is Reason.BAD_SIGNATURE
    assert ours.refusal(sent(NOW)) is Reason.REPLAYED
    assert ours.refusal(sent(NOW - 61 * UNITS, stream=(2, 1, 0))) is Reason.REPLAYED
    assert (ours.state(NOW_NS), ours.moves) == (before, moves)
    assert ours.refusal(sent(NOW + 1)) is None


# --- timestamps ---------------------------------------------------------------------------------


def test_new_stream_may_be_at_most_one_minute_behind_own_clock() -> None:
    ours = guard()
    assert ours.refusal(sent(NOW - 60 * UNITS - 1)) is Reason.REPLAYED
    assert ours.refusal(sent(NOW - 60 * UNITS)) is None
    assert ours.refusal(sent(NOW - 60 * UNITS)) is Reason.REPLAYED


def test_new_stream_may_be_at_most_one_minute_behind_accepted_frames() -> None:
    ours = guard()
    assert ours.refusal(sent(NOW + 100 * UNITS)) is None
    newcomer = (2, 1, 0)
    assert ours.refusal(sent(NOW + 40 * UNITS - 1, stream=newcomer)) is Reason.REPLAYED
    assert ours.refusal(sent(NOW + 40 * UNITS, stream=newcomer)) is None


def test_known_streams_follow_their_own_clocks() -> None:
    ours = guard()
    slow, fast, right = (1, 1, 0), (2, 1, 0), (3, 1, 0)
    assert ours.refusal(sent(NOW - 59 * UNITS, stream=slow)) is None
    assert ours.refusal(sent(NOW, stream=right)) is None
    assert ours.refusal(sent(NOW + 86_400 * UNITS, stream=fast)) is None
    for second in range(1, 5):
        assert ours.refusal(sent(NOW + second * UNITS, stream=right)) is None
        assert ours.refusal(sent(NOW + (second - 59) * UNITS, stream=slow)) is None
    assert ours.ahead_ns(NOW_NS + 4 * S) == (86_400 - 4) * S
    assert guard().ahead_ns(NOW_NS) == 0


def test_clock_ahead_blocks_new_streams_until_they_receive_our_frames() -> None:
    ours = guard()
    assert ours.refusal(sent(NOW + 3600 * UNITS, stream=(2, 1, 0))) is None
    newcomer = vehicle(KEY, NOW, sysid=7)

    def report() -> Frame:
        return framed(bytes(position().pack(newcomer)))  # type: ignore[attr-defined]

    assert ours.refusal(report()) is Reason.REPLAYED
    assert guard().refusal(report()) is None  # another link is unaffected
    newcomer.parse_buffer(ours.sign(encode.pack(encode.heartbeat(OURS), 0), NOW_NS))
    assert ours.refusal(report()) is None


def test_each_link_accepts_the_same_frame_once() -> None:
    a, b = guard(link_id=0), guard(link_id=1)
    for n in range(3):
        assert [link.refusal(sent(NOW + n)) for link in (a, b)] == [None, None]
        assert [link.refusal(sent(NOW + n)) for link in (a, b)] == [Reason.REPLAYED] * 2


@pytest.mark.parametrize("link_id", [0, 1])
def test_frame_far_behind_its_sender_is_no_frame_of_another_link(link_id: int) -> None:
    """One that was received on a link must not move the sender back in time on another one.

    Nor may one that the sender sent over another of its own links, which nobody received.
    """
    senders = NewestTimestamps()
    a, b = guard(senders=senders), guard(link_id=1, senders=senders)
    assert a.refusal(sent(NOW)) is None
    behind = (1, 1, link_id)
    assert b.refusal(sent(NOW - 10 * UNITS - 1, stream=behind)) is Reason.REPLAYED
    assert b.refusal(sent(NOW - 10 * UNITS, stream=behind)) is None
    assert b.refusal(sent(NOW - 10 * UNITS - 1, stream=(2, 1, 0))) is None  # another sender
    assert a.refusal(sent(NOW + 5 * UNITS)) is None
    assert b.refusal(sent(NOW - 6 * UNITS, stream=behind)) is Reason.REPLAYED  # falls behind


def test_own_signed_frames_are_rejected_as_replayed() -> None:
    ours = guard(link_id=3)
    signed = ours.sign(encode.pack(encode.heartbeat(OURS), 0), NOW_NS)
    assert guard().refusal(framed(signed)) is None
    assert ours.refusal(framed(signed)) is Reason.REPLAYED


# --- frames of our own --------------------------------------------------------------------------


@given(st.lists(st.integers(-3 * S, 3 * S) | st.just(0), min_size=1, max_size=60))
def test_own_timestamps_increase_and_keep_up_with_the_clock(steps_ns: list[int]) -> None:
    ours, now_ns, stamps = guard(), NOW_NS, [-1]
    raw = encode.pack(encode.heartbeat(OURS), 0)
    for step_ns in steps_ns:
        now_ns += step_ns
        stamps.append(stamp_of(ours.sign(raw, now_ns)))
        assert stamps[-1] == max(units(now_ns), stamps[-2] + 1)


def test_own_timestamps_follow_accepted_frames() -> None:
    ours, raw = guard(), encode.pack(encode.heartbeat(OURS), 0)
    assert ours.refusal(sent(NOW + 5 * UNITS)) is None
    assert stamp_of(ours.sign(raw, NOW_NS)) == NOW + 5 * UNITS + 1


def test_clock_before_2015_gives_increasing_timestamps() -> None:
    ours, raw = guard(), encode.pack(encode.heartbeat(OURS), 0)
    assert [stamp_of(ours.sign(raw, 0)) for _ in range(3)] == [1, 2, 3]
    assert ours.refusal(sent(NOW, t_ns=0)) is None
    assert stamp_of(ours.sign(raw, 0)) == NOW + 1


def test_highest_timestamp_does_not_exhaust_own_timestamps() -> None:
    ours, raw = guard(), encode.pack(encode.heartbeat(OURS), 0)
    assert ours.refusal(sent(LATEST)) is None
    assert ours.refusal(sent(LATEST)) is Reason.REPLAYED
    stamps = [stamp_of(ours.sign(raw, NOW_NS)) for _ in range(3)]
    assert stamps == [FOLLOWED_MAX + 1, FOLLOWED_MAX + 2, FOLLOWED_MAX + 3]
    again = guard(state=ours.state(NOW_NS).after_crash())
    assert stamp_of(again.sign(raw, NOW_NS)) > stamps[-1]
    assert again.refusal(sent(LATEST)) is Reason.REPLAYED


def test_only_unsigned_mavlink_2_frames_can_be_signed() -> None:
    ours, message = guard(), encode.heartbeat(OURS)
    for raw in (encode.pack(message, 0, 1), ours.sign(encode.pack(message, 0), NOW_NS)):
        with pytest.raises(ValueError, match="unsigned MAVLink 2"):
            ours.sign(raw, NOW_NS)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"key": KEY[:31]}, "has 31 bytes; give 32"),
        ({"key": b""}, "has 0 bytes; give 32"),
        ({"link_id": 256}, "is 256, allowed: 0 to 255"),
        ({"link_id": -1}, "is -1, allowed: 0 to 255"),
    ],
)
def test_invalid_guard_arguments_are_rejected(changes: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        guard(**changes)


def test_fingerprint_identifies_a_key_without_revealing_it() -> None:
    assert fingerprint(KEY) == hashlib.sha256(hashlib.sha256(KEY).digest()).hexdigest()[:8]
    assert fingerprint(KEY) != fingerprint(OTHER_KEY)


# --- memory -------------------------------------------------------------------------------------


def test_evicted_streams_stay_rejected() -> None:
    ours, more = guard(), 20
    frames = [sent(NOW + n, stream=(1 + n % 250, 1, n // 250)) for n in range(STREAMS_MAX + more)]
    assert all(ours.refusal(frame) is None for frame in frames)
    kept = ours.state(NOW_NS).streams
    assert len(kept) == STREAMS_MAX
    assert set(kept) == {(1 + n % 250, 1, n // 250) for n in range(more, STREAMS_MAX + more)}
    assert all(ours.refusal(frame) is Reason.REPLAYED for frame in frames)

    again = guard(state=ours.state(NOW_NS))
    assert all(again.refusal(frame) is Reason.REPLAYED for frame in frames[: more + 5])
    assert again.refusal(sent(NOW + STREAMS_MAX + more, stream=(1, 1, 0))) is None
    assert len(again.state(NOW_NS).streams) == STREAMS_MAX


def test_stream_that_was_silent_for_longest_gives_way() -> None:
    """Not the one with the oldest timestamp: its clock may be behind."""
    ours, behind, silent = guard(), (1, 1, 0), (1, 2, 0)
    assert ours.refusal(sent(NOW - 50 * UNITS, stream=behind)) is None
    assert ours.refusal(sent(NOW, stream=silent)) is None
    others = [(2 + n % 250, 1, n // 250) for n in range(STREAMS_MAX - 1)]
    for stream in others[:-1]:
        assert ours.refusal(sent(NOW + 1, stream=stream)) is None
    assert ours.refusal(sent(NOW - 49 * UNITS, stream=behind)) is None
    assert ours.refusal(sent(NOW + 1, stream=others[-1])) is None
    kept = ours.state(NOW_NS).streams
    assert behind in kept and silent not in kept


def test_new_stream_costs_no_more_if_another_gives_way() -> None:
    ours = guard()
    streams = [(1 + n % 250, 1 + n // 250 % 250, 0) for n in range(2 * STREAMS_MAX)]
    frames = [sent(NOW + n, stream=stream) for n, stream in enumerate(streams)]

    def timed_s(some: list[Frame]) -> float:
        begun_s = time.perf_counter()
        assert all(ours.refusal(frame) is None for frame in some)
        return time.perf_counter() - begun_s

    filling = [timed_s(frames[n : n + 64]) for n in range(0, STREAMS_MAX, 64)]
    giving_way = [timed_s(frames[n : n + 64]) for n in range(STREAMS_MAX, 2 * STREAMS_MAX, 64)]
    assert statistics.median(giving_way) < 5 * statistics.median(filling)


# --- sequences, against the rule by brute force -------------------------------------------------

STREAMS = st.tuples(st.integers(1, 3), st.just(1), st.integers(0, 1))
STAMPS = st.integers(-70, 70).map(lambda s: NOW + s * UNITS) | st.integers(NOW - 3, NOW + 3)
HEARD = st.tuples(
    st.just("hear"),
    st.integers(0, 1),  # link
    STREAMS,
    STAMPS,
    st.sampled_from([KEY, KEY, KEY, OTHER_KEY]),
)
SEQUENCES = st.lists(
    HEARD
    | st.tuples(st.just("wait"), st.integers(0, 40))
    | st.tuples(st.just("plain"), st.booleans())
    | st.just(("send",)),
    max_size=60,
)


@settings(max_examples=examples(300))
@given(SEQUENCES)
def test_timestamp_rules_match_brute_force(sequence: list[tuple]) -> None:  # type: ignore[type-arg]
    now_ns, senders = NOW_NS, NewestTimestamps()
    links = [guard(senders=senders), guard(link_id=8, senders=senders)]
    ours = links[0]
    heard: list[tuple[int, tuple[int, int, int], int]] = []
    our_stamps = [-1]
    for step in sequence:
        match step:
            case "wait", seconds:
                now_ns += seconds * S
            case "plain", v1:
                assert ours.refusal(unsigned(v1=v1)) is Reason.UNSIGNED
            case ("send",):
                raw = ours.sign(encode.pack(encode.heartbeat(OURS), 0), now_ns)
                our_stamps.append(stamp_of(raw))
                newest = max([our_stamps[-2], *(stamp for on, _, stamp in heard if on == 0)])
                assert our_stamps[-1] == max(units(now_ns), newest + 1)
            case "hear", link, stream, stamp, key:
                taken = [(other, newest) for on, other, newest in heard if on == link]
                of_stream = [newest for other, newest in taken if other == stream]
                of_sender = [newest for _, other, newest in heard if other[:2] == stream[:2]]
                local = max([units(now_ns), *(newest for _, newest in taken)])
                if key is not KEY:
                    due = Reason.BAD_SIGNATURE
                elif stamp < max(of_sender, default=0) - 10 * UNITS:
                    due = Reason.REPLAYED
                elif of_stream:
                    due = None if stamp > max(of_stream) else Reason.REPLAYED
                else:
                    due = None if local - stamp <= 60 * UNITS else Reason.REPLAYED
                frame = sent(stamp, stream=stream, key=key, t_ns=now_ns)
                assert links[link].refusal(frame) is due
                if due is None:
                    heard.append((link, stream, stamp))


# --- crashes ------------------------------------------------------------------------------------

KNOWN = {(1, 1, 0): 0, (2, 1, 0): -3600, (3, 1, 0): 7200}  # seconds by which their clocks are ahead
KNOWN_AT = {
    stream: StoredStream(NOW + (ahead - 1) * UNITS, ahead * UNITS)
    for stream, ahead in KNOWN.items()
}
NEW = {(4, 1, 0): 0, (5, 1, 0): -50}


class Run:
    """A guard with its disk: saved every second, written ``write_s`` later."""

    def __init__(self, write_s: int) -> None:
        self.now_ns = NOW_NS
        self.guard = guard(
            state=State(clock=NOW, local=NOW + 7199 * UNITS, sent=NOW, floor=-1, streams=KNOWN_AT)
        )
        self.saves = [(NOW_NS, self.guard.state(NOW_NS))]
        self.taken: list[Frame] = []
        self.stamps = [-1]
        self.write_ns = write_s * S

    def hear(self, stream: tuple[int, int, int], late_ms: int) -> Reason | None:
        stamp = units(self.now_ns - late_ms * 1_000_000) + (KNOWN | NEW)[stream] * UNITS
        frame = sent(stamp, stream=stream, t_ns=self.now_ns)
        reason = self.guard.refusal(frame)
        if reason is None:
            self.taken.append(frame)
        return reason

    def send(self) -> None:
        raw = self.guard.sign(encode.pack(encode.heartbeat(OURS), 0), self.now_ns)
        self.stamps.append(stamp_of(raw))
        assert self.stamps[-1] > self.stamps[-2]
        self.taken.append(framed(raw))

    def wait(self, milliseconds: int) -> None:
        end_ns = self.now_ns + milliseconds * 1_000_000
        while (due_ns := self.saves[-1][0] + S) <= end_ns:
            self.saves.append((due_ns, self.guard.state(due_ns)))
        self.now_ns = end_ns

    def crash(self, down_ms: int) -> None:
        on_disk = [
            (at_ns, state)
            for at_ns, state in self.saves
            if at_ns <= self.now_ns - self.write_ns or at_ns == self.saves[0][0]
        ]
        self.restart(on_disk[-1][1].after_crash(), down_ms)

    def stop(self, down_ms: int) -> None:
        self.restart(self.guard.state(self.now_ns), down_ms)

    def restart(self, state: State, down_ms: int) -> None:
        self.now_ns += down_ms * 1_000_000
        self.guard = guard(state=state)
        self.saves = [(self.now_ns, self.guard.state(self.now_ns))]
        for frame in self.taken:
            replayed = self.guard.refusal(frame._replace(t_ns=self.now_ns))
            assert replayed is Reason.REPLAYED, frame


LIVES = st.lists(
    st.tuples(st.just(Run.hear), st.sampled_from([*KNOWN, *NEW]), st.integers(0, 2000))
    | st.tuples(st.just(Run.wait), st.integers(1, 900) | st.integers(1, 90_000))
    | st.tuples(st.just(Run.crash), st.integers(0, 3000))
    | st.tuples(st.just(Run.stop), st.integers(0, 3000))
    | st.tuples(st.just(Run.send)),
    max_size=40,
)


@settings(max_examples=examples(400), deadline=None)
@given(LIVES, st.integers(0, 2))
def test_crashes_accept_no_frame_twice_and_reuse_no_timestamp(
    life: list[tuple[Callable[..., object], ...]], write_s: int
) -> None:
    run = Run(write_s)
    for step, *arguments in life:
        step(run, *arguments)
    run.crash(0)
    run.send()
    run.wait(8000)
    assert [run.hear(stream, 0) for stream in KNOWN] == [None] * len(KNOWN)


def test_clean_restart_continues_where_it_ended() -> None:
    run = Run(0)
    assert [run.hear(stream, 0) for stream in KNOWN] == [None] * 3
    run.stop(0)
    run.wait(1)
    assert [run.hear(stream, 0) for stream in KNOWN] == [None] * 3


@pytest.mark.parametrize("silent_s", [1, 10, 3600])
def test_crash_after_a_silent_stream_resumed(silent_s: int) -> None:
    run = Run(0)
    run.wait(silent_s * 1000 + 500)
    assert run.hear((1, 1, 0), 0) is None
    run.crash(0)  # replays every accepted frame
    run.wait(6000)
    assert run.hear((1, 1, 0), 0) is None


@pytest.mark.parametrize("heard_s", [1, 30])
@pytest.mark.parametrize("hz", [4, 50])
@pytest.mark.parametrize("runs", [1, 3])
def test_crash_while_a_sender_counts_its_frames(heard_s: int, hz: int, runs: int) -> None:
    """As ArduPilot and pymavlink do. A clock's margin would keep it out for hours."""
    ours, number, frames = guard(), 0, list[Frame]()

    def counted(at_s: float) -> Frame:
        nonlocal number
        number += 1
        return sent(NOW + number, t_ns=NOW_NS + round(at_s * S))

    at_s = 0.0
    for _ in range(runs):
        saved_s, until_s = at_s + heard_s, at_s + heard_s + 3
        while at_s < until_s:
            if at_s < saved_s:
                state = ours.state(NOW_NS + round(at_s * S))
            frame = counted(at_s)
            if ours.refusal(frame) is None:
                frames.append(frame)
            at_s += 1 / hz
        ours = guard(state=state.after_crash())
        assert {ours.refusal(one._replace(t_ns=NOW_NS + round(at_s * S))) for one in frames} == {
            Reason.REPLAYED
        }
        late = [ours.refusal(counted(at_s + n / hz)) for n in range(6 * hz)]
        assert late[-1] is None and late.count(Reason.REPLAYED) <= 5 * hz
        at_s += 6
    # A clock that follows again has a clock's margin again.
    for n in range(20):
        assert ours.refusal(sent(NOW + (n + 1000) * UNITS, t_ns=NOW_NS + (n + 1000) * S)) is None
    assert [known.pace for known in ours.state(NOW_NS).streams.values()] == [None]


def test_sender_that_began_minutes_ago_is_accepted_once_it_receives_our_frames() -> None:
    """As docs/links.md states: timestamps that count frames are too old for a new stream."""
    mav, ours = vehicle(KEY, NOW - 120 * UNITS), guard()
    assert ours.refusal(framed(position().pack(mav))) is Reason.REPLAYED  # type: ignore[attr-defined]
    raw = ours.sign(encode.pack(encode.heartbeat(OURS), 0), NOW_NS)
    assert mav.parse_char(raw) is not None
    assert ours.refusal(framed(position().pack(mav))) is None  # type: ignore[attr-defined]


def test_crash_after_own_timestamps_followed_a_clock_ahead() -> None:
    run = Run(0)
    run.wait(60_500)
    assert run.hear((3, 1, 0), 0) is None  # ahead, after a minute of silence
    run.send()
    run.crash(0)
    run.send()


def test_crash_after_a_burst_of_own_frames() -> None:
    """After a crash own timestamps are ahead of the clock, and each frame takes one unit."""
    run = Run(0)
    for _ in range(3):
        run.wait(100)
        for _ in range(50):
            run.send()
        run.crash(0)


@pytest.mark.parametrize("crashed", [False, True])
def test_clock_set_back_a_day_uses_the_stored_timestamp(crashed: bool) -> None:
    """A small computer without a clock battery: the stored timestamp is used."""
    first = guard()
    assert first.refusal(sent(NOW + 1)) is None
    state = first.state(NOW_NS)
    back_ns = NOW_NS - 86_400 * S
    for _ in range(2):
        ours = guard(state=state.after_crash() if crashed else state)
        assert ours.refusal(sent(NOW + 1, t_ns=back_ns)) is Reason.REPLAYED
        old = sent(NOW - 60 * UNITS, stream=(2, 1, 0), t_ns=back_ns)
        assert ours.refusal(old) is Reason.REPLAYED
        state = ours.state(back_ns)
    fresh = NOW + 12 * UNITS
    assert ours.refusal(sent(fresh, t_ns=back_ns)) is None
    assert ours.refusal(sent(fresh, stream=(2, 1, 0), t_ns=back_ns)) is None


def test_own_clock_is_kept_for_the_next_run() -> None:
    """Without any received or sent frame."""
    ours = guard(state=guard().state(NOW_NS))
    back_ns = NOW_NS - 86_400 * S
    assert ours.refusal(sent(NOW - 60 * UNITS - 1, t_ns=back_ns)) is Reason.REPLAYED
    assert ours.refusal(sent(NOW - 60 * UNITS, t_ns=back_ns)) is None


@pytest.mark.parametrize("ahead_s", [0, 7200])
def test_repeated_crashes_do_not_accumulate_offset(ahead_s: int) -> None:
    """Neither for own timestamps, which may follow a clock ahead, nor for others."""
    run = Run(0)
    if not ahead_s:
        streams = {stream: KNOWN_AT[stream] for stream in KNOWN if KNOWN[stream] <= 0}
        run.guard = guard(state=State(clock=NOW, local=NOW, sent=NOW, floor=-1, streams=streams))
        run.saves = [(NOW_NS, run.guard.state(NOW_NS))]
    for _ in range(100):
        run.send()
        run.wait(1000)
        run.crash(1000)
    assert run.stamps[-1] < units(run.now_ns) + (ahead_s + 6) * UNITS
    run.wait(6000)
    assert [run.hear(stream, 0) for stream in KNOWN if KNOWN[stream] <= 0] == [None] * 2
    assert run.hear((4, 1, 0), 0) is (Reason.REPLAYED if ahead_s else None)  # a new stream
