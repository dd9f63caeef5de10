"""BLAS and LAPACK routines for beams, without the rest of scipy.linalg.

``scipy.linalg`` imports all of numpy, including its tests and Fortran wrappers: 27 MB and a quarter
of a second that are not needed in flight. Its compiled modules are independent, and are loaded
alone here; from the public package if they are not found.
"""

from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import find_spec, module_from_spec
from pathlib import PurePath
from typing import Any


def _routines(package: str, compiled: str) -> Any:
    """Load the module ``compiled`` of scipy.linalg, or the public module that exports it."""
    scipy = find_spec("scipy")
    places = (scipy.submodule_search_locations if scipy else None) or ()
    folders = [str(PurePath(place, "linalg")) for place in places]
    spec = PathFinder.find_spec(f"scipy.linalg.{compiled}", folders)
    if spec is None or spec.loader is None:
        return import_module(f"scipy.linalg.{package}")
    found = module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


_blas, _lapack = _routines("blas", "_fblas"), _routines("lapack", "_flapack")
zgemm, zherk = _blas.zgemm, _blas.zherk
zheevd, zposv = _lapack.zheevd, _lapack.zposv
