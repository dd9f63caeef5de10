"""The command ``companion study fleet``: simulate many nodes and UAVs in virtual time."""

import time

import click

from companion.cli.console import SEED, FiniteRange, Progress
from companion.cli.study_output import Studied, study_output
from companion.values import shown


def _span(_context: click.Context, _option: click.Parameter, text: str) -> tuple[int, int]:
    first, dots, last = text.partition("..")
    try:
        found = int(first), int(last if dots else first)
    except ValueError as error:
        raise click.BadParameter(f"{shown(text)} is not FROM..TO, such as 3..100") from error
    if not 1 <= found[0] <= found[1] <= 62_500:
        raise click.BadParameter(f"{shown(text)} is outside 1..62500, or the smaller is not first")
    return found


def _steps(span: tuple[int, int], steps: int) -> list[int]:
    """Return a geometric sequence of ``steps`` integers from the first to the last of ``span``."""
    first, last = span
    if steps == 1 or first == last:
        return [last] * steps
    return [round(first * (last / first) ** (n / (steps - 1))) for n in range(steps)]


@click.command()
@click.option(
    "--nodes",
    callback=_span,
    metavar="FROM..TO",
    default="3..30",
    help="Number of nodes of the smallest and of the largest fleet.",
)
@click.option(
    "--uavs",
    callback=_span,
    metavar="FROM..TO",
    default="100..1000",
    help="Number of UAVs of the smallest and of the largest fleet.",
)
@click.option(
    "--steps",
    type=click.IntRange(1, 20),
    default=3,
    help="Number of fleet sizes between FROM and TO.",
)
@click.option(
    "--seconds", type=FiniteRange(1, 3600), default=10.0,
    help="Simulated seconds for each fleet size.",
)  # fmt: skip
@click.option(
    "--spacing", type=FiniteRange(10, 1e5), default=1500.0,
    help="Metres between nodes on a square grid; each receives UAVs within 2500 m.",
)  # fmt: skip
@click.option(
    "--delay", type=FiniteRange(0, 5), default=0.02,
    help="Delay between two nodes, seconds.",
)  # fmt: skip
@click.option(
    "--loss", type=FiniteRange(0, 0.9), default=0.02,
    help="Fraction of the messages between nodes that is lost.",
)  # fmt: skip
@SEED
@study_output("fleet")
def fleet(
    *,
    nodes: tuple[int, int],
    uavs: tuple[int, int],
    steps: int,
    seconds: float,
    spacing: float,
    delay: float,
    loss: float,
    seed: int,
    progress: Progress,
) -> Studied:
    """Simulate fleets of growing size: their traffic, processor time and handovers.

    Runs in one process and in virtual time. Measures the traffic, the processor time per node, the
    fraction of time in which exactly one node serves each UAV, and the effects of a node failure
    and of a network partition. Writes DIR/fleet.json, DIR/fleet.html and the figures as PNG and
    SVG.

    Example: companion study fleet --nodes 3..30 --uavs 100..1000 --out report
    """
    from companion.studies.fleet import report, study
    from companion.studies.origin import command_line

    sizes = tuple(zip(_steps(nodes, steps), _steps(uavs, steps), strict=True))
    asked = study.FleetStudy(
        sizes=sizes, seconds=seconds, delay_s=delay, loss=loss, spacing_m=spacing, seed=seed
    )
    found = list(study.run(asked, time.process_time, progress.show))
    command = command_line(
        "fleet",
        nodes=f"{nodes[0]}..{nodes[1]}",
        uavs=f"{uavs[0]}..{uavs[1]}",
        steps=steps,
        seconds=seconds,
        spacing=spacing,
        delay=delay,
        loss=loss,
        seed=seed,
    )
    answer = study.answer(asked, found, command)
    return Studied(
        answer=answer,
        report=lambda: report.files(asked, found, answer, progress.show),
        text=lambda: report.text(found),
    )
