"""Prometheus metrics of the fleet; none for a node without a fleet."""

from collections import Counter
from collections.abc import Iterator

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from companion.views import fleet
from companion.views.served import served_uavs
from companion.views.state import Node


def fleet_metrics(node: Node) -> Iterator[Metric]:
    """Yield metrics of nodes, served UAVs, and delays between nodes."""
    status, now_ns = node.fleet_status(), node.now_ns()
    served = served_uavs(node.pipeline, status, now_ns)
    if status is None or served is None:
        return
    member = status.member
    shown = fleet.nodes(member, now_ns)
    states = Counter(one.state for one in shown)
    nodes = GaugeMetricFamily(
        "companion_fleet_nodes", "Nodes of the fleet by state; this one is `here`", labels=["state"]
    )
    for state in fleet.NodeState:
        nodes.add_metric([str(state)], states[state])
    yield nodes
    yield GaugeMetricFamily(
        "companion_fleet_serves", "UAVs that this node serves", value=len(member.duties.serves)
    )
    yield GaugeMetricFamily(
        "companion_fleet_most", "Largest number of UAVs that this node serves", value=member.most
    )
    yield GaugeMetricFamily(
        "companion_fleet_elsewhere", "UAVs that only other nodes serve", value=served.elsewhere
    )
    yield GaugeMetricFamily(
        "companion_fleet_unserved", "UAVs that no node serves", value=len(served.unserved)
    )
    yield CounterMetricFamily(
        "companion_fleet_handovers", "UAVs that this node took or gave up", value=member.handed_over
    )
    yield CounterMetricFamily(
        "companion_fleet_damaged", "Malformed fleet messages received", value=status.damaged
    )
    yield CounterMetricFamily(
        "companion_fleet_untold",
        "Frames and round trips not shared: queue full, or too many vehicles received",
        value=member.sharing.dropped,
    )
    ways = GaugeMetricFamily(
        "companion_fleet_way_p99_seconds",
        "99th percentile of the delay of frames from another node",
        labels=["node"],
    )
    doubts = GaugeMetricFamily(
        "companion_fleet_clock_doubt_seconds",
        "Width of the possible interval of another node's clock offset",
        labels=["node"],
    )
    for one in shown:
        if one.way_p99_ms is not None:
            ways.add_metric([one.node], one.way_p99_ms * 1e-3)
        if one.clock_doubt_s is not None:
            doubts.add_metric([one.node], one.clock_doubt_s)
    yield from (ways, doubts)
