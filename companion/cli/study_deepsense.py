"""The command ``companion study deepsense``: predict measured beams from positions."""

from pathlib import Path

import click

from companion.cli.console import SEED, Progress
from companion.cli.study_output import Studied, study_output


@click.command()
@click.argument("where", metavar="DIR|CSV", type=click.Path(exists=True, path_type=Path))
@SEED
@study_output("deepsense")
def deepsense(where: Path, seed: int, progress: Progress) -> Studied:
    """Predict the best beam from the position, on a scenario of DeepSense 6G.

    Splits the samples into training and test sets by contiguous blocks. For comparison, also splits
    them at random, which leaks training data into the test set. Writes DIR/deepsense.json,
    DIR/deepsense.html and the figure as PNG and SVG. Takes minutes.

    Example: companion study deepsense scenario23_pos_beam.csv --out report
    """
    from companion.studies.deepsense import report, study
    from companion.studies.running import measured_beams

    samples = measured_beams.read(where)
    answer = study.study(samples, seed, progress.show)
    return Studied(
        answer=answer,
        report=lambda: report.files(answer, progress.show),
        text=lambda: study.text(answer),
    )
