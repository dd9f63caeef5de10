"""Synthetic flights for tests of the studies."""

import struct
from collections.abc import Callable

import numpy as np
import pytest

from companion.mavlink.wire.encode import Outgoing, pack
from companion.studies.truth.trajectory import Trajectory
from companion.studies.truth.vehicles import Flight
from companion.tracking.geodesy import LocalFrame
from companion.values import Frame, Source

MakeFlight = Callable[..., Flight]
EPOCH_NS = 1_700_000_000_000_000_000
ORIGIN = (47.4, 8.5, 400.0)


def frames(uav: str, arrival_ns: np.ndarray, flight: tuple[np.ndarray, ...]) -> tuple[Frame, ...]:
    """GLOBAL_POSITION_INT at the given boot times (ms), positions and velocities, local frame."""
    local, source, found = LocalFrame(*ORIGIN), Source.parse(uav), []
    for seq, (came_ns, boot_ms, where, moves) in enumerate(
        zip(arrival_ns.tolist(), *(column.tolist() for column in flight), strict=True)
    ):
        place = local.place(*where)
        to_ned = local.local_from_ned(place.lat_deg, place.lon_deg).T
        fields = [boot_ms, *(round(angle * 1e7) for angle in place[:2])]
        fields += [round(place.alt_m * 1e3), round(-where[2] * 1e3)]
        fields += [round(each * 1e2) for each in (to_ned @ moves).tolist()]
        payload = struct.pack("<IiiiihhhH", *fields, 65535)
        raw = pack(Outgoing(source, 33, payload), seq % 256)
        found.append(Frame(t_ns=came_ns, link="test", source=source, msgid=33, raw=raw))
    return tuple(found)


@pytest.fixture(scope="session")
def straight_flight() -> MakeFlight:
    """``straight_flight(n, uav=...)``: 10 Hz, 12 m/s, 30 m high; each report takes 5 ms to
    arrive."""

    def make(n: int = 600, uav: str = "1:1", height_m: float = 30.0) -> Flight:
        boot_ms = 5000 + 100 * np.arange(n)
        made_ns = EPOCH_NS + boot_ms * 1_000_000
        velocity = np.tile([12.0, -3.0, 0.5], (n, 1))
        position = np.array([200.0, 50.0, -height_m]) + velocity * (boot_ms[:, None] * 1e-3)
        truth = Trajectory(
            kind="SIM_STATE", t_ns=made_ns, position_ned_m=position, velocity_ned_mps=velocity
        )
        return Flight(
            uav=uav,
            arrival_ns=made_ns + 5_000_000,
            boot_ms=boot_ms,
            position_ned_m=position,
            velocity_ned_mps=velocity,
            height_m=np.full(n, height_m),
            gnss=(None,) * n,
            truth=truth,
            made_ns=made_ns,
            frames=frames(uav, made_ns + 5_000_000, (boot_ms, position, velocity)),
            report_at=np.arange(n),
        )

    return make
