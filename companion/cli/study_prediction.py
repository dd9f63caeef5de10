"""The command ``companion study prediction``: compare predictors on logs."""

import time
from pathlib import Path
from typing import Any

import click

from companion.cli.console import CENTER, CONFIG, LOGS, SEED, Progress, print_truncated, say
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
    help="Lead times of the predictions, seconds.",
)
@click.option(
    "--links",
    metavar="NAME[,NAME...]",
    default="clean,radio,hostile",
    callback=lambda _context, _option, text: tuple(word.strip() for word in text.split(",")),
    help="clean: the log's own link. radio: a slow radio. hostile: a latency that steps, ramps,"
    " wanders and stalls. noisy: a report every 0.8 s from a poor receiver.",
)
@click.option(
    "--rate",
    "rate_hz",
    metavar="HZ",
    type=float,
    default=1.2,
    help="Reports per second over the simulated radio.",
)
@click.option(
    "--latency",
    "latency_s",
    metavar="MEDIAN,P95",
    default="0.6,2.2",
    callback=lambda _context, _option, text: numbers(text),
    help="Latency that the simulated radio adds, seconds.",
)
@click.option(
    "--loss",
    metavar="F",
    type=float,
    default=0.1,
    help="Fraction of the reports that the simulated radio loses, 0 to 1.",
)
@click.option("--known-delay", is_flag=True, help="Assume known sender clocks, as with TIMESYNC.")
@SEED
@click.option(
    "--snr",
    "snr_db",
    metavar="DB",
    type=float,
    default=20.0,
    help="SNR with the beam exactly on the UAV, dB: reference for losses of spectral efficiency.",
)
@click.option(
    "--learned",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Also compare with this network, trained by `companion study train`.",
)
@click.option(
    "--jobs", metavar="N", type=click.IntRange(min=1), help="Number of processes.  [all cores]"
)
@click.option("--cluster", metavar="ADDRESS", help="Use a Dask cluster, such as tcp://H:8786.")
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
    """Compare predictors on logs, over the log's own link and over simulated links.

    Writes DIR/prediction.json, DIR/prediction.html and the figures as PNG and SVG. Without
    --center the array is placed at the position of the first report. Intervals with faults
    declared in LOG.events.json do not count for the bounds.

    Exit status 3: a bound was violated, and no refuted assumption about that UAV was published
    before or within the same second.

    Example: companion study prediction flight.tlog --center 5:1 --links clean,hostile --out report
    """
    from companion.settings.files import load
    from companion.studies.prediction import report, tables, violations
    from companion.studies.prediction.comparison import PredictionStudy, study
    from companion.studies.prediction.radio_link import RadioLink

    began_s = time.monotonic()
    if len(latency_s) != 2:
        raise click.BadParameter("--latency needs MEDIAN,P95 in seconds, such as 0.6,2.2")
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
        click.echo("no --center: array placed at the position of the first report", err=True)
    print_truncated(setting.logs)
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
