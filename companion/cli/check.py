"""The command ``companion check``: check the setup, and list what would prevent good beams."""

import json
from dataclasses import asdict
from pathlib import Path

import click

from companion.cli.console import (
    CENTER,
    CONFIG,
    INSECURE,
    JSON,
    LINKS,
    LISTEN,
    FiniteRange,
    Progress,
    bearer_token,
    say,
)
from companion.values import UserError


@click.command()
@CONFIG
@LINKS
@CENTER
@LISTEN
@click.option("--record", metavar="DIR", help="Directory for recordings.")
@INSECURE
@click.option(
    "--seconds",
    type=FiniteRange(min=0, max=3600),
    default=10.0,
    help="Seconds to listen for traffic; 0: do not listen.",
)
@JSON
def check(
    *,
    config: Path | None,
    links: tuple[str, ...],
    center: str | None,
    listen: str | None,
    record: str | None,
    insecure: bool,
    seconds: float,
    as_json: bool,
) -> None:
    """Check whether `companion run` would work here with the same options.

    Checks settings, ports, devices, disk and clock, then listens for traffic; it sends what
    [presence] in the settings enables. Each line begins with ok, doubt (a run works, but not as
    well as it could) or fault. Exit status 1: a fault would stop a run or leave it without beams.

    Example: companion check --config settings.toml
    """
    from companion.node import check as checking
    from companion.settings.files import load

    settings = load(config).override(
        center={"source": center},
        links={"urls": list(links) or None},
        server={"listen": listen},
        recording={"directory": record},
    )
    progress, found = Progress(), []
    token = bearer_token()
    for finding in checking.check(
        settings, seconds, token=token, insecure=insecure, show=progress.show
    ):
        found.append(finding)
        progress.clear()
        if not as_json:
            does = f"\n{'':6}do: {finding.remedy}" if finding.remedy else ""
            say(f"{finding.grade:5} {finding.subject}: {finding.text}{does}")
    progress.clear()
    if as_json:
        click.echo(json.dumps({"findings": [asdict(finding) for finding in found]}))
    faults = sum(finding.grade == "fault" for finding in found)
    if faults:
        raise UserError(f"{faults} of {len(found)} checks failed")
