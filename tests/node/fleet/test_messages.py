"""Fleet messages: encoded and decoded unchanged; others are rejected with a reason."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.node.fleet import messages
from companion.node.fleet.messages import FleetMessageError
from companion.recording import schemas
from companion.values import Offer, RoundTrip, Shared, SharedFrame, Source, Standing

TIMES = st.integers(0, 1 << 62)
NAMES = st.text("abc:0123456789", min_size=1, max_size=20)
NUMBERS = st.floats(-1e9, 1e9, allow_nan=False)
UNSURE = st.none() | NUMBERS
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
        place=st.none() | st.tuples(NUMBERS, NUMBERS, NUMBERS),
        reach_m=UNSURE,
        most=st.integers(0, 10_000),
        serves=st.lists(st.tuples(NAMES, NUMBERS)).map(tuple),
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
            Offer, uav=NAMES, sure_db=UNSURE, likely_db=UNSURE, sinr_db=UNSURE, heard_s=UNSURE
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
        made: bytes = schemas.StandingMessage(node="north", **fields).SerializeToString()
        return made

    assert messages.to_standing(standing(), "north").serves == ()
    for wrong, node in (
        (standing(), "south"),  # it names another node
        (standing(place=[1.0]), "north"),
        (standing(place=[1.0, float("nan"), 0.0]), "north"),
        (standing(serves=[{"uav": "1:1", "worth_db": float("inf")}]), "north"),
        (standing(serves=[{"uav": "", "worth_db": 1.0}]), "north"),
        (standing(serves=[{"uav": "x" * 65, "worth_db": 1.0}]), "north"),
        (standing(handing=[{"uav": "1:1", "to": "\n"}]), "north"),
    ):
        with pytest.raises(FleetMessageError):
            messages.to_standing(wrong, node)
    many = schemas.SharedMessage(frame=[{}] * (messages.FRAMES_MAX + 1)).SerializeToString()
    with pytest.raises(FleetMessageError):
        messages.to_shared(many)


def test_time_field_of_older_nodes_is_ignored() -> None:
    now = schemas.StandingMessage(node="north", most=3).SerializeToString()
    older = b"\x11" + b"\x01" * 8 + b"\x19" + b"\x02" * 8 + now
    assert messages.to_standing(older, "north") == messages.to_standing(now, "north")


def test_message_schema_is_published_and_documented() -> None:
    """Every message is in the published schema and in the documentation."""
    page = (Path(__file__).parents[3] / "docs" / "fleet.md").read_text(encoding="utf-8")
    for name in ("Shared", "Standing", "Offers", "Tracks"):
        assert f"companion.{name}" in page
        assert name.encode() in schemas.SHARED.descriptor_set
