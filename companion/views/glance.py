"""Short status of the running service, for a terminal's status line and for JSON lines."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from companion.pipeline.fold import Pipeline
from companion.values import Blame, Level, Notice, Verdict, kind_of
from companion.values.described import Meaning
from companion.views import health
from companion.views.as_json import Json, as_json, rfc3339
from companion.views.state import Node, overload, summary

NAMED: Final = 2  # largest number of UAVs in the status line


def glance(node: Node) -> Json:
    """Return the short status: links, UAVs with their verdicts, recording and headline."""
    pipeline, now_ns = node.pipeline, node.now_ns()
    verdicts, update = pipeline.health.verdicts, pipeline.last_update
    machine = overload(node, now_ns)
    recording = node.recording()
    return {
        "at": rfc3339(pipeline.utc_ns(now_ns)),
        **as_json(summary(node, now_ns), pipeline.utc_ns),
        "unfit": node.unfit(),
        "links": [
            {"url": link.url, "state": link.state, "frames": link.frames} for link in node.links()
        ],
        "uavs": [
            {"id": track.uav, "state": str(track.state), "age_s": track.age_s}
            | {"bound_m": track.bound_m}
            | _verdict(pipeline, verdicts.get(track.uav), machine)
            for track in (update.tracks if update else ())
            if kind_of(track.uav).reports_itself
        ],
        **node.rates(),
        "recording": {
            "state": recording.state, "file": recording.file, "bytes": recording.bytes,
        },
    }  # fmt: skip


def line(node: Node) -> str:
    """Return the short status as one line, with the worst links."""
    now_ns, verdicts = node.now_ns(), node.pipeline.health.verdicts
    up = sum(link.state == "up" for link in node.links())
    frames_hz = node.rates().get("frames_hz")
    parts = [f"{up} of {len(node.links())} links up"]
    if frames_hz is not None:
        parts[0] += f", {frames_hz:.0f} frames/s"
    machine = overload(node, now_ns)
    parts.append(summary(node, now_ns).headline)
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


@dataclass(frozen=True, slots=True)
class Events:
    """Newest notices, oldest first."""

    valid_at_ns: Annotated[int, Meaning("the instant for which the values hold")]
    events: Annotated[list[Notice], Meaning("the notices, oldest first")]


def events(node: Node) -> Json:
    """Return the answer of ``/v1/events``."""
    return as_json(Events(node.now_ns(), node.events()), node.pipeline.utc_ns)


def as_events(node: Node, notices: Sequence[Notice]) -> list[Json]:
    """Return notices in the form of ``/v1/events``."""
    return [as_json(notice, node.pipeline.utc_ns) for notice in notices]


def _verdict(pipeline: Pipeline, found: Verdict | None, machine: Blame | None) -> Json:
    level, why = health.verdict(found, machine)
    shown = None if why is None else as_json(why, pipeline.utc_ns)
    return {"verdict": None if level is None else str(level), "health": shown}


def _worst_first(verdicts: list[Verdict]) -> list[Verdict]:
    ranks = {Level.NONE: 0, Level.WEAK: 1}
    poor = [verdict for verdict in verdicts if verdict.level in ranks]
    return sorted(poor, key=lambda verdict: (ranks[verdict.level], _spare_db(verdict)))


def _spare_db(verdict: Verdict) -> float:
    """Return the guaranteed gain less the needed one; -inf without one."""
    if verdict.guaranteed_gain_db is None or verdict.needed_gain_db is None:
        return -math.inf
    return verdict.guaranteed_gain_db - verdict.needed_gain_db


def _worst(verdict: Verdict) -> str:
    why = "" if verdict.blame is None else f": {verdict.blame.reason}"
    return f"{verdict.uav} {verdict.level}{why}"
