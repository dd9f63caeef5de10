"""The commands ``companion study paper`` and ``companion study dt``."""

import click

from companion.cli.console import SEED, Progress
from companion.cli.study_output import Studied, study_output


@click.command()
@SEED
@study_output("paper")
def paper(seed: int, progress: Progress) -> Studied:
    """Repeat the published experiments, and test every claim of the paper.

    Writes DIR/paper.json, DIR/paper.html and the figures as PNG and SVG.

    Example: companion study paper --out report
    """
    from companion.studies.paper import claims, experiments, page

    answer, material = experiments.study(seed, progress.show)
    answer["claims"] = claims.judge(answer)
    return Studied(
        answer=answer,
        report=lambda: page.paper_files(answer, material, progress.show),
        text=lambda: page.text(answer),
    )


@click.command()
@study_output("dt")
def dt(progress: Progress) -> Studied:
    """Map the feasible report intervals and their error bounds.

    Writes DIR/dt.json, DIR/dt.html and the figures as PNG and SVG.

    Example: companion study dt --out report
    """
    from companion.studies.interval import maps

    answer, found = maps.study(progress.show)
    return Studied(
        answer=answer,
        report=lambda: maps.files(answer, found, progress.show),
        text=lambda: maps.text(answer),
    )
