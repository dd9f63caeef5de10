"""The command ``companion drive``: apply the beams of a running service to a device."""

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from companion.cli.console import CONFIG, SECONDS, FiniteRange, InterruptedByUser, bearer_token
from companion.values import UserError

if TYPE_CHECKING:
    from companion.node.drive.loop import DriveStatus
    from companion.values import IntArray

ANSWER_S: Final = 3.0  # timeout of the service; then the device goes to its safe state


@click.command()
@click.argument("target")
@click.option(
    "--service",
    metavar="URL",
    default="http://127.0.0.1:8080",
    help="Address of the service. COMPANION_TOKEN in the environment is its bearer token.",
)
@CONFIG
@click.option(
    "--uav",
    "uavs",
    multiple=True,
    help="UAV to follow; may be repeated, highest priority first [any UAV].",
)
@click.option(
    "--aim",
    type=click.Choice(["first", "centre"]),
    default="first",
    help="A mount points at the first UAV with a beam, or at the centre of all that have one.",
)
@click.option(
    "--rate",
    "update_hz",
    type=FiniteRange(0.1, 1000),
    default=10.0,
    help="Updates per second sent to the device.",
)
@click.option(
    "--on-stale",
    type=click.Choice(["hold", "boresight", "mute"]),
    default="hold",
    help="State of the device without beams, and after the end.",
)
@click.option("--dry-run", is_flag=True, help="Print the commands instead of sending them.")
@SECONDS
@click.option("--json", "as_json", is_flag=True, help="Print the status, one JSON object a second.")
def drive(
    *,
    target: str,
    service: str,
    config: Path | None,
    uavs: tuple[str, ...],
    aim: str,
    update_hz: float,
    on_stale: str,
    dry_run: bool,
    seconds: float | None,
    as_json: bool,
) -> None:
    """Apply the beams of a running service to a device.

    TARGET is rotctld:HOST:PORT, gimbal: or gimbal-roi:HOST:PORT:SYSID:COMPID, phaser:URI or
    phaser-memory:URI (extra [phaser]) or adar1000:BUS.DEVICE[,...] (extra [spi]). Beams are
    requested for the time at which the device will have applied them. phaser-memory stores the
    [codebook] of --config, which must equal the service's.

    Example: companion drive rotctld:127.0.0.1:4533 --uav 1:1
    """
    from companion.client import Client
    from companion.node.drive import running, targets
    from companion.node.drive.loop import Drive, SafeState
    from companion.node.drive.sources import BeamRequest, HttpSource, stored_registers
    from companion.node.printing import STDERR, STDOUT, Printer, prints_unblocked
    from companion.pipeline import assembly
    from companion.settings.files import load

    settings = load(config)
    stored: list[IntArray] = []

    def codebook() -> "list[IntArray]":
        array = assembly.array(settings)
        stored.extend(stored_registers(array, assembly.equipment(settings, array)))
        return stored

    printer, output = Printer(STDERR), Printer(STDOUT, are_data=as_json)
    lines = printer if as_json else output  # for the operator: JSON objects have stdout alone
    device = targets.device(target, printer.line, codebook)
    if dry_run:
        device = targets.device(f"none:{device.takes}", lines.line, codebook)
    client = Client(service, bearer_token(), ANSWER_S)
    driven = Drive(
        source=HttpSource(
            client,
            BeamRequest(
                uavs=uavs,
                any_uav=not uavs,
                takes=device.takes,
                stored_beams=len(stored) or None,
                centre=aim == "centre",
            ),
        ),
        device=device,
        update_hz=update_hz,
        safe=SafeState(on_stale),
        now_ns=time.time_ns,
        say=lambda text, _severity: printer.line(text),
    )

    def show(final_status: "DriveStatus") -> None:
        if as_json:
            output.require_output()
            output.line(json.dumps(asdict(final_status)))

    try:
        with prints_unblocked():
            interrupted = running.run_until_stopped(driven, show, seconds)
        final_status = driven.status()
        lines.line(_text(final_status))
    finally:
        output.finish()
        printer.finish()
    output.require_output()
    if not final_status.applied and interrupted:
        raise InterruptedByUser("interrupted; nothing was applied")
    if not final_status.applied:
        faults = {"device": driven.device_error, "service": driven.service_error}
        known = "; ".join(f"{what}: {why}" for what, why in faults.items() if why)
        raise UserError(
            f"nothing was applied: {known or 'no beams, or the device rejected them all'}"
        )


def _text(final_status: "DriveStatus") -> str:
    times = ""
    if final_status.p50_ms is not None:
        times = f", to apply p50 {final_status.p50_ms:.1f} ms p99 {final_status.p99_ms:.1f} ms"
    rejected = "".join(f", {n} {why}" for why, n in sorted(final_status.rejected.items()))
    rate = "" if final_status.rate_hz is None else f" at {final_status.rate_hz:.1f} Hz"
    return (
        f"{final_status.applied} updates{rate}{times}, lead {final_status.lead_ms:.0f} ms;"
        f" {final_status.late} late, {final_status.skipped} skipped,"
        f" {final_status.failures} failures{rejected}"
    )
