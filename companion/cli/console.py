"""Shared by the commands: user mistakes as one line on stderr, and progress on a terminal."""

import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import click

from companion.cli.interrupts import interrupts_raised
from companion.values import UserError, printable

CONFIG = click.option("--config", type=click.Path(path_type=Path), help="Settings: a TOML file.")
CENTER = click.option(
    "--center",
    metavar="SRC",
    help="What carries the array: SYSID:COMPID, LAT,LON,ALT[,HEADING], home, or the vehicle whose"
    " own log (.bin, .ulg, CSV) is named.",
)
LOGS = click.argument(
    "logs", metavar="LOG...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
SEED = click.option("--seed", type=click.IntRange(min=0), default=1)
SECONDS = click.option(
    "--seconds", type=click.FloatRange(min=0, min_open=True), help="Stop after this many seconds."
)
LINKS = click.option(
    "--link",
    "links",
    metavar="URL",
    multiple=True,
    help="udpin|udpout|tcp|tcpin:HOST:PORT or serial:DEVICE:BAUD, zenoh:KEY; receivers: "
    "sbs|readsb|rid:HOST:PORT, readsb:http://HOST/PATH, rid|cot:udp:HOST:PORT, cot:tcp:HOST:PORT. "
    "May be given several times.",
)
LISTEN = click.option(
    "--listen", metavar="HOST:PORT", help="Where HTTP is served [127.0.0.1:8080]."
)
INSECURE = click.option(
    "--insecure", is_flag=True, help="Serve beyond this machine without a token."
)
LATENCY = click.option(
    "--latency",
    "latency_s",
    metavar="S",
    type=click.FloatRange(0, 60),
    default=0.0,
    help="Seconds from a sample to its arrival, for vehicles' own logs (.bin, .ulg, CSV), which"
    " tell no arrivals; 0: as if received at once.",
)


def say(text: str, err: bool = False) -> None:
    """Print lines in which there may be text of a file or of the network."""
    click.echo(printable(text), err=err)


def tell_vehicles(logs: Sequence[Path]) -> None:
    """Say on stderr whose own logs are among these, and how well their time is known."""
    from companion.recording.reader import vehicles

    for one in vehicles(logs):
        say(one.notice(), err=True)


JSON_LINES = click.option(
    "--json", "as_json", is_flag=True, help="One JSON object a second on stdout: how it goes."
)
JSON = click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")


def make_folder(out: Path) -> None:
    """Make the folder that a command writes to, at once: a long one must not fail at its end.

    Where nothing was written by the command's end, it goes again.
    """
    made = [each for each in (out, *out.parents) if not each.exists()]
    out.mkdir(parents=True, exist_ok=True)

    def tidy() -> None:
        for each in made:
            with suppress(OSError):  # it is not empty
                each.rmdir()

    click.get_current_context().call_on_close(tidy)


class InterruptedByUser(Exception):  # noqa: N818 - it is no error
    """Ctrl-C during a command, with what the user can do now."""


class OneLineErrors(click.Group):
    """A group whose user mistakes are one line on stderr, without the usage text.

    A user's mistake is a ``UserError``, or an ``OSError`` about a file, a port or a disk.
    Everything else is a defect, and ends with its traceback.
    """

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        """Run; see ``click.Command.main``."""
        extra |= {"prog_name": prog_name, "complete_var": complete_var, "standalone_mode": False}
        work: Callable[[], Any] = partial(super().main, args, **extra)
        if not standalone_mode:
            return work()
        try:
            sys.exit(work() or 0)
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(error.exit_code)
        except click.UsageError as error:
            told = error.ctx.command_path if error.ctx else self.name
            said = error.format_message()
            stop = "" if said.endswith((".", "?", "?)")) else "."
            self._end(f"{said}{stop} See {told} --help", error.exit_code)
        except click.ClickException as error:
            self._end(error.format_message(), error.exit_code)
        except (InterruptedByUser, click.Abort) as error:
            self._end(str(error) or "interrupted", 130)
        except UserError as error:
            self._end(str(error), 1)
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            self._end(f"{where}{error.strerror or error}", 1)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; an interrupt is caught before Click, which would print an empty line."""
        try:
            with interrupts_raised():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            raise InterruptedByUser from None

    def _end(self, said: str, status: int) -> NoReturn:
        say(f"{self.name}: {' '.join(said.split())}", err=True)
        sys.exit(status)


class Progress:
    """One line on stderr that is overwritten; nothing where stderr is not a terminal."""

    def __init__(self) -> None:
        self._on = sys.stderr.isatty()

    def show(self, text: str) -> None:
        """Replace the line."""
        if self._on:
            width = shutil.get_terminal_size().columns - 1  # what wraps could not be overwritten
            click.echo(f"\r\033[K{printable(text)[:width]}", nl=False, err=True)

    def clear(self) -> None:
        """Remove the line."""
        self.show("")


def of_log(progress: Progress, ends_s: float | None) -> Callable[[int, float, float], None]:
    """Shows how far a log has been read; ``ends_s`` is its length, None where it is not known.

    What is returned takes frames, seconds of log, and seconds since it began.
    """

    def show(frames: int, at_s: float, wall_s: float) -> None:
        to_go = ""
        if ends_s and at_s > 0:
            to_go = f" of {ends_s:.0f} s, {max(0.0, ends_s / at_s - 1) * wall_s:.0f} s to go"
        progress.show(f"{frames} frames, {at_s:.0f} s of log{to_go}")

    return show
