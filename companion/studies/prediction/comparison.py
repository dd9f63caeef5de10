"""Comparison of predictors on logs: ``companion study prediction``.

For every vehicle of a log but the carrier, over each link (the log's own, a slow radio, a hostile
one), a pointer asks 20 times a second where the UAV will be at now + lead. Predictors use only data
that have arrived by then. Errors are those of position and of the direction from the array's true
position, while the UAV flies. The product answers through its pipeline, which receives the
vehicle's own frames; ``violations`` counts whether its bounds held, and whether a violation was
announced.

The Kalman filters are tuned in hindsight, once for each log and link: their process and measurement
noise are the best of a grid over all UAVs and leads, an advantage that no user has. ``kalman-peng``
assumes the noise of the settings, and is never tuned.

Each log over each link is a separate piece of work: see ``companion.studies.running.fan_out``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product as product_of
from pathlib import Path
from typing import Any, Final

from companion.mavlink.clock.sender_clock import SenderClock
from companion.pipeline import assembly
from companion.recording.reader import center_of, flights
from companion.settings.model import Settings
from companion.studies.origin import Progress, Row, command_line, silent, versions
from companion.studies.prediction import radio_link, violations
from companion.studies.prediction.delivery import deliver
from companion.studies.prediction.kalman import Kalman, Tuning
from companion.studies.prediction.pointing import (
    Receiver,
    answers,
    product_answers,
    questions,
    score,
)
from companion.studies.prediction.predictors import (
    MODELS,
    SIMPLE,
    Make,
    kalman,
    known_tuning,
    learned,
    product,
)
from companion.studies.prediction.radio_link import RADIO, RadioLink
from companion.studies.prediction.spectral import SNR_DB
from companion.studies.prediction.tuning import DENSITIES, Case, tune
from companion.studies.running import fan_out
from companion.studies.truth import vehicles
from companion.studies.truth.trajectory import Kind
from companion.studies.truth.vehicles import Flown
from companion.values import UserError

LEADS_S: Final = (0.0, 0.1, 0.3, 1.0)
LINKS: Final = ("clean", "radio", "hostile")  # default links


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictionStudy:
    """Parameters of the prediction study.

        links names of links, from those in ``radio_link``

    The choice of processes or cluster does not change the rows. Raises ``UserError`` for values out
    of range.
    """

    logs: tuple[Path, ...]  # the logs
    center: str | None = None  # as on the command line
    leads_s: tuple[float, ...] = LEADS_S  # leads, seconds
    links: tuple[str, ...] = LINKS
    radio: RadioLink = RADIO  # the slow radio
    seed: int = 1  # of all random numbers
    settings: Settings = field(default_factory=Settings)  # those of the array and the tracking
    config: str | None = None  # as on the command line
    learned: Path | None = None  # a file of companion study train
    snr_db: float = SNR_DB  # SNR for the loss in spectral efficiency
    jobs: int | None = 1  # processes; None: as many as cores
    cluster: str | None = None  # address of a cluster to use instead

    def __post_init__(self) -> None:
        if not -100 <= self.snr_db <= 100:
            raise UserError(f"--snr {self.snr_db:g}: give dB from -100 to 100")
        if not self.leads_s or not all(0 <= lead_s <= 60 for lead_s in self.leads_s):
            raise UserError("--lead: give seconds from 0 to 60")
        known = [link.name for link in radio_link.LINKS]
        if not self.links or not set(self.links) <= set(known):
            raise UserError(f"--links {','.join(self.links)}: give some of {', '.join(known)}")
        if self.seed < 0:
            raise UserError(f"--seed {self.seed}: give 0 or more")

    @property
    def over(self) -> tuple[RadioLink, ...]:
        """Links to study, each once, in the order given."""
        links = {link.name: link for link in radio_link.LINKS} | {RADIO.name: self.radio}
        return tuple(links[name] for name in dict.fromkeys(self.links))

    @property
    def command(self) -> str:
        """Command line that runs the study."""
        radio = self.radio
        return command_line(
            "prediction",
            *self.logs,
            center=self.center,
            config=self.config,
            lead=self.leads_s,
            links=tuple(dict.fromkeys(self.links)),
            rate=radio.rate_hz,
            latency=radio.latency_s,
            loss=radio.loss,
            known_delay=radio.known_delay,
            learned=self.learned,
            snr=self.snr_db,
            seed=self.seed,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LogComparison:
    """One log over one link: its rows, and the tuning of each filter."""

    log: str
    center: str
    link: RadioLink
    rows: tuple[Row, ...]
    tuned: Mapping[str, Tuning]


def compare(
    flown: Flown, link: RadioLink, setting: PredictionStudy, progress: Progress = silent
) -> LogComparison:
    """Run every predictor on every UAV of a log over one link. No rows if no UAV flies."""
    cases: list[Case] = []

    def clock() -> SenderClock:
        return assembly.clock(setting.settings)

    for flight in flown.flights:
        delivery = deliver(flight, link, setting.seed, clock)
        if delivery.observed:
            span = delivery.observed[0].arrival_ns, delivery.begins_ns
            cases.append((flight, delivery, questions(flown, flight, setting.leads_s, *span)))
    cases = [case for case in cases if case[2].counts.any()]
    where = f"{flown.log}, {link.name}"
    tuned = {}
    for name in DENSITIES if cases else ():
        progress(f"{where}: tuning {name}")
        tuned[name] = tune(name, cases)
    makes = rivals(setting, tuned)
    receiver = Receiver(assembly.array(setting.settings), setting.snr_db)
    rows: list[Row] = []
    for (flight, delivery, asked), name in product_of(cases, (*MODELS, *makes)):
        progress(f"{where}: {name} on {flight.uav}")
        if name in MODELS:
            settings = as_true(setting.settings, flight.truth.kind)
            asks = product(settings, name, flight.uav, flown.origin)
            given = product_answers(asks, delivery.events, asked)
        else:
            given = answers(makes[name](), delivery.observed, asked)
        for lead, lead_s in enumerate(setting.leads_s):
            figures = score(asked, given, lead, receiver)
            head: Row = {"log": flown.log, "link": link.name, "uav": flight.uav, "predictor": name}
            head |= {"lead_s": lead_s, "report_rate_hz": delivery.rate_hz}
            head |= {"latency_s": delivery.latency_s, "loss": link.loss}
            if figures:
                counts = violations.counted(asked, given, lead)
                rows.append(head | figures | counts | {"truth": flight.truth.kind})
    return LogComparison(
        log=flown.log, center=flown.center, link=link, rows=tuple(rows), tuned=tuned
    )


def as_true(settings: Settings, kind: Kind) -> Settings:
    """Return settings for evaluating the product against one source of truth.

    If the truth is computed from the reports themselves, reports do not lag behind it.
    """
    return settings.override(observer={"lag_s": (0.0, 0.0)}) if kind == "reports" else settings


def rivals(setting: PredictionStudy, tuned: Mapping[str, Tuning]) -> dict[str, Make]:
    """Return the predictors that the product is compared with, by name, in table order."""
    known = known_tuning(setting.settings)
    makes = dict(SIMPLE)
    makes |= {name: kalman(name, tuning) for name, tuning in tuned.items()}
    makes["kalman-peng"] = lambda: Kalman(2, known)
    if setting.learned is not None:
        makes["lstm"] = learned(setting.learned)
    return makes


@dataclass(frozen=True, slots=True)
class Piece:
    """Unit of work: the logs of one flight over one link."""

    setting: PredictionStudy
    logs: tuple[Path, ...]
    link: RadioLink


def work(piece: Piece, progress: Progress = silent) -> LogComparison:
    """Read a log and compare; ``UserError`` or ``LogError`` if it has nothing to study."""
    progress(f"reading {vehicles.named(piece.logs)}")
    flown = vehicles.load(piece.logs, center_of(piece.logs, piece.setting.center))
    return compare(flown, piece.link, piece.setting, progress)


def study(
    setting: PredictionStudy, progress: Progress = silent
) -> tuple[dict[str, Any], list[LogComparison]]:
    """Return the answer as written to ``prediction.json``, and the data of the report.

    Raises ``UserError`` or ``LogError`` for a log with nothing to study.
    """
    if setting.learned is not None:
        learned(setting.learned)  # report an unusable file before the work starts
    flown = flights(setting.logs)
    pieces = [Piece(setting, logs, link) for logs in flown for link in setting.over]
    found = _compared(setting, pieces, progress)
    for number, logs in enumerate(flown):
        among = len(setting.over)
        if not any(each.rows for each in found[number * among : (number + 1) * among]):
            names = " ".join(map(str, logs))
            raise UserError(f"{names}: no UAV flies while the carrier's position is known")
    known = known_tuning(setting.settings)
    rows = [row for compared in found for row in compared.rows]
    return {
        "rows": rows,
        "unannounced": violations.unannounced(rows),
        "command": setting.command,
        "versions": versions(),
        "seed": setting.seed,
        "snr_db": setting.snr_db,
        "links": [asdict(link) for link in setting.over],
        "tuning": [
            {"log": compared.log, "link": compared.link.name, "predictor": name} | asdict(tuning)
            for compared in found
            for name, tuning in (*compared.tuned.items(), ("kalman-peng", known))
        ],
    }, found


def _compared(
    setting: PredictionStudy, pieces: Sequence[Piece], progress: Progress
) -> list[LogComparison]:
    def progressed(done: int) -> None:
        progress(f"{done} of {len(pieces)} done (a log over a link each)")

    progressed(0)
    if setting.cluster is not None:
        there = [
            replace(piece, logs=tuple(log.absolute() for log in piece.logs)) for piece in pieces
        ]
        return fan_out.on_cluster(work, there, setting.cluster, progressed)
    jobs = setting.jobs or fan_out.cores()
    if jobs > 1 and len(pieces) > 1:
        return fan_out.on_cores(work, pieces, jobs, progressed)
    return [work(piece, progress) for piece in pieces]
