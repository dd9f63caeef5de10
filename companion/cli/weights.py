"""The command ``companion weights``: weights at a time of a log, for a program or a device."""

import json
import sys
from pathlib import Path

import click

from companion.cli.console import (
    CENTER,
    CONFIG,
    LATENCY,
    LOGS,
    FiniteRange,
    Progress,
    print_log_notices,
    say,
)
from companion.cli.output import write_file
from companion.values import WeightFormat


@click.command()
@LOGS
@click.option(
    "--at",
    metavar="T",
    required=True,
    help="Time: seconds from the start of the log, or 2026-01-01T12:00:00Z.",
)
@click.option(
    "--format",
    "form",
    type=click.Choice([str(form) for form in WeightFormat]),
    default="json",
    help="json also contains the beams; raw is little-endian complex64 in row order.",
)
@click.option(
    "--lead-ms",
    type=FiniteRange(0, 10_000),
    default=0.0,
    help="Milliseconds after T for which the beams are computed.",
)
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="File to write [stdout]."
)
@CONFIG
@CENTER
@LATENCY
def weights(
    *,
    logs: tuple[Path, ...],
    at: str,
    form: str,
    lead_ms: float,
    out: Path | None,
    config: Path | None,
    center: str | None,
    latency_s: float,
) -> None:
    """Compute the weights at a time of a log, for a program or a phased array.

    With [codebook] in the settings, each beam in JSON also gives the best stored beam, the next
    one with its time, and those to sweep. [hardware] in the settings names the calibration of a
    device. If the device cannot apply the weights, the command ends with the reason.

    Example: companion weights flight.tlog --at 120 --center 5:1 --format npy --out w.npy
    """
    from companion.node import moment
    from companion.node.replay import missing, settings_for
    from companion.pipeline import assembly
    from companion.views import beam_state, weight_formats

    if form in ("npy", "raw") and out is None and sys.stdout.isatty():
        raise click.UsageError(f"--format {form} is binary: give --out FILE, or use a pipe")
    if out is not None and not out.parent.is_dir():
        raise click.UsageError(f"--out {out}: folder {out.parent} does not exist; create it")
    progress = Progress()
    progress.show(f"reading {', '.join(log.name for log in logs)}")
    settings = settings_for(logs, config, center)
    progress.clear()
    print_log_notices(logs)
    for line in missing(logs):
        say(line, err=True)
    equipment = assembly.equipment(settings, assembly.array(settings))
    pipeline, update = moment.look(
        logs,
        settings,
        at,
        lead_s=lead_ms * 1e-3,
        progress=lambda done_s: progress.log(f"{done_s:.0f} s of log"),
        latency_s=latency_s,
    )
    progress.clear()
    if update.unfit is not None:
        raise click.ClickException(f"no beams at {at}: {update.unfit}")
    if form == "json":
        summary = beam_state.beams(pipeline, equipment, update, age_s=0.0, lead_ms=lead_ms)
        body = (
            json.dumps(summary | beam_state.weights(pipeline, update.beams, lead_ms)).encode()
            + b"\n"
        )
    else:
        body = weight_formats.encode(WeightFormat(form), update.beams, pipeline, equipment, lead_ms)
    if out is None:
        click.echo(body, nl=False)
    else:
        write_file(out, body)
