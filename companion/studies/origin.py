"""What all studies share: logs of flights, command line and versions of an answer, progress."""

import platform
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any, Final

import companion
from companion.settings.model import Settings

Row = dict[str, Any]
Progress = Callable[[str], None]
PACKAGES: Final = ("numpy",)  # packages that every study uses


def silent(_text: str) -> None:
    """Show no progress."""


def by_log(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return rows by their log, in the order of first appearance."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["log"], []).append(row)
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class StudiedLogs:
    """Logs of the flights to study, with the settings of each flight."""

    flights: tuple[tuple[Path, ...], ...]  # the logs, by flight
    settings: tuple[Settings, ...]  # those of each flight
    center: str | None = None  # as on the command line
    config: str | None = None  # as on the command line

    def by_flight(self) -> Iterator[tuple[tuple[Path, ...], Settings]]:
        """Yield the logs and the settings of each flight."""
        return zip(self.flights, self.settings, strict=True)

    def command_line(self, study: str, **options: Any) -> str:
        """Return the command line of a study of these logs."""
        logs = chain.from_iterable(self.flights)
        return command_line(study, *logs, center=self.center, config=self.config, **options)


def command_line(study: str, *arguments: object, **options: Any) -> str:
    """Return the command line of a study, with options in the order given.

    An option without a value (None, False or empty) is left out, True is a flag, and the parts of a
    sequence are joined by commas.
    """
    words = ["companion", "study", study, *map(str, arguments)]
    for name, value in options.items():
        if value is None or value is False or value in ("", ()):
            continue
        words.append(f"--{name.replace('_', '-')}")
        words += [] if value is True else [_written(value)]
    return shlex.join(words)


def _written(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(map(_written, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def versions(packages: Sequence[str] = PACKAGES) -> dict[str, str]:
    """Return the versions of this program, of packages that compute its numbers, and of Python."""
    return {
        "companion": companion.__version__,
        **{name: version(name) for name in packages},
        "python": platform.python_version(),
    }
