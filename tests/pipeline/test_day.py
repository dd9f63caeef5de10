"""One day of changing traffic in virtual time: departed aircraft use no memory."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import pytest
from changing_sky import flown

GROWS_MB = 4.0
"""Largest growth in the second half of a day, or of a shorter time, with 500 aircraft seen."""
CLOCKS_MAX = 100
"""Largest number of clocks kept for them."""


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_memory_does_not_grow_over_a_day(table: Any) -> None:
    """Runs in its own process; here, memory freed by other tests would be filled first."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
        found, clocks = alone.submit(flown, 24).result()
    print("MB by the hour:", *(f"{mb:.1f}" for mb in found))
    grown_mb = found[-1] - found[11]
    table.add("memory after 24 h of a changing sky", found[-1], "MB", "flat")
    table.add("of that, since hour 12", grown_mb, "MB", f"< {GROWS_MB:g} MB")
    assert len(found) == 24
    assert clocks < CLOCKS_MAX
    assert grown_mb < GROWS_MB
