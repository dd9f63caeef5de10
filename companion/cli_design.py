"""The commands that design and study: no vehicle, no service, nothing live."""

import json
from pathlib import Path

import click

from companion.cli_learned import train
from companion.cli_link import link
from companion.console import CENTER, CONFIG, JSON, Progress, user_errors


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        raise click.BadParameter(f"{text!r} is not a list of numbers such as 0.1,0.5") from error


def _alpha(text: str) -> float | None:
    if text == "auto":
        return None
    try:
        return float(text)
    except ValueError as error:
        raise click.BadParameter(f"alpha is 'auto' or a number, not {text!r}") from error


@click.command()
@click.option(
    "--dt",
    metavar="S[,S...]",
    callback=lambda _context, _option, text: [] if text is None else _numbers(text),
    help="Seconds between reports.",
)
@click.option(
    "--model",
    type=click.Choice(["position", "kinematic"]),
    default="position",
    show_default=True,
)
@click.option("--alpha", metavar="A|auto", default="auto", show_default=True, help="In (0, 1).")
@click.option(
    "--feedthrough",
    type=float,
    default=0.0,
    show_default=True,
    help="Position model: seconds by which a report leads the position.",
)
@click.option(
    "--mu-max", type=click.FloatRange(min=0), help="The largest mu to accept; kinematic: in m^2."
)
@click.option(
    "--method",
    type=click.Choice(["closed-form", "lmi"]),
    help="The kinematic model has only the LMI.  [default: closed-form if there is one]",
)
@click.option(
    "--acceleration",
    type=float,
    default=5.0,
    show_default=True,
    help="Kinematic: the largest acceleration, m/s^2.",
)
@click.option(
    "--position-noise",
    type=float,
    default=0.5,
    show_default=True,
    help="Kinematic: the largest error of a reported position, m.",
)
@click.option(
    "--velocity-noise",
    type=float,
    default=0.2,
    show_default=True,
    help="Kinematic: the largest error of a reported velocity, m/s.",
)
@click.option("--no-velocity", is_flag=True, help="Kinematic: velocity is not reported.")
@click.option(
    "--dt-range",
    metavar="LOW,HIGH",
    default="0.05,2",
    show_default=True,
    callback=lambda _context, _option, text: _numbers(text),
    help="With --out: the intervals that one table of gains must serve.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Kinematic: write a table of gains with its proof, for [observer] design.",
)
@JSON
def design(
    dt: list[float],
    model: str,
    alpha: str,
    feedthrough: float,
    mu_max: float | None,
    method: str | None,
    acceleration: float,
    position_noise: float,
    velocity_noise: float,
    no_velocity: bool,
    dt_range: list[float],
    out: Path | None,
    as_json: bool,
) -> None:
    """Observer gains, their certificate, and the largest feasible interval between reports.

    Example: companion design --dt 0.15,0.5 --alpha 0.5 --feedthrough 0.5 --mu-max 0.05
    """
    from companion import designing

    with user_errors():
        if not dt and out is None:
            raise click.UsageError("say --dt, or --out for a table of gains")
        if model == "position":
            if out is not None:
                raise click.UsageError("--out writes tables of the kinematic model only")
            way = method or "closed-form"
            rows = [designing.row(s, feedthrough, _alpha(alpha), mu_max, model, way) for s in dt]
        else:
            if method == "closed-form" or feedthrough:
                raise click.UsageError("the kinematic model: no closed form, no feedthrough")
            motion = designing.Motion(
                acceleration, position_noise, None if no_velocity else velocity_noise
            )
            rows = designing.kinematic_rows(dt, motion, _alpha(alpha), mu_max)
            if out is not None:
                if alpha != "auto":
                    raise click.UsageError("--out searches alpha itself; --alpha is for --dt")
                if not out.parent.is_dir():  # said before the long work, not after it
                    raise click.UsageError(f"{out}: there is no such directory")
                designed = designing.table(dt_range, motion)
                out.write_text(designed.to_json(), encoding="utf-8")
                click.echo(f"wrote {out}: {designing.described(designed)}", err=True)
    if as_json:
        click.echo(json.dumps(rows))
        return
    for row in rows:
        click.echo(designing.as_text(row))


@click.group()
def study() -> None:
    """Experiments: figures and tables as one HTML page, and the numbers as JSON.

    Example: companion study prediction flight.tlog --center 5:1 --out report
    """


