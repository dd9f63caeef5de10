"""Predictors compared on logs: ``companion study prediction``.

For every vehicle of a log but the carrier, over a clean link (the log's own arrival stamps) and
over a slow radio, a pointer is asked 20 times a second where the UAV will be at now + lead.
It uses only what has arrived by then. Errors are those of position and of the direction from the
array's true position, while the UAV flies.

The Kalman filters are tuned in hindsight, once for each log and link: their process and
measurement noise are the best of a grid over all UAVs and leads, which is kinder to them than any
user could be.
"""

import platform
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np

import companion
from companion import assembly
from companion.config import Settings
from companion.mavlink.clocks import SenderClock
from companion.studies import links, truth
from companion.studies.links import Delivery, Link
from companion.studies.pointing import Questions, Row, answers, questions, score
from companion.studies.truth import Flight, Flown
from companion.tracking.baselines import (
    DeadReckoning,
    DeadReckoningOnArrival,
    Hold,
    Kalman,
    Observed,
    Predicted,
    Predictor,
    Tuning,
)
from companion.tracking.fleet import SenderTime
from companion.tracking.noise import reported
from companion.values import AltitudeDatum, Fix, FloatArray, Report, Source

TUNE_EVERY: Final = 5
"""The grid is searched on every fifth question: it is smooth, and there are many settings."""
LEADS_S: Final = (0.0, 0.1, 0.3, 1.0)
RADIO: Final = Link("radio", rate_hz=1.2, latency_s=(0.6, 2.2), loss=0.1)

DENSITIES: Final = {
    "kalman-cv": (0.1, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0),
    "kalman-ca": (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0),
}
NOISES: Final = tuple(product((0.03, 0.3), (0.1, 0.3)))
"""What the filters are tuned over: process noise, and noise of position (m) and velocity (m/s)."""
KALMAN_STATES: Final = {"kalman-cv": 2, "kalman-ca": 3}

Make = Callable[[], Predictor]


# --- the predictors -----------------------------------------------------------------------------


class FleetPredictor:
    """The product's own tracking behind the same door as its rivals."""

    def __init__(self, settings: Settings) -> None:
        self._fleet = assembly.fleet(settings, self._sender_time)
        self._noise = assembly.noise(settings)
        self._offset_ns = 0
        self._clock_bound_s = 0.0

    def report(self, report: Observed) -> None:
        """A fix; whether it is used is the fleet's to say."""
        self._offset_ns = report.sent_ns - report.sender_ns
        self._clock_bound_s = report.clock_bound_s
        errors = self._noise.default if report.gnss is None else reported(report.gnss, self._noise)
        self._fleet.accept(
            Fix(
                _UAV,
                report.sender_ns,
                report.sent_ns,
                report.arrival_ns,
                report.position_ned_m,
                report.velocity_ned_mps,
                errors,
                _REPORT,
            )
        )

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """The track at that time, with its bound."""
        track = self._fleet.track(_UAV, now_ns, at_ns)
        if track is None:
            return None
        return Predicted(track.position_ned_m, track.velocity_ned_mps, track.bound_m)

    def _sender_time(self, _uav: str, node_ns: int) -> SenderTime:
        return SenderTime(node_ns - self._offset_ns, self._clock_bound_s)


_UAV: Final = "1:1"
_REPORT: Final = Report(
    0, "study", _UAV, Source(1, 1), 0.0, 0.0, 0.0, AltitudeDatum.MSL, None, None, None, None,
    None, None,
)  # fmt: skip
"""Stands for the message that a fix was made of, which tracking does not look into."""


def observers(settings: Settings) -> dict[str, Make]:
    """The product's observers by name: each makes a predictor of one UAV."""

    def maker(model: str) -> Make:
        chosen = settings.override(observer={"model": model})
        return lambda: FleetPredictor(chosen)

    return {f"uio-{model}": maker(model) for model in ("position", "kinematic")}


SIMPLE: Final[Mapping[str, Make]] = {
    "hold": Hold,
    "dead-reckoning-arrival": DeadReckoningOnArrival,
    "dead-reckoning": DeadReckoning,
}


def _kalman(name: str, tuning: Tuning) -> Make:
    return lambda: Kalman(KALMAN_STATES[name], tuning)


