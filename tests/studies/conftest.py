"""Flights made up for the studies' tests."""

from collections.abc import Callable

import numpy as np
import pytest

from companion.studies.truth.trajectory import Trajectory
from companion.studies.truth.vehicles import Flight

MakeFlight = Callable[..., Flight]
EPOCH_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="session")
def straight_flight() -> MakeFlight:
    """``straight_flight(n, uav=...)``: 10 Hz, 12 m/s, 30 m up; each report 5 ms on its way."""

    def make(n: int = 600, uav: str = "1:1", height_m: float = 30.0) -> Flight:
        boot_ms = 5000 + 100 * np.arange(n)
        made_ns = EPOCH_NS + boot_ms * 1_000_000
        velocity = np.tile([12.0, -3.0, 0.5], (n, 1))
        position = np.array([200.0, 50.0, -height_m]) + velocity * (boot_ms[:, None] * 1e-3)
        truth = Trajectory("SIM_STATE", made_ns, position, velocity)
        return Flight(
            uav, made_ns + 5_000_000, boot_ms, position, velocity, np.full(n, height_m),
            (None,) * n, truth, made_ns,
        )  # fmt: skip

    return make
