"""Received amplitude of each stream at each UAV: powers, delays, zero forcing."""

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.beams.array.steering import steering_matrix, unit_directions
from companion.beams.weights.precoding import Precoder
from companion.beams.weights.zero_forcing import solve
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.studies.link import channel, ofdm
from companion.studies.link.channel import Scattering
from companion.studies.link.level import uav_array
from companion.studies.link.scenario import Instant, PositionSource
from companion.values import ComplexArray, FloatArray

SIGHT = Scattering(math.inf)
AZIMUTHS = np.radians([-40.0, -3.0, 12.0, 55.0])


def seen_at(azimuths: FloatArray) -> FloatArray:
    return unit_directions(azimuths, np.zeros_like(azimuths))


def instant(off_deg: float = 0.0) -> Instant:
    """Four separated UAVs; predicted positions off by the given angle, held ones by twice that."""
    off = np.radians(off_deg)
    kinds = zip(PositionSource, (0.0, off, 2 * off), strict=True)
    return Instant(0.0, {kind: seen_at(AZIMUTHS + by) for kind, by in kinds})


def heard(seen: Instant, by: PositionSource, scattering: Scattering = SIGHT) -> ComplexArray:
    array, own = assembly.array(Settings()), uav_array(Settings())
    truly = seen.towards[PositionSource.PERFECT]
    rows = channel.draw(scattering, array, own, truly, np.random.default_rng(3))
    sent = channel.weights(array, seen, by, Precoder())
    return channel.responses(rows, sent, channel.alone(array, own, truly))


def test_zero_forcing_with_true_positions_has_no_interference() -> None:
    """Each UAV loses its loss factor, relative to a beam on it alone."""
    (amplitudes,) = heard(instant(), PositionSource.PERFECT)
    steering = steering_matrix(
        assembly.array(Settings()), instant().towards[PositionSource.PERFECT]
    )
    solved = solve(steering)
    assert solved is not None
    assert np.abs(amplitudes.diagonal()) == pytest.approx(solved.loss_factors**-0.5)
    assert np.abs(amplitudes - np.diag(amplitudes.diagonal())).max() < 1e-12


def test_mispointed_beams_interfere() -> None:
    (near,), (far,) = (
        heard(instant(0.1), by) for by in (PositionSource.PREDICTED, PositionSource.HELD)
    )
    stray = [np.abs(one[~np.eye(4, dtype=bool)]).max() for one in (near, far)]
    assert 1e-3 < stray[0] < stray[1]


def test_scattered_rays_have_their_share_of_power() -> None:
    """Relative to the line of sight at one antenna; delays follow the profile."""
    array, own = assembly.array(Settings()), uav_array(Settings())
    many = seen_at(np.tile(AZIMUTHS, 20))
    scattering = Scattering(3.0, 40e-9)
    taps = channel.draw(scattering, array, own, many, np.random.default_rng(7))
    assert len(taps) == len(scattering.profile) == 11
    scattered = np.mean(np.abs(taps[1:]) ** 2, axis=(1, 2))
    expected = 10**-0.3 * scattering.profile[1:]
    assert expected[0] / expected[2] == pytest.approx(math.e)
    assert scattered[:4] == pytest.approx(expected[:4], rel=0.25)
    sight = channel.draw(SIGHT, array, own, many, np.random.default_rng(7))
    assert np.abs(sight) == pytest.approx(np.full((1, 80, 64), 2.0))  # sqrt(N_U)


@pytest.mark.parametrize(
    ("k_db", "spread_s", "said"),
    [(-1.0, 0.0, "--rician-k -1"), (math.nan, 0.0, "--rician-k nan"), (9.0, -1e-9, "--delay-spr"),
     (9.0, 257e-9, "257: give ns from 0 to 256"), (9.0, math.nan, "--delay-spread nan")],
)  # fmt: skip
def test_invalid_channel_settings_are_rejected(k_db: float, spread_s: float, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Scattering(k_db, spread_s)


def test_all_delays_fit_in_the_cyclic_prefix() -> None:
    assert len(Scattering(9.0, 256e-9).profile) - 1 <= ofdm.PREFIX
    assert Scattering(9.0, 0.0).profile.tolist() == [1.0]


def test_policy_that_leaves_uavs_unserved_is_rejected() -> None:
    close = replace(
        instant(), towards=dict.fromkeys(PositionSource, seen_at(np.radians([0.0, 0.1])))
    )
    for policy in ("group", "drop"):
        precoder = assembly.precoder(Settings().override(beams={"policy": policy}))
        with pytest.raises(ValueError, match=f"policy = '{policy}'"):
            channel.weights(assembly.array(Settings()), close, PositionSource.PERFECT, precoder)
