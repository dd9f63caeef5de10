"""Files that commands write: complete, or as they were before."""

from pathlib import Path

from companion.mavlink.links.regular_file import replace_file
from companion.values import UserError


def write_file(out: Path, content: bytes | str) -> None:
    """Write a file; text in UTF-8. An earlier one is replaced once all bytes are on the disk.

    Raises ``UserError`` that names the file.
    """
    data = content.encode() if isinstance(content, str) else content
    try:
        if out.exists() and not out.is_file():  # a device or a pipe
            out.write_bytes(data)
        else:
            replace_file(out.resolve(), data)
    except OSError as error:
        raise UserError(f"{out}: cannot be written: {error.strerror}") from error
