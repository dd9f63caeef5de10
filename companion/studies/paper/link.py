"""Published scenario as a link: rates over time, and under blockage.

UAV and beam move uniformly between reports. Weights are zero forcing, regularised where that would
cost a UAV more than 3 dB (a line array cannot separate a direction from its mirror image). Free
space; no scattering.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array.geometry import Array, uniform_linear
from companion.beams.array.steering import steering_matrix
from companion.beams.weights import zero_forcing
from companion.beams.weights.precoding import Precoder, precode
from companion.beams.worth import channel, link_budget
from companion.beams.worth.link_budget import LinkBudget
from companion.studies.origin import Progress
from companion.studies.paper import probing
from companion.studies.paper.circles import PaperFlight
from companion.studies.paper.probing import EchoProbing
from companion.values import ComplexArray, FloatArray, Widen

FREQUENCY_HZ: Final = 30e9
UAV_ANTENNAS: Final = 4
BUDGET: Final = LinkBudget(tx_power_dbm=30.0, bandwidth_hz=50e6, noise_figure_db=7.0)
PRECODER: Final = Precoder(widen=Widen.NO)
PROBING: Final = EchoProbing(dwell_s=0.005, position_gain=0.9, rate_gain=0.5)
"""Favourable settings of echo probing: it integrates half of all time and tracks turn rates."""
MEAN_BLOCKAGE_S: Final = 0.5
RATE_DECIMATION: Final = 5  # probing intervals per computed rate


def line(elements: int) -> Array:
    """Return the published array: half a wavelength apart, from west to east, boresight north."""
    return uniform_linear(
        elements, FREQUENCY_HZ, spacing_wavelengths=0.5, array_from_body=np.eye(3)
    )


def directions(position_m: FloatArray) -> FloatArray:
    """Return unit directions (..., 3) in the array frame of positions (..., 2), north and east."""
    level = position_m / np.linalg.norm(position_m, axis=-1, keepdims=True)
    return np.concatenate([level, np.zeros((*level.shape[:-1], 1))], axis=-1)


def responses(array: Array, true_m: FloatArray, aimed_m: FloatArray) -> ComplexArray:
    """Return the responses of UAVs at their true positions to the beams: (T, N, N).

    Beams aim at the estimated positions. Responses are in square roots of watts: the budget's power
    is included.
    """
    heard = []
    for true, aimed in zip(directions(true_m), directions(aimed_m), strict=True):
        weights = precode(steering_matrix(array, aimed), PRECODER).weights
        sent = link_budget.share_power(weights, BUDGET.tx_power_w)
        heard.append(steering_matrix(array, true).T @ sent)
    return np.array(heard)


def efficiency(
    array: Array, heard: ComplexArray, true_m: FloatArray, attenuation_db: float | FloatArray = 0.0
) -> FloatArray:
    """Return spectral efficiency, bit/s/Hz, (T, N).

    ``attenuation_db`` (T, N) is due to blockages.
    """
    ranges_m = np.linalg.norm(true_m, axis=-1)
    gains = UAV_ANTENNAS * channel.free_space_gain(ranges_m, array.wavelength_m)
    blocked = 10 ** (-np.asarray(attenuation_db) / 10)
    return link_budget.spectral_efficiency(
        link_budget.sinr(heard, gains * blocked, BUDGET.noise_power_w)
    )


def zero_forcing_loss_db(array: Array, position_m: FloatArray) -> FloatArray:
    """Return the loss of the worst UAV by plain zero forcing at each time, (T,).

    inf where zero forcing has no solution.
    """
    found = []
    for there in directions(position_m):
        solved = zero_forcing.solve(steering_matrix(array, there))
        found.append(np.inf if solved is None else 10 * np.log10(solved.loss_factors.max()))
    return np.array(found)


def conjugate_responses(array: Array, position_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return |a^T f| (corrected) and |a^H f| (printed), (N,), of beams at their UAVs."""
    steering = steering_matrix(array, directions(position_m))
    weights = precode(steering, PRECODER).weights
    right = np.abs(np.einsum("mn,mn->n", steering, weights))
    return right, np.abs(np.einsum("mn,mn->n", steering.conj(), weights))


