"""The command ``companion calibrate``: the channels of an array, or its mount."""

import json
from pathlib import Path
from typing import Final

import click

from companion.cli.console import CENTER, CONFIG, JSON, LOGS, Progress, print_truncated
from companion.cli.output import write_file
from companion.values import UserError

CHANNELS: Final = "channels"


class _Calibrations(click.Group):
    """Group whose first command may be left out: ``calibrate FILE`` is ``calibrate channels``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, "--help"):
            args = [CHANNELS, *args]
        return super().parse_args(ctx, args)


@click.group(cls=_Calibrations)
def calibrate() -> None:
    """Compute a calibration: of an array's channels, or of its mount.

    `companion calibrate MEASURED` is short for `companion calibrate channels MEASURED`.

    Example: companion calibrate mount recordings/flight.mcap
    """


@calibrate.command(CHANNELS)
@click.argument("measured", type=click.Path(path_type=Path, exists=True))
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    help="Calibration file to write.",
)
@CONFIG
def channels(measured: Path, out: Path, config: Path | None) -> None:
    """Compute a calibration from measured responses, or convert a Phaser's calibration files.

    MEASURED is a CSV file of azimuth_deg,elevation_deg,channel,phase_deg,gain_db: the response of
    each single channel to one source at known directions in the array frame. The settings give
    the array and the element of each channel. MEASURED may also be the folder with a Phaser's
    phase_cal_val.pkl and gain_cal_val.pkl.

    Example: companion calibrate channels responses.csv --config phaser.toml --out measured.csv
    """
    from companion.beams.hardware import measured as measuring
    from companion.beams.hardware import phaser_pickles
    from companion.pipeline import assembly
    from companion.settings.files import load, read_file

    if measured.is_dir():
        kept = [measured / f"{name}_cal_val.pkl" for name in ("phase", "gain")]
        found = phaser_pickles.calibration(*(read_file(path) for path in kept))
        write_file(out, measuring.as_text(found))
        click.echo(f"{out}: {len(found.order)} channels; their errors are unknown")
        return
    settings = load(config)
    array = assembly.array(settings)
    before = assembly.calibration(settings, array.size)
    order = range(array.size) if before is None else before.order
    try:
        text = read_file(measured).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(f"{measured}: not UTF-8 text") from error
    try:
        fit = measuring.fitted(measuring.parse_responses(text), array, order)
    except UserError as error:
        raise UserError(f"{measured}: {error}") from error
    write_file(out, measuring.as_text(fit.calibration))
    click.echo(
        f"{out}: {array.size} channels; largest error in the measured directions"
        f" {fit.phase_deg:.2f} degrees and {fit.gain_db:.2f} dB, which reduces the guaranteed gain"
        f" of a matched beam by {fit.cost_db:.2f} dB"
    )


@calibrate.command()
@LOGS
@CONFIG
@CENTER
@JSON
def mount(
    *, logs: tuple[Path, ...], config: Path | None, center: str | None, as_json: bool
) -> None:
    """Suggest the mount of an array from what its receiver measured in a flight.

    LOG is a recording with observations (`[observations]`). If the carrier flies with different
    headings, the error of the mount can be separated from that of the compass. Compare the
    suggestion with the array before you write it into the settings.

    Example: companion calibrate mount recordings/flight.mcap
    """
    from companion.node import mount_calibration
    from companion.node.replay import settings_for

    print_truncated(logs)
    progress = Progress()
    found = mount_calibration.suggest(logs, settings_for(logs, config, center), progress.show)
    progress.clear()
    click.echo(json.dumps(found) if as_json else mount_calibration.text(found))
