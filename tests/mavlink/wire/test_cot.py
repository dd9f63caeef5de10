"""Cursor on Target: XML and TAK protobuf as takproto encodes them, on a link, and invalid input."""

import math
import time
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any
from xml.etree import ElementTree

import link_support
import pytest
import takproto
from hypothesis import given
from hypothesis import strategies as st

from companion.mavlink.wire.cot import DEPTH_MAX, OWN, from_protobuf, from_xml
from companion.mavlink.wire.cot_link import EVENT_MAX, SENDER, CotSplitter
from companion.mavlink.wire.decode import decode
from companion.values import AltitudeDatum, Frame, Reason, Rejection, Report, Source

S = 1_000_000_000
STARTED = "2026-11-22T10:00:00.250Z"
EVENT = (
    '<event version="2.0" uid="HAWK-1" type="a-f-A-M-H-Q" time="{time}" start="{time}" '
    'stale="2026-11-22T10:01:00Z" how="m-g"><point lat="51.4774" lon="-0.0015" hae="120.5" '
    'ce="4.5" le="9.0"/><detail><contact callsign="HAWK"/><track course="90.0" speed="12.5"/>'
    "</detail></event>"
)
XML = EVENT.format(time=STARTED).encode()


def changed(old: str, new: str) -> bytes:
    text = XML.decode()
    assert old in text
    return text.replace(old, new).encode()


def fed(data: bytes) -> list[Frame | Rejection]:
    return link_support.fed(CotSplitter("cot:x"), 7, data)


def said(data: bytes) -> Report:
    (frame,) = fed(data)
    assert isinstance(frame, Frame), frame
    found = decode(frame)
    assert isinstance(found, Report), found
    return found


def refused(data: bytes) -> Rejection:
    (found,) = fed(data)
    assert isinstance(found, Rejection), found
    return found


def test_cot_event_becomes_a_report_with_its_stated_errors() -> None:
    report = said(XML)
    assert (report.uav, report.source) == ("cot:HAWK-1", SENDER)
    assert (report.lat_deg, report.lon_deg) == pytest.approx((51.4774, -0.0015))
    assert (report.alt_m, report.alt_datum) == (120.5, AltitudeDatum.GEOMETRIC)
    assert report.velocity_ne_mps == pytest.approx((0.0, 12.5), abs=1e-6)
    assert report.velocity_down_mps is None
    assert report.accuracy == (4.5, 9.0, None, None)
    at = datetime(2026, 11, 22, 10, 0, 0, 250_000, UTC)
    assert report.boot_ms == round(at.timestamp() * 1000) % 2**32


def test_times_without_a_zone_are_utc() -> None:
    assert said(
        changed('time="2026-11-22T10:00:00.250Z" start', 'time="2026-11-22T10:00:00.25" start')
    ) == said(XML)
    assert said(changed("00.250Z", "00.250+00:00")) == said(XML)


def test_slope_and_unknown_errors_are_decoded() -> None:
    sinking = said(changed('speed="12.5"', 'speed="12.5" slope="-45"'))
    assert sinking.velocity_down_mps == pytest.approx(12.5)
    for ce in ("9999999", "9999999.0", "999999", "0", "-1", "NaN"):
        report = said(changed('ce="4.5"', f'ce="{ce}"'))
        assert report.accuracy == (None, 9.0, None, None)
    assert said(changed('<track course="90.0" speed="12.5"/>', "")).velocity_ne_mps is None


def test_nearly_vertical_slope_is_unknown() -> None:
    steep = said(changed('speed="12.5"', 'speed="12.5" slope="89.99999999"'))
    assert steep.velocity_down_mps is None and steep.velocity_ne_mps is not None
    diving = said(changed('speed="12.5"', 'speed="12.5" slope="-89"'))
    assert diving.velocity_down_mps == pytest.approx(12.5 * math.tan(math.radians(89)))


def test_position_before_a_fix_is_rejected() -> None:
    """TAK clients without a receiver state 0, 0, some with a height."""
    text = changed('lat="51.4774" lon="-0.0015"', 'lat="0.0" lon="0.0"')
    (frame,) = fed(text)
    assert isinstance(frame, Frame)
    found = decode(frame)
    assert isinstance(found, Rejection) and found.reason is Reason.ZERO_POSITION


