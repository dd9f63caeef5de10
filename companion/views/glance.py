"""Short status of the running service, for a terminal's status line and for JSON lines."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from companion.pipeline.fold import Pipeline
from companion.values import Level, Notice, Verdict, kind_of
from companion.values.described import Meaning
from companion.views import health
from companion.views.as_json import Json, as_json, rfc3339
from companion.views.state import Node, overload, summary

NAMED: Final = 2  # largest number of UAVs in the status line


def glance(node: Node) -> Json:
    """Return the short status: links, UAVs with their verdicts, recording and headline."""
    pipeline, now_ns = node.pipeline, node.now_ns()
    machine, update = overload(node, now_ns), pipeline.last_update
    verdicts = health.shown_verdicts(pipeline.health, machine)
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
            | _verdict(pipeline, verdicts.get(track.uav))
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
    now_ns = node.now_ns()
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
        verdicts = list(node.pipeline.health.verdicts.values())
        parts += [_worst(verdict) for verdict in _worst_first(verdicts)[:NAMED]]
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


def _verdict(pipeline: Pipeline, found: Verdict | None) -> Json:
    level, why = health.verdict(found, None)
    shown = None if why is None else as_json(why, pipeline.utc_ns)
    return {"verdict": None if level is None else str(level), "health": shown}


def _worst_first(verdicts: list[Verdict]) -> list[Verdict]:
    def place(verdict: Verdict) -> tuple[int, float]:
        spare_db = verdict.spare_gain_db
        return verdict.level.rank, -math.inf if spare_db is None else spare_db

    return sorted((one for one in verdicts if one.level is not Level.GOOD), key=place)


def _worst(verdict: Verdict) -> str:
    why = "" if verdict.blame is None else f": {verdict.blame.reason}"
    return f"{verdict.uav} {verdict.level}{why}"