# --- the study ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Setting:
    """What is asked of the study."""

    logs: tuple[Path, ...]
    center: str | None = None
    leads_s: tuple[float, ...] = LEADS_S
    radio: Link = RADIO
    seed: int = 1
    settings: Settings = field(default_factory=Settings)
    config: str | None = None

    def __post_init__(self) -> None:
        if not self.leads_s or not all(0 <= lead_s <= 60 for lead_s in self.leads_s):
            raise ValueError("leads are seconds, between 0 and 60")
        if self.seed < 0:
            raise ValueError(f"a seed is at least 0, not {self.seed}")

    @property
    def command(self) -> str:
        """The command line that asks for this."""
        radio = self.radio
        assert radio.latency_s is not None
        words = ["companion", "study", "prediction", *map(str, self.logs)]
        words += ["--center", self.center] if self.center else []
        words += ["--config", self.config] if self.config else []
        words += ["--lead", ",".join(f"{lead_s:g}" for lead_s in self.leads_s)]
        words += ["--rate", f"{radio.rate_hz:g}"]
        words += ["--latency", "{:g},{:g}".format(*radio.latency_s)]
        words += ["--loss", f"{radio.loss:g}", *(["--known-delay"] if radio.known_delay else [])]
        return shlex.join([*words, "--seed", str(self.seed)])


@dataclass(frozen=True, slots=True)
class Compared:
    """One log over one link: its rows, and the tuning that each filter was given."""

    flown: Flown
    link: Link
    rows: tuple[Row, ...]
    tuned: Mapping[str, Tuning]


Case = tuple[Flight, Delivery, Questions]


def compare(
    flown: Flown,
    link: Link,
    setting: Setting,
    progress: Callable[[str], None] = lambda _text: None,
) -> Compared:
    """Every predictor on every UAV of a log, over one link. No rows where none flies."""
    cases: list[Case] = []

    def clock() -> SenderClock:
        return assembly.clock(setting.settings)

    for flight in flown.flights:
        delivery = links.deliver(flight, link, setting.seed, clock)
        if delivery.observed:
            from_ns = delivery.observed[0].arrival_ns
            cases.append((flight, delivery, questions(flown, flight, setting.leads_s, from_ns)))
    cases = [case for case in cases if case[2].counts.any()]
    where = f"{flown.log}, {link.name}"
    tuned = {}
    for name in DENSITIES if cases else ():
        progress(f"{where}: tuning {name}")
        tuned[name] = tune(name, cases)
    makes = {**observers(setting.settings), **SIMPLE}
    makes |= {name: _kalman(name, tuning) for name, tuning in tuned.items()}
    rows: list[Row] = []
    for (flight, delivery, asked), (name, make) in product(cases, makes.items()):
        progress(f"{where}: {name} on {flight.uav}")
        given = answers(make(), delivery.observed, asked)
        for lead, lead_s in enumerate(setting.leads_s):
            figures = score(asked, given, lead)
            head = {"log": flown.log, "uav": flight.uav, "predictor": name, "lead_s": lead_s}
            head |= {"report_rate_hz": delivery.rate_hz, "latency_s": delivery.latency_s}
            if figures:
                rows.append(head | {"loss": link.loss} | figures | {"truth": flight.truth.kind})
    return Compared(flown, link, tuple(rows), tuned)


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


def study(
    setting: Setting, progress: Callable[[str], None] = lambda _text: None
) -> tuple[dict[str, Any], list[Compared]]:
    """The answer as it is written to ``prediction.json``, and what the report shows.

    ``ValueError`` or ``LogError`` for a log in which there is nothing to study.
    """
    found: list[Compared] = []
    for path in setting.logs:
        progress(f"reading {path.name}")
        flown = truth.load(path, setting.center)
        here = [compare(flown, link, setting, progress) for link in (links.CLEAN, setting.radio)]
        if not any(compared.rows for compared in here):
            raise ValueError(f"{path}: no UAV flies in it, as far as its carrier is known")
        found += here
    return {
        "rows": [row for compared in found for row in compared.rows],
        "command": setting.command,
        "versions": {
            "companion": companion.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "seed": setting.seed,
        "links": [asdict(link) for link in (links.CLEAN, setting.radio)],
        "tuning": [
            {"log": compared.flown.log, "link": compared.link.name, "predictor": name}
            | asdict(tuning)
            for compared in found
            for name, tuning in compared.tuned.items()
        ],
    }, found
