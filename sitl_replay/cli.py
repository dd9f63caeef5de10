"""The command ``sitl-replay``: commands to calls."""

import asyncio
import contextlib
import itertools
import json
import math
import signal
import sys
from collections.abc import Callable, Coroutine, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from companion import __version__
from companion.console import OneLineErrors
from companion.values import Event, Frame, Reason, Rejection
from sitl_replay import player, recorder, scenario
from sitl_replay.links import RECEIVING, SENDING, LinkError, Url

PROGRESS_EVERY_S = 0.5


def as_links(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> tuple[Url, ...]:
    """The URLs of links to send over; a usage error says what is allowed."""
    return tuple(_url(value, SENDING) for value in values)


def as_source(_: click.Context, __: click.Parameter, value: str) -> Url:
    """The URL of a link to listen to."""
    return _url(value, RECEIVING)


def as_duration(_: click.Context, __: click.Parameter, value: str | None) -> float | None:
    """Seconds, or None."""
    return None if value is None else _positive(value, "seconds, a number above 0")


def as_speed(_: click.Context, __: click.Parameter, value: str) -> float | None:
    """A factor, or None for as fast as it goes."""
    return None if value == "max" else _positive(value, "a number above 0, or 'max'")


def _url(text: str, schemes: Sequence[str]) -> Url:
    try:
        return Url.parse(text, schemes)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error


def _positive(text: str, what: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf:
        raise click.BadParameter(f"{text!r} is not {what}")
    return number


def sending_options(command: Callable[..., None]) -> Callable[..., None]:
    """``--to`` and ``--json``, for the commands that send."""
    command = json_option(command)
    return click.option(
        "--to",
        "links",
        metavar="URL",
        multiple=True,
        required=True,
        callback=as_links,
        help="Where to send: udpout:HOST:PORT or tcp:HOST:PORT. May be given several times.",
    )(command)


json_option = click.option(
    "--json", "as_json", is_flag=True, help="The summary as one JSON object."
)
duration_option = click.option(
    "--duration",
    "duration_s",
    metavar="SECONDS",
    callback=as_duration,
    help="Stop after so many seconds.",
)


@click.group(name="sitl-replay", cls=OneLineErrors)
@click.version_option(__version__, prog_name="sitl-replay")
def main() -> None:
    """MAVLink traffic to test against: synthetic vehicles and logs, live.

    Example: sitl-replay fly paper --to udpout:127.0.0.1:14550
    """


@main.command()
@click.argument("name", metavar="SCENARIO", type=click.Choice(list(scenario.BUILDERS)))
@sending_options
@click.option(
    "--uavs",
    type=click.IntRange(1, scenario.MAX_UAVS),
    default=4,
    show_default=True,
    help="How many UAVs fly about the carrier.",
)
@duration_option
@click.option("--seed", type=int, default=0, show_default=True, help="Of what is left to chance.")
@click.option(
    "--record",
    type=click.Path(dir_okay=False, writable=True, path_type=Path),
    help="Also write the frames to this tlog (replaced if it exists).",
)
def fly(
    name: str,
    links: tuple[Url, ...],
    uavs: int,
    duration_s: float | None,
    seed: int,
    record: Path | None,
    as_json: bool,
) -> None:
    """Fly SCENARIO (see `sitl-replay list`): synthetic vehicles as MAVLink 2.

    Flies until --duration, SIGINT or SIGTERM.

    Example: sitl-replay fly paper --to udpout:127.0.0.1:14550 --duration 60 --record paper.tlog
    """
    tally = player.Tally()
    urls = [str(url) for url in links]
    try:
        flight = scenario.BUILDERS[name](uavs, seed)
    except ValueError as error:
        raise click.BadParameter(f"{name}: {error}", param_hint="'--uavs'") from error
    run(player.fly(flight, urls, duration_s, seed, record, tally=tally), tally)
    conclude(tally, "sent", as_json)


@main.command()
@click.argument("log", type=click.Path(exists=True, dir_okay=False, readable=True, path_type=Path))
@sending_options
@click.option(
    "--speed",
    metavar="X|max",
    callback=as_speed,
    default="1",
    show_default=True,
    help="Times as fast as it was; max: without waiting (over UDP a slow receiver loses frames).",
)
def play(log: Path, links: tuple[Url, ...], speed: float | None, as_json: bool) -> None:
    """Play LOG (.tlog, raw MAVLink, .mcap) as live traffic.

    Paced by the log's stamps; where they step back or leap by more than 5 s, the step is played
    as 0 or 5 s, and the end says how many were.

    Example: sitl-replay play flight.tlog --to udpout:127.0.0.1:14550 --speed 2
    """
    tally = player.Tally()
    urls = [str(url) for url in links]
    run(player.play(frames_of(log, tally), urls, speed, tally=tally), tally)
    if tally.clamped:
        click.echo(
            f"{log}: {tally.clamped} time stamps step back, or leap by more than 5 s;"
            " those steps were played as 0 or 5 s",
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
    help="What to listen to: udpin:HOST:PORT or tcp:HOST:PORT.",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, writable=True, path_type=Path),
    required=True,
    help="The tlog to write (replaced if it exists).",
)
@duration_option
@json_option
def record(url: Url, out: Path, duration_s: float | None, as_json: bool) -> None:
    """Write MAVLink traffic to a tlog, until --duration, SIGINT or SIGTERM.

    Frames whose checksum is wrong, or whose message is unknown, are counted and not written.

    Example: sitl-replay record --from udpin:0.0.0.0:14550 --out flight.tlog
    """
    heard = recorder.Heard()
    run(recorder.record(url, out, duration_s, heard=heard), heard)
    conclude(heard, "recorded", as_json)


@main.command("list")
@json_option
def list_scenarios(as_json: bool) -> None:
    """List the scenarios that `fly` knows.

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


def frames_of(log: Path, tally: player.Tally) -> Iterator[Frame]:
    """The frames of a log; what is not usable in it is counted.

    Reads as far as the first one, so that a bad log is told at once.
    """
    from companion.recording.reader import LogError, read_log

    try:
        frames = _frames_among(read_log(log), tally)
        first = next(frames, None)
    except (LogError, OSError) as error:
        raise click.ClickException(str(error)) from error
    if first is None:
        raise click.ClickException(f"{log}: no MAVLink frame in it")
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


def run(work: Coroutine[Any, Any, object], count: player.Tally | recorder.Heard) -> None:
    """Run to the end, or to SIGINT or SIGTERM; a failure is one line and a non-zero exit."""
    try:
        asyncio.run(_until_signal(work, count))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        raise click.ClickException(f"{where}{error.strerror or error}") from error
    except (LinkError, ValueError) as error:  # a LogError is a ValueError
        raise click.ClickException(str(error)) from error


async def _until_signal(
    work: Coroutine[Any, Any, object], count: player.Tally | recorder.Heard
) -> None:
    loop = asyncio.get_running_loop()
    task = asyncio.ensure_future(work)
    for known in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(known, task.cancel)
    progress = asyncio.ensure_future(_progress(count)) if sys.stderr.isatty() else None
    try:
        # Only the handlers above cancel the task, and then it did what was asked.
        with contextlib.suppress(asyncio.CancelledError):
            await task
    finally:
        if progress is not None:
            progress.cancel()
            click.echo("\r\033[K", nl=False, err=True)


async def _progress(count: player.Tally | recorder.Heard) -> None:
    while True:
        await asyncio.sleep(PROGRESS_EVERY_S)
        click.echo(f"\r{count.frames} frames, {count.octets} bytes", nl=False, err=True)


def conclude(count: player.Tally | recorder.Heard, done: str, as_json: bool) -> None:
    """Print the summary; exit with 1 when a link was lost on the way."""
    if as_json:
        click.echo(json.dumps(summary_of(count)))
    else:
        unusable = [f", {number} {why}" for why, number in count.rejected.items()]
        if isinstance(count, player.Tally) and count.dropped:
            unusable.append(f", {count.dropped} dropped")
        sizes = f"{count.frames} frames, {count.octets} bytes in {count.duration_s:.1f} s"
        click.echo(f"{done} {sizes}{''.join(unusable)}")
    if isinstance(count, player.Tally) and count.lost:
        sys.exit(1)


def summary_of(count: player.Tally | recorder.Heard) -> dict[str, Any]:
    """What ``--json`` prints."""
    common = {
        "frames": count.frames,
        "bytes": count.octets,
        "duration_s": round(count.duration_s, 3),
        "by_message": {player.message_name(kind): n for kind, n in count.messages.most_common()},
    }
    common["rejected"] = dict(count.rejected)
    if isinstance(count, recorder.Heard):
        return common
    return common | {"dropped": count.dropped, "clamped": count.clamped, "lost": count.lost}
