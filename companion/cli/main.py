"""The command ``companion`` and its subcommands."""

import os

# Set before numpy loads: for small matrices, several BLAS threads are slower than one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import gc
import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import companion
from companion.cli import replay_text
from companion.cli.calibrate import calibrate
from companion.cli.check import check
from companion.cli.console import (
    CENTER,
    CONFIG,
    INSECURE,
    JSON,
    JSON_LINES,
    LATENCY,
    LINKS,
    LISTEN,
    LOGS,
    SECONDS,
    InterruptedByUser,
    OneLineErrors,
    Progress,
    bearer_token,
    log_progress,
    print_log_notices,
    say,
)
from companion.cli.design import design
from companion.cli.drive import drive
from companion.cli.export import export
from companion.cli.fleet import fleet as fleet_commands
from companion.cli.fleet import replay as replay_fleet
from companion.cli.output import require_no_input
from companion.cli.recover import recover
from companion.cli.study import study
from companion.cli.weights import weights
from companion.values import UserError, shown

SLOWEST = 0.001  # slowest replay: of a minute in 17 hours

if TYPE_CHECKING:
    from companion.node.start import Console
    from companion.recording.writer import Writer


@click.group(name="companion", cls=OneLineErrors, context_settings={"show_default": True})
@click.version_option(companion.__version__)
def main() -> None:
    """Predict the positions of UAVs from MAVLink, and compute beams that follow them.

    Example: companion demo
    """


@main.command()
@CONFIG
@LINKS
@CENTER
@LISTEN
@click.option("--record", metavar="DIR", help="Write recordings to this directory.")
@click.option(
    "--foxglove",
    metavar="PORT",
    type=click.IntRange(0, 65535),
    help="Port of live channels for Foxglove and Lichtblick, on this machine only. Needs the extra"
    " [live].",
)
@INSECURE
@click.option("--silent", is_flag=True, help="Send nothing over links; overrides the settings.")
@JSON_LINES
def run(
    *,
    config: Path | None,
    links: tuple[str, ...],
    center: str | None,
    listen: str | None,
    record: str | None,
    foxglove: int | None,
    insecure: bool,
    silent: bool,
    as_json: bool,
) -> None:
    """Run the live service.

    COMPANION_TOKEN in the environment sets the bearer token for HTTP. Nothing is sent over links
    unless [presence] or [out] in the settings enables it.

    Example: companion run --link udpin:0.0.0.0:14550 --center 5:1 --record recordings
    """
    from companion.node import start
    from companion.settings.files import layered

    options: dict[str, dict[str, Any]] = {
        "center": {"source": center},
        "links": {"urls": list(links) or None},
        "presence": {"enabled": False if silent else None},
        "out": {"urls": [] if silent else None},
        "server": {"listen": listen, "foxglove": foxglove},
        "recording": {"directory": record},
    }
    voice, token = _output(as_json), bearer_token()
    settings, origins = layered(config, options)
    start.run(settings, voice, origins=origins, token=token, insecure=insecure)


def _output(as_json: bool) -> "Console":
    from companion.cli.voice import JsonLines, Lines

    return JsonLines() if as_json else Lines()


@main.command()
@SECONDS
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8080, help="Port of the page; 0: any free one."
)
@click.option("--open", "open_page", is_flag=True, help="Open the page in a browser.")
@JSON_LINES
def demo(seconds: float | None, port: int, open_page: bool, as_json: bool) -> None:
    """Run the service and its page with four simulated UAVs; record to recordings/.

    Example: companion demo --seconds 60
    """
    from companion.node import demo as scenario
    from companion.node import start
    from companion.settings.origins import of_options

    options = {"server": {"listen": f"127.0.0.1:{port}"}}
    settings = scenario.settings("recordings").override(**options)
    voice, way = _output(as_json), scenario.traffic
    start.run(
        settings,
        voice,
        origins=of_options(options),
        traffic=way,
        seconds=seconds,
        open_page=open_page,
    )


