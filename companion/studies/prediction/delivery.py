"""Delivery of messages by a link: arrival times, and the reports for predictors.

The product receives the frames themselves; the baselines get observed reports, whose times are from
the product's clock, which uses the stamps of all messages. All random values derive from a seed and
the vehicle's id.
"""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from companion.mavlink.clock.sender_clock import SenderClock
from companion.mavlink.wire.positions import OWN
from companion.mavlink.wire.stamps import STAMPED
from companion.mavlink.wire.stamps import boot_ms as stamp_of
from companion.studies.prediction import hostile_link, noisy_frames
from companion.studies.prediction.baselines import ObservedReport
from companion.studies.prediction.radio_link import RadioLink
from companion.studies.truth.trajectory import Times
from companion.studies.truth.vehicles import Flight
from companion.values import BoolArray, FloatArray, Frame, IntArray, RoundTrip, Source

P95: Final = 1.6448536269514722  # the 95th percentile of the standard normal distribution
ROUND_TRIP_NS: Final = 10_000_000
"""Duration of each round trip by which a known clock is measured once a second."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Delivery:
    """Messages of one vehicle as a link delivers them, in order of arrival.

    events     the frames with their arrival times, and round trips; empty for a flight without
               frames
    """

    observed: tuple[ObservedReport, ...]  # the reports
    events: tuple[Frame | RoundTrip, ...]
    rate_hz: float  # nominal rate of reports, or that of the log
    latency_s: float  # nominal median latency, or that estimated by the clock
    begins_ns: int | None = None  # when a hostile link was switched on; None for others


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Sends:
    """Messages that a vehicle sent, (M,): first its reports (N,), then its other frames, if any."""

    sent_ns: Times  # when it arrived over the log's own link
    boot_ms: Times  # its boot stamp; -1 without one
    kind: IntArray  # its message id
    frame: IntArray  # its index among the flight's frames; -1 without one


def deliver(
    flight: Flight, link: RadioLink, seed: int, clock: Callable[[], SenderClock] = SenderClock
) -> Delivery:
    """Send the messages of a flight through a link; ``clock`` creates the sender's clock.

    The same seed gives the same result, independent of other flights.
    """
    rng = np.random.default_rng([seed, zlib.crc32(flight.uav.encode())])
    sends, reports = _sends(flight), len(flight.arrival_ns)
    begins_ns = _begins_ns(flight) if link.hostile else None
    rows, arrival_ns = _passed(rng, sends, reports, link, begins_ns)
    order = np.argsort(arrival_ns, kind="stable")
    rows, arrival_ns = rows[order], arrival_ns[order]
    noise = noisy_frames.noise(rng, reports, link)
    trips = flight.round_trips if link.as_logged else ()
    # The radio's delays do not affect a clock that is known by other means.
    heard_ns = sends.sent_ns[rows] if link.known_delay else arrival_ns
    placed = on_sender_clock(clock(), heard_ns, sends.boot_ms[rows], rows < reports, trips)
    observed = tuple(
        ObservedReport(
            arrival_ns=arrived,
            sent_ns=at.sent_ns,
            sender_ns=at.sender_ns,
            position_ned_m=flight.position_ned_m[row] + noise.position_ned_m[row],
            velocity_ned_mps=_reported(flight.velocity_ned_mps[row] + noise.velocity_ned_mps[row]),
            clock_bound_s=at.bound_s,
            gnss=flight.gnss[row],
        )
        for row, arrived, at in zip(rows.tolist(), arrival_ns.tolist(), placed, strict=True)
        if at is not None
    )
    rate_hz, latency_s = link.rate_hz, link.latency_s and link.latency_s[0]
    if rate_hz is None:
        rate_hz = 1e3 / float(np.median(np.diff(np.unique(flight.boot_ms))))
    if latency_s is None:
        late_s = [(each.arrival_ns - each.sent_ns) * 1e-9 for each in observed]
        latency_s = float(np.median(late_s)) if late_s else 0.0
    frames = noisy_frames.changed(flight, noise, link)
    events = [
        frames[at]._replace(t_ns=arrived)
        for at, arrived in zip(sends.frame[rows].tolist(), arrival_ns.tolist(), strict=True)
        if at >= 0
    ]
    trips += known_round_trips(flight) if link.known_delay else ()
    everything = sorted([*events, *trips], key=lambda event: event.t_ns)
    return Delivery(
        observed=observed,
        events=tuple(everything),
        rate_hz=rate_hz,
        latency_s=latency_s,
        begins_ns=begins_ns,
    )


def _sends(flight: Flight) -> _Sends:
    # Further frames with a position are repeats, or positions before a fix.
    others = np.array(
        [at for at, frame in enumerate(flight.frames) if frame.msgid not in OWN], dtype=np.int64
    )
    frames = [flight.frames[at] for at in others.tolist()]
    said = [stamp_of(frame) if frame.msgid in STAMPED else -1 for frame in frames]
    reports = len(flight.arrival_ns)
    at = flight.report_at if len(flight.frames) else np.full(reports, -1, dtype=np.int64)
    return _Sends(
        sent_ns=np.concatenate(
            [flight.arrival_ns, np.array([f.t_ns for f in frames], dtype=np.int64)]
        ),
        boot_ms=np.concatenate([flight.boot_ms, np.array(said, dtype=np.int64)]),
        kind=np.concatenate(
            [np.full(reports, -1), np.array([f.msgid for f in frames], dtype=np.int64)]
        ),
        frame=np.concatenate([at, others]),
    )


def _begins_ns(flight: Flight) -> int:
    """Return when the UAV first seems to fly; if never, when its first report arrived."""
    (flies,) = np.nonzero(flight.flying(flight.arrival_ns))
    return int(flight.arrival_ns[flies[0] if len(flies) else 0])


def _passed(
    rng: np.random.Generator, sends: _Sends, reports: int, link: RadioLink, begins_ns: int | None
) -> tuple[IntArray, Times]:
    """Return the indexes of messages that arrive, and their arrival times."""
    if begins_ns is not None:
        order = np.argsort(sends.sent_ns, kind="stable")
        came_ns, arrives = hostile_link.arrivals_ns(rng, sends.sent_ns[order], begins_ns)
        return order[arrives], came_ns[arrives]
    rows, arrival_ns = _over_radio(rng, sends, _thinned(sends, reports, link.rate_hz), link)
    others = np.arange(reports, len(sends.sent_ns))
    if link.rate_hz is not None:
        others = _thinned_each(sends, others, link.rate_hz)
    more, more_ns = _over_radio(rng, sends, others, link)
    return np.concatenate([rows, more]), np.concatenate([arrival_ns, more_ns])


def _over_radio(
    rng: np.random.Generator, sends: _Sends, rows: IntArray, link: RadioLink
) -> tuple[IntArray, Times]:
    rows = rows[rng.random(len(rows)) >= link.loss]
    added_ns = np.zeros(len(rows), dtype=np.int64)
    if link.latency_s is not None:
        median_s, p95_s = link.latency_s
        spread = math.log(p95_s / median_s) / P95
        drawn_s = median_s * np.exp(spread * rng.standard_normal(len(rows)))
        added_ns = np.round(drawn_s * 1e9).astype(np.int64)
    return rows, sends.sent_ns[rows] + added_ns


def _thinned(sends: _Sends, reports: int, rate_hz: float | None) -> IntArray:
    """Return rows of the first report in each period of the sender's clock, in order of arrival."""
    rows = np.arange(reports)
    if rate_hz is None:
        return rows
    # A new period, or a restarted clock.
    period = np.floor(sends.boot_ms[:reports] * (rate_hz * 1e-3)).astype(np.int64)
    kept: IntArray = rows[np.diff(period, prepend=period[0] - 1) != 0]
    return kept


