"""Rates and their confidence intervals, against hand calculations."""

from typing import Any

import numpy as np
import pytest

from companion.studies.link.blocks import BlockErrors
from companion.studies.link.rows import crossing_db, interval, row


def test_wilson_intervals_match_hand_computed_values() -> None:
    """Wilson intervals by hand; wider if clusters differ; never of zero width."""
    even = np.full(10, 20.0)
    assert interval(np.full(10, 0.0), even, 200.0) == pytest.approx((0.0, 0.018845), abs=1e-5)
    assert interval(np.array([30.0]), np.array([100.0]), 100.0) == pytest.approx(
        (0.21895, 0.39585), abs=1e-4
    )
    alike = interval(np.tile([1.0, 3.0], 5), even, 200.0)
    apart = interval(np.array([20.0, *[0.0] * 9]), even, 200.0)
    assert alike[0] < 0.1 < alike[1]
    assert apart[1] - apart[0] > 3 * (alike[1] - alike[0])
    assert interval(even, even, 200.0)[1] == 1.0


def test_result_row_matches_hand_computed_values() -> None:
    """Two instants of one UAV and two blocks each."""
    counted = [
        BlockErrors(np.array([[0, 9]]), np.array([[0, 3]]), np.array([[0.01, 0.04]])),
        BlockErrors(np.array([[1, 0]]), np.array([[0, 0]]), np.array([[0.04, 0.04]])),
    ]
    plain, coded = (row("held", 3.0, how, counted, 6.4e-6) for how in (False, True))
    assert (plain["ber"], plain["bler"], plain["n_bits"]) == (10 / 3744, 0.5, 3744)
    assert (coded["ber"], coded["bler"], coded["n_bits"]) == (3 / 1224, 0.25, 1224)
    assert plain["evm_percent"] == coded["evm_percent"] == pytest.approx(20.0)
    assert plain["rate_bps"] == pytest.approx(0.5 * 936 / 6.4e-6)
    assert coded["rate_bps"] == pytest.approx(0.75 * 306 / 6.4e-6)


def test_crossing_snr_is_interpolated() -> None:
    def curve(*rates: float) -> list[dict[str, Any]]:
        return [{"positions": "held", "coded": True, "snr_db": 2.0 * i, "ber": rate,
                 "n_bits": 10_000} for i, rate in enumerate(rates)]  # fmt: skip

    assert crossing_db(curve(0.1, 1e-2, 1e-4), "held", True, 1e-3) == pytest.approx(3.0)
    assert crossing_db(curve(0.1, 1e-5, 1e-2, 1e-4), "held", True, 1e-3) == pytest.approx(5.0)
    assert crossing_db(curve(0.1, 1e-2, 0.0), "held", True, 1e-3) == pytest.approx(3.0)
    assert crossing_db(curve(0.1, 0.1), "held", True, 1e-3) is None
    assert crossing_db(curve(1e-4, 1e-5), "held", True, 1e-3) is None