@pytest.mark.parametrize(
    ("old", "new"),
    [("", ""), ('ce="4.5"', 'ce="9999999.0"'), ("HAWK-1", "é 1"), ('lat="51.4774"', 'lat="0.1"')],
)
@pytest.mark.parametrize("kind", [takproto.TAKProtoVer.MESH, takproto.TAKProtoVer.STREAM])
def test_takproto_bytes_decode_like_the_xml(old: str, new: str, kind: Any) -> None:
    """Encoded by another program from the same XML."""
    text = changed(old, new) if old else XML
    (packed,) = fed(bytes(takproto.xml2proto(text.decode(), kind)))
    (plain,) = fed(text)
    assert isinstance(packed, Frame) and isinstance(plain, Frame)
    assert decode(packed) == decode(plain)


def test_takproto_reads_our_events() -> None:
    raw = bytes(takproto.xml2proto(XML.decode(), takproto.TAKProtoVer.MESH))
    theirs = takproto.parse_proto(raw).cotEvent
    ours = from_protobuf(raw[3:])
    assert ours == from_xml(XML)
    assert ours is not None
    assert (ours.uid, ours.kind, ours.time_ms) == (theirs.uid, theirs.type, theirs.sendTime)
    assert (ours.lat_deg, ours.ce_m) == (theirs.lat, theirs.ce)
    assert (ours.course_deg, ours.speed_mps) == (theirs.detail.track.course, 12.5)
    assert from_protobuf(b"") is None
    for time_ms in (2**48, 2**63):
        late = takproto.parse_proto(raw)
        late.cotEvent.sendTime = time_ms
        assert refused(b"\xbf\x01\xbf" + late.SerializeToString()).reason is Reason.MALFORMED


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("a-f-A-M-H-Q", "a-f-G-U-C", Reason.UNKNOWN_MESSAGE),
        ("a-f-A-M-H-Q", "b-t-f", Reason.UNKNOWN_MESSAGE),
        ('how="m-g"', 'how="h-e"', Reason.UNKNOWN_MESSAGE),
        ("HAWK-1", f"{OWN}3.1", Reason.UNKNOWN_MESSAGE),
        ('hae="120.5"', 'hae="9999999.0"', Reason.NO_ALTITUDE),
        ('lat="51.4774"', 'lat="91"', Reason.MALFORMED),
        ('lon="-0.0015"', 'lon="nan"', Reason.MALFORMED),
        ('lat="51.4774"', "", Reason.MALFORMED), ('uid="HAWK-1"', 'uid=""', Reason.MALFORMED),
        ('time="2026', 'time="26', Reason.MALFORMED), ("<point", "<pint", Reason.MALFORMED),
        ('version="2.0"', 'version="2.0', Reason.MALFORMED),
        ('callsign="HAWK"', 'callsign="&lol;"', Reason.MALFORMED),
        ("HAWK-1", "\x01", Reason.MALFORMED),
        ('time="2026', 'time="1926', Reason.MALFORMED),
        ('time="2026', 'time="9999999', Reason.MALFORMED),
    ],
)  # fmt: skip
def test_unusable_events_are_rejected(old: str, new: str, reason: Reason) -> None:
    assert refused(changed(old, new)).reason is reason
    assert refused(changed(old, new)).source in ("cot:x", "cot:HAWK-1")


@pytest.mark.parametrize(
    "inside",
    [
        '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>',
        "<a>" * DEPTH_MAX + "</a>" * DEPTH_MAX, "\xff\xfe", "<a" * 40, "<![CDATA[" + "</event>",
    ],
)  # fmt: skip
def test_xml_bombs_are_rejected(inside: str) -> None:
    raw = XML.replace(b"<detail>", b"<detail>" + inside.encode("latin-1"))
    found = fed(raw)
    assert found and all(isinstance(one, Rejection) for one in found)
    deep = DEPTH_MAX - 2  # within the event and its detail
    assert said(XML.replace(b"<detail>", b"<detail>" + b"<a>" * deep + b"</a>" * deep)) == said(XML)
    with pytest.raises(ValueError, match=r"document type|XML"):
        from_xml(f'<!DOCTYPE event [<!ENTITY a "b">]>{XML.decode()}'.encode())


