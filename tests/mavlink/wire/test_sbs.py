"""BaseStation lines: a published stream, whole and in fragments, and invalid input."""

import math
from itertools import pairwise
from typing import Any

import link_support
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.wire.decode import decode
from companion.mavlink.wire.sbs import LINE_MAX, SbsSplitter
from companion.mavlink.wire.transponder import SENDER
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import AdsbVehicle, AltitudeDatum, Estimate, Frame, Reason, Rejection, Source

# From http://woodair.net/SBS/Article/Barebones42_Socket_Data.htm, where lines were held back for
# five minutes; here they were not.
PUBLISHED = b"""\
STA,,5,179,400AE7,10103,2008/11/28,14:58:51.153,2008/11/28,14:58:51.153,RM
MSG,8,5,211,4CA2D6,10057,2008/11/28,14:53:50.391,2008/11/28,14:53:51.153,,,,,,,,,,,,0
MSG,4,5,211,4CA2D6,10057,2008/11/28,14:53:50.391,2008/11/28,14:53:51.153,,,408.3,146.4,,,64,,,,,
MSG,3,5,211,4CA2D6,10057,2008/11/28,14:53:50.594,2008/11/28,14:53:51.153,,37000,,,51.45735,-1.02826,,,0,0,0,0
MSG,3,5,276,4010E9,10088,2008/11/28,14:53:49.986,2008/11/28,14:53:51.153,,28000,,,53.02551,-2.91389,,,0,0,0,0
MSG,4,5,769,4CA2CB,10061,2008/11/28,14:53:50.188,2008/11/28,14:53:51.153,,,367.7,138.6,,,-2432,,,,,
"""
LATE = (
    "MSG,3,5,211,4CA2D6,10057,2008/11/28,14:53:50.594,2008/11/28,14:58:51.153,,37000,,,51.45735,"
    "-1.02826,,,0,0,0,0"
)
CALLED = (
    "MSG,1,5,211,4006B3,10057,2008/11/28,23:59:59.900,2008/11/29,00:00:02.150,BAW4J   ,,,,,,,,,,,"
)


def line(**fields: str) -> str:
    """Return a line with a position, and other fields by number: ``f11="37000"``."""
    cells = LATE.split(",")
    for name, text in fields.items():
        cells[int(name[1:])] = text
    return ",".join(cells)


def fed(text: str | bytes) -> list[Frame | Rejection]:
    data = text.encode() if isinstance(text, str) else text
    return link_support.fed(SbsSplitter("sbs:radar:30003"), 7, data + b"\r\n")


def said(text: str) -> AdsbVehicle:
    (frame,) = fed(text)
    assert isinstance(frame, Frame), frame
    found = decode(frame)
    assert isinstance(found, AdsbVehicle)
    return found


def refused(text: str | bytes) -> Rejection:
    (found,) = fed(text)
    assert isinstance(found, Rejection)
    return found


def test_published_sbs_stream_decodes() -> None:
    """Decoded by pymavlink; feet, knots and feet per minute are 0.3048 m, 1852 m/h and
    0.00508 m/s.
    """
    mav: Any = dialect.MAVLink(None)
    frames = fed(PUBLISHED.rstrip())
    assert all(isinstance(one, Frame) and one.source == (0, 156) for one in frames)
    moving, placed, other, sinking = [mav.decode(bytearray(one.raw)) for one in frames]
    assert [one.ICAO_address for one in (moving, placed, other, sinking)] == [
        0x4CA2D6, 0x4CA2D6, 0x4010E9, 0x4CA2CB,
    ]  # fmt: skip
    assert (placed.lat, placed.lon, placed.altitude) == (514_573_500, -10_282_600, 11_277_600)
    assert placed.flags == dialect.ADSB_FLAGS_VALID_COORDS | dialect.ADSB_FLAGS_VALID_ALTITUDE
    assert placed.altitude_type == dialect.ADSB_ALTITUDE_TYPE_PRESSURE_QNH
    assert (other.lat, other.lon, other.altitude) == (530_255_100, -29_138_900, 8_534_400)
    assert (moving.hor_velocity, moving.heading, moving.ver_velocity) == (21_005, 14_640, 33)
    assert (sinking.hor_velocity, sinking.heading, sinking.ver_velocity) == (18_916, 13_860, -1235)
    assert sinking.flags == (
        dialect.ADSB_FLAGS_VALID_HEADING
        | dialect.ADSB_FLAGS_VALID_VELOCITY
        | dialect.ADSB_FLAGS_VERTICAL_VELOCITY_VALID
    )
    assert [one.tslc for one in (placed, other)] == [0, 1]


