"""The command ``companion fleet``, and the replay of a fleet's recordings."""

import json
import math
import time
from collections.abc import Sequence
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from companion.cli.console import (
    JSON_LINES,
    SECONDS,
    Progress,
    bearer_token,
    log_progress,
    print_truncated,
    say,
)
from companion.values import UserError

if TYPE_CHECKING:
    from companion.client import ServiceError

EVERY_S: Final = 1.0  # time between two requests
NAME_MAX: Final = 64  # largest width of the column of names


@click.group()
def fleet() -> None:
    """Commands for a fleet of nodes that serve the same UAVs.

    Example: companion fleet watch http://192.0.2.11:8080
    """


@fleet.command()
@click.argument("url", metavar="[URL]", default="http://127.0.0.1:8080")
@SECONDS
@JSON_LINES
def watch(url: str, seconds: float | None, as_json: bool) -> None:
    """Print the nodes and the UAVs that each serves, as seen by the node at URL, once a second.

    Only the first request must succeed; later ones are retried, as while a node restarts.
    COMPANION_TOKEN in the environment is the bearer token.

    Example: companion fleet watch http://192.0.2.11:8080 --seconds 60
    """
    from companion.client import Client, ServiceError

    node = Client(url, bearer_token())
    ends_s = None if seconds is None else time.monotonic() + seconds
    answer = None
    while True:
        try:
            answer = _fleet_answer(node.fleet(), url)
            say(json.dumps(answer) if as_json else _text(answer, url))
        except ServiceError as error:
            if answer is None:
                raise UserError(_error_text(url, error)) from error
            say(f"no answer: {_error_text(url, error)}", err=True)
        left_s = math.inf if ends_s is None else ends_s - time.monotonic()
        if left_s <= 0:
            return
        time.sleep(min(EVERY_S, left_s))


def _fleet_answer(answer: dict[str, Any], url: str) -> dict[str, Any]:
    """Return the answer if it comes from a node of a fleet; raise ``UserError`` otherwise."""
    if "node" not in answer:
        raise UserError(f"{url}: not a companion: no node in /v1/fleet; check the address")
    if answer["node"] is None:
        raise UserError(f"{url}: node is not in a fleet; set its [fleet] node")
    return answer


def _error_text(url: str, error: "ServiceError") -> str:
    if error.status is None:
        return error.title  # contains the URL
    hint = " (COMPANION_TOKEN)" if error.status == HTTPStatus.UNAUTHORIZED else ""
    return f"{url}: {error}{hint}"


def _text(answer: dict[str, Any], url: str) -> str:
    try:
        return _table(answer)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{url}: malformed answer of /v1/fleet; check the address") from error


def _table(answer: dict[str, Any]) -> str:
    lines = [f"{answer['valid_at']}  fleet {answer['site']}, seen from {answer['node']}"]
    width = min(NAME_MAX, max(len(node["node"]) for node in answer["nodes"]))
    for node in answer["nodes"]:
        if node["state"] == "gone":
            lines.append(f"  {node['node']:{width}} gone, {node['heard_s']:.0f} s ago")
            continue
        served = [uav["uav"] for uav in answer["uavs"] if node["node"] in uav["served_by"]]
        names = ", ".join(served[:8]) + (" ..." if len(served) > 8 else "")
        way = "" if node["way_p99_ms"] is None else f"  way p99 {node['way_p99_ms']:.0f} ms"
        lines.append(
            f"  {node['node']:{width}} {node['state']:7} serves {len(served):3} of at most"
            f" {_text_or_dash(node['most'])}: {names or '-'}{_clock(node)}{way}"
        )
        if node["reason"] is not None:
            lines.append(f"    not trusted: it {node['reason']}")
    for uav in answer["uavs"]:
        lines += [f"  {uav['uav']} {said}" for said in _offset_text(uav)]
    kbps = answer["sent_bps"] / 1e3, answer["heard_bps"] / 1e3
    damaged = f", {answer['damaged']} damaged" if answer["damaged"] else ""
    return "\n".join(
        [*lines, f"  sent {kbps[0]:.0f} kbit/s, received {kbps[1]:.0f} kbit/s{damaged}"]
    )


def _offset_text(uav: dict[str, Any]) -> list[str]:
    """Return what needs attention for a UAV; empty if one node serves it steadily."""
    by, to = uav["served_by"], uav["handing_to"]
    said = []
    if len(by) != 1:
        said.append(f"is served by {' and '.join(by) or 'no node'}")
    if to is not None and to not in by:
        said.append(f"is being handed over to {to}")
    if uav["unconfirmed"]:
        said.append("is received by one node only, though others should receive it")
    return said


def _clock(node: dict[str, Any]) -> str:
    """Return the midpoint of the clock offset interval, and half the interval's width."""
    if node["clock_offset_s"] is None:
        return ""
    offset_s, half_s = node["clock_offset_s"], node["clock_doubt_s"] / 2
    unit, each = ("s", 1.0) if abs(offset_s) >= 1.0 else ("ms", 1e3)
    digits = 3 if unit == "s" else 1
    offset = f"{offset_s * each:+.{digits}f} \N{PLUS-MINUS SIGN} {half_s * each:.{digits}f}"
    return f"  clock {offset} {unit}"


def _text_or_dash(value: int | None) -> str:
    return "-" if value is None else str(value)


def replay(logs: Sequence[Path], as_json: bool) -> None:
    """Replay the recordings of a fleet's nodes and print the result.

    Raises ``UserError`` if a replay does not reproduce its recorded digest.
    """
    from companion.node.fleet import replaying

    print_truncated(logs)
    progress = Progress()
    found = replaying.replay(logs, log_progress(progress, None))
    progress.clear()
    say(json.dumps(found) if as_json else _replayed(found))
    other = [node["logs"][0] for node in found["nodes"] if node["same"] is False]
    if other:
        raise UserError(f"{other[0]}: replay does not reproduce the recorded digest")


def _replayed(found: dict[str, Any]) -> str:
    said = {
        True: "as recorded",
        False: "not as recorded",
        None: "none recorded (recording incomplete)",
    }
    lines = [
        f"{node['node']:12} {node['frames']:8} frames, {node['told_by_others']} from other nodes;"
        f" digest {node['digest'][:16]}: {said[node['same']]}"
        for node in found["nodes"]
    ]
    served = found["served"]
    if served["once"] is not None:
        shares = ", ".join(f"{name} {100 * share:.2f} %" for name, share in served.items())
        lines.append(
            f"{found['uavs']} UAVs over the {found['seconds']:.0f} s that all nodes recorded:"
            f" served {shares}; {found['handovers']} handovers"
        )
    return "\n".join(lines)
