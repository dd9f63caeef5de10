"""Messages that the service makes from Cursor on Target never come from a MAVLink peer."""

from companion.mavlink.links.transport import Link
from companion.mavlink.links.urls import parse_link
from companion.mavlink.wire.cot_link import TUNNEL
from companion.values import Frame, Reason, Rejection

EVENT = (
    b'<event uid="A" type="a-f-A" time="2026-11-22T10:00:00Z" how="m-g">'
    b'<point lat="51.4" lon="-0.1" hae="120" ce="4" le="9"/></event>'
)
PEER = ("10.0.0.66", 4000)


def received(url: str, data: bytes) -> list[Frame | Rejection]:
    """Return the items that a link passes on when a peer sends these bytes."""
    found: list[Frame | Rejection] = []
    Link(url=parse_link(url), receive=found.extend, now_ns=lambda: 10**18).take(PEER, data)
    return found


def test_a_peer_cannot_send_the_message_of_a_cursor_on_target_link() -> None:
    (own,) = received("cot:udp:127.0.0.1:0", EVENT)
    assert isinstance(own, Frame) and own.msgid == TUNNEL
    (forged,) = received("udpin:127.0.0.1:0", own.raw)
    assert isinstance(forged, Rejection)
    assert (forged.reason, forged.msgid, forged.source) == (Reason.NOT_ALLOWED, TUNNEL, "0:25")
