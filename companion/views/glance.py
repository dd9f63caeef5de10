"""The running service in a few words: for a terminal's last line, and for a program that reads
lines."""

from collections.abc import Sequence
from typing import Any, Final

from companion.pipeline.fold import Pipeline
from companion.values import Level, Notice, Verdict, kind_of
from companion.views import health, link_state
from companion.views.state import Node, summary
from companion.views.words import rfc3339

Json = dict[str, Any]

NAMED: Final = 2
"""Most UAVs that the line names."""


def glance(node: Node) -> Json:
    """What matters of the state: links, UAVs with their verdicts, recording, the headline."""
    pipeline, now_ns = node.pipeline, node.now_ns()
    verdicts, update = pipeline.health.verdicts, pipeline.last_update
    machine = health.behind(node.arrival_lag.seen(now_ns))
    recording = node.recording()
    return {
        "at": rfc3339(pipeline.utc_ns(now_ns)),
        **summary(node, now_ns),
        "unfit": node.unfit(),
        "links": [
            {"url": link.url, "state": link.state, "frames": link.frames} for link in node.links()
        ],
        "uavs": [
            {"id": track.uav, "state": str(track.state), "age_s": track.age_s}
            | {"bound_m": track.bound_m}
            | health.verdict(verdicts.get(track.uav), machine, pipeline.utc_ns)
            for track in (update.tracks if update else ())
            if kind_of(track.uav).reports_itself
        ],
        **node.rates(),
        "recording": {
            "state": recording.state, "file": recording.file, "bytes": recording.bytes,
        },
    }  # fmt: skip


def line(node: Node) -> str:
    """The same in a line: who is heard, how good the links are, and the worst of them."""
    now_ns, verdicts = node.now_ns(), node.pipeline.health.verdicts
    up = sum(link.state == "up" for link in node.links())
    frames_hz = node.rates().get("frames_hz")
    parts = [f"{up} of {len(node.links())} links up"]
    if frames_hz is not None:
        parts[0] += f", {frames_hz:.0f} frames/s"
    machine = health.behind(node.arrival_lag.seen(now_ns))
    parts.append(summary(node, now_ns)["headline"])
    if machine is not None:
        parts.append(machine.reason)
    elif node.unfit():
        parts.append(node.unfit()[0])
    else:
        parts += [_worst(verdict) for verdict in _worst_first(list(verdicts.values()))[:NAMED]]
    recording = node.recording()
    if recording.state != "off":
        parts.append(f"{recording.state} {recording.bytes / 1e6:.1f} MB")
    return " · ".join(parts)


def events(pipeline: Pipeline, notices: Sequence[Notice]) -> list[Json]:
    """Notices as ``/v1/events`` has them."""
    return [link_state.event(notice, pipeline.utc_ns(notice.t_ns)) for notice in notices]


def _worst_first(verdicts: list[Verdict]) -> list[Verdict]:
    """Those that are not good."""
    ranks = {Level.NONE: 0, Level.WEAK: 1}
    poor = [verdict for verdict in verdicts if verdict.level in ranks]
    return sorted(poor, key=lambda verdict: ranks[verdict.level])


def _worst(verdict: Verdict) -> str:
    why = "" if verdict.blame is None else f": {verdict.blame.reason}"
    return f"{verdict.uav} {verdict.level}{why}"
