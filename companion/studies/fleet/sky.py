"""Simulated UAVs on circles over a grid of nodes: positions, reports, the nodes' offers."""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import common

from companion.pipeline.fleet.assignment import STEP_DB
from companion.values import FloatArray, Offer, Source

SNR_AT_1_KM_DB: Final = 20.0
GAIN_DB: Final = 18.0
NEAREST_M: Final = 50.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sky:
    """Parameters of the scenario: UAVs, nodes and their network."""

    nodes: int
    uavs: int
    spacing_m: float = 1500.0  # between neighbouring nodes, on a square grid
    reach_m: float = 2500.0  # range within which a node receives and can serve a UAV
    report_hz: float = 10.0  # report rate of a UAV
    sampled: int = 50  # UAVs with simulated reports; traffic is scaled to all UAVs
    delay_s: float = 0.02  # one-way latency between two nodes
    loss: float = 0.0  # share of lost messages, 0 to 1
    seed: int = 1


class SkySimulation:
    """Positions of the UAVs over time; times are seconds since the start.

    ``names`` are the nodes, ``uavs`` the UAVs, ``places_m`` (nodes, 2) the positions of the nodes.
    """

    def __init__(self, sky: Sky, random: np.random.Generator) -> None:
        self.names = [f"n{number:03d}" for number in range(sky.nodes)]
        self.uavs = [f"{1 + number // 250}:{1 + number % 250}" for number in range(sky.uavs)]
        self._reach_m = sky.reach_m
        side = math.ceil(math.sqrt(sky.nodes))
        grid = [(number // side, number % side) for number in range(sky.nodes)]
        self.places_m = sky.spacing_m * np.array(grid, dtype=float)
        size_m = side * sky.spacing_m
        self._centres_m = random.uniform(-0.3 * sky.spacing_m, size_m, (sky.uavs, 2))
        self._radii_m = random.uniform(50, 600, sky.uavs)
        self._speeds_mps = random.uniform(5, 25, sky.uavs)
        self._phases = random.uniform(0, 2 * np.pi, sky.uavs)
        self._mavs: dict[str, Any] = {}

    def ranges_m(self, t_s: float) -> FloatArray:
        """Return the distances (nodes, UAVs) at a time, metres."""
        angles = self._phases + self._speeds_mps / self._radii_m * t_s
        around = np.column_stack([np.cos(angles), np.sin(angles)])
        positions_m = self._centres_m + self._radii_m[:, np.newaxis] * around
        apart_m = self.places_m[:, np.newaxis] - positions_m[np.newaxis]
        found: FloatArray = np.hypot(apart_m[..., 0], apart_m[..., 1])
        return found

    def offers(self, ranges_m: FloatArray) -> dict[str, Offer]:
        """Return a node's offers to the UAVs within its reach, from distances (UAVs,)."""
        found = {}
        for i in np.flatnonzero(ranges_m < self._reach_m).tolist():
            loss_db = 20 * math.log10(max(float(ranges_m[i]), NEAREST_M) / 1000)
            sinr_db = round((SNR_AT_1_KM_DB - loss_db) / STEP_DB) * STEP_DB
            found[self.uavs[i]] = Offer(
                uav=self.uavs[i], sure_db=GAIN_DB, likely_db=GAIN_DB, sinr_db=sinr_db, heard_s=0.1
            )
        return found

    def report(self, uav: str, boot_ms: int) -> bytes:
        """Encode a report of a UAV; only its stamp varies."""
        sysid, compid = Source.parse(uav)
        mav = self._mavs.setdefault(uav, common.MAVLink(None, sysid, compid))
        message = common.MAVLink_global_position_int_message(
            time_boot_ms=boot_ms,
            lat=473977000,
            lon=85456000,
            alt=500000,
            relative_alt=50000,
            vx=100,
            vy=100,
            vz=10,
            hdg=9000,
        )
        packed: bytes = message.pack(mav)
        return packed
