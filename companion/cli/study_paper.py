"""The commands ``companion study paper`` and ``companion study dt``."""

import json
from pathlib import Path

import click

from companion.cli.console import JSON, Progress, make_folder


@click.command()
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", required=True)
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
    (out / "paper.json").write_text(json.dumps(answer, indent=1), encoding="utf-8")
    for name, content in page.paper_files(answer, material, progress.show).items():
        (out / name).write_bytes(content)
    progress.clear()
    click.echo(json.dumps(answer) if as_json else page.text(answer))


@click.command()
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", required=True)
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
    (out / "dt.json").write_text(json.dumps(answer), encoding="utf-8")
    for name, content in maps.files(answer, found, progress.show).items():
        (out / name).write_bytes(content)
    progress.clear()
    click.echo(json.dumps(answer) if as_json else maps.text(answer))
