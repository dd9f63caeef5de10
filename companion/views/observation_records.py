"""Observations as binary records in one fixed little-endian layout, one in each datagram.

A record is a header and, for powers, a reading for each beam. ``examples/c/uav_observations.h``
writes the same layout. Unknown values are NaN.

A record has at most ``LARGEST_RECORD`` bytes. Up to 77 powers fit into 1400 bytes, which networks
deliver in one piece; more are sent in several IP fragments.
"""

import math
import struct
import zlib
from typing import Final

from companion.values import READINGS_MAX, Observation, reason_invalid

MAGIC: Final = b"UAVOBSRV"
VERSION: Final = 1
DIRECTION: Final = 1  # kind of a record that contains a direction
POWERS: Final = 2  # kind of a record that contains powers
CODEBOOK: Final = -1  # number of the update if beams of the codebook were used
CHECKED_FROM: Final = 20
"""First byte of a record that the checksum covers (CRC-32 as in zlib), up to the record's end."""
ID_BYTES: Final = 72

HEADER: Final = struct.Struct(
    "<8s"  # magic
    "I"  # version
    "I"  # bytes: size of the whole record
    "I"  # crc32
    "I"  # kind
    f"{ID_BYTES}s"  # uav; ends with at least one 0
    "q"  # measured_at_ns: UTC, ns since the Unix epoch
    "Q"  # time_bound_ns
    "d"  # azimuth_rad
    "d"  # elevation_rad
    "d"  # bound_rad
    "d"  # power_bound_db
    "q"  # update, or CODEBOOK
    "I"  # readings
    "I"  # flags: 0
)
READING: Final = struct.Struct("<IId")  # beam, reserved (0), power_db
LARGEST_RECORD: Final = HEADER.size + READINGS_MAX * READING.size  # bytes


class ObservationRecordError(ValueError):
    """Error of a record that is malformed, or of an observation that is invalid."""


def encode(observation: Observation) -> bytes:
    """Return the record of an observation whose ``measured_ns`` is in UTC.

    Raises ``ObservationRecordError`` if the observation is invalid.
    """
    _check(observation)
    readings = b"".join(
        READING.pack(beam, 0, power_db)
        for beam, power_db in zip(observation.beams, observation.powers_db, strict=True)
    )
    head = HEADER.pack(
        MAGIC,
        VERSION,
        HEADER.size + len(readings),
        0,  # the checksum, which the next lines compute
        DIRECTION if observation.is_direction else POWERS,
        observation.uav.encode(),
        observation.measured_ns,
        observation.time_bound_ns,
        _number(observation.azimuth_rad),
        _number(observation.elevation_rad),
        _number(observation.bound_rad),
        _number(observation.power_bound_db),
        CODEBOOK if observation.update is None else observation.update,
        len(observation.beams),
        0,
    )
    body = head + readings
    crc = zlib.crc32(memoryview(body)[CHECKED_FROM:])
    return body[:16] + crc.to_bytes(4, "little") + body[CHECKED_FROM:]


def decode(record: bytes, arrival_ns: int, utc_offset_ns: int = 0) -> Observation:
    """Return the observation in a record.

        arrival_ns     when it arrived, on the node's timeline
        utc_offset_ns  UTC less the node's timeline; 0: ``measured_ns`` is returned in UTC

    Raises ``ObservationRecordError`` if the record is malformed, and nothing else.
    """
    if len(record) < HEADER.size:
        raise ObservationRecordError(f"{len(record)} bytes; a record has at least {HEADER.size}")
    if len(record) > LARGEST_RECORD:
        raise ObservationRecordError(f"{len(record)} bytes; a record has at most {LARGEST_RECORD}")
    (
        magic, version, size, crc, kind, uav, measured_at_ns, time_bound_ns,
        azimuth_rad, elevation_rad, bound_rad, power_bound_db, update, count, flags,
    ) = HEADER.unpack_from(record)  # fmt: skip
    if magic != MAGIC:
        raise ObservationRecordError("magic number is not UAVOBSRV")
    if version != VERSION:
        raise ObservationRecordError(f"version {version} is unknown; send version {VERSION}")
    if size != len(record) or size != HEADER.size + count * READING.size:
        raise ObservationRecordError(f"size field {size}, with {count} powers: wrong size")
    if crc != zlib.crc32(memoryview(record)[CHECKED_FROM:]):
        raise ObservationRecordError("checksum is wrong")
    if kind not in (DIRECTION, POWERS):
        raise ObservationRecordError(f"kind {kind} is unknown; send {DIRECTION} or {POWERS}")
    if flags:
        raise ObservationRecordError(f"flags {flags:#x} are unknown; send 0")
    readings = list(READING.iter_unpack(record[HEADER.size :]))
    unused = (power_bound_db,) if kind == DIRECTION else (azimuth_rad, elevation_rad, bound_rad)
    if not all(math.isnan(value) for value in unused) or (
        kind == DIRECTION and (update != CODEBOOK or readings)
    ):
        raise ObservationRecordError("both a direction and powers are given; send one of them")
    if any(reserved for _, reserved, _ in readings):
        raise ObservationRecordError("reserved field of a power is not 0")
    name = uav.rstrip(b"\0").decode("ascii", errors="replace")
    is_direction = kind == DIRECTION
    observation = Observation(
        t_ns=arrival_ns,
        measured_ns=measured_at_ns - utc_offset_ns,
        time_bound_ns=time_bound_ns,
        uav=name,
        azimuth_rad=azimuth_rad if is_direction else None,
        elevation_rad=elevation_rad if is_direction else None,
        bound_rad=bound_rad if is_direction else None,
        update=None if update == CODEBOOK else update,
        beams=tuple(beam for beam, _, _ in readings),
        powers_db=tuple(power_db for _, _, power_db in readings),
        power_bound_db=None if is_direction else power_bound_db,
    )
    _check(observation)
    return observation


def _check(observation: Observation) -> None:
    reason = reason_invalid(observation)
    if reason is not None:
        raise ObservationRecordError(reason)


def _number(value: float | None) -> float:
    return math.nan if value is None else value
