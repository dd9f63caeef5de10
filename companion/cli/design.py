"""The command ``companion design``: observer gains, certificates and gain tables."""

import json
from pathlib import Path
from typing import Final

import click

from companion.cli.console import JSON, FiniteRange
from companion.cli.output import write_file
from companion.values import shown

LARGEST: Final = 1e6  # largest number of an option, in its unit


def numbers(text: str) -> list[float]:
    """Parse an option's numbers, separated by commas."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise click.BadParameter(
            f"{shown(text)} is not a list of numbers such as 0.1,0.5"
        ) from error
    if max(map(abs, found)) > LARGEST:
        raise click.BadParameter(f"{shown(text)}: allowed: at most {LARGEST:g}")
    return found


def _alpha(text: str) -> float | None:
    if text == "auto":
        return None
    try:
        return float(text)
    except ValueError as error:
        raise click.BadParameter(f"alpha {shown(text)} is neither 'auto' nor a number") from error


@click.command()
@click.option(
    "--dt",
    metavar="S[,S...]",
    callback=lambda _context, _option, text: [] if text is None else numbers(text),
    help="Seconds between reports.",
)
@click.option("--model", type=click.Choice(["position", "kinematic"]), default="position")
@click.option(
    "--alpha",
    metavar="A|auto",
    default="auto",
    help="Position model: decay of the certificate per report, 0 < A < 1, or auto.",
)
@click.option(
    "--feedthrough",
    type=float,
    default=0.0,
    help="Position model: direct effect of the velocity on a report, in seconds.",
)
@click.option(
    "--mu-max", type=FiniteRange(min=0), help="Largest accepted mu; kinematic model: in m^2."
)
@click.option(
    "--method",
    type=click.Choice(["closed-form", "lmi"]),
    help="The kinematic model supports only lmi.  [default: closed-form for the position model]",
)
@click.option(
    "--acceleration", type=float, default=5.0, help="Kinematic model: largest acceleration, m/s^2."
)
@click.option(
    "--position-noise",
    type=float,
    default=0.5,
    help="Kinematic model: largest error of a reported position, m.",
)
@click.option(
    "--velocity-noise",
    type=float,
    default=0.2,
    help="Kinematic model: largest error of a reported velocity, m/s.",
)
@click.option("--no-velocity", is_flag=True, help="Kinematic model: reports have no velocity.")
@click.option(
    "--dt-range",
    metavar="LOW,HIGH",
    default="0.05,2",
    callback=lambda _context, _option, text: numbers(text),
    help="With --out: shortest and longest interval that the gain table covers, s.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Kinematic model: gain table with its certificate to write, for [observer] design.",
)
@JSON
def design(
    *,
    dt: list[float],
    model: str,
    alpha: str,
    feedthrough: float,
    mu_max: float | None,
    method: str | None,
    acceleration: float,
    position_noise: float,
    velocity_noise: float,
    no_velocity: bool,
    dt_range: list[float],
    out: Path | None,
    as_json: bool,
) -> None:
    """Compute observer gains, their certificates, and the largest feasible report interval.

    Example: companion design --dt 0.15,0.5 --alpha 0.5 --feedthrough 0.5 --mu-max 0.05
    """
    from companion.tracking.design import answers

    if not dt and out is None:
        raise click.UsageError("give --dt, or --out for a gain table")
    for option, number in (
        ("--feedthrough", feedthrough),
        ("--acceleration", acceleration),
        ("--position-noise", position_noise),
        ("--velocity-noise", velocity_noise),
    ):
        if abs(number) > LARGEST:
            raise click.UsageError(f"{option} {number:g}: allowed: at most {LARGEST:g}")
    if model == "position":
        if out is not None:
            raise click.UsageError("--out works only with --model kinematic")
        way = method or "closed-form"
        rows = [
            answers.row(
                s,
                feedthrough_s=feedthrough,
                alpha=_alpha(alpha),
                mu_max=mu_max,
                model=model,
                method=way,
            )
            for s in dt
        ]
    else:
        if method == "closed-form" or feedthrough:
            raise click.UsageError(
                "--model kinematic supports neither closed-form nor --feedthrough"
            )
        motion = answers.KinematicLimits(
            acceleration, position_noise, None if no_velocity else velocity_noise
        )
        rows = answers.kinematic_rows(dt, motion, _alpha(alpha), mu_max)
        if out is not None:
            if alpha != "auto":
                raise click.UsageError("--out searches alpha itself; leave out --alpha")
            if not out.parent.is_dir():  # reported before the long work, not after it
                raise click.UsageError(f"{out}: directory {out.parent} does not exist; create it")
            designed = answers.table(dt_range, motion)
            write_file(out, designed.to_json())
            click.echo(f"wrote {out}: {answers.described(designed)}", err=True)
    if as_json:
        click.echo(json.dumps(rows))
        return
    for row in rows:
        click.echo(answers.as_text(row))
