"""Accepted reports, as the observer and the tracker receive them."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import ArrayLike

from companion.values import AltitudeDatum, Fix, Report, ReportNoise, Source, vector

MakeFix = Callable[..., Fix]
NOISE = ReportNoise(
    horizontal_m=1.2, vertical_m=0.9, position_m=math.hypot(1.2, 0.9), velocity_mps=0.4
)
"""1.5 m in three dimensions."""


@pytest.fixture(scope="session")
def fix() -> MakeFix:
    """Return ``fix(t_ns, position, velocity=None)``, which arrives ``late_ns`` after its time.

    The sender timeline equals the node timeline; the report's degrees only distinguish
    positions.
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
            t_ns=t_ns + late_ns,
            uav=uav,
            source=Source(1, 1),
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_m=500.0 - position[2],
            alt_datum=AltitudeDatum.MSL,
            relative_alt_m=None,
            velocity_ne_mps=None,
            velocity_down_mps=None,
            heading_deg=None,
            boot_ms=1000,
            tslc_s=None,
        )
        return Fix(
            uav=uav,
            sender_ns=t_ns,
            t_ns=t_ns,
            arrival_ns=t_ns + late_ns,
            position_ned_m=position,
            velocity_ned_mps=velocity,
            noise=noise,
            report=report,
        )

    return make
