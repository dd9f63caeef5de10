"""Output folders, with one-line errors that name the option."""

from pathlib import Path
from typing import Final

from companion.values import UserError, shown

RECORDING_MODE: Final = 0o750
DIRECTORY_OPTION: Final = "recording.directory (--record)"


def make_recording_folder(where: Path, option: str) -> None:
    """Create the folder of recordings at ``where``, a folder or a file ``.mcap`` in it.

    Raises ``UserError`` as ``make_folder``.
    """
    is_file = where.suffix == ".mcap" and not where.is_dir()
    make_folder(where.parent if is_file else where, option, RECORDING_MODE)


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
        ) from None
    return made
