"""Provenance of a study's answer: the command line and the versions of the programs."""

import platform
import shlex
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any, Final

import companion

PACKAGES: Final = ("numpy",)  # packages that every study uses


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
