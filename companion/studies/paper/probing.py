"""Echo probing, the baseline that location-aware beams are compared with: UAVs are found by echoes.

The baseline receives only radar echoes of the UAVs (the idea of radar-assisted beams: F. Liu et al.
2020). In each probing interval

1. the beam of a UAV points at the direction predicted by its tracker;
2. the echo returns with the two-way loss of the radar equation, less the pointing loss, less twice
   any blockage;
3. an echo that is strong enough, from within the beam's lobe, measures the direction with an error
   at the Cramer-Rao bound of that SNR. Without an echo the tracker extrapolates; without a rate
   the beam stays;
4. after too many intervals without an echo the UAV is lost. The node sweeps its codebook without
   serving the UAV, and repeats until a sweep ends with an echo.

Assumptions in the baseline's favour: full duplex without leakage, a receiver at every element, no
clutter, no mistaken identity, no pilots, sweeps that disturb no other stream.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.beams.array.geometry import Array
from companion.beams.array.steering import amplitudes, steering_matrix
from companion.beams.worth.link_budget import LinkBudget
from companion.values import FloatArray, IntArray

BLIND_RATIO: Final = 1e-4
"""Ratio of squared extents below which the array is blind along an axis.

A line, for example, cannot measure angles across its length, and its beams do not depend on them.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class EchoProbing:
    """Settings of the echo-probing baseline.

    dwell_s            coherent integration time of an echo, and time of each beam of a sweep; at
                       most ``interval_s``
    detection_snr_db   least SNR of an echo after integration, at the output of the array
    lobe_db            largest loss of the beam towards the UAV, relative to its peak, for which an
                       echo counts; inf: side lobes count as well
    sweep_loss_db      loss of the best sweep beam towards the UAV; 3.9 dB is halfway between two
                       orthogonal beams of a line

    Raises ``ValueError`` for values out of range.
    """

    interval_s: float = 0.01  # from one probe to the next
    dwell_s: float = 0.001
    cross_section_m2: float = 0.05  # radar cross section of a UAV
    detection_snr_db: float = 13.0
    lobe_db: float = 10.0
    patience_intervals: int = 10  # largest run of intervals without an echo before a sweep
    sweep_beams: int = 64  # beams of the codebook
    sweep_loss_db: float = 3.9
    position_gain: float = 1.0  # gain alpha of an alpha-beta tracker of the direction
    rate_gain: float = 0.0  # gain beta; (1, 0) points each beam at the last echo

    def __post_init__(self) -> None:
        if not 0 < self.dwell_s <= self.interval_s < math.inf:
            raise ValueError(
                f"dwell_s {self.dwell_s} must be above 0 and at most interval_s {self.interval_s}"
            )
        if not 0 < self.cross_section_m2 < math.inf:
            raise ValueError(f"cross_section_m2 {self.cross_section_m2} must be finite, above 0")
        if not math.isfinite(self.detection_snr_db):
            raise ValueError(f"detection_snr_db {self.detection_snr_db} must be finite")
        if not (self.lobe_db > 0 and 0 <= self.sweep_loss_db < math.inf):
            raise ValueError(
                f"lobe_db {self.lobe_db} must be above 0, sweep_loss_db {self.sweep_loss_db} "
                "finite and at least 0"
            )
        if self.patience_intervals < 0 or self.sweep_beams < 1:
            raise ValueError(
                f"patience_intervals {self.patience_intervals} must be at least 0, "
                f"sweep_beams {self.sweep_beams} at least 1"
            )
        # An alpha-beta tracker is stable where 0 <= beta < 4 - 2 alpha.
        if not (0 < self.position_gain <= 1 and 0 <= self.rate_gain < 4 - 2 * self.position_gain):
            raise ValueError(
                f"position_gain {self.position_gain} must be above 0 and at most 1, "
                f"rate_gain {self.rate_gain} at least 0 and below 4 - 2 position_gain"
            )

    @property
    def sweep_intervals(self) -> int:
        """Duration of a sweep in probing intervals, rounded up."""
        return math.ceil(self.sweep_beams * self.dwell_s / self.interval_s - 1e-9)


