"""Cost of a wrong direction: spectral efficiency lost against perfect knowledge.

The array of the settings faces the UAV: its boresight in the UAV's true direction, its y axis
level. In that direction the beam is narrowest. The matched beam f = a(v)* / |a(v)| for a predicted
direction v gives, for the UAV in the true direction u, the share

    g = |a(u)^T f|^2 / |a(u)|^2                        (1 with perfect knowledge)

of the signal-to-noise ratio S with perfect knowledge, and loses

    log2(1 + S) - log2(1 + g S)                        bit/s/Hz

``SNR_DB`` is S: at the UAV, with the beam on it, at any range. The array is that of ``[array]``
without its mount. A line of elements does not resolve errors across it: those cost nothing.
(C. Shannon 1949; steering vectors as in ``companion.beams.array.steering``.)
"""

from typing import Final

import numpy as np

from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.values import FloatArray

SNR_DB: Final = 20.0
AT_ONCE: Final = 1_000_000  # entries of a steering matrix in memory at a time


def array_from_local(truly: FloatArray) -> FloatArray:
    """Return rotations (K, 3, 3) to the frame of an array that faces directions (K, 3), NED.

    Straight up or down its y axis points east.
    """
    azimuth = np.arctan2(truly[:, 1], truly[:, 0])
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(truly))], axis=1)
    return np.stack([truly, right, np.cross(truly, right)], axis=1)


def gains(array: Array, towards: FloatArray, truly: FloatArray) -> FloatArray:
    """Return g (K,) of matched beams along ``towards`` for UAVs along ``truly``, (K, 3) each."""
    with np.errstate(invalid="ignore"):  # a UAV at the array has no direction, and no gain
        u, v = (way / np.linalg.norm(way, axis=1, keepdims=True) for way in (truly, towards))
    seen = np.einsum("kij,kj->ki", array_from_local(u), v)
    at = steering_matrix(array, np.array([[1.0, 0.0, 0.0]]))[:, 0]
    found = np.zeros(len(seen))
    step = max(1, AT_ONCE // array.size)
    for first in range(0, len(seen), step):
        beams = steering_matrix(array, seen[first : first + step])
        power = np.sum(np.abs(beams) ** 2, axis=0)
        met = np.abs(at @ beams.conj()) ** 2
        # A direction into which no element radiates has no beam, and a gain of 0.
        found[first : first + step] = np.divide(
            met, power * np.sum(np.abs(at) ** 2), out=np.zeros_like(met), where=power > 0
        )
    return found


def loss_bps_hz(array: Array, towards: FloatArray, truly: FloatArray, snr_db: float) -> float:
    """Return the mean loss over K predictions, bit/s/Hz; at least 0."""
    snr = 10 ** (snr_db / 10)
    share = np.minimum(gains(array, towards, truly), 1.0)
    return float(np.mean(np.log2((1 + snr) / (1 + snr * share))))
