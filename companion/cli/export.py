"""The command ``companion export``: logs as tables for other programs."""

import gc
import json
from pathlib import Path
from typing import Any

import click

from companion.cli.console import (
    CENTER,
    CONFIG,
    JSON,
    LATENCY,
    LOGS,
    InterruptedByUser,
    Progress,
    of_log,
    say,
    tell_vehicles,
)
from companion.cli.export_beams import beams


class _OrBeams(click.Command):
    """The command on logs, which leaves to another what begins with the word ``beams``."""

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: click.Context | None = None,
        **extra: Any,
    ) -> click.Context:
        """As ``click.Command.make_context``."""
        if args[:1] == ["beams"]:
            return beams.make_context(f"{info_name} beams", args[1:], parent, **extra)
        return super().make_context(info_name, args, parent, **extra)


@click.command(cls=_OrBeams)
@LOGS
@click.option(
    "--format",
    "form",
    type=click.Choice(("csv", "parquet", "rerun")),
    default="csv",
    help="parquet needs the extra [parquet]; rerun: tracks and beams in space, as an MCAP file.",
)
@click.option(
    "--out",
    metavar="DIR",
    required=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="The folder for the tables.",
)
@CONFIG
@CENTER
@LATENCY
@JSON
def export(
    *,
    logs: tuple[Path, ...],
    form: str,
    out: Path,
    config: Path | None,
    center: str | None,
    latency_s: float,
    as_json: bool,
) -> None:
    """Logs as tables, for pandas, DuckDB and other programs, by way of a replay.

    A table each of reports, tracks, beams, updates, rejections and events: what is in their
    columns is said in docs/export.md. Where a folder has export.json, it is whole. In place of
    logs, the word beams exports a codebook: companion export beams --help.

    Example: companion export flight.tlog --center 5:1 --format csv --out tables
    """
    from companion.node import export as exporting
    from companion.node import replay as replaying

    gc.set_threshold(200_000)  # millions of short-lived values, and no cycles among them
    progress = Progress()
    settings = replaying.settings_for(logs, config, center)
    if settings.center.source is None:
        click.echo("no --center: the array stands where the first report was made", err=True)
    tell_vehicles(logs)
    show = of_log(progress, replaying.length_s(logs))
    try:
        if form == "rerun":
            summary = exporting.export_space(logs, settings, out, show, latency_s)
        else:
            summary = exporting.export(
                logs, settings, out, form=form, progress=show, latency_s=latency_s
            )
    except KeyboardInterrupt:
        raise InterruptedByUser("interrupted; nothing was exported") from None
    progress.clear()
    say(json.dumps(summary) if as_json else _text(summary))
    if summary["unaimed"]:
        say(f"nothing was aimed at: {summary['unaimed']}", err=True)


def _text(summary: dict[str, Any]) -> str:
    *tables, last = summary["files"]
    clouds = summary["rows"].get("clouds")
    counts = zip(summary["rows"].values(), tables, strict=clouds is None)
    lines = [
        f"{summary['frames']} frames, {summary['duration_s']:.0f} s of log in"
        f" {summary['wall_s']:.1f} s; center {summary['center']}",
        *(f"  {rows:8} rows  {file}" for rows, file in counts),
        *(f"  missing: {line}" for line in summary["missing"]),
        f"  whole, by {last}" if clouds is None else f"  {clouds:8} clouds of points  {last}",
        f"digest {summary['digest']}",
    ]
    return "\n".join(lines)
