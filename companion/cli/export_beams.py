"""The command ``companion export beams``: write a codebook for other programs."""

from pathlib import Path

import click

from companion.cli.console import CONFIG
from companion.cli.output import write_file


@click.command()
@click.option(
    "--format",
    "form",
    type=click.Choice(("oai-dbt",)),
    default="oai-dbt",
    help="oai-dbt: OpenAirInterface's digital beam table, a CSV of ids and port weights.",
)
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="File to write [stdout]."
)
@CONFIG
def beams(form: str, out: Path | None, config: Path | None) -> None:
    """Write the [codebook] of the settings for a base station that selects among its beams.

    Ports are the array's elements, or the channels of [hardware] calibration. Beam ids are those
    of the API, whose ssb_candidates lists the beams to sweep for each UAV.

    Example: companion export beams --format oai-dbt --config panel.toml --out beams.csv
    """
    from companion.beams.hardware.calibration import Calibration
    from companion.beams.hardware.digital_beams import write_oai_dbt
    from companion.pipeline import assembly
    from companion.settings.files import load
    from companion.values import UserError

    settings = load(config)
    array = assembly.array(settings)
    equipment = assembly.equipment(settings, array)
    if equipment.codebook is None:
        raise UserError('[codebook]: no stored beams; set kind = "dft" or kind = "file"')
    text = write_oai_dbt(
        equipment.codebook, equipment.calibration or Calibration.ideal(range(array.size))
    )
    if out is None:
        click.echo(text, nl=False)
    else:
        write_file(out, text)
        click.echo(f"{out}: {equipment.codebook.size} beams of {array.size} ports")
