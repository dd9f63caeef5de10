"""The command ``companion recover``: complete a recording that was cut short."""

import json
from pathlib import Path

import click

from companion.cli.console import JSON, say
from companion.values import UserError


@click.command()
@click.argument(
    "files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@JSON
def recover(files: tuple[Path, ...], as_json: bool) -> None:
    """Complete recordings that were cut short, and print how much was lost.

    Exit status 1: a file cannot be completed; the others are.

    Example: companion recover recordings/companion-20260101T120000Z.mcap.active
    """
    from companion.recording.recover import recover as recover_file

    refused: list[UserError] = []
    for file in files:
        try:
            found = recover_file(file)
        except UserError as error:
            refused.append(error)
            continue
        answer = {
            "file": str(found.path),
            "changed": found.changed,
            "messages": dict(found.messages),
            "lost_bytes": found.lost_bytes,
        }
        done = "recovered" if found.changed else "already complete"
        text = f"{done}, {sum(found.messages.values())} messages, {found.lost_bytes} bytes lost"
        click.echo(json.dumps(answer) if as_json else f"{found.path}: {text}")
    for why in refused[:-1]:
        say(f"companion: {why}", err=True)
    if refused:
        raise refused[-1]
