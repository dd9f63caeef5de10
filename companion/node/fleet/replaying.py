"""Replay of a fleet's recordings together: digests, and the UAVs that each node served.

Each recording contains all input of its node, including frames from other nodes, so that each is
replayed by itself. The assignment of UAVs to nodes is compared on the nodes' own clocks.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from companion.node import replay as replaying
from companion.node.replay import Progress
from companion.recording.reader import LogError, digest_of, read_settings
from companion.settings.model import sections
from companion.settings.section import ConfigError
from companion.values import Duty, Frame

SAMPLE_NS: Final = 100_000_000  # sampling interval of the assignment


@dataclass(slots=True, kw_only=True)
class NodeRun:
    """Run of one node: its parts, its digest now and as recorded, and its duties in order."""

    node: str
    logs: list[Path]
    digest: str = ""
    recorded: str | None = None
    frames: int = 0
    told: int = 0
    first_ns: int = 0
    last_ns: int = 0
    duties: list[Duty] = field(default_factory=list)

    def serves(self, t_ns: int) -> tuple[str, ...]:
        """Return the UAVs that the node serves at a time."""
        past = bisect_right(self.duties, t_ns, key=lambda duty: duty.t_ns)
        return self.duties[past - 1].serves if past else ()


def replay(logs: Sequence[Path], progress: Progress | None = None) -> dict[str, Any]:
    """Replay each node's recording; return the summary of ``companion replay --fleet --json``.

    Several recordings of a node are the parts of one run. ``progress`` is as for
    ``companion.node.replay.replay``. Raises ``LogError`` for a log that is not a node's recording,
    or if two of one node are from different runs.
    """
    by_node: dict[str, list[Path]] = {}
    for log in logs:
        by_node.setdefault(_name(log), []).append(log)
    runs = [_run(name, _one_run(name, of), progress) for name, of in by_node.items()]
    return {
        "nodes": [
            {
                "node": run.node,
                "logs": [str(log) for log in run.logs],
                "frames": run.frames,
                "told_by_others": run.told,
                "digest": run.digest,
                "recorded_digest": run.recorded,
                "same": None if run.recorded is None else run.digest == run.recorded,
                "duties": len(run.duties),
            }
            for run in runs
        ],
        **_together(runs),
    }


def _name(log: Path) -> str:
    try:
        recorded = read_settings(log)
        text = recorded.text if recorded else ""
        name = sections(text, str(log)).get("fleet", {}).get("node")
    except (AttributeError, ConfigError):  # "fleet" may be anything in a foreign recording
        name = None
    if not isinstance(name, str):
        raise LogError(f"{log}: not a recording of a fleet's node: no [fleet] node in it")
    return name


def _one_run(name: str, logs: list[Path]) -> list[Path]:
    """Return the recordings of one node in order; ``LogError`` if they are from two runs."""
    ordered = logs if len(logs) == 1 else replaying.in_order(logs)
    if ordered is None:
        raise LogError(
            f"{logs[0]}: recordings of node {name} are not parts of one run; give one run"
        )
    return ordered


def _run(name: str, logs: list[Path], progress: Progress | None) -> NodeRun:
    settings = replaying.settings_for(logs, None, None)
    found = NodeRun(node=name, logs=logs, recorded=digest_of(logs[-1]))
    run = replaying.Run(settings, None)
    for event, _ in run.steps(replaying.log_events(logs, settings), progress):
        if isinstance(event, Duty):
            found.duties.append(event)
        elif isinstance(event, Frame):
            found.told += event.link.startswith("fleet:")
    found.digest = run.pipeline.digest.hexdigest()
    found.frames = run.pipeline.frames
    found.first_ns, found.last_ns = run.tally.first_ns or 0, run.tally.last_ns
    return found


def _together(runs: Sequence[NodeRun]) -> dict[str, Any]:
    """Return the fractions of common time in which UAVs had one serving node, several, or none.

    A UAV counts from the first time at which any node serves it.
    """
    begins_ns = max(run.first_ns for run in runs)
    ends_ns = min(run.last_ns for run in runs)
    seen: set[str] = set()
    once = twice = none = handovers = 0
    before: dict[str, frozenset[str]] = {}
    for t_ns in range(begins_ns, ends_ns, SAMPLE_NS):
        by: dict[str, set[str]] = {}
        for run in runs:
            for uav in run.serves(t_ns):
                by.setdefault(uav, set()).add(run.node)
        seen |= by.keys()
        for uav in seen:
            nodes = frozenset(by.get(uav, ()))
            once, twice, none = (
                once + (len(nodes) == 1),
                twice + (len(nodes) > 1),
                none + (not nodes),
            )
            was = before.get(uav, frozenset())
            handovers += len(nodes) == 1 and bool(was) and was.isdisjoint(nodes)
            before[uav] = nodes if len(nodes) == 1 else was
    samples = once + twice + none
    share = {"once": once, "twice": twice, "none": none}
    return {
        "seconds": max(ends_ns - begins_ns, 0) * 1e-9,
        "uavs": len(seen),
        "served": {name: n / samples if samples else None for name, n in share.items()},
        "handovers": handovers,
    }
