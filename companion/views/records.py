"""Updates as binary records in one fixed, self-describing little-endian layout.

A record is a header, an entry for each beam, and the weights: beam after beam, complex64 by
element. ``examples/c/uav_beams.h`` reads the same layout. Unknown values are NaN. An update that
exceeds the size limit of its transport is split into several records, each with some of the beams.
A beam that a report renews is a record of its own, which replaces that beam of the same update.
"""

import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.beams.aim import RenewedBeam
from companion.pipeline.fold import Pipeline
from companion.values import BeamSet, Normalisation

MAGIC: Final = b"UAVBEAMS"
VERSION: Final = 1
COMPLEX64: Final = 1  # dtype of weights as pairs of float32, real part first
WIDENED: Final = 1  # flag of a beam with a widened main lobe
EXACT: Final = 1  # flag of a record in which each UAV is in a null of all other beams of its slot
CHECKED_FROM: Final = 20
"""First byte of a record that the checksum covers (CRC-32 as in zlib), up to the record's end."""
ID_BYTES: Final = 72

HEADER: Final = np.dtype(
    [
        ("magic", "S8"),
        ("version", "<u4"),
        ("bytes", "<u4"),  # size of the whole record
        ("crc32", "<u4"),
        ("header_bytes", "<u4"),
        ("sequence", "<u8"),  # number of the update, from 0
        ("made_at_ns", "<i8"),  # UTC, ns since the Unix epoch, by the service's wall clock
        ("valid_at_ns", "<i8"),
        ("elements", "<u4"),  # M
        ("beams", "<u4"),  # N in this record
        ("first_beam", "<u4"),  # index of its first beam among all of the update
        ("all_beams", "<u4"),
        ("dtype", "<u4"),
        ("beam_bytes", "<u4"),  # size of an entry
        ("beams_at", "<u4"),  # offset of the first entry
        ("weights_at", "<u4"),  # offset of the weights
        ("normalisation", "<u4"),
        ("flags", "<u4"),
        ("revision", "<u8"),  # 0: part of a whole update; else counts its renewed beams from 1
    ]
)
BEAM: Final = np.dtype(
    [
        ("uav", f"S{ID_BYTES}"),  # ends with at least one 0
        ("group", "<u4"),
        ("flags", "<u4"),
        ("azimuth_rad", "<f8"),
        ("elevation_rad", "<f8"),
        ("azimuth_rate_radps", "<f8"),
        ("elevation_rate_radps", "<f8"),
        ("range_m", "<f8"),
        ("pointing_bound_rad", "<f8"),
        ("gain_db", "<f8"),
        ("guaranteed_gain_db", "<f8"),
    ]
)
NORMALISATIONS: Final = tuple(Normalisation)
"""Values of a record's ``normalisation`` by index: 0 unit-response, then stream, total, antenna."""


def in_utc(pipeline: Pipeline, beam_set: BeamSet) -> BeamSet:
    """Return beams whose times are in UTC instead of on the node's timeline."""
    t_ns, valid_at_ns = map(pipeline.utc_ns, (beam_set.t_ns, beam_set.valid_at_ns))
    return replace(beam_set, t_ns=t_ns, valid_at_ns=valid_at_ns)


def encode(
    beam_set: BeamSet,
    sequence: int,
    guaranteed_db: Sequence[float | None] | None = None,
    most_bytes: int | None = None,
) -> Iterator[bytes]:
    """Yield the records of one update: one, or as many as ``most_bytes`` requires.

        sequence       number of the update
        guaranteed_db  guaranteed gain of each beam; None: not computed
        most_bytes     largest record; a beam of 4096 elements takes 33 kB

    Raises ``ValueError`` if a single beam does not fit, or if a UAV's name is too long.
    """
    size, count = beam_set.weights.shape
    each = BEAM.itemsize + 8 * size
    fit = max(count, 1) if most_bytes is None else (most_bytes - HEADER.itemsize) // each
    if fit < 1:
        raise ValueError(f"a beam of {size} elements does not fit into {most_bytes} bytes")
    header = _header(beam_set, sequence)
    header["all_beams"] = count
    entries = _entries(beam_set, guaranteed_db)
    weights = _by_beam(beam_set)
    for first in range(0, max(count, 1), fit):
        part = slice(first, first + fit)
        header["first_beam"] = first
        yield _record(header, entries[part], weights[part])


def encode_renewed(renewed: RenewedBeam, sequence: int, all_beams: int, revision: int) -> bytes:
    """Return the record of one beam of an update that a report has renewed.

    sequence   number of the update
    all_beams  number of its beams
    revision   number of renewed beams of that update so far, this one included
    """
    header = _header(renewed.one, sequence)
    header["all_beams"], header["first_beam"] = all_beams, renewed.column
    header["revision"] = revision
    return _record(header, _entries(renewed.one, None), _by_beam(renewed.one))


def _by_beam(beam_set: BeamSet) -> NDArray[Any]:
    return beam_set.weights.T.astype("<c8", order="C")


def _entries(beam_set: BeamSet, guaranteed_db: Sequence[float | None] | None) -> NDArray[Any]:
    known = guaranteed_db or [None] * len(beam_set.beams)
    rows = [
        (
            _name(beam.uav),
            beam.group,
            WIDENED if beam.widened else 0,
            beam.azimuth_rad,
            beam.elevation_rad,
            _number(beam.azimuth_rate_radps),
            _number(beam.elevation_rate_radps),
            beam.range_m,
            _number(beam.pointing_bound_rad),
            beam.gain_db,
            _number(guaranteed),
        )
        for beam, guaranteed in zip(beam_set.beams, known, strict=True)
    ]
    return np.array(rows, dtype=BEAM)


def _header(beam_set: BeamSet, sequence: int) -> NDArray[Any]:
    """Return a header without what differs between the records of an update."""
    header = np.zeros((), dtype=HEADER)
    header["magic"], header["version"] = MAGIC, VERSION
    header["sequence"] = sequence
    header["made_at_ns"], header["valid_at_ns"] = beam_set.t_ns, beam_set.valid_at_ns
    header["elements"] = len(beam_set.weights)
    header["dtype"], header["beam_bytes"] = COMPLEX64, BEAM.itemsize
    header["header_bytes"] = header["beams_at"] = HEADER.itemsize
    header["normalisation"] = NORMALISATIONS.index(beam_set.normalisation)
    header["flags"] = EXACT if beam_set.exact else 0
    return header


def _record(header: NDArray[Any], entries: NDArray[Any], weights: NDArray[Any]) -> bytes:
    header["beams"] = len(entries)
    header["weights_at"] = HEADER.itemsize + entries.nbytes
    header["bytes"] = HEADER.itemsize + entries.nbytes + weights.nbytes
    body = header.tobytes() + entries.tobytes() + weights.tobytes()
    crc = zlib.crc32(memoryview(body)[CHECKED_FROM:])
    return body[:16] + crc.to_bytes(4, "little") + body[CHECKED_FROM:]


def _name(uav: str) -> bytes:
    name = uav.encode()
    if len(name) >= ID_BYTES:
        raise ValueError(f"UAV {uav!r}: its name is longer than {ID_BYTES - 1} bytes")
    return name


def _number(value: float | None) -> float:
    return math.nan if value is None else value
