"""Every format other than MAVLink: hostile bytes in linear time, and messages that never end."""

import sys
import time
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from link_support import fed

from companion.mavlink.wire.aircraft_json import AircraftJson
from companion.mavlink.wire.beast import BeastSplitter
from companion.mavlink.wire.cot_link import CotSplitter
from companion.mavlink.wire.decode import decode
from companion.mavlink.wire.foreign import ForeignSplitter
from companion.mavlink.wire.rid_json import RidJson
from companion.mavlink.wire.sbs import SbsSplitter
from companion.values import Frame, Reason, Rejection

SBS = b"MSG,3,1,1,4006B3,1,,,,,,38000,250,90,51.4,-0.1,64,,0,0,0,0\n"
BEAST = b"\x1a3" + bytes(6) + b"\x80" + bytes.fromhex("8D4840D6202CC371C32CE0576098")
JSON = b'{"now": 1.5, "aircraft": [{"hex": "a2fcf2", "lat": 1, "lon": 2, "seen_pos": 0.5}]}'
RID = b'{"mac": "01:02", "uav id": "X", "uav latitude": 1.5, "uav longitude": 2}\n'
COT = (
    b'<event uid="A" type="a-f-A" time="2026-11-22T10:00:00Z" how="m-g">'
    b'<point lat="51.4" lon="-0.1" hae="120" ce="4" le="9"/></event>'
)
FORMATS: dict[str, tuple[type[ForeignSplitter], bytes]] = {
    "sbs": (SbsSplitter, SBS),
    "beast": (BeastSplitter, BEAST),
    "json": (AircraftJson, JSON),
    "rid": (RidJson, RID),
    "cot": (CotSplitter, COT),
}
STREAMS = [name for name in FORMATS if name != "json"]
PARTS = [b"\x1a", b"\x1a3", b"\xbf", b"\xbf\x01\xbf", b"<event ", b"</event>", b"<?xml ", b"MSG,",
         b'{"', b"[", b"}", b'"', b"\n", b"\0", b",", b"9" * 5000, b"-1", b"NaN", b"Infinity",
         b"1e999", b"\xff\xfe", b"\xc3\xa9", b"\\ud800"]  # fmt: skip
"""What the formats consist of, and values that are hard to read."""


@st.composite
def damaged(draw: st.DrawFn, valid: bytes) -> bytes:
    """A message with parts replaced, removed or repeated."""
    out = valid
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(out)))
        to = draw(st.integers(at, min(len(out), at + 12)))
        out = out[:at] + draw(st.sampled_from(PARTS) | st.binary(max_size=8)) + out[to:]
    return out


@pytest.mark.parametrize("name", FORMATS)
@given(data=st.data())
def test_damaged_messages_are_decoded_or_rejected_with_a_reason(
    name: str, data: st.DataObject
) -> None:
    of, valid = FORMATS[name]
    splitter = of("x")
    for piece in data.draw(st.lists(damaged(valid), min_size=1, max_size=3)):
        for found in splitter.feed(7, piece):
            if isinstance(found, Frame):
                decode(found)
            else:
                assert found.reason in Reason and found.count > 0
                assert found.detail.isprintable() and len(found.detail) <= 200


FLOODS = {
    "beast": [b"\x1a3" + bytes(20), b"\x1a3", b"\x1a3\x1a\x1a"],
    "sbs": [b"MSG,", b"\n", b"x"],
    "cot": [b"<?xml ", b"<event ", b"\xbf\xff", b"<"],
    "rid": [b"{", b"{}\n", b'{"a":'],
}


@pytest.mark.parametrize(
    ("name", "piece"), [(name, piece) for name, pieces in FLOODS.items() for piece in pieces]
)
def test_work_grows_linearly_with_the_bytes_of_one_read(name: str, piece: bytes) -> None:
    """A read has up to 256 kB; eight times the bytes are not to take much more than eight times
    the time."""

    def seconds(size: int) -> float:
        data, least = (piece * size)[:size], float("inf")
        for _ in range(3):
            splitter = FORMATS[name][0]("x")
            began = time.process_time()
            fed(splitter, 7, data)
            least = min(least, time.process_time() - began)
        return least

    assert seconds(256 << 10) <= 24 * seconds(32 << 10) + 0.01


def calls_of_feed(splitter: ForeignSplitter, data: bytes) -> list[int]:
    """How many calls and returns of functions each call of ``feed`` takes until all is parsed."""
    counts = list[int]()

    def count(*_: object) -> None:
        counts[-1] += 1

    while data or splitter.has_more:
        counts.append(0)
        sys.setprofile(count)
        try:
            splitter.feed(7, data)
        finally:
            sys.setprofile(None)
        data = b""
    return counts