def _thinned_each(sends: _Sends, rows: IntArray, rate_hz: float) -> IntArray:
    """Return the rows of the first message of each kind in each period of the log."""
    period = np.floor((sends.sent_ns[rows] - sends.sent_ns.min()) * (rate_hz * 1e-9))
    kinds = np.stack([sends.kind[rows].astype(float), period], axis=1)
    _, first = np.unique(kinds, axis=0, return_index=True)
    return rows[np.sort(first)]


def known_round_trips(flight: Flight) -> tuple[RoundTrip, ...]:
    """Return the round trips that the service would have measured over the log's own link."""
    found: list[RoundTrip] = []
    source = Source.parse(flight.uav)
    each = zip(flight.arrival_ns.tolist(), flight.made_ns.tolist(), flight.boot_ms, strict=True)
    for arrived_ns, made_ns, boot_ms in each:
        if not found or arrived_ns - found[-1].t_ns >= 1_000_000_000:
            sent_ns = min(made_ns, arrived_ns) - ROUND_TRIP_NS
            found.append(
                RoundTrip(
                    t_ns=arrived_ns,
                    source=source,
                    sent_ns=sent_ns,
                    remote_ns=int(boot_ms) * 1_000_000,
                )
            )
    return tuple(found)


class StampedReport(NamedTuple):
    """Report placed in time by the product's clock.

    sender_ns  on the sender's timeline, which starts when its clock is first placed, and again
               after a restart
    """

    sender_ns: int
    sent_ns: int  # on the node's timeline, as estimated on arrival
    bound_s: float  # bound on the error of that


def on_sender_clock(
    clock: SenderClock,
    arrival_ns: Times,
    boot_ms: Times,
    is_report: BoolArray,
    trips: tuple[RoundTrip, ...],
) -> list[StampedReport | None]:
    """Place reports, among messages (n,), in time by the product's clock; stamp -1: none.

    The clock also receives the other messages, and ``trips``, as in the pipeline. None for other
    messages, and for reports without a placed stamp.
    """
    start_ns: int | None = None
    waiting = list(reversed(trips))
    placed: list[StampedReport | None] = [None] * len(arrival_ns)
    for row in np.argsort(arrival_ns, kind="stable").tolist():
        arrived_ns, stamp_ms = int(arrival_ns[row]), int(boot_ms[row])
        while waiting and waiting[-1].t_ns < arrived_ns:
            trip = waiting.pop()
            clock.timesync(trip.sent_ns, trip.t_ns, trip.remote_ns)
        if not is_report[row]:
            if stamp_ms >= 0 and start_ns is not None:
                clock.add_stamp(arrived_ns, stamp_ms)
            continue
        stamp = clock.observe(arrived_ns, stamp_ms)
        estimate = clock.estimate()
        if stamp is None or estimate is None:
            continue
        sent_ns = arrived_ns - round(stamp.latency_s * 1e9)
        if start_ns is None or stamp.rebooted:
            start_ns = sent_ns - stamp.sender_ns
        placed[row] = StampedReport(start_ns + stamp.sender_ns, sent_ns, estimate.uncertainty_s)
    return placed


def _reported(velocity: FloatArray) -> FloatArray | None:
    return None if np.isnan(velocity).any() else velocity
