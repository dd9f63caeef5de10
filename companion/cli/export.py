"""The command ``companion export``: write logs as tables for other programs."""

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
    FolderPath,
    InterruptedByUser,
    Progress,
    log_progress,
    print_log_notices,
    say,
)
from companion.cli.export_beams import beams
from companion.cli.replay_text import center_text


class _ExportGroup(click.Command):
    """Command on logs, with ``beams`` as a subcommand if that is its first argument."""

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: click.Context | None = None,
        **extra: Any,
    ) -> click.Context:
        """Parse the arguments, as ``click.Command.make_context``."""
        if args[:1] == ["beams"]:
            return beams.make_context(f"{info_name} beams", args[1:], parent, **extra)
        return super().make_context(info_name, args, parent, **extra)


@click.command(cls=_ExportGroup)
@LOGS
@click.option(
    "--format",
    "form",
    type=click.Choice(("csv", "parquet", "rerun")),
    default="csv",
    help="parquet needs the extra [parquet]; rerun: tracks and beams in 3D, as an MCAP file.",
)
@click.option(
    "--out",
    metavar="DIR",
    required=True,
    type=FolderPath(path_type=Path, file_okay=False),
    help="Folder for the tables.",
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
    """Replay logs and write tables for pandas, DuckDB and other programs.

    Writes one table each of reports, tracks, beams, updates, rejections and events; docs/export.md
    describes their columns. A complete export contains export.json. To export a codebook instead:
    companion export beams --help.

    Example: companion export flight.tlog --center 5:1 --format csv --out tables
    """
    from companion.node import export as exporting
    from companion.node import replay as replaying

    gc.set_threshold(200_000)  # millions of short-lived values without reference cycles
    progress = Progress()
    progress.show(f"reading {', '.join(log.name for log in logs)}")
    settings = replaying.settings_for(logs, config, center)
    progress.clear()
    if settings.center.source is None:
        click.echo("no --center: array placed at the position of the first report", err=True)
    print_log_notices(logs)
    show = log_progress(progress, replaying.length_s(logs))
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
        say(f"no beam was computed: {summary['unaimed']}", err=True)


def _text(summary: dict[str, Any]) -> str:
    *tables, last = summary["files"]
    clouds = summary["rows"].get("clouds")
    counts = zip(summary["rows"].values(), tables, strict=clouds is None)
    lines = [
        f"{summary['frames']} frames, {summary['duration_s']:.0f} s of log in"
        f" {summary['wall_s']:.1f} s; center {center_text(summary['center'])}",
        *(f"  {rows:8} rows  {file}" for rows, file in counts),
        *(f"  missing: {line}" for line in summary["missing"]),
        f"  summary in {last}" if clouds is None else f"  {clouds:8} point clouds  {last}",
        f"digest {summary['digest']}",
    ]
    return "\n".join(lines)
