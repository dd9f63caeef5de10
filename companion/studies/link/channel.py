"""Channel between the link study's streams and its UAVs, as taps one sample apart.

The line of sight is first. Scattered rays (Saleh and Valenzuela, ``channel.draw``) follow with
delays; their mean power decays exponentially, and each delay has its own rays. The response then
includes both ends: the weights, and the UAV's antennas combined towards the node.

Simplifications: delays are whole samples; nothing moves within an OFDM symbol; the receiver tracks
time and frequency (Doppler included) exactly.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.beams.weights.precoding import Precoder, precode
from companion.beams.worth import channel
from companion.beams.worth.channel import SalehValenzuela
from companion.beams.worth.link_budget import share_power
from companion.studies.link.ofdm import PREFIX
from companion.studies.link.scenario import Instant, PositionSource
from companion.values import ComplexArray, FloatArray, UserError

SAMPLE_RATE_HZ: Final = 50e6
SPREADS: Final = 5.0  # longest delay in delay spreads


@dataclass(frozen=True, slots=True)
class Scattering:
    """Power and delay of the scattered rays.

    Raises ``UserError`` for a channel without line of sight, or with delays beyond the prefix.
    """

    rician_k_db: float = 10.0  # power of the line of sight over that of all scattered rays
    delay_spread_s: float = 50e-9  # mean delay of the scattered rays behind the line of sight

    def __post_init__(self) -> None:
        if not self.rician_k_db >= 0:
            raise UserError(
                f"--rician-k {self.rician_k_db:g}: give dB of at least 0 (inf: no scattering)"
            )
        most_s = PREFIX / SAMPLE_RATE_HZ / SPREADS
        if not 0 <= self.delay_spread_s <= most_s:
            raise UserError(
                f"--delay-spread {self.delay_spread_s * 1e9:g}: give ns from 0 to"
                f" {most_s * 1e9:g}, so that the cyclic prefix covers all delays"
            )

    @property
    def profile(self) -> FloatArray:
        """Share of the scattered power at each delay in samples, (T,); the shares add up to 1."""
        spread = self.delay_spread_s * SAMPLE_RATE_HZ
        if spread == 0:
            return np.ones(1)
        shares = np.exp(-np.arange(math.floor(SPREADS * spread) + 1) / spread)
        profile: FloatArray = shares / shares.sum()
        return profile


def draw(
    scattering: Scattering,
    array: Array,
    uav_array: Array,
    truly: FloatArray,
    rng: np.random.Generator,
) -> ComplexArray:
    """Draw each UAV's response to each element after combining, at each delay: (T, N, M).

    ``truly`` are the true directions (N, 3) in the array frame. UAVs have the array's attitude.
    Units: the line of sight alone has gain 1 from an element to an antenna.
    """
    settings = SalehValenzuela(rician_k_db=math.inf)
    opposite = -truly
    towards_node = steering_matrix(uav_array, opposite)

    def rows(given: SalehValenzuela) -> ComplexArray:
        channels = channel.draw(
            given,
            array,
            uav_array=uav_array,
            directions_at_node=truly,
            directions_at_uav=opposite,
            rng=rng,
        )
        return channel.combined_rows(channels, towards_node)

    scattered = 10 ** (-scattering.rician_k_db / 10)
    profile = scattering.profile if scattered > 0 else np.ones(1)
    taps: ComplexArray = np.zeros((len(profile), len(truly), array.size), dtype=complex)
    taps[0] = rows(settings)
    if scattered > 0:
        no_sight = replace(settings, rician_k_db=-math.inf)
        for delay, share in enumerate(profile):
            taps[delay] += math.sqrt(scattered * share) * rows(no_sight)
    return taps


def weights(array: Array, instant: Instant, by: PositionSource, precoder: Precoder) -> ComplexArray:
    """Return weights (M, N), unit-norm columns, not widened, for the directions ``by``.

    Raises ``UserError`` if the precoder omits UAVs or uses time slots.
    """
    made = precode(steering_matrix(array, instant.towards[by]), precoder)
    users = len(instant.towards[by])
    if len(made.served) < users or made.groups.any():
        raise UserError(
            f"[beams] policy = {precoder.policy.value!r}: this study serves all UAVs at once;"
            " give 'regularise'"
        )
    return share_power(made.weights, users)


def responses(rows: ComplexArray, sent: ComplexArray, alone: FloatArray) -> ComplexArray:
    """Return the response of each UAV to each stream at each delay: (T, N, N), row i the UAV.

    rows   (T, N, M), from ``draw``
    sent   (M, N), the weights
    alone  (N,), amplitude of an exact beam on a UAV, scaled to 1
    """
    return (rows @ sent) / alone[:, np.newaxis]


def alone(array: Array, uav_array: Array, truly: FloatArray) -> FloatArray:
    """Return the line-of-sight amplitude (N,) at each UAV of an exact beam of unit norm.

    The UAV's antennas are combined: the amplitude is |a| |b|, sqrt(M N_U) for isotropic elements.
    """
    at_node = np.linalg.norm(steering_matrix(array, truly), axis=0)
    at_uav = np.linalg.norm(steering_matrix(uav_array, -truly), axis=0)
    lengths: FloatArray = at_node * at_uav
    return lengths
