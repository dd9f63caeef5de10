"""Predictors compared on logs: ``companion study prediction``.

For every vehicle of a log but the carrier, over a clean link (the log's own arrival stamps) and
over a slow radio, a pointer is asked 20 times a second where the UAV will be at now + lead. It uses
only what has arrived by then. Errors are those of position and of the direction from the array's
true position, while the UAV flies.

The Kalman filters are tuned in hindsight, once for each log and link: their process and measurement
noise are the best of a grid over all UAVs and leads, which is kinder to them than any user could
be. ``kalman-peng`` has the noise that the settings state, and is never tuned.

Each log over each link is a piece of work of its own: see ``companion.studies.running.fan_out``.
"""

import platform
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np

import companion
from companion.mavlink.clock.sender_clock import SenderClock
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.studies.prediction import radio_link
from companion.studies.prediction.baselines import Kalman, Tuning
from companion.studies.prediction.pointing import (
    Questions,
    Receiver,
    Row,
    answers,
    questions,
    score,
)
from companion.studies.prediction.predictors import (
    KALMAN_STATES,
    SIMPLE,
    Make,
    kalman,
    known_tuning,
    learned,
    observers,
)
from companion.studies.prediction.radio_link import Delivery, RadioLink
from companion.studies.prediction.spectral import SNR_DB
from companion.studies.running import fan_out
from companion.studies.truth import vehicles
from companion.studies.truth.vehicles import Flight, Flown
from companion.values import FloatArray, UserError

TUNE_EVERY: Final = 5
"""Step between the questions on which the grid is searched.

The grid is smooth, and there are many settings.
"""
LEADS_S: Final = (0.0, 0.1, 0.3, 1.0)
RADIO: Final = RadioLink("radio", rate_hz=1.2, latency_s=(0.6, 2.2), loss=0.1)

DENSITIES: Final = {
    "kalman-cv": (0.1, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0),
    "kalman-ca": (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0),
}
NOISES: Final = tuple(product((0.03, 0.3), (0.1, 0.3)))
"""Noise of position (m) and velocity (m/s) of the grid on which the filters are tuned.

``DENSITIES`` holds its process noises.
"""


@dataclass(frozen=True, slots=True)
class PredictionStudy:
    """What is asked of the study.

        logs      the logs
        center    as on the command line
        leads_s   leads, seconds
        radio     the slow radio
        seed      of all random numbers
        settings  those of the array and the tracking
        config    as on the command line
        learned   a file of ``companion study train``
        snr_db    SNR for the loss in spectral efficiency
        jobs      processes; None: as many as cores
        cluster   address of a cluster that works instead

    Who works does not change the rows. Raises ``UserError`` for values out of range.
    """

    logs: tuple[Path, ...]
    center: str | None = None
    leads_s: tuple[float, ...] = LEADS_S
    radio: RadioLink = RADIO
    seed: int = 1
    settings: Settings = field(default_factory=Settings)
    config: str | None = None
    learned: Path | None = None
    snr_db: float = SNR_DB
    jobs: int | None = 1
    cluster: str | None = None

    def __post_init__(self) -> None:
        if not -100 <= self.snr_db <= 100:
            raise UserError(f"--snr is in dB, between -100 and 100, not {self.snr_db:g}")
        if not self.leads_s or not all(0 <= lead_s <= 60 for lead_s in self.leads_s):
            raise UserError("leads are seconds, between 0 and 60")
        if self.seed < 0:
            raise UserError(f"a seed is at least 0, not {self.seed}")

    @property
    def command(self) -> str:
        """The command line that asks for this study."""
        radio = self.radio
        assert radio.latency_s is not None
        words = ["companion", "study", "prediction", *map(str, self.logs)]
        words += ["--center", self.center] if self.center else []
        words += ["--config", self.config] if self.config else []
        words += ["--lead", ",".join(f"{lead_s:g}" for lead_s in self.leads_s)]
        words += ["--rate", f"{radio.rate_hz:g}"]
        words += ["--latency", "{:g},{:g}".format(*radio.latency_s)]
        words += ["--loss", f"{radio.loss:g}", *(["--known-delay"] if radio.known_delay else [])]
        words += ["--learned", str(self.learned)] if self.learned else []
        words += ["--snr", f"{self.snr_db:g}"]
        return shlex.join([*words, "--seed", str(self.seed)])


@dataclass(frozen=True, slots=True)
class Compared:
    """A log, by its name, over one link: its rows, and the tuning that each filter was given."""

    log: str
    center: str
    link: RadioLink
    rows: tuple[Row, ...]
    tuned: Mapping[str, Tuning]


Case = tuple[Flight, Delivery, Questions]