def test_ids_with_special_characters_stay_distinct() -> None:
    names = [said(changed("HAWK-1", uid)).uav for uid in ("a/b", "a_b", "a b", "x" * 300)]
    assert len(set(names)) == 4
    assert names[1] == "cot:a_b"
    assert all(len(name) < 64 and "/" not in name and " " not in name for name in names)


def test_foreign_tunnel_message_is_ignored() -> None:
    (frame,) = fed(XML)
    assert isinstance(frame, Frame)
    assert decode(frame._replace(source=Source(9, 25))) is None


STREAM = (
    b'<?xml version="1.0" encoding="UTF-8"?>\n' + XML + b"\n" + XML
    + bytes(takproto.xml2proto(XML.decode(), takproto.TAKProtoVer.STREAM)) + b"\n" + XML
)  # fmt: skip


@given(st.lists(st.integers(1, len(STREAM) - 1), max_size=20))
def test_split_input_gives_the_same_result(cuts: list[int]) -> None:
    at = [0, *sorted(cuts), len(STREAM)]
    splitter = CotSplitter("x")
    pieces = [STREAM[a:b] for a, b in pairwise(at)]
    whole = link_support.fed(CotSplitter("x"), 7, STREAM)
    assert [type(one) for one in whole] == [Frame] * 4
    assert [one for piece in pieces for one in link_support.fed(splitter, 7, piece)] == whole
    assert splitter.finish(8) == []


def test_bytes_between_events_are_counted() -> None:
    garbage, frame = sorted(fed(b"noise" + XML + b"more"), key=lambda one: isinstance(one, Frame))
    assert isinstance(frame, Frame)
    assert garbage == Rejection(t_ns=7, source="cot:x", reason=Reason.GARBAGE, count=9)
    splitter = CotSplitter("x")
    assert splitter.feed(7, XML[:100]) == []
    assert splitter.finish(8) == [Rejection(t_ns=8, source="x", reason=Reason.GARBAGE, count=100)]


@pytest.mark.parametrize("piece", [b"<event ", b"\xbf\xff\xff\xff\xff\x7f", b"\xbf", b"<", b"<a>"])
def test_endless_events_use_bounded_memory_and_time(piece: bytes) -> None:
    splitter = CotSplitter("x")
    began_s = time.process_time()
    for _ in range(100):
        link_support.fed(splitter, 7, piece * 500)
        assert len(splitter._pending) <= EVENT_MAX + len(piece) * 500
    assert time.process_time() - began_s < 10  # linear: tenths of a second
    found = link_support.fed(splitter, 7, b"</event>" * 2 + XML)
    assert isinstance(found[0], Frame | Rejection)


@given(st.binary(max_size=200), st.integers(0, 2))
def test_arbitrary_bytes_never_raise(data: bytes, form: int) -> None:
    wrapped = (data, b"\xbf\x01\xbf" + data, b"<event " + data + b"</event>")[form]
    for found in fed(wrapped + XML):
        assert isinstance(found, Rejection) or isinstance(decode(found), Report)


_TEXT = st.text(max_size=30) | st.floats().map(str)


@given(st.sampled_from(["uid", "type", "how", "time", "lat", "lon", "hae", "ce", "le"]), _TEXT)
def test_arbitrary_attributes_never_raise(name: str, text: str) -> None:
    root = ElementTree.fromstring(XML)
    point = root.find("point")
    assert point is not None
    (point if name in point.attrib else root).set(name, text)
    for found in fed(ElementTree.tostring(root)):
        report = found if isinstance(found, Rejection) else decode(found)
        assert isinstance(report, Report | Rejection)
        if isinstance(found, Frame) and isinstance(report, Rejection):
            assert report.reason is Reason.ZERO_POSITION


@given(st.binary(max_size=160), st.integers(0, 140))
def test_arbitrary_tunnel_payloads_never_raise(body: bytes, size: int) -> None:
    (frame,) = fed(XML)
    assert isinstance(frame, Frame)
    payload = frame.payload[:4] + bytes([size]) + body
    raw = bytearray(frame.raw[:10] + payload + b"\0\0")
    raw[1] = len(payload)
    assert isinstance(decode(frame._replace(raw=bytes(raw))), Report | Rejection | None)
    assert not math.isnan(said(XML).alt_m)


def test_cot_frames_use_system_0_and_a_user_component() -> None:
    assert Source(sysid=0, compid=25) == SENDER
