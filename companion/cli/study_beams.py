"""The command ``companion study beams``: evaluate the beams of an array over a flight."""

from pathlib import Path

import click

from companion.cli.console import CENTER, CONFIG, LOGS, Progress, print_truncated
from companion.cli.study_output import Studied, study_output


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
    from companion.node.replay import settings_for
    from companion.recording.reader import flights
    from companion.studies.beams import report
    from companion.studies.beams.flight import BeamStudy, study

    print_truncated(logs)
    flown = tuple(flights(logs))
    settings = tuple(settings_for(each, config, center) for each in flown)
    over = tuple(name for name in links.split(",") if name)
    setting = BeamStudy(
        flights=flown,
        settings=settings,
        hz=hz,
        center=center,
        config=str(config) if config else None,
        links=over,
    )
    if any(each.center.source is None for each in settings):
        click.echo("no --center: array placed at the position of the first report", err=True)
    answer, found = study(setting, progress.show)
    return Studied(
        answer=answer,
        report=lambda: report.files(answer, found, progress.show),
        text=lambda: report.text(found, answer["modes"]),
    )
