"""``aircraft.json``: its content, new positions in it, and invalid documents."""

import json
import math
import time
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.wire.aircraft_json import (
    AIRCRAFT_MAX,
    AT_ONCE,
    DOCUMENT_MAX,
    ENTRY_MAX,
    HEAD_MAX,
    TRANSPONDER_LATENCY_S,
    AircraftJson,
)
from companion.mavlink.wire.decode import decode
from companion.values import AdsbVehicle, AltitudeDatum, Frame, Reason, Rejection

# An aircraft as published by ADS-B Exchange, which runs readsb.
ONE: dict[str, Any] = {
    "hex": "a2fcf2", "type": "adsb_icao", "flight": "ASA541  ", "alt_baro": 5400, "alt_geom": 5650,
    "gs": 250, "track": 0.69, "baro_rate": -960, "squawk": "3766", "category": "A3",
    "lat": 47.143753, "lon": -122.320953, "nic": 8, "rc": 186, "seen_pos": 0.5, "version": 2,
    "nac_p": 10, "nac_v": 2, "sil": 3, "gva": 2, "mlat": [], "tisb": [], "messages": 52561265,
    "seen": 0, "rssi": -5,
}  # fmt: skip


def document(*aircraft: Any, now: Any = 1_600_000_000.0) -> bytes:
    return json.dumps({"now": now, "messages": 7, "aircraft": list(aircraft)}).encode()


def polling() -> AircraftJson:
    """A link that has received a document without aircraft, since the first has an unknown age."""
    poll = AircraftJson("x")
    assert poll.feed(0, document(now=1.0)) == []
    return poll


def fed(*aircraft: Any) -> list[Frame | Rejection]:
    return polling().feed(7, document(*aircraft))


def said(**changed: Any) -> AdsbVehicle:
    (frame,) = fed(ONE | changed)
    assert isinstance(frame, Frame), frame
    found = decode(frame)
    assert isinstance(found, AdsbVehicle)
    return found


def test_aircraft_json_matches_pymavlink() -> None:
    (frame,) = fed(ONE)
    assert isinstance(frame, Frame)
    mav: Any = dialect.MAVLink(None)
    theirs = mav.decode(bytearray(frame.raw))
    assert (theirs.ICAO_address, theirs.callsign) == (0xA2FCF2, "ASA541")
    assert (theirs.lat, theirs.lon) == (471_437_530, -1_223_209_530)
    assert theirs.altitude == round(5650 * 304.8)
    assert theirs.altitude_type == dialect.ADSB_ALTITUDE_TYPE_GEOMETRIC
    assert theirs.hor_velocity == round(250 * 1852 / 36)
    assert (theirs.heading, theirs.ver_velocity, theirs.tslc) == (69, round(-960 * 0.508), 0)


def test_accuracy_codes_are_95_percent_limits() -> None:
    told = said().accuracy
    assert told is not None
    assert told[:3] == pytest.approx((0.617 * 10, 0.617 * 45, 0.617 * 3), rel=1e-3)
    for unknown in (said(nac_p=0, nac_v=0, gva=0), said(nac_p=15, nac_v=7, gva=3)):
        assert unknown.accuracy is not None and unknown.accuracy[:3] == (None, None, None)


def test_missing_fields_are_unknown() -> None:
    bare = {"hex": "a2fcf2", "lat": 47.0, "lon": -122.0, "seen_pos": 3.9}
    (frame,) = fed(bare)
    assert isinstance(frame, Frame)
    found = decode(frame)
    assert isinstance(found, AdsbVehicle)
    assert found.alt_m is found.velocity_ne_mps is found.velocity_down_mps is found.callsign is None
    assert found.tslc_s == pytest.approx(3.9 + 0.1, abs=1 / 256)  # written up to 0.2 s ago
    assert said(alt_geom=None).alt_datum is AltitudeDatum.PRESSURE
    assert said(alt_geom=None, alt_baro="ground").alt_m is None
    for away in ("lat", "lon", "seen_pos"):
        assert fed({key: value for key, value in ONE.items() if key != away}) == []


