"""The command ``companion calibrate``: compute a ``[hardware] calibration`` from measurements."""

from pathlib import Path

import click

from companion.cli.console import CONFIG
from companion.values import UserError


@click.command()
@click.argument("measured", type=click.Path(path_type=Path, exists=True))
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    help="Calibration file to write.",
)
@CONFIG
def calibrate(measured: Path, out: Path, config: Path | None) -> None:
    """Compute a calibration from measured responses, or convert a Phaser's calibration files.

    MEASURED is a CSV file of azimuth_deg,elevation_deg,channel,phase_deg,gain_db: the response of
    each single channel to one source at known directions in the array frame. The settings give
    the array and the element of each channel. MEASURED may also be the folder with a Phaser's
    phase_cal_val.pkl and gain_cal_val.pkl.

    Example: companion calibrate responses.csv --config phaser.toml --out measured.csv
    """
    from companion.beams.hardware import measured as measuring
    from companion.beams.hardware import phaser_pickles
    from companion.pipeline import assembly
    from companion.settings.files import load

    if measured.is_dir():
        kept = [measured / f"{name}_cal_val.pkl" for name in ("phase", "gain")]
        found = phaser_pickles.calibration(*(path.read_bytes() for path in kept))
        out.write_text(measuring.as_text(found), encoding="utf-8")
        click.echo(f"{out}: {len(found.order)} channels; their errors are unknown")
        return
    settings = load(config)
    array = assembly.array(settings)
    before = assembly.calibration(settings, array.size)
    order = range(array.size) if before is None else before.order
    try:
        text = measured.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UserError(f"{measured}: not UTF-8 text") from error
    fit = measuring.fitted(measuring.parse_responses(text), array, order)
    out.write_text(measuring.as_text(fit.calibration), encoding="utf-8")
    click.echo(
        f"{out}: {array.size} channels; largest error in the measured directions"
        f" {fit.phase_deg:.2f} degrees and {fit.gain_db:.2f} dB, which reduces the guaranteed gain"
        f" of a matched beam by {fit.cost_db:.2f} dB"
    )
