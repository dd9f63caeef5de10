"""The command ``companion study link``: simulate the radio link bit by bit."""

from pathlib import Path
from typing import Any

import click

from companion.cli.console import CENTER, CONFIG, SEED, Progress, print_truncated
from companion.cli.study_output import Studied, study_output
from companion.values import shown


def _range(
    _context: click.Context, _option: click.Parameter, text: str
) -> tuple[float, float, float]:
    try:
        first, last, step = (float(part) for part in text.split(":"))
    except ValueError as error:
        raise click.BadParameter(
            f"{shown(text)} is not FROM:TO:STEP in dB, such as 0:20:2"
        ) from error
    return first, last, step


@click.command()
@click.argument("logs", metavar="[LOG...]", nargs=-1, type=click.Path(path_type=Path))
@CONFIG
@CENTER
@click.option(
    "--snr",
    "snr_db",
    metavar="FROM:TO:STEP",
    default="-2:30:1",
    callback=_range,
    help="SNR of a data subcarrier with the beam exactly on the UAV, dB.",
)
@click.option(
    "--instants", type=int, default=96, help="Number of simulated instants of the flight."
)
@click.option(
    "--blocks", type=int, default=16, help="Number of blocks sent to each UAV per instant and SNR."
)
@click.option(
    "--estimation",
    type=click.Choice(["pilots", "ideal"]),
    default="pilots",
    help="Channel estimation at the receiver.",
)
@click.option("--interval", type=float, default=0.15, help="Seconds between reports.")
@click.option("--latency", type=float, default=0.05, help="Latency of a report, seconds.")
@click.option(
    "--rician-k",
    type=float,
    default=10.0,
    help="Ratio of line of sight to scattered power, dB; inf: no scattering.",
)
@click.option(
    "--delay-spread",
    type=float,
    default=50.0,
    help="Mean delay of the scattered rays, ns; 0: flat channel.",
)
@SEED
@study_output("link")
def link(
    *,
    logs: tuple[Path, ...],
    config: Path | None,
    center: str | None,
    estimation: str,
    interval: float,
    latency: float,
    rician_k: float,
    delay_spread: float,
    progress: Progress,
    **asked: Any,
) -> Studied:
    """Compute error rates and throughput of 16-QAM OFDM for true, predicted and held positions.

    Simulates four UAVs on the paper's circles that report every --interval seconds. With LOG,
    replays logs of one flight, which must contain the simulator's truth. Writes DIR/link.json,
    DIR/link.html and the figures as PNG and SVG.

    Example: companion study link --out report
    """
    from companion.node.replay import settings_for
    from companion.settings.files import load
    from companion.studies.link import report
    from companion.studies.link.blocks import Estimation
    from companion.studies.link.channel import Scattering
    from companion.studies.link.level import LinkStudy, study
    from companion.studies.link.scenario import Reports

    print_truncated(logs)
    if not logs and center is not None:
        raise click.UsageError("--center needs a LOG: the paper's circles surround the array")
    setting = LinkStudy(
        logs=logs,
        center=center,
        config=str(config) if config else None,
        settings=settings_for(logs, config, center) if logs else load(config),
        estimation=Estimation(estimation),
        reports=Reports(interval, latency),
        scattering=Scattering(rician_k, delay_spread * 1e-9),
        **asked,
    )
    answer = study(setting, progress.show)
    return Studied(
        answer=answer,
        report=lambda: report.files(answer, progress.show),
        text=lambda: report.text(answer),
    )