@pytest.mark.parametrize(
    ("name", "piece"), [(name, piece) for name, pieces in FLOODS.items() for piece in pieces]
)
def test_one_call_does_a_limited_amount_of_work(name: str, piece: bytes) -> None:
    """64 kB of tiny messages took 0.7 s in one call, on the event loop."""
    data = piece * ((64 << 10) // len(piece))
    assert max(calls_of_feed(FORMATS[name][0]("x"), data)) < 10_000


def test_lengths_that_are_too_large_are_passed_over_without_a_call() -> None:
    """Each such byte took 10 microseconds, which 64 kB of them multiply."""
    assert sum(calls_of_feed(CotSplitter("x"), b"\xbf" * (64 << 10))) < 16_000
    found = fed(CotSplitter("x"), 7, b"\xbf" * (64 << 10))
    assert sum(one.count for one in found if isinstance(one, Rejection)) == (64 << 10) - 3


def test_dropped_bytes_leave_no_half_message() -> None:
    splitter = CotSplitter("x")
    splitter.feed(1, b" " * 9 + 20 * COT)
    assert splitter.has_more and splitter._pending
    splitter.drop()
    assert not splitter.has_more
    assert [type(one) for one in splitter.feed(2, COT)] == [Frame]


# --- the bytes since the last complete message ----------------------------------------------------


@pytest.mark.parametrize("name", STREAMS)
def test_unfinished_bytes_are_dated_by_the_first_of_them(name: str) -> None:
    of, whole = FORMATS[name]
    splitter = of("x")
    assert splitter.unfinished_ns is None and not splitter.is_incomplete
    splitter.feed(1, whole[:5])
    splitter.feed(2, whole[5:9])
    assert splitter.unfinished_ns == 1 and splitter.is_incomplete
    splitter.feed(3, whole[9:])
    assert splitter.unfinished_ns is None and not splitter.is_incomplete
    splitter.feed(4, whole + whole[:5])
    splitter.feed(5, whole[5:] + whole[:5])
    assert splitter.unfinished_ns == 5 and not splitter.is_incomplete
    splitter.finish(6)
    assert splitter.unfinished_ns is None


UNUSABLE: list[tuple[str, Callable[[str], ForeignSplitter], bytes]] = [
    ("readsb's heartbeat", SbsSplitter, b"\r\n"),
    ("a line about the display", SbsSplitter, b"STA,,5,1,,1,,,,,RM\n"),
    ("a receiver's status", BeastSplitter, b"\x1a4" + bytes(21)),
    ("a wrong checksum", BeastSplitter, BEAST[:-1] + b"\0"),
    ("a receiver's report", RidJson, b'{"debug": "rx"}\n'),
    ("a TAK server's ping", CotSplitter, COT.replace(b"a-f-A", b"t-x-c-t")),
]


@pytest.mark.parametrize(
    ("of", "data"), [one[1:] for one in UNUSABLE], ids=[o[0] for o in UNUSABLE]
)
def test_complete_messages_without_an_aircraft_are_no_unfinished_bytes(
    of: Callable[[str], ForeignSplitter], data: bytes
) -> None:
    splitter = of("x")
    splitter.feed(1, data[:1])
    splitter.feed(2, data[1:])
    assert splitter.unfinished_ns is None and not splitter.is_incomplete


@pytest.mark.parametrize("name", FORMATS)
def test_skipped_messages_are_counted_and_the_stream_stays_in_step(name: str) -> None:
    of, valid = FORMATS[name]
    splitter, cut = of("x"), len(valid) // 2
    if name == "json":
        splitter.feed(0, valid.replace(b"1.5", b"0.5"))  # the first has an unknown age
        splitter.skips = True
        assert splitter.feed(1, valid) == [] and not splitter.has_more
        valid = valid.replace(b"1.5", b"1.6")
    else:
        splitter.feed(1, valid[:cut])
        splitter.skips = True
        assert splitter.feed(2, valid[cut:] + valid + valid[:cut]) == []
        assert splitter.skipped == 2
        splitter.skips, splitter.skipped = False, 1
        found = splitter.feed(3, valid[cut:])
        assert [type(one) for one in found] == [Frame] * len(found) and found
    splitter.skips = False
    assert any(isinstance(one, Frame) for one in splitter.feed(4, valid))
    assert splitter.skipped == 1
    assert splitter.unfinished_ns is None


@pytest.mark.parametrize("name", FORMATS)
def test_garbage_alone_is_unfinished(name: str) -> None:
    splitter = FORMATS[name][0]("x")
    for found in fed(splitter, 1, b"x" * 20_000):
        assert isinstance(found, Rejection) and found.reason is Reason.GARBAGE
    fed(splitter, 2, b"x" * 20_000)
    assert splitter.unfinished_ns == 1 and splitter.is_incomplete
    splitter.feed(3, (b"\n" if name in ("sbs", "rid") else b"") + FORMATS[name][1])
    assert splitter.unfinished_ns is None


def test_objects_of_another_format_are_counted() -> None:
    (found,) = RidJson("x").feed(7, b'{"lat": 1.5, "lon": 2}\n')
    assert isinstance(found, Rejection)
    assert (found.reason, found.detail) == (Reason.UNKNOWN_MESSAGE, "object of an unknown format")
