"""What the commands share: user mistakes as one line on stderr, and progress on a terminal."""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click

CONFIG = click.option("--config", type=click.Path(path_type=Path), help="Settings: a TOML file.")
CENTER = click.option(
    "--center",
    metavar="SRC",
    help="What carries the array: SYSID:COMPID, LAT,LON,ALT[,HEADING] or home.",
)
JSON = click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")


class OneLineErrors(click.Group):
    """A group whose user mistakes are one line on stderr, without the usage text."""

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
        except click.ClickException as error:
            click.echo(f"{self.name}: {' '.join(error.format_message().split())}", err=True)
            sys.exit(error.exit_code)
        except click.Abort:
            sys.exit(130)


class Progress:
    """One line on stderr that is written over; nothing where stderr is not a terminal."""

    def __init__(self) -> None:
        self._on = sys.stderr.isatty()

    def show(self, text: str) -> None:
        """Replace the line."""
        if self._on:
            click.echo(f"\r\033[K{text}", nl=False, err=True)

    def clear(self) -> None:
        """Take the line away."""
        self.show("")


class user_errors:  # noqa: N801 - reads as a statement
    """Turns what a user can do wrong into one line on stderr."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if isinstance(error, click.ClickException | None):
            return
        if isinstance(error, OSError):
            where = f"{error.filename}: " if error.filename else ""
            raise click.ClickException(f"{where}{error.strerror or error}") from error
        if type(error).__name__ == "LmiError":  # by name: its module loads the solver
            raise click.ClickException(str(error)) from error
        if isinstance(error, ValueError) and _is_meant_for_users(error):
            raise click.ClickException(str(error)) from error


def _is_meant_for_users(error: ValueError) -> bool:
    """Our own subclasses of ValueError, and plain ones raised by our own checks."""
    return type(error) is ValueError or type(error).__module__.startswith("companion")
