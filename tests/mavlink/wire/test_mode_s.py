"""Mode S: messages encoded here and decoded like pyModeS, and the Beast stream that carries
them.
"""

import json
import math
import random
from itertools import pairwise
from typing import Any

import link_support
import pyModeS
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mavlink.wire.beast import BeastSplitter
from companion.mavlink.wire.decode import decode
from companion.mavlink.wire.mode_s import (
    PAIR_NS,
    STATUS_NS,
    Transponders,
    ground_deg,
    ground_speed_kt,
    parity,
    zones,
)
from companion.values import AdsbVehicle, Frame, Reason, Rejection

S = 1_000_000_000
# From https://mode-s.org/1090mhz: an even and an odd position, a callsign, a velocity.
EVEN = bytes.fromhex("8D40621D58C382D690C8AC2863A7")
ODD = bytes.fromhex("8D40621D58C386435CC412692AD6")
NAMED = bytes.fromhex("8D4840D6202CC371C32CE0576098")
MOVING = bytes.fromhex("8D485020994409940838175B284F")


def message(me: int, icao: int = 0x40621D, head: int = 0x8D) -> bytes:
    """Return an extended squitter with its parity."""
    body = bytes([head]) + icao.to_bytes(3, "big") + me.to_bytes(7, "big")
    return body + parity(body + b"\0\0\0").to_bytes(3, "big")


def placed(lat_deg: float, lon_deg: float, odd: int, altitude: int = 0xC38) -> bytes:
    """Return an airborne position, encoded as in DO-260B, A.1.7.3."""
    lat_zone = 360 / (60 - odd)
    y = math.floor(2**17 * (lat_deg % lat_zone) / lat_zone + 0.5)
    at = lat_zone * (y / 2**17 + math.floor(lat_deg / lat_zone))
    lon_zone = 360 / max(zones(at) - odd, 1)
    x = math.floor(2**17 * (lon_deg % lon_zone) / lon_zone + 0.5)
    me = 11 << 51 | altitude << 36 | odd << 34 | (y & 0x1FFFF) << 17 | x & 0x1FFFF
    return message(me)


def status(nac_p: int, gva: int = 2, version: int = 2) -> bytes:
    return message(31 << 51 | version << 13 | nac_p << 8 | gva << 6)


def beast(raw: bytes, ticks: int = 1, kind: int = 0x33) -> bytes:
    body = ticks.to_bytes(6, "big") + b"\x80" + raw
    return bytes([0x1A, kind]) + body.replace(b"\x1a", b"\x1a\x1a")


def fed(data: bytes, t_ns: int = 7) -> list[Frame | Rejection]:
    return BeastSplitter("readsb:radar:30005").feed(t_ns, data)


def said(item: Frame | Rejection) -> AdsbVehicle:
    assert isinstance(item, Frame), item
    found = decode(item)
    assert isinstance(found, AdsbVehicle)
    return found


def test_random_mode_s_messages_match_pymodes() -> None:
    """Every common field is equal, and the same messages are rejected."""
    rng = random.Random(3)
    read = 0
    for _ in range(3000):
        kind = rng.choice([1, 2, 3, 4, 7, 9, 11, 13, 18, 19, 19, 20, 31])
        me = rng.getrandbits(48) | rng.choice([1, 2] if kind == 19 else [0]) << 48 | kind << 51
        raw = message(me, rng.getrandbits(24) or 1)
        theirs: dict[str, Any] = dict(pyModeS.decode(raw.hex()))
        assert theirs["crc_valid"]
        ours = Transponders().read(0, raw)
        if ours is None:
            assert kind == 31  # decided by the next position
            continue
        read += 1
        assert f"{ours.icao:06X}" == theirs["icao"]
        if kind <= 4 and ours.callsign:
            assert ours.callsign == theirs["callsign"].strip()
        if 9 <= kind <= 18 and ours.altitude_ft is not None:
            assert ours.altitude_ft == theirs["altitude"]
        if kind == 7:
            assert ours.track_deg == theirs.get("track")
        if kind == 19:
            assert (ours.speed_kt is None) is (theirs.get("groundspeed") is None)
            if ours.speed_kt is not None and ours.track_deg is not None and ours.speed_kt > 0:
                assert ours.speed_kt == pytest.approx(theirs["groundspeed"], abs=1)
                assert ours.track_deg == pytest.approx(theirs["track"] % 360)
            assert ours.climb_fpm == theirs.get("vertical_rate")
    assert read > 2000


