"""Separately loaded BLAS and LAPACK routines are those of scipy, wherever scipy keeps them."""

import numpy as np
import scipy.linalg.blas
import scipy.linalg.lapack

from companion.beams.weights import lapack


def test_loaded_routines_match_scipy() -> None:
    rng = np.random.default_rng(1)
    a = rng.normal(size=(8, 3)) + 1j * rng.normal(size=(8, 3))
    gram = lapack.zherk(1.0, a.T)
    np.testing.assert_array_equal(gram, scipy.linalg.blas.zherk(1.0, a.T))
    ours, theirs = (
        each.zposv(gram, np.asfortranarray(np.eye(3, dtype=complex)))
        for each in (lapack, scipy.linalg.lapack)
    )
    assert ours[2] == theirs[2] == 0
    np.testing.assert_array_equal(ours[1], theirs[1])
    np.testing.assert_allclose(lapack.zgemm(1.0, a, ours[1]), a @ ours[1])


def test_routines_fall_back_to_the_scipy_modules() -> None:
    assert lapack._routines("blas", "_kept_elsewhere") is scipy.linalg.blas
    assert lapack._routines("lapack", "_kept_elsewhere") is scipy.linalg.lapack
