"""Bit-level study of the link: ``companion study link``.

At many instants of a flight the array zero-forces towards the assumed directions of the UAVs;
coded 16-QAM on OFDM passes the channel of the true directions. The study measures error rates, EVM
and throughput over the signal-to-noise ratio, for beams by perfect, predicted and held positions.
All three use the same bits, channels and noise, so they differ by the positions alone. References
are the same link without array or channel (``awgn``) and the exact curve of uncoded 16-QAM.

The ratio (SNR) is that of a data carrier at a UAV served alone by an exact beam over the line of
sight: the energy of a symbol over the noise (Es/N0). It is the same for every UAV: ranges enter
only through the directions. Each UAV has an equal share of the power.

Uncoded and coded results come from the same transmissions: hard decisions on the coded bits give
the performance without a code, in blocks of 936 payload bits.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.beams.array import geometry
from companion.beams.array.geometry import Array
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.studies.link import blocks, channel, modulation, ofdm
from companion.studies.link.blocks import BLOCK_BITS, CODED_BITS, BlockErrors, Estimation
from companion.studies.link.channel import SAMPLE_RATE_HZ, Scattering
from companion.studies.link.rows import crossing_db, row
from companion.studies.link.scenario import PositionSource, Reports, Scenario, circles, from_logs
from companion.studies.origin import Progress, Row, command_line, silent, versions
from companion.studies.prediction.pointing import angles_deg
from companion.values import ComplexArray, UserError

SYMBOL_S: Final = ofdm.SAMPLES / SAMPLE_RATE_HZ  # duration of an OFDM symbol
AWGN: Final = "awgn"
KINDS: Final = (AWGN, *(kind.value for kind in PositionSource))
MAX_POINTS: Final = 100  # per curve
TARGET: Final = 1e-3  # bit error rate at which curves are compared


def snrs(first_db: float, last_db: float, step_db: float) -> tuple[float, ...]:
    """Return SNRs from the first to the last in equal steps, dB.

    Raises ``UserError`` for a range out of order.
    """
    said = f"--snr {first_db:g}:{last_db:g}:{step_db:g}"
    if not (-40 <= first_db <= last_db <= 80 and step_db > 0):
        raise UserError(
            f"{said}: give FROM:TO:STEP in dB, -40 <= FROM <= TO <= 80 and STEP above 0"
        )
    count = int((last_db - first_db) / step_db + 1e-9) + 1
    if count > MAX_POINTS:
        raise UserError(f"{said}: {count} points, at most {MAX_POINTS} are allowed")
    return tuple(round(first_db + i * step_db, 9) for i in range(count))


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStudy:
    """Parameters of the link study.

        logs        of one flight with the simulator's truth; none: the paper's circles

    Raises ``UserError`` for values out of range.
    """

    logs: tuple[Path, ...] = ()
    center: str | None = None  # as on the command line
    config: str | None = None  # as on the command line
    settings: Settings = field(default_factory=Settings)  # of the array and the tracking
    snr_db: tuple[float, float, float] = (-2.0, 30.0, 1.0)  # first, last and step
    instants: int = 96  # times of the flight
    blocks: int = 16  # to each UAV at each instant, for each SNR
    estimation: Estimation = Estimation.PILOTS  # channel knowledge of the receivers
    reports: Reports = field(default_factory=Reports)  # timing of the circling UAVs' reports
    scattering: Scattering = field(default_factory=Scattering)
    seed: int = 1  # of all random numbers

    def __post_init__(self) -> None:
        snrs(*self.snr_db)
        for name, value, most in (
            ("instants", self.instants, 10_000),
            ("blocks", self.blocks, 1000),
        ):
            if not 1 <= value <= most:
                raise UserError(f"--{name} {value}: give 1 to {most}")
        if self.seed < 0:
            raise UserError(f"--seed {self.seed}: give a number of at least 0")

    @property
    def command(self) -> str:
        """Command line that runs the study."""
        return command_line(
            "link",
            *self.logs,
            center=self.center,
            config=self.config,
            snr=":".join(f"{part:g}" for part in self.snr_db),
            instants=self.instants,
            blocks=self.blocks,
            estimation=self.estimation.value,
            interval=None if self.logs else self.reports.interval_s,
            latency=None if self.logs else self.reports.latency_s,
            rician_k=self.scattering.rician_k_db,
            delay_spread=self.scattering.delay_spread_s * 1e9,
            seed=self.seed,
        )


Counts = dict[tuple[str, float], list[BlockErrors]]
"""Counts of errors by kind of positions and SNR in dB, one entry per instant."""


def uav_array(settings: Settings) -> Array:
    """Return the UAVs' own antennas: a line, half a wavelength apart, at the array's frequency."""
    radio, frequency_hz = settings.radio, settings.array.frequency_hz
    return geometry.uniform_linear(
        radio.uav_antennas, frequency_hz, spacing_wavelengths=0.5, array_from_body=np.eye(3)
    )


def simulate(setting: LinkStudy, scenario: Scenario, progress: Progress = silent) -> Counts:
    """Send every block of every instant; each instant has its own random generator."""
    counts: Counts = {}
    array, own = scenario.array, uav_array(setting.settings)
    precoder = assembly.precoder(setting.settings)
    for number, instant in enumerate(scenario.instants):
        progress(f"instant {number + 1} of {len(scenario.instants)}")
        rng = np.random.default_rng([setting.seed, 1, number])
        truly = instant.towards[PositionSource.PERFECT]
        rows = channel.draw(setting.scattering, array, own, truly, rng)
        alone = channel.alone(array, own, truly)
        channels: dict[str, ComplexArray] = {AWGN: np.eye(len(truly), dtype=complex)[np.newaxis]}
        for kind in PositionSource:
            sent = channel.weights(array, instant, kind, precoder)
            channels[kind.value] = channel.responses(rows, sent, alone)
        for key, counted in exchange(setting, channels, rng):
            counts.setdefault(key, []).append(counted)
    return counts


def exchange(
    setting: LinkStudy, channels: dict[str, ComplexArray], rng: np.random.Generator
) -> Iterable[tuple[tuple[str, float], BlockErrors]]:
    """Send the same blocks with the same noise over every channel (T, N, N), at every SNR.

    Over ``awgn`` the receiver knows the channel exactly.
    """
    users = channels[AWGN].shape[-1]
    sent = blocks.send(users, setting.blocks, rng)
    white = ofdm.received_carriers(blocks.noise(users, setting.blocks, rng))
    for kind, taps in channels.items():
        clean = ofdm.received_carriers(blocks.through(taps, sent.samples))
        estimation = Estimation.IDEAL if kind == AWGN else setting.estimation
        for snr_db in snrs(*setting.snr_db):
            noise_power = 10 ** (-snr_db / 10)
            heard = clean + np.sqrt(noise_power) * white
            yield ((kind, snr_db), blocks.receive(sent, heard, noise_power, taps, estimation))


def study(setting: LinkStudy, progress: Progress = silent) -> dict[str, Any]:
    """Return the answer of the study, the content of ``link.json``.

    Raises ``UserError``, ``LogError`` or ``ConfigError`` if there is nothing to study.
    """
    rng = np.random.default_rng([setting.seed, 0])
    if not setting.logs:
        scenario = circles(setting.settings, setting.reports, setting.instants, rng)
    else:
        scenario = from_logs(setting.logs, setting.settings, setting.instants, rng, progress)
    counts = simulate(setting, scenario, progress)
    rows: list[Row] = [
        row(kind, snr_db, coded, counted, SYMBOL_S)
        for (kind, snr_db), counted in sorted(
            counts.items(), key=lambda item: (KINDS.index(item[0][0]), item[0][1])
        )
        for coded in (False, True)
    ]
    levels = snrs(*setting.snr_db)
    theory = modulation.bit_error_rate(10 ** (np.array(levels) / 10))
    return {
        "rows": [found for found in rows if found["positions"] != AWGN],
        "awgn": [found for found in rows if found["positions"] == AWGN],
        "theory": [
            {"snr_db": snr_db, "coded": False, "ber": ber}
            for snr_db, ber in zip(levels, theory.tolist(), strict=True)
        ],
        "summary": [
            {
                "positions": kind,
                "coded": coded,
                "snr_at_ber_1e-3_db": crossing_db(rows, kind, coded, TARGET),
                **_best_rates(rows, kind, coded),
                **({} if kind == AWGN else _pointing(scenario, PositionSource(kind))),
            }
            for kind in KINDS
            for coded in (False, True)
        ],
        "scenario": {
            "description": scenario.description,
            "array": f"{scenario.array.size} elements ({scenario.array.kind})",
            "uav_antennas": setting.settings.radio.uav_antennas,
            "instants": len(scenario.instants),
            "unresolved_share": scenario.unresolved_share,
            "block_bits": {"coded": BLOCK_BITS, "uncoded": CODED_BITS},
            "symbol_s": SYMBOL_S,
        },
        "command": setting.command,
        "versions": versions(),
        "seed": setting.seed,
    }


def _best_rates(rows: list[Row], kind: str, coded: bool) -> Row:
    last = [found for found in rows if (found["positions"], found["coded"]) == (kind, coded)][-1]
    return {"ber_at_highest_snr": last["ber"], "rate_at_highest_snr_bps": last["rate_bps"]}


def _pointing(scenario: Scenario, kind: PositionSource) -> Row:
    off_deg = np.concatenate(
        [
            angles_deg(instant.towards[kind], instant.towards[PositionSource.PERFECT])
            for instant in scenario.instants
        ]
    )
    return {
        "pointing_error_median_deg": float(np.median(off_deg)),
        "pointing_error_p95_deg": float(np.percentile(off_deg, 95)),
    }
