"""Optional packages, and one line to a user who has not installed them."""

from collections.abc import Iterator
from contextlib import contextmanager

from companion.values.errors import UserError


@contextmanager
def needs(package: str, extra: str, what: str) -> Iterator[None]:
    """Wrap an import: raises ``UserError`` that says what to install if the package is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        install = f"pip install 'uav-companion-beams[{extra}]'"
        raise UserError(f"{what} needs the package {package}: {install}") from error
