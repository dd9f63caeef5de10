"""Reports, accepted, as the observer and the tracker take them."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import ArrayLike

from companion.values import AltitudeDatum, Fix, Report, ReportNoise, Source, vector

MakeFix = Callable[..., Fix]
NOISE = ReportNoise(1.2, 0.9, math.hypot(1.2, 0.9), 0.4)
"""1.5 m in space."""


@pytest.fixture(scope="session")
def fix() -> MakeFix:
    """``fix(t_ns, position, velocity=None)``: arrived ``late_ns`` after it was true.

    The sender's timeline is the node's; the report's degrees tell positions apart, no more.
    """

    def make(
        t_ns: int,
        position_ned_m: ArrayLike,
        velocity_ned_mps: ArrayLike | None = None,
        *,
        uav: str = "1:1",
        late_ns: int = 0,
        noise: ReportNoise = NOISE,
    ) -> Fix:
        velocity = velocity_ned_mps
        if velocity is not None:
            velocity = vector(np.array(velocity, dtype=float))
        position = vector(np.array(position_ned_m, dtype=float))
        lat_deg, lon_deg = 47.0 + position[0] * 9e-6, 8.0 + position[1] * 13e-6
        report = Report(
            t_ns + late_ns, uav, Source(1, 1), lat_deg, lon_deg, 500.0 - position[2],
            AltitudeDatum.MSL, None, None, None, None, 1000, None,
        )  # fmt: skip
        return Fix(uav, t_ns, t_ns, t_ns + late_ns, position, velocity, noise, report)

    return make
