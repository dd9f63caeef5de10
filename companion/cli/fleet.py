"""The command ``companion fleet``, and replays of a fleet's recordings."""

import json
import math
import os
import time
from collections.abc import Sequence
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from companion.cli.console import JSON_LINES, SECONDS, Progress, of_log, say
from companion.values import UserError

if TYPE_CHECKING:
    from companion.client import ServiceError

EVERY_S: Final = 1.0  # time between two looks


@click.group()
def fleet() -> None:
    """Several nodes that share one sky.

    Example: companion fleet watch http://192.0.2.11:8080
    """


@fleet.command()
@click.argument("url", metavar="[URL]", default="http://127.0.0.1:8080")
@SECONDS
@JSON_LINES
def watch(url: str, seconds: float | None, as_json: bool) -> None:
    """Who is there and who serves whom, as the node at URL sees it, once a second.

    Only the first look must succeed: a node that is restarted is waited for. The token is that of
    the environment, COMPANION_TOKEN.

    Example: companion fleet watch http://192.0.2.11:8080 --seconds 60
    """
    from companion.client import Client, ServiceError

    node = Client(url, os.environ.get("COMPANION_TOKEN"))
    ends_s = None if seconds is None else time.monotonic() + seconds
    answer = None
    while True:
        try:
            answer = _asked(node.fleet(), url)
            say(json.dumps(answer) if as_json else _text(answer))
        except ServiceError as error:
            if answer is None:
                raise UserError(_refused(url, error)) from error
            say(f"no answer: {_refused(url, error)}", err=True)
        left_s = math.inf if ends_s is None else ends_s - time.monotonic()
        if left_s <= 0:
            return
        time.sleep(min(EVERY_S, left_s))


def _asked(answer: dict[str, Any], url: str) -> dict[str, Any]:
    """The answer, if it is that of a fleet's node."""
    if "node" not in answer:
        raise UserError(f"{url} is no companion: its /v1/fleet has no node")
    if answer["node"] is None:
        raise UserError(f"{url} is part of no fleet: it has no [fleet] node")
    return answer


def _refused(url: str, error: "ServiceError") -> str:
    if error.status is None:
        return error.title  # which names the URL
    hint = " (COMPANION_TOKEN)" if error.status == HTTPStatus.UNAUTHORIZED else ""
    return f"{url}: {error}{hint}"


def _text(answer: dict[str, Any]) -> str:
    """A line for each node, those for UAVs that need a look, and one for the traffic."""
    lines = [f"{answer['valid_at']}  fleet {answer['site']}, seen from {answer['node']}"]
    width = max(len(node["node"]) for node in answer["nodes"])
    for node in answer["nodes"]:
        if node["state"] == "gone":
            lines.append(f"  {node['node']:{width}} gone, {node['heard_s']:.0f} s ago")
            continue
        served = [uav["uav"] for uav in answer["uavs"] if node["node"] in uav["served_by"]]
        names = ", ".join(served[:8]) + (" ..." if len(served) > 8 else "")
        way = "" if node["way_p99_ms"] is None else f"  way p99 {node['way_p99_ms']:.0f} ms"
        lines.append(
            f"  {node['node']:{width}} {node['state']:7} serves {len(served):3} of at most"
            f" {_or_dash(node['most'])}: {names or '-'}{_clock(node)}{way}"
        )
        if node["reason"] is not None:
            lines.append(f"    not believed: it {node['reason']}")
    for uav in answer["uavs"]:
        lines += [f"  {uav['uav']} {said}" for said in _about(uav)]
    kbps = answer["sent_bps"] / 1e3, answer["heard_bps"] / 1e3
    damaged = f", {answer['damaged']} damaged" if answer["damaged"] else ""
    return "\n".join(
        [*lines, f"  tells {kbps[0]:.0f} kbit/s, is told {kbps[1]:.0f} kbit/s{damaged}"]
    )


def _about(uav: dict[str, Any]) -> list[str]:
    """What is to be looked at of a UAV; nothing where one node serves it and keeps it."""
    by, to = uav["served_by"], uav["handing_to"]
    said = []
    if len(by) != 1:
        said.append(f"is served by {' and '.join(by) or 'nobody'}")
    if to is not None and to not in by:
        said.append(f"is to be taken over by {to}")
    if uav["unconfirmed"]:
        said.append("is heard by one node alone, where others ought to hear it")
    return said


def _clock(node: dict[str, Any]) -> str:
    """The middle of what is possible, and how far it may be off to either side."""
    if node["clock_offset_s"] is None:
        return ""
    offset_s, half_s = node["clock_offset_s"], node["clock_doubt_s"] / 2
    unit, each = ("s", 1.0) if abs(offset_s) >= 1.0 else ("ms", 1e3)
    digits = 3 if unit == "s" else 1
    offset = f"{offset_s * each:+.{digits}f} \N{PLUS-MINUS SIGN} {half_s * each:.{digits}f}"
    return f"  clock {offset} {unit}"


def _or_dash(value: int | None) -> str:
    return "-" if value is None else str(value)


def replay(logs: Sequence[Path], as_json: bool) -> None:
    """Replay the recordings of a fleet's nodes, and say how that went.

    Raises ``UserError`` where one does not come to its digest.
    """
    from companion.node.fleet import replaying

    progress = Progress()
    found = replaying.replay(logs, of_log(progress, None))
    progress.clear()
    say(json.dumps(found) if as_json else _replayed(found))
    other = [node["logs"][0] for node in found["nodes"] if node["same"] is False]
    if other:
        raise UserError(f"{other[0]}: the replay does not come to the digest of the run")


def _replayed(found: dict[str, Any]) -> str:
    said = {True: "as recorded", False: "not as recorded", None: "none was recorded: cut short"}
    lines = [
        f"{node['node']:12} {node['frames']:8} frames, {node['told_by_others']} by others;"
        f" digest {node['digest'][:16]}: {said[node['same']]}"
        for node in found["nodes"]
    ]
    served = found["served"]
    if served["once"] is not None:
        shares = ", ".join(f"{name} {100 * share:.2f} %" for name, share in served.items())
        lines.append(
            f"{found['uavs']} UAVs over {found['seconds']:.0f} s that all recorded:"
            f" served {shares}; {found['handovers']} handovers"
        )
    return "\n".join(lines)
