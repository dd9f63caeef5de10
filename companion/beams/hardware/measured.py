"""Calibration from measured responses: one source at known directions, each channel alone.

In direction k channel c, which drives element m, responds with

    y_kc = s_k h_m a_m(u_k) + noise

with a the steering vector, h_m the channel's factor, and s_k the source, of unknown phase and
level. With z = y / a the least-squares s and h are the first singular vectors of z (Eckart and
Young). Only ratios of h can be measured: phases are relative to element 0, gains to the mean in dB.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix, unit_directions
from companion.beams.hardware.calibration import (
    BOUNDED_HEADER,
    GAIN_MAX_DB,
    PHASE_MAX_DEG,
    Calibration,
    channel_error,
    fields,
    real,
    whole,
)
from companion.values import ComplexArray, FloatArray, UserError

MEASURED_HEADER: Final = "azimuth_deg,elevation_deg,channel,phase_deg,gain_db"
DIRECTIONS_MAX: Final = 100_000  # most directions of a file: a sphere in steps of 0.6 degrees


@dataclass(frozen=True, slots=True, eq=False)
class ChannelResponses:
    """Measured responses (K, M) of single channels to a source at unit directions (K, 3)."""

    directions: FloatArray
    responses: ComplexArray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FittedCalibration:
    """Calibration fitted to measurements, with bounds, and its residual errors.

    phase_deg, gain_db  largest errors that remain, of all channels and directions
    """

    calibration: Calibration
    phase_deg: float
    gain_db: float
    cost_db: float  # largest loss of a matched beam's guaranteed gain by them


def parse_responses(text: str) -> ChannelResponses:
    """Parse responses from CSV with the header ``MEASURED_HEADER``, a line per measurement.

    Raises ``UserError`` that names the line, or the missing channel.
    """
    found: dict[tuple[float, float], dict[int, complex]] = {}
    for number, row in fields(text, MEASURED_HEADER):
        azimuth_deg = real(number, "azimuth_deg", row[0], PHASE_MAX_DEG)
        towards = azimuth_deg, real(number, "elevation_deg", row[1], PHASE_MAX_DEG)
        channel = whole(number, "channel", row[2], 0, 4095)
        phase_deg = real(number, "phase_deg", row[3], PHASE_MAX_DEG)
        gain_db = real(number, "gain_db", row[4], GAIN_MAX_DB)
        channels = found.setdefault(towards, {})
        if len(found) > DIRECTIONS_MAX:
            raise UserError(f"line {number}: more than {DIRECTIONS_MAX} directions")
        if channel in channels:
            raise UserError(f"line {number}: channel {channel} appears twice at {towards}")
        channels[channel] = cmath.rect(10 ** (gain_db / 20), math.radians(phase_deg))
    size = max((len(channels) for channels in found.values()), default=0)
    for towards, channels in found.items():
        missing = set(range(size)) - set(channels)
        if missing:
            raise UserError(
                f"channel {min(missing)}: no measured response at azimuth, elevation {towards};"
                f" measure channels 0 to {size - 1} there"
            )
    if not found:
        raise UserError("file has no responses")
    angles = np.radians(np.array(list(found)))
    responses = np.array([[one[c] for c in range(size)] for one in found.values()])
    return ChannelResponses(unit_directions(angles[:, 0], angles[:, 1]), responses)


def fitted(measured: ChannelResponses, array: Array, order: Sequence[int]) -> FittedCalibration:
    """Fit a calibration to the responses; ``order`` is the element of each channel.

    Its bounds are the largest residual errors of each channel: they cover only what was measured.
    Raises ``UserError`` if the responses do not match the array.
    """
    responses, places = measured.responses, list(order)
    if responses.shape[1] != array.size:
        raise UserError(f"{responses.shape[1]} channels for {array.size} elements")
    if len(responses) < 2:
        raise UserError("one direction cannot reveal errors; measure two or more")
    steering = steering_matrix(array, measured.directions).T[:, places]
    if not steering.all():
        raise UserError("an element is dead, or does not radiate in one of these directions")
    seen = responses / steering
    u, s, vh = np.linalg.svd(seen, full_matrices=False)
    source, channel = u[:, 0] * s[0], vh[0]
    if not channel.all() or not source.all():
        raise UserError("no response from a channel, or from the source in one direction")
    off = seen / np.outer(source, channel)
    factors = np.empty(array.size, dtype=complex)
    factors[places] = channel
    phase_off, gain_off = np.empty(array.size), np.empty(array.size)
    phase_off[places] = np.abs(np.angle(off)).max(axis=0)
    gain_off[places] = np.abs(20 * np.log10(np.abs(off))).max(axis=0)
    gains = 20 * np.log10(np.abs(factors))
    calibration = Calibration(
        phase_rad=tuple(np.angle(factors / factors[0]).tolist()),
        gain_db=tuple((gains - gains.mean()).tolist()),
        order=tuple(places),
        phase_error_rad=tuple(phase_off.tolist()),
        gain_error_db=tuple(gain_off.tolist()),
    )
    share = 1 - float(channel_error(phase_off, gain_off).mean())
    return FittedCalibration(
        calibration=calibration,
        phase_deg=float(np.degrees(phase_off.max())),
        gain_db=float(gain_off.max()),
        cost_db=-20 * float(np.log10(share)) if share > 0 else np.inf,
    )


def as_text(calibration: Calibration) -> str:
    """Return a calibration with bounds as CSV that ``parse_calibration`` reads."""
    errors = calibration.phase_error_rad, calibration.gain_error_db
    phase_off, gain_off = (found or (0.0,) * len(calibration.order) for found in errors)
    lines = [BOUNDED_HEADER]
    for channel, m in enumerate(calibration.order):
        numbers = (np.degrees(calibration.phase_rad[m]), calibration.gain_db[m])
        bounds = (np.degrees(phase_off[m]), gain_off[m])
        lines.append(",".join([f"{channel},{m}", *(f"{x:.6f}" for x in (*numbers, *bounds))]))
    return "\n".join(lines) + "\n"
