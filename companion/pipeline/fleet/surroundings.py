"""Surroundings of a node: position and range of its array, and unconfirmed vehicles."""

import math
from typing import Final

from companion.pipeline.fleet.member import FleetMember
from companion.pipeline.fleet.nearness import Place
from companion.pipeline.fleet.trust import Witness
from companion.pipeline.fold import Pipeline
from companion.values import Carrier, Notice, Vector, kind_of

RECENT_S: Final = 5.0
"""Largest age of a vehicle's last report at which it counts for this node's range, seconds."""


class Surroundings:
    """UAVs and carrier of one node's pipeline, as its fleet logic needs them."""

    def __init__(self, pipeline: Pipeline, member: FleetMember) -> None:
        self._pipeline = pipeline
        self._member = member

    def place(self) -> Place | None:
        """Return latitude, longitude and height of this node's array; None if they are unknown."""
        carrier, local = self._pipeline.last_carrier, self._pipeline.local
        if carrier is None or local is None:
            return None
        place = local.place(*carrier.position_ned_m.tolist())
        return place.lat_deg, place.lon_deg, place.alt_m

    def reach_m(self, now_ns: int) -> float | None:
        """Return the distance of the farthest vehicle that this node receives; None without any."""
        carrier = self._pipeline.last_carrier
        return None if carrier is None else self._reach_m(carrier, self._positions(), now_ns)

    def _reach_m(self, carrier: Carrier, positions: dict[str, Vector], now_ns: int) -> float | None:
        here, hearing = carrier.position_ned_m.tolist(), self._member.reception
        away_m = [
            math.dist(here, position)
            for uav, position in positions.items()
            if (silent_s := hearing.silent_s(uav, now_ns)) is not None and silent_s < RECENT_S
        ]
        return max(away_m, default=None)

    def phantoms(self, now_ns: int) -> list[Notice]:
        """Check vehicles that only one other node receives against those that should."""
        local, carrier = self._pipeline.local, self._pipeline.last_carrier
        if local is None or carrier is None:
            return []
        positions, hearing = self._positions(), self._member.reception
        heard = frozenset(u for u in positions if hearing.silent_s(u, now_ns) is not None)
        north, east, down = carrier.position_ned_m.tolist()
        own = Witness((north, east, down), self._reach_m(carrier, positions, now_ns) or 0.0, heard)

        def to_local(place: Place) -> Vector:
            return local.localise(*place, None)[0]

        return self._member.check_vehicles(now_ns, positions, own, to_local)

    def _positions(self) -> dict[str, Vector]:
        """Return the newest position of every vehicle that reports itself, in the local frame."""
        tracker = self._pipeline.tracker
        names = [uav for uav in tracker.uavs if kind_of(uav).reports_itself]
        found = ((name, tracker.newest(name)) for name in names)
        return {uav: newest.position_ned_m for uav, newest in found if newest is not None}
