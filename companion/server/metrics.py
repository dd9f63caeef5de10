"""Prometheus metrics, read off the node when they are asked for."""

from collections.abc import Iterator

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from companion.server.views import Node


class NodeCollector(Collector):
    """Counters and gauges of a node."""

    def __init__(self, node: Node) -> None:
        self._node = node

    def collect(self) -> Iterator[Metric]:
        """All metrics at this moment."""
        pipeline, now_ns = self._node.pipeline, self._node.now_ns()
        yield CounterMetricFamily(
            "companion_frames", "MAVLink frames whose checksum held", value=pipeline.frames
        )
        yield CounterMetricFamily("companion_updates", "Beam updates", value=pipeline.updates)
        rejected = CounterMetricFamily(
            "companion_rejected", "What was received and not used, by reason", labels=["reason"]
        )
        for reason, count in pipeline.refusals.total.items():
            rejected.add_metric([str(reason)], count)
        yield rejected
        states = GaugeMetricFamily("companion_uavs", "UAVs by state", labels=["state"])
        bounds = GaugeMetricFamily("companion_bound_metres", "Position bound", labels=["uav"])
        latency = GaugeMetricFamily("companion_latency_seconds", "Latency seen", labels=["uav"])
        by_state: dict[str, int] = {}
        for track in pipeline.tracks(now_ns, now_ns):
            by_state[track.state] = by_state.get(track.state, 0) + 1
            bounds.add_metric([track.uav], track.bound_m)
            if track.latency_s is not None:
                latency.add_metric([track.uav], track.latency_s)
        for state, count in by_state.items():
            states.add_metric([state], count)
        yield states
        yield bounds
        yield latency
        update = pipeline.last_update
        if update is not None and update.beams.condition_number is not None:
            yield GaugeMetricFamily(
                "companion_condition_number",
                "Condition number of the steering matrix",
                value=update.beams.condition_number,
            )
        recording = self._node.recording()
        yield CounterMetricFamily(
            "companion_recording_dropped",
            "Events that the recorder could not take",
            value=recording.dropped,
        )