def between(flight: PaperFlight, place_m: FloatArray, time_s: FloatArray) -> FloatArray:
    """Interpolate positions (K + 1, N, 2), given at the steps, at times (T,): (T, N, 2)."""
    at = time_s / flight.scenario.dt_s
    step = np.minimum(np.floor(at + 1e-9).astype(int), len(place_m) - 2)
    share = (at - step)[:, np.newaxis, np.newaxis]
    moved: FloatArray = place_m[step] + share * (place_m[step + 1] - place_m[step])
    return moved


@dataclass(frozen=True, slots=True, eq=False)
class BlockageComparison:
    """Mean spectral efficiency per UAV, bit/s/Hz, by scheme.

    Arrays are (B,), over blockages per minute (B,).
    """

    blockages_per_minute: FloatArray
    schemes: dict[str, FloatArray]


def under_blockage(
    flight: PaperFlight,
    aimed_m: dict[str, FloatArray],
    blockages_per_minute: FloatArray,
    *,
    draws: int,
    rng: np.random.Generator,
    progress: Progress,
) -> BlockageComparison:
    """Compare location-aware beams, aimed at estimates (K + 1, N, 2), to echo probing.

    Every scheme has the same precoder and the same blockages, ``draws`` times per rate.
    """
    array = line(64)
    time_s = np.arange(0.0, float(flight.time_s[-1]), PROBING.interval_s)
    true_m = between(flight, flight.position_m, time_s)
    some = true_m[::RATE_DECIMATION]
    heard = {
        name: responses(array, some, between(flight, places, time_s[::RATE_DECIMATION]))
        for name, places in aimed_m.items()
    }
    found: dict[str, list[float]] = {name: [] for name in (*aimed_m, "echo probing")}
    for number, rate in enumerate(blockages_per_minute.tolist()):
        totals = dict.fromkeys(found, 0.0)
        for _ in range(draws):
            progress(f"echo probing under blockage: {number + 1} of {len(blockages_per_minute)}")
            lost_db = _attenuation_db(true_m.shape[1], time_s, rate / 60, rng)
            for name, responded in heard.items():
                rate_now = efficiency(array, responded, some, lost_db[::RATE_DECIMATION])
                totals[name] += float(rate_now.mean()) / draws
            echoed = _echo_efficiency(array, true_m, lost_db, rng)
            totals["echo probing"] += float(echoed.mean()) / draws
        for name, total in totals.items():
            found[name].append(total)
    return BlockageComparison(
        blockages_per_minute, {name: np.array(seen) for name, seen in found.items()}
    )


def _attenuation_db(
    users: int, time_s: FloatArray, rate_hz: float, rng: np.random.Generator
) -> FloatArray:
    """Draw the attenuation by blockages, independent per UAV, (T, N), dB."""
    last_s = float(time_s[-1])
    drawn = [channel.draw_blockages(rng, last_s, rate_hz, MEAN_BLOCKAGE_S) for _ in range(users)]
    return np.stack([one.attenuation_db(time_s) for one in drawn], axis=1)


def _echo_efficiency(
    array: Array, true_m: FloatArray, lost_db: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return the baseline's spectral efficiency (T / RATE_DECIMATION, N); 0 during a sweep."""
    state = probing.started(directions(true_m[0]))
    pointed, served = [], []
    for at, (there, places) in enumerate(zip(directions(true_m), true_m, strict=True)):
        ranges_m = np.linalg.norm(places, axis=1)
        snr = probing.echo_snr(
            PROBING, BUDGET, array, directions=there, ranges_m=ranges_m, attenuation_db=lost_db[at]
        )
        state = probing.step(PROBING, array, state, directions=there, snr=snr, rng=rng)
        if at % RATE_DECIMATION == 0:
            pointed.append(state.pointed)
            served.append(state.served)
    heard = []
    for beams, there, on in zip(
        pointed, directions(true_m[::RATE_DECIMATION]), served, strict=True
    ):
        sent = np.zeros((array.size, len(on)), dtype=complex)
        if on.any():
            sent[:, on] = precode(steering_matrix(array, beams[on]), PRECODER).weights
        heard.append(
            steering_matrix(array, there).T @ link_budget.share_power(sent, BUDGET.tx_power_w)
        )
    return efficiency(array, np.array(heard), true_m[::RATE_DECIMATION], lost_db[::RATE_DECIMATION])
