"""Optional packages, and the one-line error if such a package does not load."""

from collections.abc import Iterator
from contextlib import contextmanager

from companion.values.errors import UserError, text_of


@contextmanager
def needs(package: str, extra: str, what: str, library: str | None = None) -> Iterator[None]:
    """Guard an import: raise ``UserError`` if a package is missing or does not load.

    The error of a missing package is the install command. ``library`` is a system library without
    which the package does not load.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise  # the user's Ctrl-C
    except BaseException as error:
        if isinstance(error, ModuleNotFoundError) and error.name == package:
            install = f"pip install 'uav-companion-beams[{extra}]'"
            raise UserError(f"{what} needs the package {package}: {install}") from error
        may_be_missing = library is not None and isinstance(error, OSError | AttributeError)
        raise UserError(
            f"{what} needs the package {package}, which does not load:"
            f" {text_of(error)}" + (f"; is {library} installed?" if may_be_missing else "")
        ) from error
