"""The routines of BLAS and LAPACK that beams take, without all else that is scipy.linalg.

``scipy.linalg`` asks numpy for everything it has, down to its tests and its Fortran wrappers: 27 MB
and a quarter of a second for what nobody uses in flight. What it hands on are compiled modules,
which stand for themselves. They are loaded alone; by the package where it keeps them otherwise.
"""

from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import find_spec, module_from_spec
from pathlib import PurePath
from typing import Any


def _routines(package: str, compiled: str) -> Any:
    """The module ``compiled`` below scipy.linalg, or the public one that hands it on."""
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
zgemm, zherk, zposv = _blas.zgemm, _blas.zherk, _lapack.zposv
