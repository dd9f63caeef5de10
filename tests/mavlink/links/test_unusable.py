"""Peers whose datagrams have no acceptable frame: parsed in part, while the machine is late."""

import pytest
from link_support import frame

from companion.mavlink.links.transport import UNUSABLE_MAX, UNUSABLE_PARSED, Link
from companion.mavlink.links.urls import parse_link
from companion.mavlink.trust.newcomers import LATE_NS
from companion.mavlink.trust.signing import LinkSigning
from companion.values import Frame, Rejection

DAMAGED = frame(1)[:-2] + b"xx"


def link(guard: LinkSigning | None = None) -> tuple[Link, list[Frame | Rejection]]:
    items = list[Frame | Rejection]()
    url = parse_link("udpin:127.0.0.1:0")
    made = Link(url=url, receive=items.extend, now_ns=lambda: 10**12, guard=guard)
    return made, items


@pytest.mark.parametrize("data", [DAMAGED, b"\xfd\xff" * 20], ids=["damaged", "starts of frames"])
def test_late_datagrams_of_a_peer_without_valid_frames_are_mostly_dropped(data: bytes) -> None:
    made, items = link()
    for n in range(UNUSABLE_MAX + 10 * UNUSABLE_PARSED):
        made.take(("127.0.0.1", 9), data, LATE_NS + 1)
        if n == UNUSABLE_MAX - 1:
            assert made.status.overflowed is None
    assert made.status.overflowed == 10 * (UNUSABLE_PARSED - 1)
    made.take(("127.0.0.1", 8), frame(2), LATE_NS + 1)  # another peer's is not
    assert sum(isinstance(one, Frame) for one in items) == 1


def test_frames_that_are_not_signed_are_no_better() -> None:
    made, items = link(LinkSigning(key=bytes(32), link_id=0))
    for n in range(UNUSABLE_MAX + 10 * UNUSABLE_PARSED):
        made.take(("127.0.0.1", 9), frame(n), LATE_NS + 1)
    assert made.status.overflowed == 10 * (UNUSABLE_PARSED - 1)
    assert not any(isinstance(one, Frame) for one in items)


def test_peer_that_sends_valid_frames_again_is_found() -> None:
    made, items = link()
    for _ in range(UNUSABLE_MAX):
        made.take(("127.0.0.1", 9), DAMAGED, LATE_NS + 1)
    for n in range(2 * UNUSABLE_PARSED):
        made.take(("127.0.0.1", 9), frame(n), LATE_NS + 1)
    assert sum(isinstance(one, Frame) for one in items) > UNUSABLE_PARSED


def test_datagrams_in_time_are_all_parsed() -> None:
    made, _ = link()
    for _ in range(UNUSABLE_MAX + 10):
        made.take(("127.0.0.1", 9), DAMAGED, LATE_NS)
    assert made.status.overflowed is None