@main.command()
@LOGS
@CONFIG
@CENTER
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Recording to write [recordings/, named after the log].",
)
@click.option("--no-record", is_flag=True, help="Write no recording.")
@click.option(
    "--speed", metavar="max|X", help="Speed relative to the log's own [max; 1 with --serve]."
)
@LATENCY
@click.option(
    "--fleet", is_flag=True, help="The logs are recordings of a fleet, one from each node."
)
@click.option("--serve", is_flag=True, help="Serve the page and the API until interrupted.")
@LISTEN
@INSECURE
@JSON
def replay(
    *,
    logs: tuple[Path, ...],
    config: Path | None,
    center: str | None,
    out: Path | None,
    no_record: bool,
    speed: str | None,
    latency_s: float,
    fleet: bool,
    serve: bool,
    listen: str | None,
    insecure: bool,
    as_json: bool,
) -> None:
    """Replay logs through the same pipeline as the live service.

    Formats, detected by content: .tlog, raw MAVLink, packet captures, .mcap recordings, and
    onboard logs: ArduPilot's DataFlash (.bin), PX4's ULog (.ulg), a table (CSV). Several logs
    must be of one flight.

    Without --center or [center] the array is placed at the position of the first report. A
    recording of companion is replayed with the settings stored in it. With --serve, the page
    shows the replay while it runs, and its end, until SIGINT.

    Example: companion replay flight.tlog --center 5:1 --json

    Example: companion replay uav.bin carrier.bin --center carrier.bin

    With --fleet each node's recording is replayed with its own settings and compared with its
    own digest; no recording is written.
    """
    from companion.node import replay as replaying

    if not serve and (listen or insecure):
        raise click.UsageError("--listen and --insecure need --serve")
    if fleet:
        if config or center or out or speed or serve:
            raise click.UsageError(
                "--fleet excludes --config, --center, --out, --speed and --serve; leave them out"
            )
        replay_fleet(logs, as_json)
        return
    if out is not None:
        require_no_input(out)
    pace = _speed(speed or ("1" if serve else "max"))
    gc.set_threshold(200_000)  # millions of short-lived values without reference cycles
    progress = Progress()
    progress.show(f"reading {', '.join(log.name for log in logs)}")
    settings, origins = replaying.layers_for(logs, config, center)
    progress.clear()
    if settings.center.source is None:
        click.echo("no --center: array placed at the position of the first report", err=True)
    print_log_notices(logs)
    begun: list[Writer] = []

    def record() -> "Writer":
        begun.append(replaying.writer_for(logs, settings, out))
        return begun[0]

    recorder = None if no_record else record
    if serve:
        from companion.node import served_replay  # imports the HTTP server
        from companion.settings.files import load

        own = load(config).override(server={"listen": listen})
        served_replay.serve(
            served_replay.ReplayRequest(
                logs=logs,
                settings=settings,
                speed=pace,
                record=recorder,
                latency_s=latency_s,
                origins=origins,
                area_map=own.page.map,
            ),
            own.server.listen,
            partial(_summary_text, as_json),
            token=bearer_token(),
            insecure=insecure,
        )
        return
    show = log_progress(progress, replaying.length_s(logs))
    try:
        summary = replaying.replay(
            logs, settings, recorder, speed=pace, progress=show, latency_s=latency_s
        )
    except KeyboardInterrupt:
        raise InterruptedByUser(_recovery_hint(begun)) from None
    progress.clear()
    say(_summary_text(as_json, summary))
    if summary["unaimed"]:
        raise UserError(f"no beam was computed: {summary['unaimed']}")


def _recovery_hint(begun: "list[Writer]") -> str:
    """Return how to complete the recording that Ctrl-C interrupted; empty if none was begun."""
    for writer in begun:
        writer.abandon()
        return f"interrupted; to complete the partial recording: companion recover {writer.path}"
    return ""


def _summary_text(as_json: bool, summary: dict[str, Any]) -> str:
    return json.dumps(summary) if as_json else replay_text.text(summary)


def _speed(text: str) -> float | None:
    if text == "max":
        return None
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not SLOWEST <= factor < float("inf"):
        raise click.BadParameter(
            f"{shown(text)} is neither max nor a number of at least {SLOWEST}",
            param_hint="'--speed'",
        )
    return factor


for command in (calibrate, check, design, drive, export, recover, study, weights):
    main.add_command(command)
main.add_command(fleet_commands, "fleet")