def test_delayed_line_has_its_age() -> None:
    assert said(LATE).tslc_s == 255  # 300 s, limited to the field's maximum
    assert said(CALLED).tslc_s == 2.25
    assert said(line(f7="14:59:00.000")).tslc_s == 0  # from the future
    assert said(line(f6="", f7="")).tslc_s == 0


def test_late_stream_is_in_the_age_and_its_error() -> None:
    """A line may be 4 s late, or its writer's clock was set back by as much."""
    splitter = SbsSplitter("x")
    stated = [("14:58:00.5", 10), ("14:58:01.5", 11), ("14:58:02.5", 16), ("14:58:07.6", 17)]
    found = []
    for stamp, arrival_s in stated:
        text = line(f6="2008/11/28", f7=stamp, f8="2008/11/28", f9=stamp)
        (frame,) = splitter.feed(arrival_s * 1_000_000_000, text.encode() + b"\n")
        assert isinstance(frame, Frame)
        told = decode(frame)
        assert isinstance(told, AdsbVehicle)
        found.append((told.tslc_s, told.accuracy.time_s if told.accuracy else None))
    assert found[:2] == [(0, None), (0, None)]
    assert found[2] == (pytest.approx(2.0, abs=0.005), pytest.approx(3.0, abs=0.101))
    assert found[3] == (0, None)


def stamped(splitter: SbsSplitter, arrival_s: float, stamp: str) -> list[Frame | Rejection]:
    text = line(f6="2008/11/28", f7=stamp, f8="2008/11/28", f9=stamp)
    return splitter.feed(round(arrival_s * 1e9), text.encode() + b"\n")


def test_line_with_another_time_is_rejected_alone() -> None:
    """One line 60 s ahead made all aircraft of the connection 30 s old."""
    splitter = SbsSplitter("x")
    for second in range(10):
        (found,) = stamped(splitter, second, f"14:58:{second:02}.0")
        assert isinstance(found, Frame)
        if second == 5:
            (refused,) = stamped(splitter, second, "14:59:05.0")
            assert isinstance(refused, Rejection) and refused.reason is Reason.UNPLACED_STAMP
    told = decode(found)
    assert isinstance(told, AdsbVehicle)
    assert told.tslc_s == 0 and told.accuracy is None and splitter.too_late is None
    for second in range(10, 16):
        stamped(splitter, second, f"14:57:{second:02}.0")
    assert splitter.too_late == "lines are over 10 s later than before, or its clock was set back"


def test_fields_missing_from_a_line_are_unknown() -> None:
    called = said(CALLED)
    assert (called.callsign, called.uav) == ("BAW4J", "icao:4006B3")
    assert called.position_deg is called.alt_m is called.velocity_ne_mps is None
    assert called.velocity_down_mps is called.heading_deg is called.alt_datum is None
    placed = said(LATE)
    assert placed.callsign is placed.velocity_ne_mps is None
    assert said(line(f15="")).position_deg is None
    assert said(line(f12="0", f13="0")).velocity_ne_mps == (0.0, 0.0)
    assert said(line(f11="1000H")).alt_datum is AltitudeDatum.GEOMETRIC
    assert placed.alt_datum is AltitudeDatum.PRESSURE


@pytest.mark.parametrize(
    "fields",
    [
        {"f14": "91"}, {"f15": "-180.1"}, {"f14": "nan"}, {"f14": "1e1"}, {"f11": "x"},
        {"f12": "-1"}, {"f13": "361"}, {"f16": "99999"}, {"f4": "4CA2D"}, {"f4": "~4CA2D"},
        {"f11": "9" * 400}, {"f10": "\xe9"},
    ],
)  # fmt: skip
def test_malformed_fields_are_rejected(fields: dict[str, str]) -> None:
    found = refused(line(**fields))
    assert (found.reason, found.source) == (Reason.MALFORMED, "sbs:radar:30003")
    assert found.detail


