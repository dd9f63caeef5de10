"""The command ``companion study prediction``: predictors compared on logs."""

import time
from pathlib import Path
from typing import Any

import click

from companion.cli.console import CENTER, CONFIG, LOGS, SEED, Progress, say
from companion.cli.design import numbers
from companion.cli.study_output import Studied, study_output


@click.command()
@LOGS
@CONFIG
@CENTER
@click.option(
    "--lead",
    "leads_s",
    metavar="S[,S...]",
    default="0,0.1,0.3,1",
    callback=lambda _context, _option, text: tuple(numbers(text)),
    help="Seconds ahead of now that are aimed at.",
)
@click.option(
    "--links",
    metavar="NAME[,NAME...]",
    default="clean,radio,hostile",
    callback=lambda _context, _option, text: tuple(word.strip() for word in text.split(",")),
    help="The log's own link; a slow radio; one whose latency steps, ramps, wanders and holds all"
    " back, regime by regime; and noisy: a report each 0.8 s, of a poor receiver.",
)
@click.option("--rate", "rate_hz", metavar="HZ", type=float, default=1.2)
@click.option(
    "--latency",
    "latency_s",
    metavar="MEDIAN,P95",
    default="0.6,2.2",
    callback=lambda _context, _option, text: numbers(text),
    help="Seconds that the simulated radio adds to each report.",
)
@click.option(
    "--loss",
    metavar="F",
    type=float,
    default=0.1,
    help="Share of reports that the simulated radio loses, 0 to 1.",
)
@click.option("--known-delay", is_flag=True, help="The senders' clocks are known, as by TIMESYNC.")
@SEED
@click.option(
    "--snr",
    "snr_db",
    metavar="DB",
    type=float,
    default=20.0,
    help="At a UAV with the beam right on it: what the loss in spectral efficiency is of.",
)
@click.option(
    "--learned",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Compare with this network as well, which `companion study train` made.",
)
@click.option("--jobs", metavar="N", type=click.IntRange(min=1), help="Processes.  [all cores]")
@click.option("--cluster", metavar="ADDRESS", help="Work on a Dask cluster, such as tcp://H:8786.")
@study_output("prediction")
def prediction(
    *,
    config: Path | None,
    rate_hz: float,
    latency_s: list[float],
    loss: float,
    known_delay: bool,
    progress: Progress,
    **asked: Any,
) -> Studied:
    """Predictors compared on logs, over the link that they had, a slow radio and a hostile link.

    Writes DIR/prediction.json, DIR/prediction.html and the figures as PNG and SVG. Without
    --center the array stands where the first report was made. Windows of faults that are declared
    in LOG.events.json do not count for the bounds.

    Exit status 3 means that a bound was broken, and the product had not said that one of its
    assumptions about that UAV was refuted, neither before nor within the same second.

    Example: companion study prediction flight.tlog --center 5:1 --links clean,hostile --out report
    """
    from companion.settings.files import load
    from companion.studies.prediction import report, tables, violations
    from companion.studies.prediction.comparison import PredictionStudy, study
    from companion.studies.prediction.radio_link import RadioLink

    began_s = time.monotonic()
    if len(latency_s) != 2:
        raise click.BadParameter("a latency is MEDIAN,P95 in seconds, such as 0.6,2.2")
    radio = RadioLink(
        name="radio",
        rate_hz=rate_hz,
        latency_s=(latency_s[0], latency_s[1]),
        loss=loss,
        known_delay=known_delay,
    )
    name = str(config) if config else None
    setting = PredictionStudy(**asked, radio=radio, settings=load(config), config=name)
    if setting.center is None:
        click.echo("no --center: the array stands where the first report was made", err=True)
    answer, found = study(setting, progress.show)

    def at_end() -> None:
        took_s = time.monotonic() - began_s
        click.echo(
            f"{len(setting.logs)} logs over {len(setting.over)} links in {took_s:.0f} s", err=True
        )
        broken = violations.notice(answer["rows"])
        if broken is not None:
            say(f"companion: {broken}", err=True)
            click.get_current_context().exit(3)

    return Studied(
        answer=answer,
        report=lambda: report.files(answer, found, progress.show),
        text=lambda: tables.text(found),
        at_end=at_end,
    )
