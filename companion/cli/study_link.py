"""The command ``companion study link``: the radio link bit by bit."""

import json
from pathlib import Path

import click

from companion.cli.console import (
    CENTER,
    CONFIG,
    FOLDER,
    JSON,
    SEED,
    Progress,
    make_folder,
    write_study,
)


def _range(_context: click.Context, _option: click.Parameter, text: str) -> list[float]:
    try:
        first, last, step = (float(part) for part in text.split(":"))
    except ValueError as error:
        raise click.BadParameter(f"{text!r} is not FROM:TO:STEP in dB, such as 0:20:2") from error
    return [first, last, step]


@click.command()
@click.argument("logs", metavar="[LOG...]", nargs=-1, type=click.Path(path_type=Path))
@CONFIG
@CENTER
@click.option(
    "--snr",
    "snr_db",
    metavar="FROM:TO:STEP",
    default="-2:30:1",
    show_default=True,
    callback=_range,
    help="Of a data carrier, beam exactly on the UAV, dB.",
)
@click.option("--instants", type=int, default=96, show_default=True, help="Times of the flight.")
@click.option(
    "--blocks", type=int, default=16, show_default=True, help="To each UAV at each time and SNR."
)
@click.option(
    "--estimation",
    type=click.Choice(["pilots", "ideal"]),
    default="pilots",
    show_default=True,
    help="How receivers know their channel.",
)
@click.option(
    "--interval", type=float, default=0.15, show_default=True, help="Seconds between reports."
)
@click.option(
    "--latency", type=float, default=0.05, show_default=True, help="Seconds that a report is late."
)
@click.option(
    "--rician-k",
    type=float,
    default=10.0,
    show_default=True,
    help="Line of sight over all scattered rays, dB; inf: none scattered.",
)
@click.option(
    "--delay-spread",
    type=float,
    default=50.0,
    show_default=True,
    help="Mean delay of the scattered rays, ns; 0: a flat channel.",
)
@SEED
@FOLDER
@JSON
def link(
    *,
    logs: tuple[Path, ...],
    config: Path | None,
    center: str | None,
    snr_db: list[float],
    instants: int,
    blocks: int,
    estimation: str,
    interval: float,
    latency: float,
    rician_k: float,
    delay_spread: float,
    seed: int,
    out: Path,
    as_json: bool,
) -> None:
    """Error rates and throughput of 16-QAM OFDM by perfect, predicted and held positions.

    Four UAVs on the paper's circles, reporting each --interval seconds; or those of LOGs of
    one flight that hold the simulator's truth, through the whole pipeline. Writes DIR/link.json,
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

    if not logs and center is not None:
        raise click.UsageError("--center is for a LOG: the paper's circles are about the array")
    progress = Progress()
    setting = LinkStudy(
        logs=logs,
        center=center,
        config=str(config) if config else None,
        settings=settings_for(logs, config, center) if logs else load(config),
        snr_db=(snr_db[0], snr_db[1], snr_db[2]),
        instants=instants,
        blocks=blocks,
        estimation=Estimation(estimation),
        reports=Reports(interval, latency),
        scattering=Scattering(rician_k, delay_spread * 1e-9),
        seed=seed,
    )
    make_folder(out)
    answer = study(setting, progress.show)
    write_study(out, "link", answer, lambda: report.files(answer, progress.show))
    progress.clear()
    click.echo(json.dumps(answer) if as_json else report.text(answer))
