"""From beams to a device's table: calibration, limits, the nearest settings, and what they cost.

``fit`` finds the settings, ``encode`` writes them as the device's tools read them, ``parse`` reads
them back, so that the pattern of what was really sent can be drawn.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from companion.beams import device_text
from companion.beams.devices import LIMITS, SETTINGS, Device, Mode
from companion.beams.precoding import gain_db
from companion.beams.quantise import quantise
from companion.values import ComplexArray, IntArray

CALIBRATION_HEADER: Final = "channel,element,phase_deg,gain_db"


@dataclass(frozen=True, slots=True)
class Calibration:
    """What was measured at an array of M elements.

    ``phase_rad`` and ``gain_db`` (by element) are what the channel adds to its setting, so a
    setting is the wanted value less these. ``order`` (by channel) is the element that each channel
    drives, counted from 0. ``ValueError`` for lengths that differ, what is not finite, or an order
    that is no permutation.
    """

    phase_rad: tuple[float, ...]
    gain_db: tuple[float, ...]
    order: tuple[int, ...]

    def __post_init__(self) -> None:
        size = len(self.order)
        if not size or len(self.phase_rad) != size or len(self.gain_db) != size:
            raise ValueError(
                f"{len(self.phase_rad)} phases, {len(self.gain_db)} gains and an order of {size}: "
                "a calibration has one of each for every element"
            )
        if sorted(self.order) != list(range(size)):
            raise ValueError(f"order {self.order} is not each of 0 to {size - 1} once")
        for name, values in (("phase", self.phase_rad), ("gain", self.gain_db)):
            for element, value in enumerate(values):
                if not math.isfinite(value):
                    raise ValueError(f"{name} {value} of element {element} is not finite")

    @classmethod
    def ideal(cls, order: Sequence[int]) -> Self:
        """Channels that add nothing, in this order."""
        return cls((0.0,) * len(order), (0.0,) * len(order), tuple(order))

    @property
    def factors(self) -> ComplexArray:
        """What each element's channel multiplies by, (M,)."""
        factors: ComplexArray = np.exp(1j * np.array(self.phase_rad))
        factors *= 10 ** (np.array(self.gain_db) / 20)
        return factors


def parse_calibration(text: str) -> Calibration:
    """Read CSV with the header ``channel,element,phase_deg,gain_db``, a line for each channel.

    Both count from 0; lines may come in any order. ``ValueError`` names the line and the value.
    """
    order: dict[int, int] = {}
    measured: dict[int, tuple[float, float]] = {}
    for number, found in device_text.fields(text, CALIBRATION_HEADER):
        channel = device_text.whole(number, "channel", found[0], 0, 99_999)
        element = device_text.whole(number, "element", found[1], 0, 99_999)
        if channel in order:
            raise ValueError(f"line {number}: channel {channel} stands twice")
        if element in measured:
            raise ValueError(f"line {number}: element {element} stands twice")
        phase_deg = device_text.real(number, "phase_deg", found[2])
        measured[element] = math.radians(phase_deg), device_text.real(number, "gain_db", found[3])
        order[channel] = element
    for name, seen in (("channel", order), ("element", measured)):
        missing = set(range(len(order))) - set(seen)
        if missing:
            raise ValueError(f"{name} {min(missing)} of {len(order)} has no line")
    elements = range(len(order))
    return Calibration(
        tuple(measured[m][0] for m in elements),
        tuple(measured[m][1] for m in elements),
        tuple(order[c] for c in elements),
    )


@dataclass(frozen=True, slots=True, eq=False)
class WantedBeam:
    """A beam for a device: weights (M,), its direction in the array frame, and the steering
    vectors (M, J) that count when it is quantised: its own first, then those of its nulls."""

    uav: str
    weights: ComplexArray
    azimuth_rad: float
    elevation_rad: float
    steering: ComplexArray


@dataclass(frozen=True, slots=True, eq=False)
class DeviceTable:
    """What a device is set to: ``codes`` (K, M, 2) by beam and channel, ``order`` the element of
    each channel.

    ``uavs`` names the beams; where the text had no room for names, their numbers. ``weights``
    (M, K), by element, are what is radiated, each beam with its strongest element at full gain:
    how beams share the power is for what feeds the array. ``loss_db`` is what each beam lost in
    array gain towards its own direction by the settings (None where what was wanted is unknown).
    """

    device: Device
    uavs: tuple[str, ...]
    codes: IntArray
    order: tuple[int, ...]
    weights: ComplexArray
    loss_db: tuple[float, ...] | None