@dataclass(frozen=True, slots=True, kw_only=True)
class EchoState:
    """State of the echo-probing baseline after one interval, N UAVs."""

    pointed: FloatArray  # (N, 3), beam directions: unit vectors, array frame
    served: NDArray[np.bool_]  # (N,), whether the UAV had its beam; False during a sweep
    heard: NDArray[np.bool_]  # (N,), whether an echo was used
    estimate: FloatArray  # (N, 3), estimated direction for the next interval
    turn_radps: FloatArray  # (N, 3), its rotation rate, perpendicular to it
    silent: IntArray  # (N,), consecutive intervals without an echo
    sweep_left: IntArray  # (N,), remaining intervals of a sweep; 0 without one


def started(directions: FloatArray) -> EchoState:
    """Return the initial state: beams have just found their UAVs at unit directions (N, 3)."""
    users = len(directions)
    yes, none = np.ones(users, dtype=bool), np.zeros(users, dtype=np.int64)
    return EchoState(
        pointed=directions,
        served=yes,
        heard=yes,
        estimate=directions,
        turn_radps=np.zeros((users, 3)),
        silent=none,
        sweep_left=none,
    )


def echo_snr(
    settings: EchoProbing,
    budget: LinkBudget,
    array: Array,
    *,
    directions: FloatArray,
    ranges_m: FloatArray,
    attenuation_db: float | FloatArray = 0.0,
) -> FloatArray:
    """Return the SNR of each echo of a matched beam after integration, at the output of the array.

        budget          its power is shared equally by the UAVs
        directions      (N, 3), unit directions
        ranges_m        (N,)
        attenuation_db  scalar or (N,), one way; it counts twice

    A power ratio, (N,), by the radar equation: P G^2 wavelength^2 sigma / ((4 pi)^3 r^4 noise),
    times bandwidth times dwell (a whole block of samples adds coherently); G is the gain of the
    matched beam, elements included. Raises ``ValueError`` for ranges that are not finite and above
    0.
    """
    if not (np.isfinite(ranges_m).all() and (ranges_m > 0).all()):
        raise ValueError(f"ranges_m {ranges_m} must be finite and above 0")
    power_w = budget.tx_power_w / max(len(ranges_m), 1)
    gains = np.sum(np.abs(steering_matrix(array, directions)) ** 2, axis=0)
    two_way = settings.cross_section_m2 * array.wavelength_m**2 / ((4 * np.pi) ** 3 * ranges_m**4)
    samples = budget.bandwidth_hz * settings.dwell_s
    blocked = 10 ** (-2 * np.asarray(attenuation_db) / 10)
    snr: FloatArray = power_w * gains**2 * two_way * blocked * samples / budget.noise_power_w
    return snr


def step(
    settings: EchoProbing,
    array: Array,
    state: EchoState,
    *,
    directions: FloatArray,
    snr: FloatArray,
    rng: np.random.Generator,
) -> EchoState:
    """Advance the baseline by one probing interval.

        directions (N, 3), unit directions of the UAVs
        snr         (N,), ``echo_snr`` now, blockage included

    Every step draws the same number of random values, so that runs with one seed differ only by the
    changed parameter. A sweep that finds a UAV serves it from the next interval on.
    """
    sweeping = state.sweep_left > 0
    pointed = _turned(state.estimate, state.turn_radps * settings.interval_s)
    left = np.maximum(state.sweep_left - 1, 0)

    inside = alignment(array, pointed, directions)
    caught = np.where(sweeping, 10 ** (-settings.sweep_loss_db / 10), inside)
    strong = snr * caught >= 10 ** (settings.detection_snr_db / 10)
    heard = strong & np.where(sweeping, left == 0, inside >= 10 ** (-settings.lobe_db / 10))
    measured = _turned(directions, direction_error_rad(array, directions, snr * caught, rng))

    estimate, turn = _tracked(settings, pointed, state.turn_radps, measured)
    estimate = np.where(sweeping[:, np.newaxis], measured, estimate)
    estimate = np.where(heard[:, np.newaxis], estimate, pointed)
    turn = np.where(heard[:, np.newaxis], turn, state.turn_radps)

    silent = np.where(heard, 0, state.silent + 1)
    lost = (left == 0) & (silent > settings.patience_intervals)
    return EchoState(
        pointed=pointed,
        served=~sweeping,
        heard=heard,
        estimate=estimate,
        # The rate is zero at the start and at the end of a sweep.
        turn_radps=np.where((lost | sweeping)[:, np.newaxis], 0.0, turn),
        silent=silent,
        sweep_left=np.where(lost, settings.sweep_intervals, left),
    )


