"""The command ``companion study compass``: what the array's measurements say of the attitude."""

from pathlib import Path

import click

from companion.cli.console import CENTER, CONFIG, LOGS, SEED, Progress
from companion.cli.study_output import Studied, studied_flights, study_output


@click.command()
@LOGS
@CONFIG
@CENTER
@click.option(
    "--seconds", type=float, default=60.0, help="Seconds of each flight that are studied."
)
@click.option(
    "--jobs", type=click.IntRange(1, 64), default=1, help="Number of cases that run in parallel."
)
@SEED
@study_output("compass")
def compass(
    *,
    logs: tuple[Path, ...],
    config: Path | None,
    center: str | None,
    seconds: float,
    jobs: int,
    seed: int,
    progress: Progress,
) -> Studied:
    """Evaluate how well an array's receiver determines the carrier's attitude.

    Simulates a receiver that measures the UAVs of a flight within a bound. Varies the receiver,
    the error of the mount and the number of UAVs. Compares beams with these measurements, beams
    without them, a Kalman filter and the truth. Needs SIM_STATE of the carrier and of UAVs. Writes
    DIR/compass.json, DIR/compass.html and the figures as PNG and SVG. Takes minutes.

    Example: companion study compass flight.tlog --center 5:1 --out report
    """
    from companion.studies.compass import report, study

    logged = studied_flights(logs, config, center)
    asked = study.CompassStudy(**logged, seconds=seconds, seed=seed, jobs=jobs)
    answer = study.study(asked, progress.show)
    return Studied(
        answer=answer,
        report=lambda: report.files(answer, progress.show),
        text=lambda: study.text(answer),
    )
