"""The command ``companion study deepsense``: beams as they were measured."""

import json
from pathlib import Path

import click

from companion.cli.console import JSON, Progress, make_folder


@click.command()
@click.argument("where", metavar="DIR|CSV", type=click.Path(exists=True, path_type=Path))
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of the random split."
)
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", required=True)
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
    (out / "deepsense.json").write_text(json.dumps(answer, indent=1), encoding="utf-8")
    for name, content in report.files(answer, progress.show).items():
        (out / name).write_bytes(content)
    progress.clear()
    click.echo(json.dumps(answer) if as_json else study.text(answer))
