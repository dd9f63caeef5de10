"""Settings read from a TOML file, together with the files that they name."""

import base64
import binascii
import errno
from collections.abc import Mapping
from importlib import resources
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.settings.beams import ArraySettings
from companion.settings.model import Settings
from companion.settings.origins import Origin, Origins, given, of_options
from companion.settings.section import ConfigError
from companion.tracking.design.gain_table import KinematicDesign
from companion.values import ComplexArray, FloatArray, UserError

DEFAULT_DESIGN: Final = "kinematic_default.json"
LARGEST_BYTES: Final = 1 << 24
"""Most bytes of a file that is read: a codebook of 1024 elements and as many beams."""


def load(path: Path | None) -> Settings:
    """Read the settings from a TOML file; the defaults if ``path`` is None.

    Raises ``ConfigError``.
    """
    if path is None:
        return Settings()
    try:
        text = _read(path).decode()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not TOML: it is not UTF-8 text") from error
    return embedded(Settings.from_toml(text, str(path)))


def embedded(settings: Settings) -> Settings:
    """Settings with all files read in that they name, so that a recording of them is complete.

    Raises ``ConfigError`` where one cannot be read.
    """
    placed = _with_coupling(_with_positions(settings))
    return _with_unit(_with_codebook(_with_calibration(_with_design(placed))))


def layered(path: Path | None, options: Mapping[str, dict[str, Any]]) -> tuple[Settings, Origins]:
    """The settings of a file with options over them, and where each comes from.

    ``path`` as in ``load``, ``options`` as the sections of ``Settings.override``. Raises
    ``ConfigError``.
    """
    loaded = load(path)
    origins = {**given(loaded, Origin("file", str(path))), **of_options(options)}
    return loaded.override(**options), origins


def _with_positions(settings: Settings) -> Settings:
    """Settings with the element positions read in."""
    named = settings.array.positions
    if named is None:
        return settings
    rows = [tuple(row) for row in numbers_file("array.positions", named, 3).tolist()]
    given = settings.array.model_dump(mode="json", exclude_unset=True)
    array = {**given, "positions": None, "positions_m": rows}
    return settings.model_copy(update={"array": ArraySettings.model_validate(array)})


def numbers_file(key: str, name: str, columns: int) -> FloatArray:
    """Read a table of numbers from a .npy file, or from text separated by commas or blanks.

    Returns (n, k) with k >= ``columns``. Raises ``ConfigError``, naming ``key``, where it cannot.
    """
    found = _npy_file(key, name, "fiu") if name.endswith(".npy") else _text_file(key, name)
    if found.ndim != 2 or found.shape[1] < columns or not np.isfinite(found).all():
        raise ConfigError(f"{key} = {name!r}: rows of at least {columns} finite numbers are needed")
    rows: FloatArray = found.astype(np.float64)
    return rows


def _text_file(key: str, name: str) -> NDArray[Any]:
    data = _bytes(key, name)
    try:
        lines = (
            line.split("#")[0].replace(",", " ").split() for line in data.decode().splitlines()
        )
        return np.array([[float(word) for word in line] for line in lines if line])
    except ValueError as error:
        raise ConfigError(f"{key} = {name!r}: not a table of numbers: {error}") from error


def _npy_file(key: str, name: str, kinds: str) -> NDArray[Any]:
    """Read the array of a .npy file whose dtype kind is one of the letters in ``kinds``."""
    return _npy(f"{key} = {name!r}", _bytes(key, name), kinds)


def _npy(where: str, data: bytes, kinds: str) -> NDArray[Any]:
    """The array in the bytes of a .npy file; as ``_npy_file``."""
    try:
        found = np.lib.format.read_array(BytesIO(data), allow_pickle=False)
    except (ValueError, MemoryError, TokenError) as error:  # the header is read as Python text
        first = str(error).splitlines()[0]
        raise ConfigError(f"{where}: not a .npy file of numbers: {first}") from error
    if found.dtype.kind not in kinds:
        raise ConfigError(f"{where}: {found.dtype} are not the numbers that are needed")
    return found


def _with_codebook(settings: Settings) -> Settings:
    """Settings with the stored beams read in."""
    name = settings.codebook.file
    if name is None or settings.codebook.stored is not None:
        return settings
    stored = base64.b64encode(_bytes("codebook.file", name)).decode()
    return settings.override(codebook={"stored": stored})


