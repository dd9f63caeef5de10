"""Packages that are installed by choice, and one line to a user who has not chosen them."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needs(package: str, extra: str, what: str) -> Iterator[None]:
    """Around an import: ``ValueError`` that says what to install where the package is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        install = f"pip install 'uav-companion-beams[{extra}]'"
        raise ValueError(f"{what} needs the package {package}: {install}") from error