def test_only_new_positions_are_delivered() -> None:
    poll, s = polling(), 1_000_000_000
    assert len(poll.feed(0, document(ONE, now=100.0))) == 1
    assert poll.feed(1, document(ONE | {"seen_pos": 0.2}, now=100.0)) == []  # the same document
    assert poll.feed(s, document(ONE | {"seen_pos": 1.5}, now=101.0)) == []  # the same position
    assert len(poll.feed(2 * s, document(ONE | {"seen_pos": 0.1}, now=102.0))) == 1
    (unplaced,) = poll.feed(3 * s, document(ONE, now=5.0))  # the server's clock was set
    assert isinstance(unplaced, Rejection) and unplaced.reason is Reason.UNPLACED_STAMP
    assert len(poll.feed(4 * s, document(ONE, now=6.0))) == 1


def test_document_of_unknown_age_is_rejected() -> None:
    """The receiver of the first may have stopped an hour ago."""
    poll = AircraftJson("x")
    (refused,) = poll.feed(7, document(ONE, ONE))
    assert isinstance(refused, Rejection)
    assert (refused.reason, refused.count) == (Reason.UNPLACED_STAMP, 2)


@pytest.mark.parametrize("answers_after_s", [0.0, 0.4, 1.5, 3.0])
@pytest.mark.parametrize("read", [0.0, 0.5, 1.0])  # when, as a share of that time
def test_position_is_as_old_as_stated(answers_after_s: float, read: float) -> None:
    """A server reads its document at any time between request and answer."""
    poll, asked_s, largest_s = AircraftJson("x"), 1000.0, 0.0
    for number in range(60):
        poll.requested(round(asked_s * 1e9))
        written_s = math.floor(asked_s + read * answers_after_s - 0.3) + 0.3  # once a second
        aircraft = ONE | {"seen_pos": 0.5, "lat": number}
        arrival_ns = round((asked_s + answers_after_s) * 1e9)
        found = poll.feed(arrival_ns, document(aircraft, now=round(written_s, 1)))
        asked_s += max(1.02, answers_after_s + 0.01)
        if number and found:
            (frame,) = found
            assert isinstance(frame, Frame)
            told = decode(frame)
            assert isinstance(told, AdsbVehicle)
            assert told.accuracy is not None and told.accuracy.time_s is not None
            largest_s = told.accuracy.time_s - TRANSPONDER_LATENCY_S
            assert abs(told.true_ns * 1e-9 - (written_s - 0.5)) <= largest_s
    assert 0 < largest_s < 0.5 + answers_after_s


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"type": "mlat"}, "computed by others"), ({"type": "tisb_icao"}, "computed by others"),
        ({"mlat": ["lat", "lon"]}, "computed by others"), ({"hex": "~a2fcf2"}, "not an ICAO"),
    ],
)  # fmt: skip
def test_aircraft_located_by_multilateration_are_rejected(
    changed: dict[str, Any], why: str
) -> None:
    (found,) = fed(ONE | changed)
    assert isinstance(found, Rejection)
    assert found.reason is Reason.UNKNOWN_MESSAGE and why in found.detail


@pytest.mark.parametrize(
    "changed",
    [
        {"lat": 91}, {"lon": float("nan")}, {"lat": "47"}, {"lat": True}, {"gs": float("inf")},
        {"alt_geom": 1e300}, {"seen_pos": -1}, {"nac_p": 99}, {"hex": "xyzxyz"}, {"hex": 5},
        {"hex": None}, {"track": [1]}, {"hex": "-12345"}, {"hex": "0x1234"}, {"hex": "fffffff"},
        {"hex": "1_2345"}, {"hex": "~"}, {"hex": "\u0663" * 6}, {"lat": 10**4000},
    ],
)  # fmt: skip
def test_malformed_aircraft_is_rejected_and_others_are_read(changed: Any) -> None:
    refused, read = fed(ONE | changed, ONE)
    assert isinstance(refused, Rejection) and refused.reason is Reason.MALFORMED and refused.detail
    assert isinstance(read, Frame)