def fit(device: Device, beams: Sequence[WantedBeam], calibration: Calibration) -> DeviceTable:
    """The settings nearest to the wanted beams.

    ``ValueError``, with the reason, for what the device cannot do.
    """
    _check(device, beams, calibration)
    factors = calibration.factors
    found = [quantise(b.weights, SETTINGS[device], b.steering, factors) for b in beams]
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
    return DeviceTable(device, uavs, codes, calibration.order, weights, losses)


def encode(
    table: DeviceTable,
    frequency_hz: float | None = None,
    full_gain_db: float = 0.0,
    mode: Mode = Mode.TX,
) -> str:
    """The table as the text of its device (``companion.beams.device_text``).

    ``frequency_hz`` is needed by Sivers alone; ``full_gain_db`` and ``mode`` (TX or RX) are
    TMYTEK's. ``ValueError`` where one cannot be.
    """
    match table.device:
        case Device.ADAR1000:
            return device_text.write_adar1000(table.uavs, table.codes, table.order)
        case Device.TMYTEK:
            return device_text.write_tmytek(table.codes, mode, full_gain_db)
        case Device.SIVERS:
            if frequency_hz is None:
                raise ValueError("a Sivers beam book needs the frequency that it is for")
            return device_text.write_sivers(table.uavs, table.codes, frequency_hz)


def parse(device: Device, text: str, calibration: Calibration) -> DeviceTable:
    """The table that a text sets, and what it radiates with this calibration.

    ``ValueError`` where the text is not the device's, or is for another array.
    """
    order = calibration.order
    match device:
        case Device.ADAR1000:
            uavs, codes, order = device_text.read_adar1000(text)
        case Device.TMYTEK:
            codes = device_text.read_tmytek(text)
            uavs = tuple(str(beam + 1) for beam in range(len(codes)))
        case Device.SIVERS:
            uavs, codes = device_text.read_sivers(text)
    if codes.shape[1] != len(calibration.order) or order != calibration.order:
        raise ValueError(
            f"the table drives elements {order} by {codes.shape[1]} channels, "
            f"the calibration {calibration.order}"
        )
    weights = np.empty(codes.shape[:2], dtype=complex).T
    weights[list(order)] = SETTINGS[device].values(codes).T
    weights *= calibration.factors[:, np.newaxis]
    return DeviceTable(device, uavs, codes, order, weights, None)


def _check(device: Device, beams: Sequence[WantedBeam], calibration: Calibration) -> None:
    """Refuse what the device cannot do."""
    limits, size = LIMITS[device], len(calibration.order)
    if limits.elements is not None and size != limits.elements:
        raise ValueError(f"{device} drives {limits.elements} elements, the array has {size}")
    if not 1 <= len(beams) <= limits.beams:
        raise ValueError(f"{device} stores 1 to {limits.beams} beams, not {len(beams)}")
    spread_db = max(calibration.gain_db) - min(calibration.gain_db)
    if spread_db > limits.gain_range_db:
        raise ValueError(
            f"the channels differ by {spread_db:.1f} dB, {device} can level "
            f"{limits.gain_range_db:.1f} dB"
        )
    for beam in beams:
        if beam.weights.shape != (size,) or beam.steering.ndim != 2 or not beam.steering.size:
            raise ValueError(
                f"beam for {beam.uav}: weights {beam.weights.shape} and steering "
                f"{beam.steering.shape}, for {size} elements and one direction or more"
            )
        off_rad = _off_boresight_rad(beam)
        if limits.off_boresight_rad is not None and not off_rad <= limits.off_boresight_rad + 1e-9:
            raise ValueError(
                f"beam for {beam.uav} is {math.degrees(off_rad):.1f} degrees off boresight, "
                f"{device} steers to {math.degrees(limits.off_boresight_rad):.0f}"
            )


def _off_boresight_rad(beam: WantedBeam) -> float:
    """Angle between the direction and x of the array frame: theta."""
    along = math.cos(beam.elevation_rad) * math.cos(beam.azimuth_rad)
    return float(np.arccos(np.clip(along, -1.0, 1.0)))