def compare(
    flown: Flown,
    link: RadioLink,
    setting: PredictionStudy,
    progress: Callable[[str], None] = lambda _text: None,
) -> Compared:
    """Every predictor on every UAV of a log, over one link. No rows where none flies."""
    cases: list[Case] = []

    def clock() -> SenderClock:
        return assembly.clock(setting.settings)

    for flight in flown.flights:
        delivery = radio_link.deliver(flight, link, setting.seed, clock)
        if delivery.observed:
            from_ns = delivery.observed[0].arrival_ns
            cases.append((flight, delivery, questions(flown, flight, setting.leads_s, from_ns)))
    cases = [case for case in cases if case[2].counts.any()]
    where = f"{flown.log}, {link.name}"
    tuned = {}
    for name in DENSITIES if cases else ():
        progress(f"{where}: tuning {name}")
        tuned[name] = tune(name, cases)
    makes = predictors(setting, tuned)
    receiver = Receiver(assembly.array(setting.settings), setting.snr_db)
    rows: list[Row] = []
    for (flight, delivery, asked), (name, make) in product(cases, makes.items()):
        progress(f"{where}: {name} on {flight.uav}")
        given = answers(make(), delivery.observed, asked)
        for lead, lead_s in enumerate(setting.leads_s):
            figures = score(asked, given, lead, receiver)
            head = {"log": flown.log, "uav": flight.uav, "predictor": name, "lead_s": lead_s}
            head |= {"report_rate_hz": delivery.rate_hz, "latency_s": delivery.latency_s}
            if figures:
                rows.append(head | {"loss": link.loss} | figures | {"truth": flight.truth.kind})
    return Compared(flown.log, flown.center, link, tuple(rows), tuned)


def predictors(setting: PredictionStudy, tuned: Mapping[str, Tuning]) -> dict[str, Make]:
    """All predictors that are compared, by name, in the order of the tables."""
    known = known_tuning(setting.settings)
    makes = {**observers(setting.settings), **SIMPLE}
    makes |= {name: kalman(name, tuning) for name, tuning in tuned.items()}
    makes["kalman-peng"] = lambda: Kalman(2, known)
    if setting.learned is not None:
        makes["lstm"] = learned(setting.learned)
    return makes


def tune(name: str, cases: Sequence[Case]) -> Tuning:
    """The noise of the grid with the least mean square position error over all UAVs and leads."""
    few = [(delivery.observed, asked.every(TUNE_EVERY)) for _, delivery, asked in cases]

    def cost(tuning: Tuning) -> float:
        squares: list[FloatArray] = []
        for observed, asked in few:
            given = answers(Kalman(KALMAN_STATES[name], tuning), observed, asked)
            error = (given.position_ned_m - asked.truth_ned_m)[asked.counts]
            squares.append(np.sum(error * error, axis=1))
        return float(np.nanmean(np.concatenate(squares)))

    grid = product(DENSITIES[name], NOISES)
    return min((Tuning(density, *noises) for density, noises in grid), key=cost)


@dataclass(frozen=True, slots=True)
class Piece:
    """A piece of work: one log over one link."""

    setting: PredictionStudy
    path: Path
    link: RadioLink


def work(piece: Piece, progress: Callable[[str], None] = lambda _text: None) -> Compared:
    """Read a log and compare.

    Raises ``UserError`` or ``LogError`` where it has nothing to study.
    """
    progress(f"reading {piece.path.name}")
    flown = vehicles.load(piece.path, piece.setting.center)
    return compare(flown, piece.link, piece.setting, progress)


def study(
    setting: PredictionStudy, progress: Callable[[str], None] = lambda _text: None
) -> tuple[dict[str, Any], list[Compared]]:
    """The answer as it is written to ``prediction.json``, and what the report shows.

    Raises ``UserError`` or ``LogError`` for a log in which there is nothing to study.
    """
    if setting.learned is not None:
        learned(setting.learned)  # what cannot be used is said before the work
    pieces = [
        Piece(setting, path, link)
        for path in setting.logs
        for link in (radio_link.CLEAN, setting.radio)
    ]
    found = _compared(setting, pieces, progress)
    for path, *both in zip(setting.logs, found[::2], found[1::2], strict=True):
        if not any(compared.rows for compared in both):
            raise UserError(f"{path}: no UAV flies in it, as far as its carrier is known")
    known = known_tuning(setting.settings)
    return {
        "rows": [row for compared in found for row in compared.rows],
        "command": setting.command,
        "versions": {
            "companion": companion.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "seed": setting.seed,
        "snr_db": setting.snr_db,
        "links": [asdict(link) for link in (radio_link.CLEAN, setting.radio)],
        "tuning": [
            {"log": compared.log, "link": compared.link.name, "predictor": name} | asdict(tuning)
            for compared in found
            for name, tuning in (*compared.tuned.items(), ("kalman-peng", known))
        ],
    }, found


def _compared(
    setting: PredictionStudy, pieces: Sequence[Piece], progress: Callable[[str], None]
) -> list[Compared]:
    """The results of the pieces, in their order."""

    def told(done: int) -> None:
        progress(f"{done} of {len(pieces)} done (a log over a link each)")

    told(0)
    if setting.cluster is not None:
        there = [replace(piece, path=piece.path.absolute()) for piece in pieces]
        return fan_out.on_cluster(work, there, setting.cluster, told)
    jobs = setting.jobs or fan_out.cores()
    if jobs > 1 and len(pieces) > 1:
        return fan_out.on_cores(work, pieces, jobs, told)
    return [work(piece, progress) for piece in pieces]
