"""A set of weights in the forms that programs and devices take."""

import io
import json
from typing import Final

import numpy as np

from companion.assembly import Equipment
from companion.beams import hardware
from companion.beams.aim import directions
from companion.beams.arrays import SPEED_OF_LIGHT_MPS, Array
from companion.beams.devices import MEDIA_TYPES, Device
from companion.beams.steering import steering_matrix
from companion.server import beam_views
from companion.values import BeamSet

TYPES: Final = {
    "json": "application/json",
    "npy": "application/x-npy",
    "raw": "application/octet-stream",
    **{str(device): media_type for device, media_type in MEDIA_TYPES.items()},
}
"""Names of the forms, and their media types. ``raw``: interleaved little-endian complex64,
row-major."""


def encode(
    form: str, beam_set: BeamSet, array: Array, equipment: Equipment, lead_ms: float
) -> bytes:
    """The weights in one of ``TYPES``.

    Raises ``ValueError``, with the reason, for what a device cannot do.
    """
    match form:
        case "json":
            return json.dumps(beam_views.weights(beam_set, lead_ms)).encode()
        case "npy":
            file = io.BytesIO()
            np.save(file, beam_set.weights, allow_pickle=False)
            return file.getvalue()
        case "raw":
            return beam_set.weights.astype("<c8").tobytes()
    table = device_table(Device(form), beam_set, array, equipment)
    frequency_hz = SPEED_OF_LIGHT_MPS / array.wavelength_m
    return hardware.encode(table, frequency_hz).encode()


def device_table(
    device: Device, beam_set: BeamSet, array: Array, equipment: Equipment
) -> hardware.DeviceTable:
    """The settings of a device that come nearest to the weights: each beam towards its own UAV,
    away from the others of its group. ``ValueError`` as above."""
    steering = steering_matrix(array, directions(beam_set))
    wanted = []
    for i, beam in enumerate(beam_set.beams):
        others = [j for j, one in enumerate(beam_set.beams) if j != i and one.group == beam.group]
        wanted.append(
            hardware.WantedBeam(
                beam.uav,
                beam_set.weights[:, i],
                beam.azimuth_rad,
                beam.elevation_rad,
                steering[:, [i, *others]],
            )
        )
    calibration = equipment.calibration or hardware.Calibration.ideal(range(array.size))
    return hardware.fit(device, wanted, calibration)