@pytest.mark.parametrize("seed", range(20))
def test_even_and_odd_positions_decode_like_pymodes(seed: int) -> None:
    rng = random.Random(seed)
    lat, lon = rng.uniform(-86.9, 86.9), rng.uniform(-180, 180)
    pair = [placed(lat, lon, 0), placed(lat, lon, 1)]
    heard = Transponders()
    assert heard.read(0, pair[0]).lat_deg is None  # type: ignore[union-attr]
    ours = heard.read(S, pair[1])
    assert ours is not None and ours.lat_deg is not None and ours.lon_deg is not None
    *_, theirs = pyModeS.decode([raw.hex() for raw in pair], timestamps=[0.0, 1.0])
    assert (ours.lat_deg, ours.lon_deg) == pytest.approx(
        (theirs["latitude"], theirs["longitude"]), abs=1e-5
    )
    assert ours.lat_deg == pytest.approx(lat, abs=3e-5)  # 5 m, DO-260B, A.1.7.1
    across = math.cos(math.radians(lat)) * ((ours.lon_deg - lon + 180) % 360 - 180)
    assert across == pytest.approx(0, abs=3e-5 + 360 / 2**17 / max(zones(lat) - 1, 1))


def test_published_mode_s_messages_decode() -> None:
    """Positions and other fields as worked out at https://mode-s.org/1090mhz."""
    splitter = BeastSplitter("readsb:radar:30005")
    (first,) = splitter.feed(0, beast(EVEN))
    later = [beast(one, 1 + 36_000_000) for one in (ODD, NAMED, MOVING)]  # it flew 1.6 km
    second, named, moving = link_support.fed(splitter, 3 * S, b"".join(later))
    assert said(first).position_deg is None
    place = said(second)
    assert place.position_deg == pytest.approx((52.26578, 3.93891), abs=1e-5)
    assert place.alt_m == pytest.approx(38_000 * 0.3048)
    assert place.accuracy is None
    assert said(named).callsign == "KLM1023"
    velocity = said(moving)
    assert velocity.heading_deg == pytest.approx(182.88, abs=0.01)
    assert velocity.velocity_down_mps == pytest.approx(832 * 0.00508, abs=0.01)
    assert velocity.velocity_ne_mps is not None
    assert math.hypot(*velocity.velocity_ne_mps) == pytest.approx(159.2 * 1852 / 3600, abs=0.01)


def on_ground(lat_deg: float, lon_deg: float, odd: int, movement: int = 42) -> bytes:
    """Return a surface position, encoded as in DO-260B, A.1.7.3: zones of a quarter of the size."""
    lat_zone = 90 / (60 - odd)
    y = math.floor(2**17 * (lat_deg % lat_zone) / lat_zone + 0.5)
    at = lat_zone * (y / 2**17 + math.floor(lat_deg / lat_zone))
    lon_zone = 90 / max(zones(at) - odd, 1)
    x = math.floor(2**17 * (lon_deg % lon_zone) / lon_zone + 0.5)
    me = 7 << 51 | movement << 44 | 1 << 43 | 50 << 36 | odd << 34
    return message(me | (y & 0x1FFFF) << 17 | x & 0x1FFFF)


@pytest.mark.parametrize("seed", range(20))
def test_surface_position_is_relative_to_the_airborne_one(seed: int) -> None:
    """Up to 40 nautical miles away, as pyModeS does with a reference position."""
    rng = random.Random(seed)
    lat, lon = rng.uniform(-80, 80), rng.uniform(-180, 180)
    there = lat + rng.uniform(-0.66, 0.66), lon
    heard = Transponders()
    raw = on_ground(*there, odd=seed % 2)
    lost = heard.read(0, raw)
    assert lost is not None and lost.lat_deg is None  # no reference position
    for odd in (0, 1):
        heard.read(0, placed(lat, lon, odd))
    ours = heard.read(239 * S, raw)
    assert ours is not None and ours.lat_deg is not None and ours.lon_deg is not None
    theirs = pyModeS.decode(raw.hex(), surface_ref=(lat, lon))
    assert ours.lat_deg == pytest.approx(theirs["latitude"], abs=1e-6)
    assert (ours.lon_deg - theirs["longitude"] + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)
    assert ours.lat_deg == pytest.approx(there[0], abs=1e-5)
    assert (ours.speed_kt, ours.track_deg) == (theirs["groundspeed"], theirs["track"])
    assert ours.altitude_ft is None
    again = heard.read(478 * S, raw)  # relative to the surface position
    assert again is not None and again.lat_deg == pytest.approx(ours.lat_deg)
    late = heard.read(800 * S, raw)
    assert late is not None and late.lat_deg is None


