"""Files that commands write: complete, or as they were before."""

from pathlib import Path

import click

from companion.mavlink.links.regular_file import replace_file
from companion.values import UserError


def write_file(out: Path, content: bytes | str) -> None:
    """Write a file; text in UTF-8. An earlier one is replaced once all bytes are on the disk.

    Raises ``UserError`` that names the file, also if it is an input of the command.
    """
    require_no_input(out)
    data = content.encode() if isinstance(content, str) else content
    try:
        out = out.resolve()
    except RuntimeError as error:
        raise UserError(f"{out}: cannot be written: it is a loop of symbolic links") from error
    try:
        if out.exists() and not out.is_file():  # a device or a pipe
            out.write_bytes(data)
        else:
            replace_file(out, data)
    except OSError as error:
        raise UserError(f"{out}: cannot be written: {error.strerror}") from error


def require_no_input(out: Path) -> None:
    """Raise ``UserError`` if an output is one of the files that the running command reads."""
    context = click.get_current_context(silent=True)
    given = {} if context is None else context.params
    for name, value in given.items():
        for path in value if isinstance(value, tuple) else (value,):
            if name != "out" and isinstance(path, Path) and _is_same(path, out):
                raise UserError(f"{out}: is also an input of this command; name another file")


def _is_same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:  # one of them does not exist
        return False
