"""The beams as a picture in space, for the 3D panel of a viewer.

Viewers want z upwards, so the frames are (REP 103 of ROS): ``map``, east-north-up at the origin of
the local frame, child of ``wgs84``, the Earth's own; ``carrier``, forward-left-up, child of
``map``; ``array``, x along boresight, y to the left, z upwards, child of ``carrier``. The local
frame is north-east-down and the body and array frames are forward-right-down: half a turn about x
leads from those to these.

What is drawn lives for some updates of the scene and then disappears by itself, such as the beam of
a UAV that is lost.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from companion.beams import line_of_sight
from companion.beams.aim import directions
from companion.beams.array.geometry import Array
from companion.recording import schemas
from companion.recording.codec import FRAME_ID, timestamp
from companion.tracking.geodesy import LocalFrame, ned_from_ecef
from companion.values import Beam, Carrier, FloatArray, Track, TrackState, Update

MAP: Final = "map"
CARRIER: Final = "carrier"
ARRAY: Final = "array"
LIFETIMES: Final = 3
"""Periods of the scene for which a drawn thing stays."""
WIDEST_RAD: Final = math.pi / 3
"""Widest cone that is drawn: that of a line of elements would be open to one side."""
HALF_POWER: Final = 0.886
"""Full width at half power of a uniform aperture, in wavelengths per aperture.

Van Trees, Optimum Array Processing, 2.4: 0.891 for ten elements and 0.886 in the limit.
"""

_UP: Final = np.diag([1.0, -1.0, -1.0])  # forward-left-up from forward-right-down, and back
ENU_FROM_NED: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
COLOURS: Final = {
    TrackState.LIVE: (0.1, 0.8, 0.4),
    TrackState.COASTING: (1.0, 0.7, 0.1),
    TrackState.STALE: (0.9, 0.3, 0.2),
    TrackState.LOST: (0.5, 0.5, 0.5),
}


@dataclass(frozen=True, slots=True)
class Scene:
    """Draws updates for an array, ``rate_hz`` times a second (> 0)."""

    array: Array
    rate_hz: float

    def transforms(self, update: Update) -> list[Any]:
        """``foxglove.FrameTransform``: the carrier in the map, and the array on it.

        Empty while the carrier's place is not known.
        """
        carrier = update.carrier
        if carrier is None:
            return []
        at = timestamp(update.t_ns)
        turned = _map_from_carrier(carrier)
        on_carrier = _UP @ self.array.array_from_body.T @ _UP
        return [
            _transform(at, MAP, CARRIER, ENU_FROM_NED @ carrier.position_ned_m, turned),
            _transform(at, CARRIER, ARRAY, _UP @ self.array.lever_arm_m, on_carrier),
        ]

    def origin(self, t_ns: int, lat_deg: float, lon_deg: float, alt_m: float) -> Any:
        """``foxglove.FrameTransform``: where the map's origin stands on the Earth, and how.

        Degrees and metres; the parent is the Earth's own frame (EPSG 4978), in which heights above
        the sea are taken for heights above the ellipsoid, as everywhere here.
        """
        stands = LocalFrame(lat_deg, lon_deg, alt_m).origin_ecef_m
        ecef_from_map = (ENU_FROM_NED @ ned_from_ecef(lat_deg, lon_deg)).T
        return _transform(timestamp(t_ns), FRAME_ID, MAP, stands, ecef_from_map)

    def picture(self, update: Update) -> Any:
        """``foxglove.SceneUpdate``: an entity for each UAV (place and bound) and for each beam."""
        states = {track.uav: track.state for track in update.tracks}
        entities = [self._uav(track, update.t_ns) for track in update.tracks]
        if update.carrier is not None and update.beams.beams:
            towards = directions(update.beams)
            for beam, direction in zip(update.beams.beams, towards, strict=True):
                entities.append(
                    self._beam(beam, direction, update.carrier, states[beam.uav], update.t_ns)
                )
        return schemas.SceneUpdateMessage(entities=entities)

    def _uav(self, track: Track, t_ns: int) -> Any:
        """A name, a point, and the upright cylinder that holds the UAV, where it is finite."""
        place = ENU_FROM_NED @ track.position_ned_m
        colour = COLOURS[track.state]
        entity = self._entity(f"uav {track.uav}", t_ns)
        entity.texts.add(
            pose=_pose(place), billboard=True, font_size=14, scale_invariant=True,
            color=_colour(colour, 1.0), text=f"{track.uav} {track.state}",
        )  # fmt: skip
        entity.spheres.add(pose=_pose(place), size=_vector([2.0] * 3), color=_colour(colour, 1.0))
        if math.isfinite(track.bound_m):
            width_m, height_m = 2 * track.horizontal_bound_m, 2 * track.vertical_bound_m
            entity.cylinders.add(
                pose=_pose(place), size=_vector([width_m, width_m, height_m]),
                bottom_scale=1, top_scale=1, color=_colour(colour, 0.25),
            )  # fmt: skip
        return entity

    def _beam(
        self, beam: Beam, direction: FloatArray, carrier: Carrier, state: TrackState, t_ns: int
    ) -> Any:
        """A cone from the array to the range of its UAV, as wide as the beam at half power."""
        map_from_array = ENU_FROM_NED @ carrier.body_from_local.T @ self.array.array_from_body.T
        begin = ENU_FROM_NED @ line_of_sight.place_ned_m(carrier, self.array)
        along, right, down = (map_from_array @ axis for axis in _axes(direction))
        widths = [2 * beam.range_m * math.tan(angle / 2) for angle in self.widths_rad(direction)]
        colour = COLOURS[state]
        entity = self._entity(f"beam {beam.uav}", t_ns)
        entity.cylinders.add(
            pose=_pose(begin + along * beam.range_m / 2, np.array([right, down, along]).T),
            size=_vector([*widths, beam.range_m]),
            bottom_scale=0, top_scale=1, color=_colour(colour, 0.2),
        )  # fmt: skip
        line = entity.lines.add(thickness=2, scale_invariant=True, color=_colour(colour, 0.8))
        for point in (begin, begin + along * beam.range_m):
            line.points.add(x=point[0], y=point[1], z=point[2])
        return entity

    def widths_rad(self, direction: FloatArray) -> tuple[float, float]:
        """Approximate full widths at half power across a unit direction (3,) of the array frame.

        Horizontally and vertically in that frame: the widths of a uniform aperture of the extent
        seen from there, at most ``WIDEST_RAD``. They are for drawing; ``patterns`` has the exact
        ones.
        """
        array = self.array
        least_m = array.wavelength_m / 2
        _, right, down = _axes(direction)
        extents = (np.ptp(array.elements_m @ axis) + least_m for axis in (right, down))
        right_rad, down_rad = (
            min(WIDEST_RAD, HALF_POWER * array.wavelength_m / float(extent)) for extent in extents
        )
        return right_rad, down_rad

    def _entity(self, name: str, t_ns: int) -> Any:
        lifetime_ns = int(LIFETIMES * 1e9 / self.rate_hz)
        return schemas.SceneEntityMessage(
            timestamp=timestamp(t_ns),
            frame_id=MAP,
            id=name,
            lifetime=timestamp(lifetime_ns),
        )


def _axes(direction: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A direction of the array frame, and right and down across it: an orthonormal triple."""
    right = np.array([-direction[1], direction[0], 0.0])
    length = float(np.linalg.norm(right))
    right = right / length if length > 1e-9 else np.array([0.0, 1.0, 0.0])  # straight up or down
    return direction, right, np.cross(direction, right)