def test_published_surface_position_decodes() -> None:
    """From https://mode-s.org/1090mhz: 52.32061 north, 4.73473 east, near 51.990, 4.375."""
    me = int.from_bytes(bytes.fromhex("8C4841753A8A35323FAEBDAC702D")[4:11], "big")
    half = me >> 17 & 0x1FFFF, me & 0x1FFFF
    assert ground_deg(half, (51.990, 4.375), me >> 34 & 1) == pytest.approx(
        (52.32061, 4.73473), abs=1e-5
    )


def test_surface_speeds_match_pymodes() -> None:
    for code in range(128):
        theirs = pyModeS.decode(on_ground(1.0, 1.0, 0, code).hex()).get("groundspeed")
        assert ground_speed_kt(code) == (None if theirs is None else pytest.approx(theirs, abs=0.6))


def test_even_and_odd_positions_too_far_apart_give_no_position() -> None:
    for apart_ns, there in ((PAIR_NS, True), (PAIR_NS + 1, False)):
        heard = Transponders()
        heard.read(0, EVEN)
        found = heard.read(apart_ns, ODD)
        assert found is not None and (found.lat_deg is not None) is there


def test_halves_of_two_aircraft_with_one_address_are_seldom_combined() -> None:
    """They gave a place anywhere, for as long as both were received."""
    rng = random.Random(1)
    found = wrong = 0
    for _ in range(300):
        lat, lon = rng.uniform(-80, 80), rng.uniform(-170, 170)
        across = rng.uniform(0.1, 0.3) / math.cos(math.radians(lat))
        places = [(lat, lon), (lat + rng.uniform(0.1, 0.3), lon + across)]  # 15 to 50 km apart
        heard, before = Transponders(), None
        for number in range(40):
            which = rng.randrange(2)
            state = heard.read(number * S // 2, placed(*places[which], number % 2))
            assert state is not None
            if state.lat_deg is None or state.lon_deg is None:
                assert which != before  # both halves of one aircraft have a place
            else:
                found += 1
                wrong += all(abs(state.lat_deg - one[0]) > 0.05 for one in places)
            before = which
    assert found > 5000 and wrong < 0.02 * found


@pytest.mark.parametrize(
    ("nac_p", "gva", "version", "horizontal_m", "vertical_m"),
    [
        (10, 2, 2, 10.0, 45.0), (7, 1, 2, 185.2, 150.0), (0, 0, 2, None, None),
        (12, 3, 2, None, None), (15, 0, 2, None, None), (11, 2, 1, 3.0, None),
        (9, 2, 0, None, None), (9, 2, 5, None, None),
    ],
)  # fmt: skip
def test_stated_accuracies_come_with_the_position(
    nac_p: int, gva: int, version: int, horizontal_m: float | None, vertical_m: float | None
) -> None:
    """95 % limits converted to 68 % (Rayleigh: factor 0.617); unknown codes give no accuracy."""
    *_, last = fed(b"".join(map(beast, (status(nac_p, gva, version), EVEN, ODD))))
    told = said(last).accuracy
    if horizontal_m is None and vertical_m is None:
        assert told is None
        return
    assert told is not None and told.velocity_mps is None
    assert told.horizontal_m == pytest.approx(0.617 * (horizontal_m or 0), rel=1e-3)
    assert told.vertical_m == (
        None if vertical_m is None else pytest.approx(0.617 * vertical_m, rel=1e-3)
    )


def test_stated_accuracy_expires() -> None:
    heard = Transponders()
    heard.read(0, status(10))
    assert heard.read(STATUS_NS, EVEN).nac_p == 10  # type: ignore[union-attr]
    assert heard.read(STATUS_NS + 1, ODD).nac_p == 0  # type: ignore[union-attr]


def test_delayed_message_has_its_age() -> None:
    """By the receiver's 12 MHz counter, relative to the least delayed message so far."""
    splitter = BeastSplitter("x")
    (soon,) = splitter.feed(10 * S, beast(EVEN, 600 * 12_000_000))
    (late,) = splitter.feed(25 * S, beast(ODD, 603 * 12_000_000))
    assert (said(soon).tslc_s, said(late).tslc_s) == pytest.approx((0, 12), abs=1 / 256)
    assert said(late).position_deg is not None  # sent three seconds apart
    (again,) = splitter.feed(26 * S, beast(ODD, 5))  # the receiver was restarted
    assert said(again).tslc_s == 0
    ages = []
    for n in range(20):  # a queue of 3 s
        late_s = 3 if n >= 15 else 0
        ticks = 5 + 6_000_000 * n - 12_000_000 * late_s
        (frame,) = splitter.feed(26 * S + n * S // 2, beast(EVEN, ticks & (1 << 48) - 1))
        ages.append(said(frame).tslc_s)
    assert ages == pytest.approx([0.0] * 15 + [3.0] * 5, abs=1 / 256)


def test_unused_messages_are_counted() -> None:
    damaged = EVEN[:-1] + bytes([EVEN[-1] ^ 1])
    (refused,) = fed(beast(damaged))
    assert isinstance(refused, Rejection) and refused.reason is Reason.BAD_CRC
    (refused,) = fed(b"\x1a3\xff\x00MLAT\x80" + EVEN)
    assert isinstance(refused, Rejection) and refused.reason is Reason.UNKNOWN_MESSAGE
    (refused,) = fed(b"GET / HTTP/1.1\r\n")
    assert refused == Rejection(
        t_ns=7, source="readsb:radar:30005", reason=Reason.GARBAGE, count=16
    )
    rebroadcast = message(int.from_bytes(EVEN[4:11], "big"), head=18 << 3 | 2)
    assert fed(beast(rebroadcast)) == fed(beast(b"\0\0", kind=0x31)) == []
    garbage, frame = fed(b"\x1a3\x00\x1b" + beast(EVEN))[::-1]  # a truncated one
    assert isinstance(frame, Frame)
    assert isinstance(garbage, Rejection) and garbage.count == 4


@given(
    st.lists(st.tuples(st.integers(0, (1 << 56) - 1), st.integers(0, 3 * S)), max_size=20),
    st.sampled_from([0x88, 0x8D, 0x90, 0x92]),
)
def test_any_content_of_an_intact_message_is_decoded_or_rejected(
    contents: list[tuple[int, int]], head: int
) -> None:
    splitter, t_ns = BeastSplitter("x"), 0
    for me, later_ns in contents:
        t_ns += later_ns
        for found in splitter.feed(t_ns, beast(message(me, head=head))):
            assert isinstance(found, Rejection) or isinstance(
                decode(found), AdsbVehicle | Rejection
            )


@pytest.mark.parametrize(("subtype", "speed_kt"), [(1, 1445), (2, 5781)])
def test_speed_beyond_the_message_is_malformed(subtype: int, speed_kt: int) -> None:
    """Mode S can state 5781 kt; the field of ADSB_VEHICLE ends at 1274 kt."""
    (found,) = fed(beast(message(19 << 51 | subtype << 48 | 1023 << 32 | 1023 << 21)))
    assert isinstance(found, Rejection) and found.reason is Reason.MALFORMED
    assert found.detail == f"speed {speed_kt} kt exceeds 1200 kt"


STREAM = b"".join(
    beast(raw, 26 + 0x1A1A * number)
    for number, raw in enumerate((EVEN, ODD, NAMED, placed(26.0, 26.1, 0), MOVING, status(26 % 12)))
)


@given(st.lists(st.integers(1, len(STREAM) - 1), max_size=20))
def test_split_input_gives_the_same_result(cuts: list[int]) -> None:
    at = [0, *sorted(cuts), len(STREAM)]
    splitter = BeastSplitter("x")
    pieces = [STREAM[a:b] for a, b in pairwise(at)]
    whole = link_support.fed(BeastSplitter("x"), 7, STREAM)
    assert len(whole) == 5
    assert [one for piece in pieces for one in link_support.fed(splitter, 7, piece)] == whole


@given(st.lists(st.binary(max_size=60) | st.sampled_from([b"\x1a", b"\x1a3", STREAM[:40]])))
def test_arbitrary_bytes_never_raise_and_are_not_kept(pieces: list[bytes]) -> None:
    splitter = BeastSplitter("x")
    for piece in pieces:
        for found in splitter.feed(7, piece):
            assert isinstance(found, Rejection) or isinstance(decode(found), AdsbVehicle)
        assert len(splitter._pending) <= 2 + 2 * 21  # a whole message with every byte doubled
    json.dumps([one.count for one in splitter.finish(8) if isinstance(one, Rejection)])
