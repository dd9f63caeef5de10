"""The command ``companion study beams``: evaluate the beams of an array over a flight."""

from pathlib import Path

import click

from companion.cli.console import CENTER, CONFIG, LOGS, Progress
from companion.cli.study_output import Studied, studied_flights, study_output


@click.command()
@LOGS
@CONFIG
@CENTER
@click.option(
    "--hz", type=float, default=5.0, help="Beam updates evaluated per second of log time."
)
@click.option(
    "--links",
    metavar="NAME,...",
    default="",
    show_default=False,
    help="Compare the three settings of beams.widen, and sharp beams by other predictors, over"
    " these links: clean, radio, hostile, noisy.",
)
@study_output("beams")
def beams(
    *,
    logs: tuple[Path, ...],
    config: Path | None,
    center: str | None,
    hz: float,
    links: str,
    progress: Progress,
) -> Studied:
    """Evaluate the beams of an array over a flight: gains, guarantees, beams to sweep.

    Compares the beams of the settings with the same beams without widening. If the log contains
    the simulator's truth, every guarantee is tested against it. Writes DIR/beams.json,
    DIR/beams.html and the figures as PNG and SVG. A recording of companion is studied with the
    settings stored in it. Onboard logs (.bin, .ulg, CSV) must be of one flight.

    Example: companion study beams flight.tlog --center 5:1 --links clean,radio --out report
    """
    from companion.studies.beams import report
    from companion.studies.beams.flight import BeamStudy, study

    over = tuple(name for name in links.split(",") if name)
    setting = BeamStudy(**studied_flights(logs, config, center), hz=hz, links=over)
    if any(each.center.source is None for each in setting.settings):
        click.echo("no --center: array placed at the position of the first report", err=True)
    answer, found = study(setting, progress.show)
    return Studied(
        answer=answer,
        report=lambda: report.files(answer, found, progress.show),
        text=lambda: report.text(found, answer["modes"]),
    )
