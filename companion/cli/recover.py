"""The command ``companion recover``: complete a recording that was cut short."""

import json
from pathlib import Path

import click

from companion.cli.console import JSON


@click.command()
@click.argument(
    "files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@JSON
def recover(files: tuple[Path, ...], as_json: bool) -> None:
    """Complete recordings that were cut short, and print how much was lost.

    Example: companion recover recordings/companion-20260101T120000Z.mcap.active
    """
    from companion.recording.recover import recover as recover_file

    for file in files:
        found = recover_file(file)
        answer = {
            "file": str(found.path),
            "changed": found.changed,
            "messages": dict(found.messages),
            "lost_bytes": found.lost_bytes,
        }
        done = "recovered" if found.changed else "already complete"
        text = f"{done}, {sum(found.messages.values())} messages, {found.lost_bytes} bytes lost"
        click.echo(json.dumps(answer) if as_json else f"{found.path}: {text}")
