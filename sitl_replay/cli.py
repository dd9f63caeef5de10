"""The command ``sitl-replay`` and its subcommands.

Over 300 lines: a list of the commands and their options.
"""

import asyncio
import contextlib
import itertools
import json
import math
import sys
from collections.abc import Callable, Coroutine, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from companion import __version__
from companion.cli.console import OneLineErrors, bearer_token, print_last, print_truncated
from companion.mavlink.links.regular_file import open_regular
from companion.mavlink.links.urls import MAVLINK, LinkUrl, parse_link
from companion.node.signals import ENDS, interrupts_held, release_interrupts
from companion.values import Event, Frame, Reason, Rejection, UserError, shown
from sitl_replay.faults.asked import KINDS, Fault, described, in_order
from sitl_replay.faults.traffic import HELD_MAX, OVERFLOW
from sitl_replay.flight import scenario
from sitl_replay.receiver.asked import OPTIONS, receiver_help, receiver_model
from sitl_replay.receiver.model import ReceiverModel
from sitl_replay.traffic import player, recorder
from sitl_replay.traffic.observations import ReceiverPlan, check_url

PROGRESS_EVERY_S = 0.5
TOKEN_MAX = 4096  # bytes of a token's file that are read


def as_links(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> tuple[LinkUrl, ...]:
    """Parse the URLs of links to send to. Usage error if a URL is invalid."""
    return tuple(_url(value) for value in values)


def as_source(_: click.Context, __: click.Parameter, value: str) -> LinkUrl:
    """Parse the URL of a link to receive from. Usage error if the URL is invalid."""
    return _url(value)


def as_faults(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> list[Fault]:
    """Parse the values of ``--fault``. Usage error if one is invalid."""
    try:
        return in_order([Fault.parse(value) for value in values])
    except UserError as error:
        raise click.BadParameter(str(error)) from error


def as_duration(_: click.Context, __: click.Parameter, value: str | None) -> float | None:
    """Parse a duration in seconds; None if no duration is given."""
    return None if value is None else _positive(value, "a positive number of seconds")


def as_speed(_: click.Context, __: click.Parameter, value: str) -> float | None:
    """Parse a speed factor; None for "max", which sends without waiting."""
    return None if value == "max" else _positive(value, "a positive number or 'max'")


def as_receiver(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> ReceiverModel:
    """Parse the values of ``--receive``. Usage error if one is invalid."""
    try:
        return receiver_model(values)
    except UserError as error:
        raise click.BadParameter(str(error)) from error


def as_service(_: click.Context, __: click.Parameter, value: str | None) -> str | None:
    """Check the address of a service that takes measurements. Usage error if it is invalid."""
    try:
        if value is not None:
            check_url(value)
    except UserError as error:
        raise click.BadParameter(str(error)) from error
    return value


def _url(text: str) -> LinkUrl:
    try:
        return parse_link(text, MAVLINK)
    except UserError as error:
        raise click.BadParameter(str(error)) from error


def _positive(text: str, what: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf:
        raise click.BadParameter(f"{shown(text)} is not {what}")
    return number


def sending_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add ``--to``, ``--fault`` and ``--json`` to a command that sends."""
    command = fault_option(json_option(command))
    return click.option(
        "--to",
        "links",
        metavar="URL",
        multiple=True,
        required=True,
        callback=as_links,
        help="Destination: udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD, tcpin:HOST:PORT"
        " (sends to every client that connects), udpin:HOST:PORT (sends to every peer that has"
        " sent a datagram) or zenoh:KEY?as=hub. Sending starts when each of the last three has a"
        " peer. Can be repeated.",
    )(command)


json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the summary as one JSON object."
)
fault_option = click.option(
    "--fault",
    "faults",
    metavar="NAME[@SYSID[:COMPID]]=VALUE[/FROM-TO]",
    multiple=True,
    callback=as_faults,
    help="Inject a fault (see below), for all systems or for one system or component, always"
    " or for frames sent from FROM to TO s. Can be repeated.",
)
duration_option = click.option(
    "--duration",
    "duration_s",
    metavar="SECONDS",
    callback=as_duration,
    help="Stop after this many seconds.",
)
FAULTS = f"""Faults, in the order in which they are applied (the order of the options has no
effect). The first six belong to the sender and are the same on every link: frames are rewritten
with a valid checksum, and signatures are removed. The others are drawn for each link separately.
The same --seed and input give the same bytes at the same times. Times are seconds since the start
(of the log: at --speed 2 they pass twice as fast). Each fault can be limited to a time:
loss@3=1/20-50 is a loss of all frames that system 3 sends from 20 to 50 s. Afterwards its effect
ends: a clock or a position that it changed goes back.

{described()}

At most {HELD_MAX} frames are delayed at a time; further ones are lost and counted as {OVERFLOW}."""


RECEIVER = f"""With --receiver, a receiver behind the carrier's array measures the direction of each
UAV. Its measurements (observations) are sent to a running service, which must have
[observations] enabled = true and, for UDP, the address as [observations] udp. Options:

{receiver_help()}

An error of the carrier's compass and a UAV with a false position are faults: compass and spoof."""


@click.group(name="sitl-replay", cls=OneLineErrors)
@click.version_option(__version__, prog_name="sitl-replay")
def main() -> None:
    """Send MAVLink test traffic: synthetic vehicles, or logs.

    Example: sitl-replay fly paper --to udpout:127.0.0.1:14550
    """


@main.command(epilog=f"{FAULTS}\n\n{RECEIVER}")
@click.argument("name", metavar="SCENARIO", type=click.Choice(list(scenario.BUILDERS)))
@sending_options
@click.option(
    "--uavs",
    type=click.IntRange(1, scenario.MAX_UAVS),
    default=4,
    show_default=True,
    help="Number of UAVs around the carrier.",
)
@duration_option
@click.option(
    "--seed",
    type=int,
    default=0,
    show_default=True,
    help="Seed of all random numbers, including faults.",
)
@click.option(
    "--record",
    type=click.Path(dir_okay=False, writable=True, path_type=Path),
    help="Also write the frames to this tlog (overwritten if it exists).",
)
@click.option(
    "--receiver",
    metavar="URL",
    callback=as_service,
    help="Service that takes the measurements of the carrier's array: http://HOST:PORT or"
    " udp:HOST:PORT.",
)
@click.option(
    "--receive",
    "model",
    metavar="NAME=VALUE",
    multiple=True,
    callback=as_receiver,
    help="Property or error of that receiver (see below). Can be repeated.",
)
@click.option(
    "--token",
    metavar="FILE",
    type=click.Path(exists=True, dir_okay=False, readable=True, path_type=Path),
    help="File with the bearer token for HTTP; without it, COMPANION_TOKEN in the environment.",
)
def fly(
    *,
    name: str,
    links: tuple[LinkUrl, ...],
    uavs: int,
    duration_s: float | None,
    seed: int,
    record: Path | None,
    receiver: str | None,
    model: ReceiverModel,
    token: Path | None,
    faults: list[Fault],
    as_json: bool,
) -> None:
    """Send a scenario (see `sitl-replay list`): synthetic vehicles as MAVLink 2.

    Ends after --duration, or on SIGINT or SIGTERM.

    Example: sitl-replay fly paper --to udpout:127.0.0.1:14550 --duration 60 --record paper.tlog

    Example: sitl-replay fly racetrack --to udpout:127.0.0.1:14550 --receiver
    http://127.0.0.1:8080 --receive bound=2 --receive outliers=0.05 --fault compass@5:1=8
    """
    tally = player.Tally()
    plan = None if receiver is None else _plan(receiver, model, token)
    urls = [str(url) for url in links]
    try:
        flight = scenario.BUILDERS[name](uavs, seed)
    except UserError as error:
        raise click.BadParameter(f"{name}: {error}", param_hint="'--uavs'") from error
    flying = player.fly(
        flight, urls, duration_s, seed, record, faults=faults, receiver=plan, tally=tally
    )
    run(flying, tally)
    conclude(tally, "sent", as_json)


def _text(path: Path) -> str:
    with open_regular(path) as file:
        return file.read(TOKEN_MAX).decode().strip()


def _plan(url: str, model: ReceiverModel, token: Path | None) -> ReceiverPlan:
    try:
        given = None if token is None else _text(token)
    except OSError as error:
        raise click.BadParameter(f"{token}: {error.strerror}", param_hint="'--token'") from error
    except UnicodeDecodeError as error:
        raise click.BadParameter(f"{token}: not UTF-8 text", param_hint="'--token'") from error
    found = bearer_token() if given is None else given
    return ReceiverPlan(url=url, token=found, model=model)


@main.command(epilog=FAULTS)
@click.argument(
    "logs",
    metavar="LOG...",
    nargs=-1,
    required=True,
    type=click.Path(exists=True, dir_okay=False, readable=True, path_type=Path),
)
@sending_options
@click.option(
    "--speed",
    metavar="X|max",
    callback=as_speed,
    default="1",
    show_default=True,
    help="Speed factor; max: no waiting (over UDP a slow receiver loses frames).",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the faults.")
def play(
    *,
    logs: tuple[Path, ...],
    links: tuple[LinkUrl, ...],
    speed: float | None,
    seed: int,
    faults: list[Fault],
    as_json: bool,
) -> None:
    """Play logs as live traffic: .tlog, raw MAVLink, .mcap, .bin, .ulg or CSV.

    Several logs are merged by time. The pace follows the time stamps; a step back is played as
    0 s, a jump of more than 5 s as 5 s, and the number of such steps is printed at the end.

    Example: sitl-replay play flight.tlog --to udpout:127.0.0.1:14550 --speed 2

    Example: sitl-replay play flight.tlog --to tcpin:127.0.0.1:5760 --fault loss=0.1
    --fault jitter=0.2 --fault frozen@3:1=20:5 --seed 7
    """
    tally = player.Tally()
    urls = [str(url) for url in links]
    frames = frames_of(logs, tally)
    print_truncated(logs)
    run(player.play(frames, urls, speed, faults=faults, seed=seed, tally=tally), tally)
    if tally.clamped:
        click.echo(
            f"{', '.join(map(str, logs))}: {tally.clamped} time stamps step back, or jump by more"
            " than 5 s; these steps were played as 0 or 5 s",
            err=True,
        )
    conclude(tally, "sent", as_json)


@main.command()
@click.option(
    "--from",
    "url",
    metavar="URL",
    callback=as_source,
    required=True,
    help="Link to receive from: udpin:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT,"
    " serial:DEVICE:BAUD, zenoh:KEY or udpout:HOST:PORT. Nothing is sent, except over udpout: an"
    " empty datagram each second until the first reply, to make this end known to the peer.",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, writable=True, path_type=Path),
    required=True,
    help="The tlog to write (overwritten if it exists).",
)
@duration_option
@json_option
def record(url: LinkUrl, out: Path, duration_s: float | None, as_json: bool) -> None:
    """Record MAVLink traffic to a tlog, until --duration, SIGINT or SIGTERM.

    Time stamps are Unix time and never step back. Frames with a wrong checksum or an unknown
    message id are counted, but not written.

    Example: sitl-replay record --from udpin:0.0.0.0:14550 --out flight.tlog
    """
    heard = recorder.RecordingTally()
    run(recorder.record(url, out, duration_s, heard=heard), heard)
    conclude(heard, "recorded", as_json)


@main.command("list")
@json_option
def list_scenarios(as_json: bool) -> None:
    """List the scenarios of `sitl-replay fly`, and the names of its faults and receiver options.

    Example: sitl-replay list
    """
    built = [build() for build in scenario.BUILDERS.values()]
    if as_json:
        click.echo(
            json.dumps([{"name": one.name, "description": one.description} for one in built])
        )
        return
    for one in built:
        click.echo(f"{one.name:9} {one.description}")
    click.echo(
        "\nWith --receiver URL the carrier's array measures the directions of the UAVs, with the"
        f" errors of --receive: {', '.join(OPTIONS)}.\nFaults of senders and links (--fault):"
        f" {', '.join(KINDS)}.\n`sitl-replay fly --help` describes them."
    )


def frames_of(logs: Sequence[Path], tally: player.Tally) -> Iterator[Frame]:
    """Return the frames of logs, merged by time; unusable data is counted.

    The logs are read up to the first frame, so that an unreadable log is reported at once.
    """
    from companion.recording.reader import LogError, read_flight

    try:
        frames = _frames_among(read_flight(logs), tally)
        first = next(frames, None)
    except (LogError, OSError) as error:
        raise click.ClickException(str(error)) from error
    if first is None:
        raise click.ClickException(f"{' '.join(map(str, logs))}: no MAVLink frame in it")
    return itertools.chain((first,), frames)


def _frames_among(events: Iterable[Event], tally: player.Tally) -> Iterator[Frame]:
    for event in events:
        if isinstance(event, Frame):
            yield event
        elif isinstance(event, Rejection):
            if event.reason is Reason.BAD_STAMP:
                tally.clamped += event.count
            else:
                tally.rejected[event.reason.value] += event.count


def run(work: Coroutine[Any, Any, object], count: player.Tally | recorder.RecordingTally) -> None:
    """Run a command until its end, SIGINT or SIGTERM. An error prints a line and exits non-zero."""
    with interrupts_held():  # until the loop has handlers
        asyncio.run(_until_signal(work, count))


async def _until_signal(
    work: Coroutine[Any, Any, object], count: player.Tally | recorder.RecordingTally
) -> None:
    loop = asyncio.get_running_loop()
    task = asyncio.ensure_future(work)
    for known in ENDS:
        loop.add_signal_handler(known, task.cancel)
    release_interrupts()
    progress = asyncio.ensure_future(_progress(count)) if sys.stderr.isatty() else None
    try:
        # Only the handlers above cancel the task: a requested end.
        with contextlib.suppress(asyncio.CancelledError):
            await task
    finally:
        if progress is not None:
            progress.cancel()
            click.echo("\r\033[K", nl=False, err=True)


async def _progress(count: player.Tally | recorder.RecordingTally) -> None:
    while True:
        await asyncio.sleep(PROGRESS_EVERY_S)
        click.echo(f"\r{count.frames} frames, {count.octets} bytes", nl=False, err=True)


def conclude(count: player.Tally | recorder.RecordingTally, done: str, as_json: bool) -> None:
    """Print the summary. Exit with status 1 if a link was lost during the run."""
    if as_json:
        print_last(json.dumps(summary_of(count)))
    else:
        unusable = [f", {number} {why}" for why, number in count.rejected.items()]
        if isinstance(count, player.Tally) and count.dropped:
            unusable.append(f", {count.dropped} dropped")
        if isinstance(count, player.Tally):
            unusable += [f", {name}: {number}" for name, number in count.faults.items()]
            unusable += [f", observations {name}: {n}" for name, n in count.observed.items()]
        sizes = f"{count.frames} frames, {count.octets} bytes in {count.duration_s:.1f} s"
        print_last(f"{done} {sizes}{''.join(unusable)}")
    if isinstance(count, player.Tally) and count.lost:
        sys.exit(1)


def summary_of(count: player.Tally | recorder.RecordingTally) -> dict[str, Any]:
    """Return the object that ``--json`` prints."""
    common = {
        "frames": count.frames,
        "bytes": count.octets,
        "duration_s": round(count.duration_s, 3),
        "by_message": {player.message_name(kind): n for kind, n in count.messages.most_common()},
    }
    common["rejected"] = dict(count.rejected)
    if isinstance(count, recorder.RecordingTally):
        return common
    return common | {
        "dropped": count.dropped,
        "clamped": count.clamped,
        "faults": dict(count.faults),
        "observations": dict(count.observed),
        "lost": count.lost,
    }
