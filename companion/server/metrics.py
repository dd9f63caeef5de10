"""Prometheus metrics, read from the node on request.

Names follow Prometheus: base units, ``_total`` for counters. The process's own metrics (memory,
CPU, open files) come from the client library.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

import companion
from companion.mavlink.links.status import LinkStatus
from companion.server.access import WrongTokens
from companion.server.fleet_metrics import fleet_metrics
from companion.server.giving_way import GivingWay
from companion.server.large_answers import Make
from companion.server.stream import Stream
from companion.values import Level, Track, Verdict
from companion.values.described import meaning
from companion.views.health import shown_verdicts
from companion.views.state import Node, overload
from companion.views.uav_state import Overview

LINK_COUNTS: Final = (
    "frames", "bytes", "gaps", "sent", "send_dropped", "misstamped", "overflowed"
)  # fmt: skip
GAINS: Final = ("needed", "guaranteed", "likely")


def _help(described: Any, name: str) -> str:
    text = meaning(described, name).text
    return text[0].upper() + text[1:]


def _gauges(value: Any, **names: str) -> Iterator[Metric]:
    """Yield a gauge for each of the fields in ``names`` that is known."""
    return _described(GaugeMetricFamily, value, names)


def _counters(value: Any, **names: str) -> Iterator[Metric]:
    return _described(CounterMetricFamily, value, names)


def _described(
    family: Callable[..., Metric], value: Any, names: dict[str, str]
) -> Iterator[Metric]:
    for field, name in names.items():
        number = getattr(value, field)
        if number is not None:
            yield family(name, _help(type(value), field), value=number)


class _Given(Collector):
    """Metrics that are known already."""

    def __init__(self, metrics: Iterable[Metric]) -> None:
        self._metrics = metrics

    def collect(self) -> Iterable[Metric]:
        """Return the metrics."""
        return self._metrics


class NodeMetrics:
    """Counters and gauges of a node, of its server and of its process."""

    def __init__(self, node: Node, stream: Stream, wrong_tokens: WrongTokens) -> None:
        self._node = node
        self._stream = stream
        self._wrong_tokens = wrong_tokens
        self._process = ProcessCollector(registry=CollectorRegistry())

    def prepare(self, overview: Overview) -> Make[bytes]:
        """Read the node; return a function that writes its metrics, on any thread."""
        before = [*self._service(), *self._arrival_lag(), *self._links()]
        node = self._node
        machine = overload(node, node.now_ns())
        beams = list(self._beams())
        verdicts = list(shown_verdicts(node.pipeline.health, machine).values())
        after = [*fleet_metrics(self._node), *self._recording()]

        def made(way: GivingWay) -> bytes:
            registry = CollectorRegistry(auto_describe=False)
            node = [
                *before,
                *_uavs(way.between(overview.tracks())),
                *beams,
                *_verdicts(way.between(verdicts)),
                *after,
            ]
            for metric in node:
                # They are read once, one after the other.
                metric.samples = way.between(metric.samples)  # type: ignore[assignment]
            registry.register(_Given([*node, *self._process.collect()]))
            return generate_latest(registry)

        return made

    def _service(self) -> Iterator[Metric]:
        node, pipeline = self._node, self._node.pipeline
        build = GaugeMetricFamily("companion_build_info", "Version", labels=["version"])
        build.add_metric([companion.__version__], 1)
        yield build
        yield GaugeMetricFamily(
            "companion_uptime_seconds", "Time since the start", value=node.uptime_s()
        )
        yield GaugeMetricFamily(
            "companion_ready", "1 if the service is ready", value=float(not node.unfit())
        )
        yield CounterMetricFamily(
            "companion_frames", "MAVLink frames with a valid checksum", value=pipeline.frames
        )
        yield CounterMetricFamily("companion_updates", "Beam updates", value=pipeline.updates)
        rejected = CounterMetricFamily(
            "companion_rejected", "Rejections by reason", labels=["reason"]
        )
        for reason, count in pipeline.refusals.total.items():
            rejected.add_metric([str(reason)], count)
        yield rejected
        yield HistogramMetricFamily(
            "companion_event_loop_lag_seconds",
            "Delay of the timer's ticks",
            buckets=node.lateness.buckets(),
            sum_value=node.lateness.sum_s,
        )
        counts = self._node.observations()
        if counts is not None:
            yield from _counters(
                counts,
                received="companion_observations",
                malformed="companion_observations_malformed",
                dropped="companion_observations_dropped",
            )
        yield GaugeMetricFamily(
            "companion_stream_clients", "Clients of /v1/stream", value=self._stream.clients
        )
        yield CounterMetricFamily(
            "companion_stream_messages", "Messages sent over /v1/stream", value=self._stream.sent
        )
        yield CounterMetricFamily(
            "companion_wrong_tokens",
            "HTTP requests with a wrong bearer token",
            value=self._wrong_tokens.count,
        )

    def _arrival_lag(self) -> Iterator[Metric]:
        yield from _gauges(
            self._node.arrival_lag.seen(self._node.now_ns()),
            newest_s="companion_arrival_lag_seconds",
            p95_s="companion_arrival_lag_p95_seconds",
            max_s="companion_arrival_lag_max_seconds",
        )

    def _links(self) -> Iterator[Metric]:
        up = GaugeMetricFamily("companion_link_up", "1 if the link is up", labels=["link"])
        families = {
            name: CounterMetricFamily(
                f"companion_link_{name}", _help(LinkStatus, name), labels=["link"]
            )
            for name in LINK_COUNTS
        }
        lost = CounterMetricFamily(
            "companion_link_lost",
            "Rejected frames by reason; garbage in bytes",
            labels=["link", "reason"],
        )
        for link in self._node.links():
            up.add_metric([link.url], float(link.state == "up"))
            for name, family in families.items():
                count = getattr(link, name)
                if count is not None:
                    family.add_metric([link.url], count)
            for reason, count in list(link.lost.items()):
                lost.add_metric([link.url, str(reason)], count)
        yield from (up, *families.values(), lost)

    def _beams(self) -> Iterator[Metric]:
        update = self._node.pipeline.last_update
        if update is not None:
            beams = update.beams
            yield GaugeMetricFamily("companion_beams", "Beams formed", value=len(beams.beams))
            yield from _gauges(beams, condition_number="companion_condition_number")

    def _recording(self) -> Iterator[Metric]:
        recording = self._node.recording()
        yield GaugeMetricFamily(
            "companion_recording_up",
            "1 if everything is recorded",
            value=float(recording.state == "recording"),
        )
        yield from _gauges(
            recording,
            bytes="companion_recording_bytes",
            queued="companion_recording_queue",
            lag_s="companion_recording_lag_seconds",
        )
        yield from _counters(recording, dropped="companion_recording_dropped")


def _uavs(tracks: Iterable[Track]) -> Iterator[Metric]:
    states = GaugeMetricFamily("companion_uavs", "UAVs by state", labels=["state"])
    bounds = GaugeMetricFamily("companion_bound_meters", _help(Track, "bound_m"), labels=["uav"])
    latency = GaugeMetricFamily(
        "companion_latency_seconds", _help(Track, "latency_s"), labels=["uav"]
    )
    likely = GaugeMetricFamily(
        "companion_likely_error_meters", _help(Track, "error_p95_m"), labels=["uav"]
    )
    by_state: dict[str, int] = {}
    for track in tracks:
        by_state[track.state] = by_state.get(track.state, 0) + 1
        bounds.add_metric([track.uav], track.bound_m)
        if track.error_p95_m is not None:
            likely.add_metric([track.uav], track.error_p95_m)
        if track.latency_s is not None:
            latency.add_metric([track.uav], track.latency_s)
    for state, count in by_state.items():
        states.add_metric([str(state)], count)
    yield from (states, bounds, likely, latency)


def _verdicts(verdicts: Iterable[Verdict]) -> Iterator[Metric]:
    levels = GaugeMetricFamily(
        "companion_verdict",
        "1 for the verdict on the link to each UAV, 0 for the others",
        labels=["uav", "verdict"],
    )
    gains = {
        name: GaugeMetricFamily(
            f"companion_{name}_gain_decibels", _help(Verdict, f"{name}_gain_db"), labels=["uav"]
        )
        for name in GAINS
    }
    for found in verdicts:
        for level in Level:
            levels.add_metric([found.uav, str(level)], float(found.level is level))
        for name in GAINS:
            gain_db = getattr(found, f"{name}_gain_db")
            if gain_db is not None:
                gains[name].add_metric([found.uav], gain_db)
    yield from (levels, *gains.values())
