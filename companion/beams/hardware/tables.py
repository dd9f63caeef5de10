"""Device tables from beams: calibration, limits, the nearest settings, and their cost.

``fit`` finds the settings, ``encode`` writes them in the format of the device's tools.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.beams.hardware import device_text
from companion.beams.hardware.calibration import Calibration
from companion.beams.hardware.devices import LIMITS, SETTINGS, Beamformer
from companion.beams.hardware.quantise import quantise
from companion.beams.hardware.unit_gains import RELATIVE, UnitGains
from companion.beams.weights.precoding import gain_db
from companion.values import ComplexArray, IntArray, UserError


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class WantedBeam:
    """Beam to convert to settings of a device.

    weights                     (M,)
    azimuth_rad, elevation_rad  its direction in the array frame
    steering                    (M, J), steering vectors that the quantisation emphasises: its own
                                first, then those of its nulls
    """

    uav: str
    weights: ComplexArray
    azimuth_rad: float
    elevation_rad: float
    steering: ComplexArray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DeviceTable:
    """Settings of a device for all beams of a table.

    weights  (M, K), by element, as radiated; each beam has its strongest element at full gain,
             and the feed of the array divides the power among beams
    loss_db  loss of each beam's array gain towards its own direction by the settings; None if the
             wanted weights are unknown
    """

    device: Beamformer
    uavs: tuple[str, ...]  # names of the beams; their numbers if the format has no names
    codes: IntArray  # (K, M, 2), by beam and channel
    order: tuple[int, ...]  # the element of each channel
    weights: ComplexArray
    loss_db: tuple[float, ...] | None
    gains: UnitGains = RELATIVE  # possible gains of the channels of a TMYTEK unit


def fit(
    device: Beamformer,
    beams: Sequence[WantedBeam],
    calibration: Calibration,
    gains: UnitGains = RELATIVE,
) -> DeviceTable:
    """Return the settings nearest to the wanted beams; ``gains`` are the gains of a TMYTEK unit.

    Raises ``UserError``, with the reason, for beams outside the device's limits.
    """
    _check(device, beams, calibration, gains)
    factors = calibration.factors
    states = gains.settings if device is Beamformer.TMYTEK else SETTINGS[device]
    found = [quantise(b.weights, states, b.steering, factors) for b in beams]
    codes = np.stack([one.codes[list(calibration.order)] for one in found])
    losses = tuple(
        float((gain_db(own, wanted) - gain_db(own, sent))[0])
        for own, wanted, sent in (
            (b.steering[:, :1], b.weights[:, np.newaxis], one.weights[:, np.newaxis])
            for b, one in zip(beams, found, strict=True)
        )
    )
    weights = np.stack([one.weights for one in found], axis=1)
    uavs = tuple(device_text.check_name(beam.uav) for beam in beams)
    return DeviceTable(
        device=device,
        uavs=uavs,
        codes=codes,
        order=calibration.order,
        weights=weights,
        loss_db=losses,
        gains=gains,
    )


def encode(table: DeviceTable, frequency_hz: float | None = None) -> str:
    """Return a device table in the device's format (``companion.beams.hardware.device_text``).

    ``frequency_hz`` is needed by Sivers only. Raises ``UserError`` for a value that the format
    cannot hold.
    """
    match table.device:
        case Beamformer.ADAR1000:
            return device_text.write_adar1000(table.uavs, table.codes, table.order)
        case Beamformer.TMYTEK:
            return device_text.write_tmytek(table.codes, table.gains)
        case Beamformer.SIVERS:
            if frequency_hz is None:
                raise UserError("Sivers beam book: give its frequency")
            return device_text.write_sivers(table.uavs, table.codes, frequency_hz)


def _check(
    device: Beamformer, beams: Sequence[WantedBeam], calibration: Calibration, gains: UnitGains
) -> None:
    limits, size = LIMITS[device], len(calibration.order)
    range_db = gains.range_db if device is Beamformer.TMYTEK else limits.gain_range_db
    if limits.elements is not None and size != limits.elements:
        raise UserError(f"{device} drives {limits.elements} elements, the array has {size}")
    if not 1 <= len(beams) <= limits.beams:
        raise UserError(f"{device} stores 1 to {limits.beams} beams, not {len(beams)}")
    spread_db = max(calibration.gain_db) - min(calibration.gain_db)
    if spread_db > range_db:
        raise UserError(
            f"channel gains differ by {spread_db:.1f} dB, {device} can equalise {range_db:.1f} dB"
        )
    for beam in beams:
        if beam.weights.shape != (size,) or beam.steering.ndim != 2 or not beam.steering.size:
            raise UserError(
                f"beam for {beam.uav}: weights {beam.weights.shape} and steering "
                f"{beam.steering.shape}, for {size} elements and one direction or more"
            )
        off_rad = _off_boresight_rad(beam)
        if limits.off_boresight_rad is not None and not off_rad <= limits.off_boresight_rad + 1e-9:
            raise UserError(
                f"beam for {beam.uav} is {math.degrees(off_rad):.1f} degrees off boresight, "
                f"{device} steers to {math.degrees(limits.off_boresight_rad):.0f}"
            )


def _off_boresight_rad(beam: WantedBeam) -> float:
    """Return the angle theta between a beam's direction and x of the array frame."""
    along = math.cos(beam.elevation_rad) * math.cos(beam.azimuth_rad)
    return float(np.arccos(np.clip(along, -1.0, 1.0)))
