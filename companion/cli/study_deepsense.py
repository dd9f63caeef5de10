"""The command ``companion study deepsense``: beams as they were measured."""

import json
from pathlib import Path

import click

from companion.cli.console import FOLDER, JSON, SEED, Progress, make_folder, write_study


@click.command()
@click.argument("where", metavar="DIR|CSV", type=click.Path(exists=True, path_type=Path))
@SEED
@FOLDER
@JSON
def deepsense(where: Path, seed: int, out: Path, as_json: bool) -> None:
    """How well a position tells the best beam, on a scenario of DeepSense 6G.

    On contiguous blocks, and on a random split beside it, which leaks. Writes DIR/deepsense.json,
    DIR/deepsense.html and the figure as PNG and SVG. It takes minutes.

    Example: companion study deepsense scenario23_pos_beam.csv --out report
    """
    from companion.studies.deepsense import report, study
    from companion.studies.running import measured_beams

    progress = Progress()
    samples = measured_beams.read(where)
    make_folder(out)
    answer = study.study(samples, seed, progress.show)
    write_study(out, "deepsense", answer, lambda: report.files(answer, progress.show))
    progress.clear()
    click.echo(json.dumps(answer) if as_json else study.text(answer))
