"""What lies between the streams of the link study and its UAVs, as taps one sample apart.

The line of sight comes first and alone; scattered rays (Saleh and Valenzuela, ``channel.draw``)
follow with delays, their mean power falling exponentially, each delay with rays of its own. Then
come the two ends: the weights, and the UAV's antennas combined towards the node.

What is simplified: delays are whole samples; nothing moves within an OFDM symbol; the receiver
follows time and frequency (Doppler among it) exactly.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from companion.beams import channel
from companion.beams.arrays import Array
from companion.beams.channel import SalehValenzuela
from companion.beams.precoding import Precoder, precode
from companion.beams.rates import share_power
from companion.beams.steering import steering_matrix
from companion.studies.link_scenario import Instant, Positions
from companion.studies.ofdm import PREFIX
from companion.values import ComplexArray, FloatArray

SAMPLE_RATE_HZ: Final = 50e6
SPREADS: Final = 5.0
"""Delays of more than so many delay spreads are left out."""


@dataclass(frozen=True, slots=True)
class Scattering:
    """The line of sight over all scattered rays, dB, and the mean delay of these behind it.

    ``ValueError`` for a channel without line of sight, or with delays that pass the prefix.
    """

    rician_k_db: float = 10.0
    delay_spread_s: float = 50e-9

    def __post_init__(self) -> None:
        if not self.rician_k_db >= 0:
            raise ValueError(
                f"--rician-k {self.rician_k_db:g}: dB, at least 0 (inf: no scattering)"
            )
        most_s = PREFIX / SAMPLE_RATE_HZ / SPREADS
        if not 0 <= self.delay_spread_s <= most_s:
            raise ValueError(
                f"--delay-spread {self.delay_spread_s * 1e9:g}: ns, 0 to {most_s * 1e9:g}, so that"
                " all delays are within the cyclic prefix"
            )

    @property
    def profile(self) -> FloatArray:
        """Shares of the scattered power by delay in samples, (T,); they add up to 1."""
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
    """What each UAV hears of each element after combining, at each delay: (T, N, M).

    ``truly``: the true directions (N, 3) in the array frame. UAVs are turned as the array is. In
    units in which the line of sight alone has the gain 1 from an element to an antenna.
    """
    settings = SalehValenzuela(rician_k_db=math.inf)
    opposite = -truly
    towards_node = steering_matrix(uav_array, opposite)

    def rows(given: SalehValenzuela) -> ComplexArray:
        channels = channel.draw(given, array, uav_array, truly, opposite, rng)
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


def weights(array: Array, instant: Instant, by: Positions, precoder: Precoder) -> ComplexArray:
    """Columns of unit norm (M, N), sharp, for the directions that are believed in.

    ``ValueError`` where the precoder serves some UAVs only, or in turns.
    """
    made = precode(steering_matrix(array, instant.towards[by]), precoder)
    users = len(instant.towards[by])
    if len(made.served) < users or made.groups.any():
        raise ValueError(
            f"[beams] policy = {precoder.policy.value!r}: this study serves all UAVs at once,"
            " by 'regularise'"
        )
    return share_power(made.weights, users)


def responses(rows: ComplexArray, sent: ComplexArray, alone: FloatArray) -> ComplexArray:
    """How strongly each UAV hears each stream at each delay: (T, N, N), row i the UAV.

    ``rows`` (T, N, M) of ``draw``, ``sent`` (M, N) the weights, ``alone`` (N,) the amplitude of a
    beam exactly on a UAV, which becomes 1.
    """
    heard: ComplexArray = (rows @ sent) / alone[:, np.newaxis]
    return heard


def alone(array: Array, uav_array: Array, truly: FloatArray) -> FloatArray:
    """Amplitude (N,) that each UAV hears, on the line of sight, of a beam of unit norm exactly on
    it, its antennas combined: |a| |b|, sqrt(M N_U) for isotropic elements."""
    at_node = np.linalg.norm(steering_matrix(array, truly), axis=0)
    at_uav = np.linalg.norm(steering_matrix(uav_array, -truly), axis=0)
    lengths: FloatArray = at_node * at_uav
    return lengths