def alignment(array: Array, pointed: FloatArray, directions: FloatArray) -> FloatArray:
    """Return the gain of matched beams towards other directions over the peak gain, 0 to 1.

    |a(u)^T a(p)*|^2 / (|a(u)|^2 |a(p)|^2), (N,), for beams at unit directions p and UAVs at u,
    both (N, 3); 0 where no element faces either.
    """
    towards = steering_matrix(array, directions)
    beams = steering_matrix(array, pointed)
    powers = np.sum(np.abs(towards) ** 2, axis=0) * np.sum(np.abs(beams) ** 2, axis=0)
    met = np.abs(np.einsum("mn,mn->n", towards, beams.conj())) ** 2
    shares: FloatArray = np.minimum(met / np.where(powers > 0, powers, 1.0), 1.0)
    return shares


def direction_error_rad(
    array: Array, directions: FloatArray, snr: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Draw rotation vectors (N, 3) from a true to a measured direction, at the Cramer-Rao bound.

    Model: one plane wave of unknown amplitude and phase, SNR ``snr`` (N,) at the output of the
    array: the Fisher information of an angle along a unit axis t across u is 2 snr (2
    pi/wavelength)^2 t^T C t, C the covariance of the element positions, weighted by received power
    (P. Stoica and A. Nehorai 1989; 6 / (SNR M (M^2 - 1)) for a line, in electrical angle and SNR at
    one element). The error is zero along an axis to which the array is blind, and without an echo.
    """
    across = np.eye(3) - directions[:, :, np.newaxis] * directions[:, np.newaxis, :]
    spread = _spread_m2(array, directions)
    seen, axes = np.linalg.eigh(across @ spread @ across)
    size = np.trace(spread, axis1=1, axis2=2)[:, np.newaxis]
    known = (seen > BLIND_RATIO * size) & (snr[:, np.newaxis] > 0)
    information = 2 * snr[:, np.newaxis] * array.wavenumber_radpm**2 * seen
    deviations = np.where(known, 1 / np.sqrt(np.where(known, information, 1.0)), 0.0)
    drawn = rng.standard_normal(deviations.shape) * deviations
    return np.cross(directions, np.einsum("nij,nj->ni", axes, drawn))


def _spread_m2(array: Array, directions: FloatArray) -> FloatArray:
    """Return the covariance (N, 3, 3) of the element positions, weighted by received power."""
    powers = np.broadcast_to(amplitudes(array, directions) ** 2, (array.size, len(directions)))
    total = powers.sum(axis=0)
    shares = (powers / np.where(total > 0, total, 1.0)).T
    centred = array.elements_m - (shares @ array.elements_m)[:, np.newaxis]
    spread: FloatArray = np.einsum("nm,nmi,nmj->nij", shares, centred, centred)
    return spread


def _tracked(
    settings: EchoProbing, pointed: FloatArray, turn_radps: FloatArray, measured: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Apply an alpha-beta update on the sphere; return the estimate and its rotation rate."""
    normal = np.cross(pointed, measured)
    sine = np.linalg.norm(normal, axis=1, keepdims=True)
    cosine = np.sum(pointed * measured, axis=1, keepdims=True)
    residual = normal * (np.arctan2(sine, cosine) / np.where(sine > 0, sine, 1.0))
    estimate = _turned(pointed, settings.position_gain * residual)
    turn = turn_radps + settings.rate_gain / settings.interval_s * residual
    return estimate, turn - np.sum(turn * estimate, axis=1, keepdims=True) * estimate


def _turned(directions: FloatArray, rotations_rad: FloatArray) -> FloatArray:
    """Rotate unit vectors (N, 3) by rotation vectors (N, 3) perpendicular to them."""
    angle = np.linalg.norm(rotations_rad, axis=1, keepdims=True)
    aside = np.sinc(angle / np.pi) * np.cross(rotations_rad, directions)
    turned: FloatArray = np.cos(angle) * directions + aside
    return turned
