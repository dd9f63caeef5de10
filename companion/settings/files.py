"""Reading of settings from a TOML file, and of the files that these settings name."""

import errno
import warnings
from collections.abc import Mapping
from importlib import resources
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from companion.mavlink.links.regular_file import open_regular
from companion.settings.beams import ArraySettings
from companion.settings.invalid import first_error
from companion.settings.model import DESIGN, NAMED_FILES, NamedFile, Settings
from companion.settings.origins import Origin, Origins, given, of_options
from companion.settings.section import ConfigError
from companion.tracking.design.gain_table import KinematicDesign
from companion.values import ComplexArray, FloatArray, UserError
from companion.values.numbers import NPY_ERRORS

DEFAULT_DESIGN: Final = "kinematic_default.json"
LARGEST_BYTES: Final = 1 << 24
"""Largest file that is read, bytes: a codebook of 1024 elements and as many beams."""
TEXT_BYTES: Final = 1 << 21
"""Largest settings, and positions of elements. Parsed, they take 50 times as much memory."""
NAMED_TEXT_BYTES: Final = 1 << 22  # largest other text that the settings name, as a calibration
NUMBERS_MAX: Final = 1 << 22  # most numbers of an array
MATRIX_MAX: Final = 1 << 20  # most numbers of a complex matrix, of which several copies are made


def load(path: Path | None) -> Settings:
    """Read the settings from a TOML file; the defaults if ``path`` is None.

    Raises ``ConfigError``.
    """
    if path is None:
        return Settings()
    try:
        text = read_file(path, TEXT_BYTES).decode("utf-8-sig")  # an editor may begin it with a mark
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not TOML: it is not UTF-8 text") from error
    return embedded(Settings.from_toml(text, str(path)))


def embedded(settings: Settings) -> Settings:
    """Return the settings with the contents of all named files, for a complete recording.

    Raises ``ConfigError`` if a file cannot be read.
    """
    placed = _with_positions(settings)
    read = {file.attachment: _content(placed, file) for file in NAMED_FILES}
    return placed.with_files({name: data for name, data in read.items() if data is not None})


def layered(path: Path | None, options: Mapping[str, dict[str, Any]]) -> tuple[Settings, Origins]:
    """Return the settings of a file, overridden by options, with the origin of each key.

    ``path`` as in ``load``, ``options`` as in ``Settings.override``. Raises ``ConfigError``.
    """
    loaded = load(path)
    origins = {**given(loaded, Origin("file", str(path))), **of_options(options)}
    return loaded.override(**options), origins


def _with_positions(settings: Settings) -> Settings:
    named = settings.array.positions
    if named is None:
        return settings
    rows = [tuple(row) for row in numbers_file("array.positions", named, 3).tolist()]
    given = settings.array.model_dump(mode="json", exclude_unset=True, exclude={"positions"})
    array = {**given, "positions_m": rows}
    try:
        return settings.model_copy(update={"array": ArraySettings.model_validate(array)})
    except ValidationError as error:
        raise ConfigError(
            f"array.positions = {named!r}: {first_error(error, Settings.model_fields)}"
        ) from error


def numbers_file(key: str, name: str, columns: int) -> FloatArray:
    """Read a table of numbers from a .npy file, or from text separated by commas or blanks.

    Returns (n, k) with k >= ``columns``. Raises ``ConfigError`` that names ``key``.
    """
    if name.endswith(".npy"):
        found = _npy(f"{key} = {name!r}", _bytes(key, name, TEXT_BYTES), "fiu")
    else:
        found = _text_file(key, name)
    if found.ndim != 2 or found.shape[1] < columns or not np.isfinite(found).all():
        raise ConfigError(f"{key} = {name!r}: each row must have {columns} or more finite numbers")
    return found.astype(np.float64)


def _text_file(key: str, name: str) -> NDArray[Any]:
    data = _bytes(key, name, TEXT_BYTES)
    try:
        lines = (
            line.split("#")[0].replace(",", " ").split()
            for line in data.decode("utf-8-sig").splitlines()
        )
        return np.array([[float(word) for word in line] for line in lines if line])
    except ValueError as error:
        raise ConfigError(
            f"{key} = {name!r}: not a table of numbers; give rows of numbers"
        ) from error


