"""The link between a vehicle and the node: as it was, or as a slow radio would have made it.

A radio thins the reports to a rate, loses some, and delays each by a lognormal time of its own, so
that reports overtake one another. Everything is drawn from a seed and the vehicle's id.
"""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.mavlink.clock.sender_clock import SenderClock
from companion.studies.prediction.baselines import Observed
from companion.studies.truth.trajectory import Times
from companion.studies.truth.vehicles import Flight
from companion.values import FloatArray, UserError

P95: Final = 1.6448536269514722
"""The 95th percentile of the standard normal distribution."""


@dataclass(frozen=True, slots=True)
class RadioLink:
    """What a link does to reports.

        name         its name in tables
        rate_hz      rate to which they are thinned; None: as in the log
        latency_s    median and 95th percentile of the added latency; None: none is added
        loss         share of reports that never arrive
        known_delay  the sender's clock is known as well as over the log's own link, as by TIMESYNC

    Raises ``UserError`` for values out of range.
    """

    name: str
    rate_hz: float | None = None
    latency_s: tuple[float, float] | None = None
    loss: float = 0.0
    known_delay: bool = False

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not 0 < self.rate_hz < math.inf:
            raise UserError(f"a rate is a positive number of Hz, not {self.rate_hz}")
        if self.latency_s is not None and not 0 < self.latency_s[0] <= self.latency_s[1] < math.inf:
            raise UserError(
                "a latency is MEDIAN,P95 in seconds, 0 < MEDIAN <= P95, not {:g},{:g}".format(
                    *self.latency_s
                )
            )
        if not 0 <= self.loss < 1:
            raise UserError(f"a loss is at least 0 and below 1, not {self.loss}")


CLEAN: Final = RadioLink("clean")
"""The log's own link."""


@dataclass(frozen=True, slots=True, eq=False)
class Delivery:
    """Reports delivered by a link, in order of arrival.

    observed   the reports
    rate_hz    nominal rate, or that of the log
    latency_s  nominal median latency, or that seen by the clock
    """

    observed: tuple[Observed, ...]
    rate_hz: float
    latency_s: float


def deliver(
    flight: Flight, link: RadioLink, seed: int, clock: Callable[[], SenderClock] = SenderClock
) -> Delivery:
    """Send a flight's reports through a link; ``clock`` makes the sender's clock.

    The same seed gives the same result, whatever else is flown.
    """
    rng = np.random.default_rng([seed, zlib.crc32(flight.uav.encode())])
    rows = _thinned(flight.boot_ms, link.rate_hz)
    rows = rows[rng.random(len(rows)) >= link.loss]
    added_ns = np.zeros(len(rows), dtype=np.int64)
    if link.latency_s is not None:
        median_s, p95_s = link.latency_s
        spread = math.log(p95_s / median_s) / P95
        drawn_s = median_s * np.exp(spread * rng.standard_normal(len(rows)))
        added_ns = np.round(drawn_s * 1e9).astype(np.int64)
    order = np.argsort(flight.arrival_ns[rows] + added_ns, kind="stable")
    rows, added_ns = rows[order], added_ns[order]
    arrival_ns = flight.arrival_ns[rows] + added_ns
    # The radio's delays do not reach a clock that is known by other means.
    heard_ns = flight.arrival_ns[rows] if link.known_delay else arrival_ns
    sender_ns, sent_ns, bound_s, placed = on_sender_clock(clock(), heard_ns, flight.boot_ms[rows])
    observed = tuple(
        Observed(
            arrived,
            sent,
            made,
            position,
            _known(velocity),
            bound,
            gnss,
        )
        for arrived, sent, made, position, velocity, bound, gnss, known in zip(
            arrival_ns.tolist(),
            sent_ns.tolist(),
            sender_ns.tolist(),
            flight.position_ned_m[rows],
            flight.velocity_ned_mps[rows],
            bound_s.tolist(),
            [flight.gnss[row] for row in rows],
            placed.tolist(),
            strict=True,
        )
        if known
    )
    rate_hz, latency_s = link.rate_hz, link.latency_s and link.latency_s[0]
    if rate_hz is None:
        rate_hz = 1e3 / float(np.median(np.diff(np.unique(flight.boot_ms))))
    if latency_s is None:
        latency_s = float(np.median((arrival_ns - sent_ns)[placed])) * 1e-9
    return Delivery(observed, rate_hz, latency_s)


def on_sender_clock(
    clock: SenderClock, arrival_ns: Times, boot_ms: Times
) -> tuple[Times, Times, FloatArray, NDArray[np.bool_]]:
    """When reports were made, by the product's clock, (N,) each.

    Returns their times on the sender's timeline; those on the node's, as known on arrival; the
    bound on their error, seconds; and whether the stamp could be placed at all. Only here does the
    study use that clock. The sender's timeline begins where its clock is first placed, and again
    after a restart.
    """
    start_ns: int | None = None
    rows: list[tuple[int, int, float, bool]] = [(0, 0, 0.0, False)] * len(arrival_ns)
    for row in np.argsort(arrival_ns, kind="stable").tolist():
        arrived_ns = int(arrival_ns[row])
        stamp, estimate = clock.observe(arrived_ns, int(boot_ms[row])), clock.estimate()
        if stamp is None or estimate is None:
            continue
        sent_ns = arrived_ns - round(stamp.latency_s * 1e9)
        if start_ns is None or stamp.rebooted:
            start_ns = sent_ns - stamp.sender_ns
        rows[row] = (start_ns + stamp.sender_ns, sent_ns, estimate.uncertainty_s, True)
    sender, sent, bound_s, placed = zip(*rows, strict=True) if rows else ((), (), (), ())
    return (
        np.array(sender, dtype=np.int64),
        np.array(sent, dtype=np.int64),
        np.array(bound_s, dtype=float),
        np.array(placed, dtype=bool),
    )


def _known(velocity: FloatArray) -> FloatArray | None:
    return None if np.isnan(velocity).any() else velocity


def _thinned(boot_ms: Times, rate_hz: float | None) -> Times:
    """Rows of the first report in each period of the sender's clock, in order of arrival."""
    rows: Times = np.arange(len(boot_ms))
    if rate_hz is None:
        return rows
    # A new period, or a clock that was restarted.
    period = np.floor(boot_ms * (rate_hz * 1e-3)).astype(np.int64)
    kept: Times = rows[np.diff(period, prepend=period[0] - 1) != 0]
    return kept
