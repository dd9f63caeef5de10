"""Binary observations: every valid one survives, every malformed record is a declared error."""

import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from observed import DIRECTION, OBSERVATIONS, POWER, WRONG, wrong

from companion.values import READINGS_MAX, Observation, reason_invalid
from companion.views import observation_records as records
from companion.views.observation_records import ObservationRecordError, decode, encode

LAYOUT = np.dtype(
    [("magic", "S8"), ("version", "<u4"), ("bytes", "<u4"), ("crc32", "<u4"), ("kind", "<u4"),
     ("uav", "S72"), ("measured_at_ns", "<i8"), ("time_bound_ns", "<u8"), ("azimuth_rad", "<f8"),
     ("elevation_rad", "<f8"), ("bound_rad", "<f8"), ("power_bound_db", "<f8"), ("update", "<i8"),
     ("readings", "<u4"), ("flags", "<u4")], align=True
)  # fmt: skip
READINGS = np.dtype([("beam", "<u4"), ("reserved", "<u4"), ("power_db", "<f8")], align=True)


def with_checksum(body: bytes) -> bytes:
    """Return a record with the right checksum, whatever else is wrong."""
    return body[:16] + zlib.crc32(body[20:]).to_bytes(4, "little") + body[20:]


def changed(record: bytes, **values: object) -> bytes:
    """Return a record with other values in its header, and the right checksum."""
    head = np.frombuffer(record, LAYOUT, 1).copy()
    for name, value in values.items():
        head[name] = value
    return with_checksum(head.tobytes() + record[LAYOUT.itemsize :])


@given(OBSERVATIONS)
def test_valid_observation_survives(observation: Observation) -> None:
    assert reason_invalid(observation) is None
    record = encode(observation)
    assert len(record) <= records.LARGEST_RECORD
    assert decode(record, observation.t_ns) == observation


@given(OBSERVATIONS)
def test_record_has_the_documented_layout(observation: Observation) -> None:
    """Read by numpy with C's alignment, an independent description of the layout."""
    record = encode(observation)
    head = np.frombuffer(record, LAYOUT, 1)[0]
    rows = np.frombuffer(record, READINGS, offset=LAYOUT.itemsize)
    assert (head["magic"], head["version"], head["flags"]) == (b"UAVOBSRV", 1, 0)
    assert head["bytes"] == len(record)
    assert head["kind"] == (1 if observation.is_direction else 2)
    assert head["uav"].decode() == observation.uav
    assert head["measured_at_ns"] == observation.measured_ns
    assert head["time_bound_ns"] == observation.time_bound_ns
    for name in ("azimuth_rad", "elevation_rad", "bound_rad", "power_bound_db"):
        known = getattr(observation, name)
        assert np.isnan(head[name]) if known is None else head[name] == known
    assert head["update"] == (-1 if observation.update is None else observation.update)
    assert tuple(rows["beam"].tolist()) == observation.beams
    assert tuple(rows["power_db"].tolist()) == observation.powers_db
    assert head["readings"] == len(rows)
    assert not rows["reserved"].any()


def test_sizes_are_those_of_the_c_header() -> None:
    assert (records.HEADER.size, LAYOUT.itemsize) == (160, 160)
    assert (records.READING.size, READINGS.itemsize) == (16, 16)
    assert records.LARGEST_RECORD == 160 + 16 * READINGS_MAX
    many = replace(POWER, beams=tuple(range(77)), powers_db=(0.0,) * 77)
    assert len(encode(many)) <= 1400


def test_times_are_converted_from_utc() -> None:
    assert decode(encode(DIRECTION), DIRECTION.t_ns, 7).measured_ns == DIRECTION.measured_ns - 7
    with pytest.raises(ObservationRecordError, match="measured_at: time is before 1970"):
        decode(encode(DIRECTION), DIRECTION.t_ns, DIRECTION.measured_ns + 1)


@pytest.mark.parametrize("name", WRONG)
def test_invalid_observation_is_not_encoded(name: str) -> None:
    reason = reason_invalid(wrong(name))
    assert reason
    assert "\n" not in reason
    with pytest.raises(ObservationRecordError) as raised:
        encode(wrong(name))
    assert str(raised.value) == reason


