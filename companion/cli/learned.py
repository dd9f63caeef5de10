"""The command ``companion study train``: train the network for ``study prediction --learned``."""

import json
from pathlib import Path

import click

from companion.cli.console import JSON, SEED, Progress


@click.command()
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", required=True
)
@SEED
@click.option("--epochs", type=click.IntRange(min=1), default=30, help="Number of training epochs.")
@click.option(
    "--flights", type=click.IntRange(min=1), default=240, help="Number of synthetic flights."
)
@JSON
def train(out: Path, seed: int, epochs: int, flights: int, as_json: bool) -> None:
    """Train the LSTM predictor on random synthetic flights. Needs PyTorch: the extra [learned].

    The same seed gives the same network on the same machine.

    Example: companion study train --out lrnet.pt
    """
    from companion.recording.folders import make_folder
    from companion.values.extras import needs

    progress = Progress()
    with needs("torch", "learned", "this"):
        from companion.studies.prediction import learned
    make_folder(out.parent, "--out")
    held, loss_m = learned.train(seed, epochs, flights, progress.show)
    learned.save(held, out)
    progress.clear()
    answer = {
        "file": str(out),
        "seed": seed,
        "epochs": epochs,
        "flights": flights,
        "loss_m": loss_m,
    }
    click.echo(json.dumps(answer) if as_json else f"{out}: loss {loss_m:.3f} m")
