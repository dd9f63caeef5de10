"""Options that the commands share, one-line errors on stderr, and progress on a terminal."""

import errno
import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, NoReturn

import click

from companion.cli.interrupts import INTERRUPTED, command_ended, interrupts_raised
from companion.node.signals import LAST_S
from companion.values import UserError, printable, shown

TOKEN: Final = "COMPANION_TOKEN"
ERROR_MAX: Final = 5000  # longest error line, characters; paths have at most 4096
NO_THREADS: Final = "can't start new thread"  # text of Python's error
LOG_EVERY_S: Final = 10.0  # time between two progress lines without a terminal
CONFIG = click.option("--config", type=click.Path(path_type=Path), help="Settings file (TOML).")


class FiniteRange(click.FloatRange):
    """Option that is a finite number in a range: ``click.FloatRange`` lets NaN pass."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number, or fail with the option's name."""
        found = super().convert(value, param, ctx)
        if not math.isfinite(found):
            self.fail(f"{shown(str(value))} is not a finite number", param, ctx)
        return float(found)


class FolderPath(click.Path):
    """Option that names a folder: ``click.Path`` takes "" for the current one."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path, or fail with the option's name."""
        if value == "":
            self.fail("'' is not the name of a folder", param, ctx)
        return super().convert(value, param, ctx)


