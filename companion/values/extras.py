"""Optional packages, and the one-line error if such a package is not installed."""

from collections.abc import Iterator
from contextlib import contextmanager

from companion.values.errors import UserError


@contextmanager
def needs(package: str, extra: str, what: str) -> Iterator[None]:
    """Guard an import: raise ``UserError`` with the install command if a package is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        install = f"pip install 'uav-companion-beams[{extra}]'"
        raise UserError(f"{what} needs the package {package}: {install}") from error