@pytest.mark.parametrize(
    "data",
    [
        b"", b"<html>", b"[]", b"{}", b'{"now": 1}', b'{"now": 1, "aircraft": 5}', b"\xff\xfe",
        b"[" * 100_000, b'{"now": ' + b"9" * 5000 + b"}", b'{"now": NaN, "aircraft": []}',
        b'{"now": true, "aircraft": []}', b"null", b" " * (DOCUMENT_MAX + 1),
        b'{"now": 1, "x": "' + b"x" * HEAD_MAX + b'", "aircraft": []}',
        b'{"now": 1, "aircraft": [{}',
    ],
    ids=range(15),
)  # fmt: skip
def test_invalid_document_is_counted_in_bytes(data: bytes) -> None:
    (found,) = AircraftJson("x").feed(7, data)
    assert found == Rejection(t_ns=7, source="x", reason=Reason.GARBAGE, count=len(data) or 1)


@pytest.mark.parametrize(
    "entry",
    [
        b'{"hex":"' + b"x" * ENTRY_MAX + b'"}',
        b'{"0":1,' + b'"1":1,' * 800_000 + b'"1":1}',
        b"[" * 100_000,
        b"5x",
        b"{} {}",
        b"",
    ],
    ids=["long", "many keys", "nested", "no comma", "two", "none"],
)
def test_aircraft_after_a_malformed_one_are_garbage(entry: bytes) -> None:
    """It is not parsed whole: 8 MB of keys took a second, in which no beam was computed."""
    poll, one = polling(), json.dumps(ONE).encode()
    data = b'{"now": 1.1, "aircraft": [%b, %b, %b]}' % (one, entry, one)
    started_s = time.process_time()
    found = poll.feed(7, data)
    while poll.has_more:
        found += poll.feed(7, b"")
    assert time.process_time() - started_s < 0.2
    frame, *rest = found
    assert isinstance(frame, Frame)
    assert [one.reason for one in rest if isinstance(one, Rejection)][-1:] == [Reason.GARBAGE]


def test_reading_takes_time_linear_in_the_document() -> None:
    """A document of 8 MB took 16 s: each piece counted all aircraft that were left."""
    poll = polling()
    found = poll.feed(7, b'{"now": 1.1, "aircraft": [' + b'"hex",' * 1_300_000 + b"1]}")
    started_s = time.process_time()
    while poll.has_more:
        found += poll.feed(7, b"")
    assert len(found) == AIRCRAFT_MAX
    assert time.process_time() - started_s < 2.0


def test_too_many_aircraft_use_bounded_memory() -> None:
    poll = polling()
    for start in (0, AIRCRAFT_MAX // 2):
        many = [
            {"hex": f"{number + 1:06x}", "lat": 1, "lon": 1, "seen_pos": 0, "alt_geom": 1}
            for number in range(start, start + AIRCRAFT_MAX + 5)
        ]
        found = poll.feed(7, document(*many, now=2.0 + 0.19 * bool(start)))
        assert poll.has_more
        while poll.has_more:
            more = poll.feed(99, b"")
            assert 0 < len(more) <= AT_ONCE
            found += more
        assert {one.t_ns for one in found} == {7}  # they arrived with their document
        assert len(found) == AIRCRAFT_MAX
    assert len(poll._true_at) == AIRCRAFT_MAX


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner),
)


@given(st.dictionaries(st.sampled_from(sorted(ONE)), _JSON) | _JSON)
def test_arbitrary_values_never_raise(entry: Any) -> None:
    base = ONE | entry if isinstance(entry, dict) else entry
    for found in fed(base, entry):
        assert isinstance(found, Rejection) or isinstance(decode(found), AdsbVehicle | Rejection)