CENTER = click.option(
    "--center",
    metavar="SRC",
    help="Carrier of the array: SYSID:COMPID; LAT,LON,ALT[,HEADING]; home; or the onboard log"
    " (.bin, .ulg, CSV) of the carrying vehicle.",
)
LOGS = click.argument(
    "logs", metavar="LOG...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
SEED = click.option(
    "--seed", type=click.IntRange(min=0), default=1, help="Seed of the random numbers."
)
SECONDS = click.option(
    "--seconds", type=FiniteRange(min=0, min_open=True), help="Stop after this many seconds."
)
LINKS = click.option(
    "--link",
    "links",
    metavar="URL",
    multiple=True,
    help="MAVLink: udpin|udpout|tcp|tcpin:HOST:PORT, serial:DEVICE:BAUD, zenoh:KEY; receivers: "
    "sbs|readsb|rid:HOST:PORT, readsb:http://HOST/PATH, rid|cot:udp:HOST:PORT, cot:tcp:HOST:PORT. "
    "May be repeated.",
)
LISTEN = click.option(
    "--listen", metavar="HOST:PORT", help="Address of the HTTP server [127.0.0.1:8080]."
)
INSECURE = click.option("--insecure", is_flag=True, help="Serve other machines without a token.")
LATENCY = click.option(
    "--latency",
    "latency_s",
    metavar="S",
    type=FiniteRange(0, 60),
    default=0.0,
    help="Seconds between a sample and its arrival, for onboard logs (.bin, .ulg, CSV), which"
    " contain no arrival times.",
)


def say(text: str, err: bool = False) -> None:
    """Print text that may come from a file or the network, with control characters escaped."""
    click.echo(printable(text), err=err)


def print_last(text: str, *, err: bool = False) -> None:
    """Print the last line of a command; wait at most ``LAST_S`` until it is written.

    A pipe that is not read blocks the write: the process then ends without the line (see
    ``threads_abandoned``). Raises ``OSError`` if the output is closed or full.
    """
    failed: list[OSError] = []

    def write() -> None:
        try:
            say(text, err=err)
        except OSError as error:
            failed.append(error)

    try:
        writing = threading.Thread(target=write, name="last-line")
        writing.start()
    except RuntimeError:  # the system allows no more threads
        write()
    else:
        writing.join(LAST_S)
    if failed:
        raise failed[0]


def bearer_token() -> str | None:
    """Return the bearer token of the environment; a file of variables may add a line end to it.

    Raises ``UserError`` if it is not one that HTTP can transmit.
    """
    token = os.environ.get(TOKEN, "").strip()
    if not all(letter.isprintable() and ord(letter) < 256 for letter in token):
        raise UserError(f"{TOKEN}: use ASCII letters, digits and signs")
    return token or None


def print_log_notices(logs: Sequence[Path]) -> None:
    """Print on stderr the vehicle of each onboard log, with the accuracy of its time, and each log
    that is truncated."""
    from companion.recording.reader import vehicles

    print_truncated(logs)
    for one in vehicles(logs):
        say(one.notice(), err=True)


def print_truncated(logs: Sequence[Path]) -> None:
    """Print on stderr each log that ends early."""
    from companion.recording.truncated import truncated

    for log in truncated(logs):
        say(log.notice(), err=True)


JSON_LINES = click.option(
    "--json", "as_json", is_flag=True, help="Print the status as one JSON object per second."
)
JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout.")


def make_folder(out: Path) -> None:
    """Create the output folder first, so that a long command does not fail at its end.

    Folders that were created and are still empty when the command ends are removed.
    """
    from companion.recording import folders

    made = folders.make_folder(out, "--out")

    def single_line() -> None:
        for each in made:
            with suppress(OSError):  # the folder is not empty
                each.rmdir()

    click.get_current_context().call_on_close(single_line)


class InterruptedByUser(Exception):  # noqa: N818 - not an error
    """Ctrl-C or SIGTERM during a command; its text is the user's next step."""


class OneLineErrors(click.Group):
    """Command group that prints a user's mistake as one line on stderr, without the usage text.

    A user's mistake is a ``UserError``, or an ``OSError`` about a file, a port or a disk.
    Any other exception is a defect and ends with its traceback.
    """

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        """Run the command line; see ``click.Command.main``."""
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
            self._end(str(error) or "interrupted", INTERRUPTED)
        except UserError as error:
            self._end(str(error), 1)
        except RuntimeError as error:
            if str(error) != NO_THREADS:
                raise
            self._end("the system allows no more threads; see `ulimit -u`", 1)
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            if error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT) and not where:
                where = "the output cannot be written: "
            self._end(f"{where}{error.strerror or error}", 1)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; catch interrupts before Click, which would print an empty line."""
        try:
            with interrupts_raised():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            raise InterruptedByUser from None

    def _end(self, said: str, status: int) -> NoReturn:
        command_ended()
        line = " ".join(said.split())
        cut = line if len(line) <= ERROR_MAX else f"{line[:ERROR_MAX]}…"
        with suppress(OSError):  # its reader has ended
            print_last(f"{self.name}: {cut}", err=True)
        sys.exit(status)


class Progress:
    """Progress line on stderr that is overwritten; ``show`` prints nothing without a terminal."""

    def __init__(self) -> None:
        self._on = sys.stderr.isatty()
        self._logged_s = time.monotonic()

    def show(self, text: str) -> None:
        """Replace the progress line."""
        if self._on:
            width = shutil.get_terminal_size().columns - 1  # a wrapped line cannot be overwritten
            click.echo(f"\r\033[K{printable(text)[:width]}", nl=False, err=True)

    def log(self, text: str) -> None:
        """Replace the progress line; without a terminal, print a line every ten seconds."""
        if self._on:
            self.show(text)
        elif time.monotonic() - self._logged_s >= LOG_EVERY_S:
            self._logged_s = time.monotonic()
            click.echo(printable(text), err=True)

    def clear(self) -> None:
        """Remove the progress line."""
        self.show("")


def log_progress(progress: Progress, ends_s: float | None) -> Callable[[int, float, float], None]:
    """Return a callback that shows the progress through a log of ``ends_s`` (None: unknown).

    Its arguments are frames, seconds of log, and wall-clock seconds since the start.
    """

    def show(frames: int, at_s: float, wall_s: float) -> None:
        remaining = ""
        if ends_s and at_s > 0:
            remaining = f" of {ends_s:.0f} s, {max(0.0, ends_s / at_s - 1) * wall_s:.0f} s to go"
        progress.log(f"{frames} frames, {at_s:.0f} s of log{remaining}")

    return show
