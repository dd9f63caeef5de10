"""Degraded reports: noise added to GLOBAL_POSITION_INT, and to the accuracies in GPS_RAW_INT."""

import math
import struct
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.mavlink.wire.decode import GPS_RAW_INT
from companion.mavlink.wire.encode import Outgoing, pack
from companion.mavlink.wire.payload import unpack
from companion.studies.prediction.radio_link import NOISE_MOST, RadioLink
from companion.studies.truth.vehicles import Flight
from companion.values import FloatArray, Frame

_REPORT: Final = struct.Struct("<IiiiihhhH")
_ACCURACY: Final = struct.Struct("<III")
_ACCURACY_AT: Final = 34  # offset of h_acc, v_acc (mm) and vel_acc (mm/s) in GPS_RAW_INT
_GPS_RAW_INT_SIZE: Final = 52
_METRES_PER_DEGREE: Final = 111_195.0


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Noise of each report: position (N, 3), velocity (N, 3), north-east-down."""

    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray


def noise(rng: np.random.Generator, reports: int, link: RadioLink) -> Noise:
    """Draw the noise that a link adds to a number of reports."""
    if not (link.noise_m or link.noise_mps):
        return Noise(np.zeros((reports, 3)), np.zeros((reports, 3)))
    drawn = np.clip(rng.standard_normal((2, reports, 3)), -NOISE_MOST, NOISE_MOST)
    return Noise(drawn[0] * link.noise_m, drawn[1] * link.noise_mps)


def changed(flight: Flight, added: Noise, link: RadioLink) -> list[Frame]:
    """Return the frames of a flight with noise added to its reports."""
    frames = list(flight.frames)
    if not (frames and (link.noise_m or link.noise_mps)):
        return frames
    for row, at in enumerate(flight.report_at.tolist()):
        frames[at] = _worse_report(
            frames[at], added.position_ned_m[row].tolist(), added.velocity_ned_mps[row].tolist()
        )
    for at, frame in enumerate(frames):
        if frame.msgid == GPS_RAW_INT:
            frames[at] = _less_accurate(frame, link)
    return frames


def _worse_report(frame: Frame, way_m: list[float], speed_mps: list[float]) -> Frame:
    fields = list(unpack(frame, _REPORT))
    across = _METRES_PER_DEGREE * math.cos(math.radians(fields[1] * 1e-7))
    fields[1] += round(way_m[0] / _METRES_PER_DEGREE * 1e7)
    fields[2] += round(way_m[1] / across * 1e7)
    for height in (3, 4):
        fields[height] -= round(way_m[2] * 1e3)
    for axis, more in enumerate(speed_mps):
        fields[5 + axis] += round(more * 1e2)
    return _framed(frame, _REPORT.pack(*fields))


def _less_accurate(frame: Frame, link: RadioLink) -> Frame:
    payload = bytearray(frame.payload.ljust(_GPS_RAW_INT_SIZE, b"\0"))
    told = _ACCURACY.unpack_from(payload, _ACCURACY_AT)
    more = (link.noise_m, link.noise_m, link.noise_mps)
    # A receiver's accuracy is a deviation over all directions together.
    sums = (
        round(math.hypot(before, one * math.sqrt(3) * 1e3))
        for before, one in zip(told, more, strict=True)
    )
    _ACCURACY.pack_into(payload, _ACCURACY_AT, *sums)
    return _framed(frame, bytes(payload))


def _framed(frame: Frame, payload: bytes) -> Frame:
    return frame._replace(raw=pack(Outgoing(frame.source, frame.msgid, payload), frame.seq))