CASES = {
    "magic": (DIRECTION, {"magic": b"UAVBEAMS"}, "magic number is not UAVOBSRV"),
    "version": (DIRECTION, {"version": 2}, "version 2 is unknown"),
    "size": (DIRECTION, {"bytes": 159}, "wrong size"),
    "count": (POWER, {"readings": 4}, "wrong size"),
    "large count": (POWER, {"readings": 2**32 - 1}, "wrong size"),
    "kind": (DIRECTION, {"kind": 3}, "kind 3 is unknown"),
    "kind 0": (DIRECTION, {"kind": 0}, "kind 0 is unknown"),
    "flags": (DIRECTION, {"flags": 4}, "flags 0x4 are unknown"),
    "direction sent as powers": (DIRECTION, {"kind": 2}, "both a direction and powers"),
    "powers sent as a direction": (POWER, {"kind": 1}, "both a direction and powers"),
    "update of a direction": (DIRECTION, {"update": 0}, "both a direction and powers"),
    "power bound of a direction": (DIRECTION, {"power_bound_db": 1}, "both a direction and powers"),
    "azimuth of powers": (POWER, {"azimuth_rad": 0}, "both a direction and powers"),
    "azimuth NaN": (DIRECTION, {"azimuth_rad": np.nan}, "azimuth"),
    "bound infinite": (DIRECTION, {"bound_rad": np.inf}, "bound"),
    "power bound NaN": (POWER, {"power_bound_db": np.nan}, "power_bound_db"),
    "update": (POWER, {"update": -2}, "update"),
    "measured early": (DIRECTION, {"measured_at_ns": -1}, "measured_at"),
    "time bound": (DIRECTION, {"time_bound_ns": 2**64 - 1}, "time_bound"),
    "name without an end": (DIRECTION, {"uav": b"rid:" + 68 * b"a"}, "uav"),
    "name with a 0 inside": (DIRECTION, {"uav": b"3:1\0x"}, "uav"),
    "name not ASCII": (DIRECTION, {"uav": "3:١".encode()}, "uav"),
    "no name": (DIRECTION, {"uav": b""}, "uav"),
}


@pytest.mark.parametrize("name", CASES)
def test_malformed_record_is_rejected_with_its_reason(name: str) -> None:
    valid, values, reason = CASES[name]
    with pytest.raises(ObservationRecordError, match=reason):
        decode(changed(encode(valid), **values), 1)


def test_reserved_field_of_a_power_is_zero() -> None:
    body = bytearray(encode(POWER))
    body[160 + 4] = 1
    with pytest.raises(ObservationRecordError, match="reserved field"):
        decode(with_checksum(bytes(body)), 1)


@pytest.mark.parametrize("observation", [DIRECTION, POWER], ids=["direction", "powers"])
def test_record_with_a_changed_bit_or_length_is_rejected(observation: Observation) -> None:
    record = encode(observation)
    bad = [
        record[:i] + bytes([record[i] ^ 1 << i % 8]) + record[i + 1 :] for i in range(len(record))
    ]
    bad += [record[:i] for i in range(len(record))]
    bad += [record + b"\0", record + record, record + bytes(5000)]
    for one in bad:
        with pytest.raises(ObservationRecordError):
            decode(one, 1)


@given(st.binary(max_size=400), st.integers(-(2**63), 2**63 - 1))
def test_arbitrary_bytes_raise_the_declared_error_only(garbage: bytes, offset_ns: int) -> None:
    head = b"UAVOBSRV" + (1).to_bytes(4, "little")
    size = max(160, len(garbage))
    sized = head + size.to_bytes(4, "little") + garbage.ljust(size, b"\0")[16:]
    for record in (garbage, sized, with_checksum(sized)):
        try:
            found = decode(record, 1, offset_ns)
        except ObservationRecordError:
            continue
        assert reason_invalid(found) is None


@given(
    observation=OBSERVATIONS,
    at=st.integers(20, 159),
    byte=st.integers(0, 255),
    offset_ns=st.sampled_from([0, 2**62, -(2**62)]),
)
def test_accepted_records_are_valid_observations(
    *, observation: Observation, at: int, byte: int, offset_ns: int
) -> None:
    body = bytearray(encode(observation))
    body[at] = byte
    try:
        found = decode(with_checksum(bytes(body)), 1, offset_ns)
    except ObservationRecordError:
        return
    assert reason_invalid(found) is None