def _npy(where: str, data: bytes, kinds: str) -> NDArray[Any]:
    """Return the array of a .npy file whose dtype kind is one of the letters in ``kinds``."""
    try:
        with warnings.catch_warnings(action="ignore"):  # of headers that Python 2 wrote
            found = np.lib.format.read_array(BytesIO(data), allow_pickle=False)
    except MemoryError as error:
        raise ConfigError(f"{where}: array is too large for the memory: {error}") from error
    except NPY_ERRORS as error:
        first = str(error).splitlines()[0]
        raise ConfigError(f"{where}: not a .npy file of numbers: {first}") from error
    if found.dtype.kind not in kinds:
        raise ConfigError(f"{where}: unsupported dtype {found.dtype}; save it as numbers")
    if found.size > NUMBERS_MAX:
        raise ConfigError(f"{where}: has {found.size} numbers; the limit is {NUMBERS_MAX}")
    return found


def matrix_of(settings: Settings, file: NamedFile) -> ComplexArray | None:
    """Return the matrix of a .npy file that the settings name; None if they name no file.

    Raises ``ConfigError`` if the file cannot be read or is not a matrix.
    """
    data = _content(settings, file)
    if data is None:
        return None
    where = _where(settings, file)
    found = _npy(where, data, "fciu")
    if found.size > MATRIX_MAX:
        raise ConfigError(f"{where}: has {found.size} numbers; the limit is {MATRIX_MAX}")
    if found.ndim != 2:
        raise ConfigError(f"{where}: not a matrix: shape {found.shape}; save a 2-dimensional array")
    return found.astype(np.complex128)


def text_of(settings: Settings, file: NamedFile) -> str | None:
    """Return the text of a file that the settings name; None if they name no file.

    Raises ``ConfigError`` if the file cannot be read.
    """
    data = _content(settings, file)
    try:
        return None if data is None else data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{_where(settings, file)}: not UTF-8 text") from error


def _content(settings: Settings, file: NamedFile) -> bytes | None:
    """Return a named file's bytes, from the settings or else from disk; None if none is named.

    Raises ``ConfigError``.
    """
    path = _path(settings, file)
    if path is None:
        return None
    held = settings.files.get(file.attachment)
    most = LARGEST_BYTES if file.attachment.endswith(".npy") else NAMED_TEXT_BYTES
    data = _bytes(file.setting, path, most) if held is None else held
    if len(data) > most:
        raise ConfigError(f"{_where(settings, file)}: larger than {most >> 20} MiB")
    return data


def _path(settings: Settings, file: NamedFile) -> str | None:
    path: str | None = getattr(getattr(settings, file.section), file.key)
    return path


def _where(settings: Settings, file: NamedFile) -> str:
    return f"{file.setting} = {_path(settings, file)!r}"


def _bytes(key: str, name: str, most: int = LARGEST_BYTES) -> bytes:
    try:
        return read_file(Path(name), most)
    except OSError as error:
        raise ConfigError(f"{key} = {name!r}: {error.strerror}") from error


def read_file(path: Path, most: int = LARGEST_BYTES) -> bytes:
    """Return the content of a regular file of at most so many bytes. Raises ``OSError``."""
    with open_regular(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"larger than {most >> 20} MiB", str(path))
    return data


def kinematic_design(settings: Settings) -> KinematicDesign:
    """Return the kinematic observer's gains, from the file in the settings or the built-in ones.

    The certificate of the gains is verified. Raises ``ConfigError`` if they are unusable.
    """
    text = text_of(settings, DESIGN)
    if text is None:
        source = resources.files("companion.tracking.design") / DEFAULT_DESIGN
        text = source.read_text(encoding="utf-8")
    try:
        return KinematicDesign.from_json(text)
    except UserError as error:
        raise ConfigError(f"{_where(settings, DESIGN)}: {error}") from error
