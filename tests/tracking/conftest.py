"""Reports, accepted, as the observer and the fleet take them."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import ArrayLike

from companion.values import AltitudeDatum, Fix, Report, Source

MakeFix = Callable[..., Fix]


@pytest.fixture(scope="session")
def fix() -> MakeFix:
    """``fix(t_ns, position, velocity=None)``: arrived ``late_ns`` after it was true."""

    def make(
        t_ns: int,
        position_ned_m: ArrayLike,
        velocity_ned_mps: ArrayLike | None = None,
        *,
        uav: str = "1:1",
        late_ns: int = 0,
    ) -> Fix:
        report = Report(
            t_ns + late_ns, "udp", uav, Source(1, 1), 47.0, 8.0, 500.0, AltitudeDatum.MSL, None,
            None, None, None, 1000, None,
        )  # fmt: skip
        velocity = None if velocity_ned_mps is None else np.array(velocity_ned_mps, dtype=float)
        position = np.array(position_ned_m, dtype=float)
        return Fix(uav, t_ns, t_ns, t_ns + late_ns, position, velocity, report)

    return make