def _map_from_carrier(carrier: Carrier) -> FloatArray:
    turned: FloatArray = ENU_FROM_NED @ carrier.body_from_local.T @ _UP
    return turned


def _transform(at: Any, parent: str, child: str, place: FloatArray, turned: FloatArray) -> Any:
    return schemas.FrameTransformMessage(
        timestamp=at,
        parent_frame_id=parent,
        child_frame_id=child,
        translation=_vector(place),
        rotation=_quaternion(turned),
    )


def _pose(place: FloatArray, turned: FloatArray | None = None) -> dict[str, Any]:
    rotation = {"w": 1.0} if turned is None else _quaternion(turned)
    return {"position": _vector(place), "orientation": rotation}


def _vector(xyz: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, xyz), strict=True))


def _quaternion(turned: FloatArray) -> dict[str, float]:
    """The quaternion of a rotation matrix, parent from child.

    Found by its largest part (Shepperd 1978): the others are divided by it, so it must not be
    small.
    """
    trace = float(np.trace(turned))
    squares = [*(1 + 2 * float(turned[i, i]) - trace for i in range(3)), 1 + trace]
    m = turned.tolist()
    largest = max(range(4), key=squares.__getitem__)
    minus = (m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1])
    if largest == 3:
        parts = [*minus, squares[3]]
    else:
        parts = [m[largest][k] + m[k][largest] for k in range(3)] + [minus[largest]]
        parts[largest] = squares[largest]
    length = math.sqrt(sum(part * part for part in parts))
    return dict(zip("xyzw", (part / length for part in parts), strict=True))


def _colour(rgb: tuple[float, float, float], alpha: float) -> dict[str, float]:
    return dict(zip("rgba", (*rgb, alpha), strict=True))
