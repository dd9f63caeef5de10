"""The table of position messages, against the dialect and against its users."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.voice.component import ACCEPTED_IDS
from companion.mavlink.wire.decode import DECODED, POSE
from companion.mavlink.wire.positions import HIGH_LATENCY2, OWN, POSITIONS, read
from companion.pipeline.fleet.reception import SHARED
from companion.values import Frame, Source


@pytest.mark.parametrize("msgid", POSITIONS)
def test_message_names_match_the_dialect(msgid: int) -> None:
    assert POSITIONS[msgid].name == dialect.mavlink_map[msgid].msgname


def test_position_messages_are_handled_everywhere() -> None:
    assert POSITIONS.keys() <= DECODED
    assert OWN
    for users in (POSE, SHARED, ACCEPTED_IDS):
        assert users >= OWN


SUMMARIES = st.tuples(
    st.integers(0, 2**32 - 1),
    st.integers(-900_000_000, 900_000_000),
    st.integers(-1_800_000_000, 1_800_000_000),
    st.integers(-2000, 30_000),
    st.integers(0, 255),
    st.integers(0, 255),
)


@given(SUMMARIES)
def test_high_latency2_decodes_like_the_dialect(summary: tuple[int, ...]) -> None:
    boot_ms, lat, lon, alt, heading, eph = summary
    kind = dialect.MAVLink_high_latency2_message
    fields = dict.fromkeys(kind.fieldnames, 7) | {
        "timestamp": boot_ms, "latitude": lat, "longitude": lon, "altitude": alt,
        "heading": heading, "eph": eph, "epv": 0,
    }  # fmt: skip
    raw = bytes(kind(**fields).pack(dialect.MAVLink(None, srcSystem=3, srcComponent=1)))
    found = read(Frame(t_ns=0, link="udp", source=Source(3, 1), msgid=HIGH_LATENCY2, raw=raw))
    assert (found.boot_ms, found.lat_1e7, found.lon_1e7, found.alt_m) == (boot_ms, lat, lon, alt)
    assert found.heading_deg == (2.0 * heading if heading < 180 else None)
    assert found.velocity_ned_mps is None and found.accuracy is not None
    known = eph not in (0, 255)
    assert found.accuracy.horizontal_m == (pytest.approx(eph * 0.1) if known else None)
    assert found.accuracy.vertical_m is None