def test_invalid_line_is_counted_in_bytes() -> None:
    assert refused("GET / HTTP/1.1") == Rejection(
        t_ns=7, source="sbs:radar:30003", reason=Reason.GARBAGE, count=16
    )
    assert sum(one.count for one in fed(b"\xfd\x00" * LINE_MAX)) == 2 * LINE_MAX + 2
    assert refused(line().replace("MSG", "MLAT")).reason is Reason.UNKNOWN_MESSAGE
    assert fed("CLK,,,,,,2008/11/28,14:53:50.594,,") == fed("") == []
    ended = SbsSplitter("x")
    assert ended.feed(7, b"MSG,3") == []
    assert ended.finish(8) == [Rejection(t_ns=8, source="x", reason=Reason.GARBAGE, count=5)]


def test_endless_line_uses_bounded_memory() -> None:
    splitter = SbsSplitter("x")
    found = [one for _ in range(1000) for one in splitter.feed(7, b"M" * 100)]
    counted = sum(one.count for one in found if isinstance(one, Rejection))
    assert 100_000 - LINE_MAX <= counted <= 100_000  # bytes not counted are kept
    end_of_it = LATE.encode() + b"\n"
    found += splitter.feed(7, end_of_it + PUBLISHED)
    lost = sum(one.count for one in found if isinstance(one, Rejection))
    assert lost == 100_000 + len(end_of_it)
    assert sum(isinstance(one, Frame) for one in found) == 4
    assert splitter.feed(7, b"M" * (LINE_MAX + 1))  # all of it is counted, and none is kept
    assert isinstance(splitter.feed(7, end_of_it)[0], Rejection)  # still the rest of that line


@given(st.lists(st.integers(1, len(PUBLISHED) - 1), max_size=20))
def test_split_input_gives_the_same_result(cuts: list[int]) -> None:
    at = [0, *sorted(cuts), len(PUBLISHED)]
    splitter = SbsSplitter("x")
    pieces = [PUBLISHED[a:b] for a, b in pairwise(at)]
    whole = link_support.fed(SbsSplitter("x"), 7, PUBLISHED)
    assert [one for piece in pieces for one in link_support.fed(splitter, 7, piece)] == whole


@given(st.binary(max_size=200) | st.text(max_size=80).map(lambda text: f"MSG,{text}".encode()))
def test_arbitrary_bytes_never_raise(data: bytes) -> None:
    for found in fed(data):
        assert isinstance(found, Rejection) or isinstance(decode(found), AdsbVehicle | Rejection)


def test_aircraft_also_relayed_over_mavlink_stays_one_track() -> None:
    pipeline = Pipeline(Settings().override(center={"source": "51.4,-1.0,100"}))
    relay: Any = dialect.MAVLink(None, srcSystem=9, srcComponent=156)
    flags = dialect.ADSB_FLAGS_VALID_COORDS | dialect.ADSB_FLAGS_VALID_ALTITUDE
    again = dialect.MAVLink_adsb_vehicle_message(
        0x4CA2D6, 514_563_500, -10_272_600, 0, 11_277_600, 0, 0, 0, b"", 0, 0, flags, 0
    ).pack(relay)
    (first,) = SbsSplitter("sbs").feed(1_000_000_000, line(f9="14:53:50.700").encode() + b"\n")
    assert isinstance(first, Frame)
    second = Frame(
        t_ns=3_000_000_000, link="udp", source=Source(9, 156), msgid=246, raw=bytes(again)
    )
    (one,) = [out for out in pipeline.step(first) if isinstance(out, Estimate)]
    (two,) = [out for out in pipeline.step(second) if isinstance(out, Estimate)]
    assert one.fix.uav == two.fix.uav == "icao:4CA2D6"
    assert list(pipeline.tracker.uavs) == ["icao:4CA2D6"]
    assert set(pipeline.senders.aircraft.relays("icao:4CA2D6")) == {SENDER, Source(9, 156)}
    assert math.isclose(one.fix.noise.horizontal_m, two.fix.noise.horizontal_m)
