"""Fleet messages: encoded and decoded unchanged; others are rejected with a reason."""

import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.mavlink.links.zenoh_config import MESSAGE_MAX
from companion.node.fleet import messages
from companion.node.fleet.messages import FleetMessageError
from companion.recording import schemas
from companion.values import Offer, RoundTrip, Shared, SharedFrame, Source, Standing

TIMES = st.integers(0, 1 << 62)
NAMES = st.text("abc:0123456789", min_size=1, max_size=20)
PLACES = st.tuples(st.floats(-90, 90), st.floats(-180, 180), st.floats(-1e6, 1e6))
NUMBERS = st.floats(-1e9, 1e9, allow_nan=False)
DECIBELS = st.floats(-300, 300)
UNSURE = st.none() | DECIBELS
FRAMES = st.lists(st.builds(SharedFrame, st.integers(0, 1 << 61), st.binary(max_size=300)))
TRIPS = st.lists(
    st.builds(
        RoundTrip,
        t_ns=TIMES,
        source=st.builds(Source, st.integers(0, 255), st.integers(0, 255)),
        sent_ns=TIMES,
        remote_ns=st.integers(-(1 << 62), 1 << 62),
    ),
    max_size=5,
)


@given(st.builds(Shared, TIMES, FRAMES.map(tuple), TRIPS.map(tuple)))
@settings(max_examples=examples(100))
def test_shared_frames_round_trip(said: Shared) -> None:
    assert messages.to_shared(messages.shared(said)) == said


@given(
    st.builds(
        Standing,
        node=st.just("north"),
        place=st.none() | PLACES,
        reach_m=st.none() | NUMBERS,
        most=st.integers(0, messages.OFFERS_MAX),
        serves=st.lists(st.tuples(NAMES, DECIBELS)).map(tuple),
        handing=st.lists(st.tuples(NAMES, NAMES)).map(tuple),
    )
)
@settings(max_examples=examples(100))
def test_node_status_round_trips_exactly(said: Standing) -> None:
    """Bit-exact: nodes that compare values must have the same number."""
    assert messages.to_standing(messages.standing(said), "north") == said


@given(
    st.lists(
        st.builds(
            Offer,
            uav=NAMES,
            sure_db=UNSURE,
            likely_db=UNSURE,
            sinr_db=UNSURE,
            heard_s=st.none() | NUMBERS,
        ),
        unique_by=lambda o: o.uav,
    )
)
@settings(max_examples=examples(100))
def test_offers_round_trip(said: list[Offer]) -> None:
    assert list(messages.to_offers(messages.offers({o.uav: o for o in said}))) == said


@given(st.binary(max_size=400))
@settings(max_examples=examples(300))
def test_arbitrary_bytes_are_decoded_or_rejected(data: bytes) -> None:
    for read in (
        messages.to_shared,
        messages.to_offers,
        lambda some: messages.to_standing(some, "north"),
    ):
        try:
            read(data)
        except FleetMessageError:
            continue


def test_implausible_messages_are_rejected() -> None:
    def standing(**fields: object) -> bytes:
        made: bytes = schemas.message_class("Standing")(node="north", **fields).SerializeToString()
        return made

    assert messages.to_standing(standing(), "north").serves == ()
    for wrong, node in (
        (standing(), "south"),  # it names another node
        (standing(place=[1.0]), "north"),
        (standing(place=[1.0, float("nan"), 0.0]), "north"),
        (standing(place=[90.5, 0.0, 0.0]), "north"),
        (standing(place=[1.0, 1e300, 0.0]), "north"),
        (standing(reach_m=float("nan")), "north"),
        (standing(serves=[{"uav": "1:1", "worth_db": 301.0}]), "north"),
        (standing(serves=[{"uav": "\u0663:1", "worth_db": 1.0}]), "north"),
        (standing(serves=[{"uav": "1:1", "worth_db": float("inf")}]), "north"),
        (standing(serves=[{"uav": "", "worth_db": 1.0}]), "north"),
        (standing(serves=[{"uav": "x" * 65, "worth_db": 1.0}]), "north"),
        (standing(handing=[{"uav": "1:1", "to": "\n"}]), "north"),
    ):
        with pytest.raises(FleetMessageError):
            messages.to_standing(wrong, node)
    many = schemas.message_class("Shared")(
        frame=[{}] * (messages.FRAMES_MAX + 1)
    ).SerializeToString()
    with pytest.raises(FleetMessageError, match="too many frames in one message"):
        messages.to_shared(many)


def test_time_field_of_older_nodes_is_ignored() -> None:
    now = schemas.message_class("Standing")(node="north", most=3).SerializeToString()
    older = b"\x11" + b"\x01" * 8 + b"\x19" + b"\x02" * 8 + now
    assert messages.to_standing(older, "north") == messages.to_standing(now, "north")


def test_message_schema_is_published_and_documented() -> None:
    """Every message is in the published schema and in the documentation."""
    page = (Path(__file__).parents[3] / "docs" / "fleet.md").read_text(encoding="utf-8")
    for name in ("Shared", "Standing", "Offers", "Tracks"):
        assert f"companion.{name}" in page
        assert name.encode() in schemas.schema("Shared").descriptor_set


LARGE = {"shared": messages.to_shared, "offers": messages.to_offers}


@pytest.mark.parametrize("name", LARGE)
def test_largest_messages_fit_into_a_sample(name: str) -> None:
    uav = "x" * messages.NAME_MAX
    offers = {
        str(n): Offer(uav=uav, sure_db=1.0, likely_db=1.0, sinr_db=1.0, heard_s=1.0)
        for n in range(messages.OFFERS_MAX)
    }
    frames = (SharedFrame(1 << 61, bytes(280)),) * messages.FRAMES_MAX
    largest = {"offers": messages.offers(offers), "shared": messages.shared(Shared(0, frames, ()))}
    LARGE[name](largest[name])
    assert len(largest[name]) <= MESSAGE_MAX


def _fields(*numbers: int) -> st.SearchStrategy[bytes]:
    """Bytes of protobuf with these fields, of any type and content."""

    def encoded(parts: list[tuple[int, int, int, bytes]]) -> bytes:
        out = b""
        for number, kind, value, data in parts:
            out += bytes([number << 3 | kind])
            out += {
                0: messages.schemas._varint(value),
                1: struct.pack("<Q", value),
                2: messages.schemas._varint(len(data)) + data,
            }[kind]
        return out

    part = st.tuples(
        st.sampled_from(numbers),
        st.sampled_from([0, 1, 2]),
        st.integers(0, (1 << 64) - 1) | st.sampled_from([0, 0x7FF0 << 48, 0x7FF8 << 48, 1 << 62]),
        st.binary(max_size=12),
    )
    return st.lists(part, max_size=6).map(encoded)


@given(
    outer=_fields(1, 2, 3, 4, 5, 6, 7, 8), inner=_fields(1, 2, 3, 4, 5), number=st.integers(1, 8)
)
@settings(max_examples=examples(300))
def test_any_protobuf_is_decoded_or_rejected_in_one_line(
    outer: bytes, inner: bytes, number: int
) -> None:
    data = outer + bytes([number << 3 | 2, len(inner) & 127]) + inner + b"\x0a\x05north"
    for read in (
        messages.to_shared,
        messages.to_offers,
        lambda some: messages.to_standing(some, "north"),
    ):
        try:
            read(data)
        except FleetMessageError as error:
            assert str(error).isprintable() and len(str(error)) < 100
