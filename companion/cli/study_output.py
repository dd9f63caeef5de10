"""Output that all commands of ``companion study`` share."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import click

from companion.cli.console import JSON, FolderPath, Progress, make_folder, print_truncated
from companion.cli.output import write_file


@dataclass(frozen=True, slots=True, kw_only=True)
class Studied:
    """Outcome of a study."""

    answer: dict[str, Any]
    report: Callable[[], Mapping[str, bytes]]  # page and figures, by file name
    text: Callable[[], str]  # printed without --json
    at_end: Callable[[], None] = lambda: None  # called after all files are written


def study_output(name: str) -> Callable[[Callable[..., Studied]], Callable[..., None]]:
    """Add --out and --json to a study's command, and write what the study returns.

    The study is called with ``progress``. The answer is written as JSON before the figures.
    """

    def decorate(study: Callable[..., Studied]) -> Callable[..., None]:
        @click.option(
            "--out",
            type=FolderPath(path_type=Path),
            metavar="DIR",
            required=True,
            help="Folder for the results.",
        )
        @JSON
        @wraps(study)
        def command(*, out: Path, as_json: bool, **options: Any) -> None:
            progress = Progress()
            make_folder(out)
            studied = study(progress=progress, **options)
            written = json.dumps(studied.answer, indent=1)
            write_file(out / f"{name}.json", written)
            for file, content in studied.report().items():
                write_file(out / file, content)
            progress.clear()
            click.echo(json.dumps(studied.answer) if as_json else studied.text())
            studied.at_end()

        return command

    return decorate


def studied_flights(
    logs: tuple[Path, ...], config: Path | None, center: str | None
) -> dict[str, Any]:
    """Return the fields of ``StudiedLogs`` for the logs of a command, which may be truncated."""
    from companion.node.replay import settings_for
    from companion.recording.reader import flights

    print_truncated(logs)
    flown = tuple(flights(logs))
    return {
        "flights": flown,
        "settings": tuple(settings_for(each, config, center) for each in flown),
        "center": center,
        "config": str(config) if config else None,
    }
