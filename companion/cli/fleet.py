"""The command ``companion fleet``, and replays of a fleet's recordings."""

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import click

from companion.cli.console import JSON_LINES, Progress, of_log
from companion.values import UserError

EVERY_S: Final = 1.0
"""Time between two looks."""


@click.group()
def fleet() -> None:
    """Several nodes that share one sky.

    Example: companion fleet watch http://192.0.2.11:8080
    """


@fleet.command()
@click.argument("url", metavar="[URL]", default="http://127.0.0.1:8080")
@click.option("--seconds", type=click.FloatRange(min=0, min_open=True), help="Stop after so long.")
@JSON_LINES
def watch(url: str, seconds: float | None, as_json: bool) -> None:
    """Who is there and who serves whom, as the node at URL sees it, once a second.

    The token is that of the environment, COMPANION_TOKEN.

    Example: companion fleet watch http://192.0.2.11:8080 --seconds 60
    """
    from companion.client import Client, ServiceError

    node = Client(url, os.environ.get("COMPANION_TOKEN"))
    ends_s = None if seconds is None else time.monotonic() + seconds
    while True:
        try:
            answer = node.fleet()
        except ServiceError as error:
            raise UserError(f"{url}: {error}") from error
        if answer["node"] is None:
            raise UserError(f"{url} is part of no fleet: it has no [fleet] node")
        click.echo(json.dumps(answer) if as_json else _text(answer))
        if ends_s is not None and time.monotonic() >= ends_s:
            return
        time.sleep(EVERY_S)


def _text(answer: dict[str, Any]) -> str:
    """A line for each node, one for UAVs that need a look, and one for the traffic."""
    lines = [f"{answer['valid_at']}  fleet {answer['site']}, seen from {answer['node']}"]
    for node in answer["nodes"]:
        served = [uav["uav"] for uav in answer["uavs"] if node["node"] in uav["served_by"]]
        names = ", ".join(served[:8]) + (" ..." if len(served) > 8 else "")
        way = "" if node["way_p99_ms"] is None else f"  way p99 {node['way_p99_ms']:.0f} ms"
        lines.append(
            f"  {node['node']:12} {node['state']:7} serves {len(served):3} of at most"
            f" {_or_dash(node['most'])}: {names or '-'}{_clock(node)}{way}"
        )
        if node["reason"] is not None:
            lines.append(f"    not believed: it {node['reason']}")
    for uav in answer["uavs"]:
        if len(uav["served_by"]) != 1:
            by = " and ".join(uav["served_by"]) or "nobody"
            lines.append(f"  {uav['uav']} is served by {by}")
        if uav["unconfirmed"]:
            lines.append(
                f"  {uav['uav']} is heard by one node alone, where others ought to hear it"
            )
    kbps = answer["sent_bps"] / 1e3, answer["heard_bps"] / 1e3
    return "\n".join([*lines, f"  tells {kbps[0]:.0f} kbit/s, is told {kbps[1]:.0f} kbit/s"])


def _clock(node: dict[str, Any]) -> str:
    if node["clock_offset_s"] is None:
        return ""
    doubt_ms = node["clock_doubt_s"] * 500
    return f"  clock {node['clock_offset_s']:+.3f} s \N{PLUS-MINUS SIGN} {doubt_ms:.1f} ms"


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
    click.echo(json.dumps(found) if as_json else _replayed(found))
    other = [node["log"] for node in found["nodes"] if node["same"] is False]
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
