"""Weights in the formats of programs and devices.

``raw`` is interleaved little-endian complex64, row-major, without metadata, which is in
``headers``. ``npy`` holds the same numbers, in C order.
"""

import io
import json

import numpy as np

from companion.beams.array.geometry import SPEED_OF_LIGHT_MPS
from companion.beams.hardware import tables
from companion.beams.hardware.devices import Beamformer
from companion.pipeline.assembly import Equipment
from companion.pipeline.fold import Pipeline
from companion.values import BeamSet, WeightFormat
from companion.views import beam_state
from companion.views.as_json import rfc3339
from companion.views.quantised import device_table


def headers(pipeline: Pipeline, beam_set: BeamSet) -> dict[str, str]:
    """Return the metadata of weights as HTTP headers, the only metadata of ``raw``."""
    valid_at_ns = pipeline.utc_ns(beam_set.valid_at_ns)
    return {
        "x-format": "complex64-le-row-major-1",
        "x-elements": str(beam_set.weights.shape[0]),
        "x-beams": str(beam_set.weights.shape[1]),
        "x-uavs": ",".join(beam_set.uavs),
        "x-groups": ",".join(str(beam.group) for beam in beam_set.beams),
        "x-valid-at": rfc3339(valid_at_ns),
        "x-valid-at-ns": str(valid_at_ns),
        "x-method": str(beam_set.method),
        "x-normalisation": str(beam_set.normalisation),
    }


def encode(
    form: WeightFormat, beam_set: BeamSet, pipeline: Pipeline, equipment: Equipment, lead_ms: float
) -> bytes:
    """Return weights in a format for a program or a device.

    Raises ``UserError`` with the reason if a device cannot apply them.
    """
    match form:
        case WeightFormat.JSON:
            return json.dumps(beam_state.weights(pipeline, beam_set, lead_ms)).encode()
        case WeightFormat.NPY:
            file = io.BytesIO()
            np.save(file, beam_set.weights.astype("<c8", order="C"), allow_pickle=False)
            return file.getvalue()
        case WeightFormat.RAW:
            return beam_set.weights.astype("<c8").tobytes("C")
    array = pipeline.array
    table = device_table(Beamformer(form.value), beam_set, array, equipment)
    frequency_hz = SPEED_OF_LIGHT_MPS / array.wavelength_m
    return tables.encode(table, frequency_hz).encode()
