"""Settings read from a TOML file, together with the files that they name."""

from collections.abc import Mapping
from importlib import resources
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


def load(path: Path | None) -> Settings:
    """Read the settings from a TOML file; the defaults if ``path`` is None.

    Raises ``ConfigError``.
    """
    if path is None:
        return Settings()
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not TOML: it is not UTF-8 text") from error
    return _with_design(_with_positions(Settings.from_toml(text, str(path))))


def layered(path: Path | None, options: Mapping[str, dict[str, Any]]) -> tuple[Settings, Origins]:
    """The settings of a file with options over them, and where each comes from.

    ``path`` as in ``load``, ``options`` as the sections of ``Settings.override``. Raises
    ``ConfigError``.
    """
    loaded = load(path)
    origins = {**given(loaded, Origin("file", str(path))), **of_options(options)}
    return loaded.override(**options), origins


def _with_positions(settings: Settings) -> Settings:
    """Settings with the element positions read in, so that a recording of them is complete."""
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
    try:
        text = Path(name).read_text(encoding="utf-8")
        lines = (line.split("#")[0].replace(",", " ").split() for line in text.splitlines())
        return np.array([[float(word) for word in line] for line in lines if line])
    except OSError as error:
        raise ConfigError(f"{key} = {name!r}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{key} = {name!r}: not a table of numbers: {error}") from error


def _npy_file(key: str, name: str, kinds: str) -> NDArray[Any]:
    """Read the array of a .npy file whose dtype kind is one of the letters in ``kinds``."""
    try:
        with Path(name).open("rb") as file:
            found = np.lib.format.read_array(file, allow_pickle=False)
    except OSError as error:
        raise ConfigError(f"{key} = {name!r}: {error.strerror or error}") from error
    except (ValueError, MemoryError, TokenError) as error:  # the header is read as Python text
        first = str(error).splitlines()[0]
        raise ConfigError(f"{key} = {name!r}: not a .npy file of numbers: {first}") from error
    if found.dtype.kind not in kinds:
        raise ConfigError(f"{key} = {name!r}: {found.dtype} are not the numbers that are needed")
    return found


def codebook_file(settings: Settings) -> ComplexArray:
    """Read the beams of ``codebook.file``, complex (M, K), one beam per column.

    Raises ``ConfigError`` if the file cannot be read or is not a matrix.
    """
    name = settings.codebook.file or ""
    found = _npy_file("codebook.file", name, "fciu")
    if found.ndim != 2:
        raise ConfigError(f"codebook.file = {name!r}: not a matrix, but of shape {found.shape}")
    beams: ComplexArray = found.astype(np.complex128)
    return beams


def calibration_text(settings: Settings) -> str | None:
    """The text of the hardware's calibration table; None if the settings name none.

    Raises ``ConfigError`` if it cannot be read.
    """
    name = settings.hardware.calibration
    if name is None:
        return None
    try:
        return Path(name).read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"hardware.calibration = {name!r}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"hardware.calibration = {name!r}: not UTF-8 text") from error


def _with_design(settings: Settings) -> Settings:
    """Settings with the observer's gains read in, so that a recording of them is complete."""
    named = settings.observer.design
    if named is None:
        return settings
    try:
        text = Path(named).read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"observer.design = {named!r}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"observer.design = {named!r}: not UTF-8 text") from error
    return settings.override(observer={"design_json": text})


def kinematic_design(settings: Settings) -> KinematicDesign:
    """The gains of the kinematic observer: those named in the settings, or those of the program.

    Their certificate is verified. Raises ``ConfigError`` where they cannot be used.
    """
    given = _with_design(settings).observer if settings.observer.design_json is None else None
    given = given or settings.observer
    try:
        if given.design_json is not None:
            return KinematicDesign.from_json(given.design_json)
        source = resources.files("companion.tracking.design") / DEFAULT_DESIGN
        return KinematicDesign.from_json(source.read_text(encoding="utf-8"))
    except UserError as error:
        raise ConfigError(f"observer.design = {given.design!r}: {error}") from error