def _with_coupling(settings: Settings) -> Settings:
    """Settings with the coupling matrix read in."""
    name = settings.array.coupling
    if name is None or settings.array.coupling_stored is not None:
        return settings
    stored = base64.b64encode(_bytes("array.coupling", name)).decode()
    return settings.override(array={"coupling_stored": stored})


def coupling_file(settings: Settings) -> ComplexArray | None:
    """The matrix of ``array.coupling_stored``, else of ``array.coupling``; None without.

    Raises ``ConfigError`` if the file cannot be read or is not a matrix.
    """
    kept = _with_coupling(settings).array
    if kept.coupling_stored is None:
        return None
    where = (
        "array.coupling_stored" if kept.coupling is None else f"array.coupling = {kept.coupling!r}"
    )
    return _matrix(where, kept.coupling_stored)


def codebook_file(settings: Settings) -> ComplexArray:
    """The beams of ``codebook.stored``, else of ``codebook.file``: complex (M, K), a column each.

    Raises ``ConfigError`` if the file cannot be read or is not a matrix.
    """
    kept = _with_codebook(settings).codebook
    where = "codebook.stored" if kept.file is None else f"codebook.file = {kept.file!r}"
    return _matrix(where, kept.stored or "")


def _matrix(where: str, stored: str) -> ComplexArray:
    """The matrix in the bytes (base64) of a .npy file. Raises ``ConfigError``."""
    try:
        data = base64.b64decode(stored, validate=True)
    except binascii.Error as error:
        raise ConfigError(f"{where}: not base64: {error}") from error
    found = _npy(where, data, "fciu")
    if found.ndim != 2:
        raise ConfigError(f"{where}: not a matrix, but of shape {found.shape}")
    beams: ComplexArray = found.astype(np.complex128)
    return beams


def _with_calibration(settings: Settings) -> Settings:
    """Settings with the table of the hardware's channels read in."""
    name = settings.hardware.calibration
    if name is None or settings.hardware.calibration_csv is not None:
        return settings
    text = _text("hardware.calibration", name)
    return settings.override(hardware={"calibration_csv": text})


def calibration_text(settings: Settings) -> str | None:
    """The text of the hardware's calibration table; None if the settings name none.

    Raises ``ConfigError`` if it cannot be read.
    """
    return _with_calibration(settings).hardware.calibration_csv


def _with_unit(settings: Settings) -> Settings:
    """Settings with the gains of a unit read in."""
    name = settings.hardware.unit
    if name is None or settings.hardware.unit_toml is not None:
        return settings
    return settings.override(hardware={"unit_toml": _text("hardware.unit", name)})


def unit_text(settings: Settings) -> str | None:
    """The text of a unit's gains; None if the settings name none.

    Raises ``ConfigError`` if it cannot be read.
    """
    return _with_unit(settings).hardware.unit_toml


def _text(key: str, name: str) -> str:
    """The text of a file that a setting names. Raises ``ConfigError``, naming ``key``."""
    try:
        return _bytes(key, name).decode()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{key} = {name!r}: not UTF-8 text") from error


def _bytes(key: str, name: str) -> bytes:
    """The bytes of a file that a setting names. Raises ``ConfigError``, naming ``key``."""
    try:
        return _read(Path(name))
    except OSError as error:
        raise ConfigError(f"{key} = {name!r}: {error.strerror}") from error


def _read(path: Path) -> bytes:
    """The bytes of a file. Raises ``OSError`` where it cannot be read or is too large."""
    with path.open("rb") as file:
        data = file.read(LARGEST_BYTES + 1)
    if len(data) > LARGEST_BYTES:
        raise OSError(errno.EFBIG, f"larger than {LARGEST_BYTES >> 20} MiB")
    return data


def _with_design(settings: Settings) -> Settings:
    """Settings with the observer's gains read in."""
    named = settings.observer.design
    if named is None or settings.observer.design_json is not None:
        return settings
    return settings.override(observer={"design_json": _text("observer.design", named)})


def kinematic_design(settings: Settings) -> KinematicDesign:
    """The gains of the kinematic observer: those named in the settings, or those of the program.

    Their certificate is verified. Raises ``ConfigError`` where they cannot be used.
    """
    given = _with_design(settings).observer
    try:
        if given.design_json is not None:
            return KinematicDesign.from_json(given.design_json)
        source = resources.files("companion.tracking.design") / DEFAULT_DESIGN
        return KinematicDesign.from_json(source.read_text(encoding="utf-8"))
    except UserError as error:
        raise ConfigError(f"observer.design = {given.design!r}: {error}") from error
