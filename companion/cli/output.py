"""Files that commands write: complete, or as they were before."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Final

from companion.values import UserError

PARTIAL: Final = ".partial"


def write_file(out: Path, content: bytes | str) -> None:
    """Write a file; text in UTF-8. An earlier one is replaced once all bytes are on the disk.

    Raises ``UserError`` that names the file.
    """
    data = content.encode() if isinstance(content, str) else content
    try:
        if out.exists() and not out.is_file():  # a device or a pipe
            out.write_bytes(data)
        else:
            _replace(out.resolve(), data)
    except OSError as error:
        raise UserError(f"{out}: cannot be written: {error.strerror}") from error


def _replace(out: Path, data: bytes) -> None:
    beside = out.with_name(out.name + PARTIAL)
    try:
        with beside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(out)
    except BaseException:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        raise
