"""Output folders, with one-line errors that name the option."""

import errno
from pathlib import Path
from typing import Final

from companion.values import UserError, shown

RECORDING_MODE: Final = 0o750
DISK_FAULTS: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO})
"""Errors of a full, read-only or broken disk, which are no mistake of the user."""
DIRECTORY_OPTION: Final = "recording.directory (--record)"


def make_recording_folder(where: Path, option: str) -> None:
    """Create the folder of recordings at ``where``, a folder or a file ``.mcap`` in it.

    Raises ``UserError`` as ``make_folder``.
    """
    make_folder(folder_of(where), option, RECORDING_MODE)


def make_service_folder(where: Path) -> None:
    """Create the folder of a service's recordings, unless the disk is full, read-only or broken.

    The recorder tries again. Raises ``UserError`` as ``make_folder``.
    """
    try:
        make_recording_folder(where, DIRECTORY_OPTION)
    except UserError as error:
        if not isinstance(error.__cause__, OSError) or error.__cause__.errno not in DISK_FAULTS:
            raise


def folder_of(where: Path) -> Path:
    """Return the folder of recordings at ``where``, a folder or a file ``.mcap`` in it."""
    return where.parent if where.suffix == ".mcap" and not where.is_dir() else where


def make_folder(folder: Path, option: str, mode: int = 0o777) -> list[Path]:
    """Create a folder and its parents; return those that were created, the innermost first.

    ``option`` is the option or setting that names the folder. Raises ``UserError`` if a file is in
    the way or a folder cannot be created.
    """
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(mode, parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        whole = (folder, *folder.parents)
        file = next((each for each in whole if each.exists() and not each.is_dir()), folder)
        raise UserError(
            f"{option} {shown(str(folder))}: {file} is not a folder; name another one"
        ) from None
    except OSError as error:
        raise UserError(
            f"{option} {shown(str(folder))}: the folder cannot be created ({error.strerror});"
            " name one that can be written"
        ) from error
    return made