@study.command()
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=click.Path(path_type=Path))
@CONFIG
@CENTER
@click.option(
    "--lead",
    "leads_s",
    metavar="S[,S...]",
    default="0,0.1,0.3,1",
    show_default=True,
    callback=lambda _context, _option, text: _numbers(text),
    help="Seconds ahead of now that are aimed at.",
)
@click.option("--rate", "rate_hz", metavar="HZ", type=float, default=1.2, show_default=True)
@click.option(
    "--latency",
    "latency_s",
    metavar="MEDIAN,P95",
    default="0.6,2.2",
    show_default=True,
    callback=lambda _context, _option, text: _numbers(text),
    help="Seconds that the simulated radio adds to each report.",
)
@click.option(
    "--loss", metavar="F", type=float, default=0.1, show_default=True, help="Share that is lost."
)
@click.option("--known-delay", is_flag=True, help="The senders' clocks are known, as by TIMESYNC.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option(
    "--snr",
    "snr_db",
    metavar="DB",
    type=float,
    default=20.0,
    show_default=True,
    help="At a UAV with the beam right on it: what the loss in spectral efficiency is of.",
)
@click.option(
    "--learned",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Compare with this network as well, which `companion study train` made.",
)
@click.option("--jobs", metavar="N", type=click.IntRange(min=1), help="Processes.  [all cores]")
@click.option("--cluster", metavar="ADDRESS", help="Work on a Dask cluster, such as tcp://H:8786.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", required=True)
@JSON
def prediction(
    logs: tuple[Path, ...],
    config: Path | None,
    center: str | None,
    leads_s: list[float],
    rate_hz: float,
    latency_s: list[float],
    loss: float,
    known_delay: bool,
    seed: int,
    snr_db: float,
    learned: Path | None,
    jobs: int | None,
    cluster: str | None,
    out: Path,
    as_json: bool,
) -> None:
    """Predictors compared on logs, over the link that they had and over a slow radio.

    Writes DIR/prediction.json, DIR/prediction.html and the figures as PNG and SVG. Without
    --center the array stands where the first report was made.

    Example: companion study prediction flight.tlog --center 5:1 --out report
    """
    from companion.config import load
    from companion.studies import report
    from companion.studies.links import Link
    from companion.studies.prediction import Setting, study

    if len(latency_s) != 2:
        raise click.BadParameter("a latency is MEDIAN,P95 in seconds, such as 0.6,2.2")
    progress = Progress()
    with user_errors():
        radio = Link("radio", rate_hz, (latency_s[0], latency_s[1]), loss, known_delay)
        name = str(config) if config else None
        setting = Setting(
            logs, center, tuple(leads_s), radio, seed, load(config), name,
            learned, snr_db, jobs, cluster,
        )  # fmt: skip
        out.mkdir(parents=True, exist_ok=True)
        if center is None:
            click.echo("no --center: the array stands where the first report was made", err=True)
        answer, found = study(setting, progress.show)
        (out / "prediction.json").write_text(json.dumps(answer, indent=1), encoding="utf-8")
        for each, content in report.files(answer, found, progress.show).items():
            (out / each).write_bytes(content)
    progress.clear()
    click.echo(json.dumps(answer) if as_json else report.text(found))


@study.command()
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=click.Path(path_type=Path))
@CONFIG
@CENTER
@click.option(
    "--hz", type=float, default=5.0, show_default=True, help="Looks a second of the log's time."
)
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", required=True)
@JSON
def beams(
    logs: tuple[Path, ...],
    config: Path | None,
    center: str | None,
    hz: float,
    out: Path,
    as_json: bool,
) -> None:
    """What an array would have done over a flight: gains, guarantees, what must be swept.

    The beams as the settings make them, and beside them the same not widened. Where the log has
    the simulator's truth (SIM_STATE) every guarantee is put to the test. Writes DIR/beams.json,
    DIR/beams.html and the figures as PNG and SVG. A recording of our own is studied with the
    settings that it holds.

    Example: companion study beams flight.tlog --center 5:1 --out report
    """
    from companion.replay import settings_for
    from companion.studies import beam_report
    from companion.studies.beams import Setting, study

    progress = Progress()
    with user_errors():
        settings = tuple(settings_for([log], config, center) for log in logs)
        setting = Setting(logs, settings, hz, center, str(config) if config else None)
        out.mkdir(parents=True, exist_ok=True)
        if any(each.center.source is None for each in settings):
            click.echo("no --center: the array stands where the first report was made", err=True)
        answer, found = study(setting, progress.show)
        (out / "beams.json").write_text(json.dumps(answer, indent=1), encoding="utf-8")
        for name, content in beam_report.files(answer, found, progress.show).items():
            (out / name).write_bytes(content)
    progress.clear()
    click.echo(json.dumps(answer) if as_json else beam_report.text(found))


@study.command()
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", required=True)
@JSON
def paper(seed: int, out: Path, as_json: bool) -> None:
    """The published experiments made again, and every claim judged.

    Writes DIR/paper.json, DIR/paper.html and the figures as PNG and SVG.

    Example: companion study paper --out report
    """
    from companion.studies import paper as experiments
    from companion.studies import paper_claims, paper_page

    progress = Progress()
    with user_errors():
        out.mkdir(parents=True, exist_ok=True)
        answer, material = experiments.study(seed, progress.show)
        answer["claims"] = paper_claims.judge(answer)
        (out / "paper.json").write_text(json.dumps(answer, indent=1), encoding="utf-8")
        for name, content in paper_page.paper_files(answer, material, progress.show).items():
            (out / name).write_bytes(content)
    progress.clear()
    click.echo(json.dumps(answer) if as_json else paper_page.text(answer))


@study.command()
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", required=True)
@JSON
def dt(out: Path, as_json: bool) -> None:
    """How often UAVs must report: feasible intervals and their bounds, as maps.

    Writes DIR/dt.json, DIR/dt.html and the figures as PNG and SVG.

    Example: companion study dt --out report
    """
    from companion.studies import dt_maps

    progress = Progress()
    with user_errors():
        out.mkdir(parents=True, exist_ok=True)
        answer, found = dt_maps.study(progress.show)
        (out / "dt.json").write_text(json.dumps(answer), encoding="utf-8")
        for name, content in dt_maps.files(answer, found, progress.show).items():
            (out / name).write_bytes(content)
    progress.clear()
    click.echo(json.dumps(answer) if as_json else dt_maps.text(answer))


study.add_command(train)
study.add_command(link)
