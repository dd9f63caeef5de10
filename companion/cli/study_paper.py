"""The commands ``companion study paper`` and ``companion study dt``."""

import json
from pathlib import Path

import click

from companion.cli.console import FOLDER, JSON, SEED, Progress, make_folder, write_study


@click.command()
@SEED
@FOLDER
@JSON
def paper(seed: int, out: Path, as_json: bool) -> None:
    """The published experiments made again, and every claim judged.

    Writes DIR/paper.json, DIR/paper.html and the figures as PNG and SVG.

    Example: companion study paper --out report
    """
    from companion.studies.paper import claims, experiments, page

    progress = Progress()
    make_folder(out)
    answer, material = experiments.study(seed, progress.show)
    answer["claims"] = claims.judge(answer)
    write_study(out, "paper", answer, lambda: page.paper_files(answer, material, progress.show))
    progress.clear()
    click.echo(json.dumps(answer) if as_json else page.text(answer))


@click.command()
@FOLDER
@JSON
def dt(out: Path, as_json: bool) -> None:
    """How often UAVs must report: feasible intervals and their bounds, as maps.

    Writes DIR/dt.json, DIR/dt.html and the figures as PNG and SVG.

    Example: companion study dt --out report
    """
    from companion.studies.interval import maps

    progress = Progress()
    make_folder(out)
    answer, found = maps.study(progress.show)
    write_study(out, "dt", answer, lambda: maps.files(answer, found, progress.show))
    progress.clear()
    click.echo(json.dumps(answer) if as_json else maps.text(answer))
