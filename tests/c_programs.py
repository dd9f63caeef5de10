"""Programs in C and C++ of ``examples/c``, built with warnings as errors."""

import shutil
import subprocess
from pathlib import Path

import pytest
from support import HANG_S, ROOT

SOURCES = ROOT / "examples" / "c"
STRICT = ("-O2", "-Wall", "-Wextra", "-Werror")


def built(folder: Path, compiler: str, standard: str, source: str | Path) -> Path:
    """Return the program built from an example, or from a file that includes its headers."""
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} on this machine")
    out = folder / Path(source).stem
    command = [compiler, standard, *STRICT, f"-I{SOURCES}", "-o", out, SOURCES / source]
    subprocess.run(command, check=True, timeout=HANG_S)
    return out
