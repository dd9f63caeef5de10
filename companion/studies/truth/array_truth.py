"""True directions of UAVs from the array, for logs with the simulator's truth.

SIM_STATE of a UAV gives its position; that of the vehicle that carries the array gives position and
attitude. Only then is a whole pointing bound tested: both positions and the attitude. Without a
SIM_STATE of the carrier, its predicted pose counts as true; study reports state this.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from companion.beams import line_of_sight
from companion.beams.array.geometry import Array
from companion.pipeline.fold import Pipeline
from companion.settings.center import FixedCenter, VehicleCenter
from companion.studies.truth import vehicles
from companion.studies.truth.trajectory import Times
from companion.studies.truth.vehicles import Flight
from companion.tracking.geodesy import LocalFrame
from companion.values import Carrier, FloatArray, Track

SIMULATED: Final = "SIM_STATE"
CARRIER_PREDICTED: Final = "SIM_STATE, carrier as predicted"


@dataclass(frozen=True, slots=True, eq=False)
class CarrierTruth:
    """Trajectory and attitude (ned from body) of the carrier, in seconds after ``from_ns``."""

    flight: Flight
    from_ns: int
    ned_from_body: Slerp


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ArrayTruth:
    """True directions in a log, for the array of a pipeline.

    carrier  the carrier's truth; None: its pose is the predicted one, which is exact for a fixed
             station
    """

    kind: str  # name in reports
    local: LocalFrame  # of the pipeline
    flights: Mapping[str, Flight]  # flights with truth, by UAV
    carrier: CarrierTruth | None

    def directions(self, tracks: Sequence[Track], predicted: Carrier, array: Array) -> FloatArray:
        """Return true unit directions (N, 3), array frame, at the tracks' time; NaN if unknown."""
        found = np.full((len(tracks), 3), np.nan)
        at_ns = np.array([predicted.valid_at_ns])
        carrier = self._carrier(predicted, at_ns)
        for i, track in enumerate(tracks):
            flight = self.flights.get(track.uav)
            if flight is not None:
                placed = replace(track, position_ned_m=flight.truth.at(at_ns)[0][0])
                found[i] = line_of_sight.directions([placed], carrier, array)[1][0]
        return found

    def _carrier(self, predicted: Carrier, at_ns: Times) -> Carrier:
        if self.carrier is None:
            return predicted
        position, body_from_local = self._pose(self.carrier, at_ns)
        return replace(predicted, position_ned_m=position, body_from_local=body_from_local)

    def _pose(self, carrier: CarrierTruth, at_ns: Times) -> tuple[FloatArray, FloatArray]:
        """Return the carrier's true position (3,) and body_from_local (3, 3)."""
        position = carrier.flight.truth.at(at_ns)[0][0]
        spline = carrier.ned_from_body
        at_s = np.clip((at_ns[0] - carrier.from_ns) * 1e-9, spline.times[0], spline.times[-1])
        (lat_deg,), (lon_deg,), _ = self.local.geodetic(position[np.newaxis])
        local_from_body = self.local.local_from_ned(lat_deg, lon_deg) @ spline(at_s).as_matrix()
        return position, local_from_body.T

    def direction(self, uav: str, at_ns: int, array: Array) -> FloatArray | None:
        """Return a UAV's true unit direction (3,), array frame; None if it is unknown."""
        flight = self.flights.get(uav)
        if flight is None or self.carrier is None:
            return None
        at = np.array([at_ns])
        position, body_from_local = self._pose(self.carrier, at)
        lever_m = body_from_local.T @ array.lever_arm_m
        offset_m = flight.truth.at(at)[0][0] - position - lever_m
        if np.isnan(offset_m).any():
            return None
        towards: FloatArray = array.array_from_body @ body_from_local @ offset_m
        return towards / math.sqrt(towards @ towards)


def known_directions(
    truth: ArrayTruth | None, tracks: Sequence[Track], predicted: Carrier, array: Array
) -> dict[str, FloatArray]:
    """Return the true unit directions (3,) that are known, by UAV."""
    if truth is None:
        return {}
    found = truth.directions(tracks, predicted, array)
    return {
        track.uav: towards
        for track, towards in zip(tracks, found, strict=True)
        if not np.isnan(towards).any()
    }


def load(logs: Sequence[Path], pipeline: Pipeline) -> ArrayTruth | None:
    """Return the true directions in a flight's logs, for a pipeline's array; None without truth.

    The pipeline's local frame must exist, which needs at least one report of a vehicle.
    """
    local = pipeline.local
    assert local is not None
    lat_deg, lon_deg, alt_m = local.origin
    flown = vehicles.load(logs, str(FixedCenter(lat_deg=lat_deg, lon_deg=lon_deg, alt_m=alt_m)))
    flights = {flight.uav: flight for flight in flown.flights if flight.truth.kind == SIMULATED}
    if not isinstance(pipeline.center.place, VehicleCenter):
        return (
            ArrayTruth(kind=SIMULATED, local=local, flights=flights, carrier=None)
            if flights
            else None
        )
    own = flights.pop(str(pipeline.center.place), None)
    if not flights:
        return None
    carrier = None if own is None else _carrier_truth(own)
    kind = CARRIER_PREDICTED if carrier is None else SIMULATED
    return ArrayTruth(kind=kind, local=local, flights=flights, carrier=carrier)


def _carrier_truth(flight: Flight) -> CarrierTruth | None:
    """Return the carrier's truth by attitudes of SIM_STATE; None with fewer than two."""
    truth = flight.truth
    if truth.ned_from_body is None:
        return None
    turned = truth.ned_from_body.any(axis=1)
    times_ns = truth.t_ns[turned]
    if len(times_ns) < 2:
        return None
    rotations = Rotation.from_quat(np.roll(truth.ned_from_body[turned], -1, axis=1))
    from_ns = int(times_ns[0])
    return CarrierTruth(flight, from_ns, Slerp((times_ns - from_ns) * 1e-9, rotations))
