"""3D scene of the beams, for viewers.

Viewers use z upwards, so the frames are (REP 103 of ROS): ``map``, east-north-up at the origin of
the local frame, child of ``wgs84``, which is Earth-fixed; ``carrier``, forward-left-up, child of
``map``; ``array``, x along boresight, y to the left, z upwards, child of ``carrier``. The local
frame is north-east-down and the body and array frames are forward-right-down: a rotation by half a
turn around x converts them.

Drawn entities expire after some updates of the scene, such as the beam of a UAV that is lost.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from companion.beams import line_of_sight
from companion.beams.aim import directions
from companion.beams.array.geometry import Array
from companion.recording import schemas
from companion.recording.codec import FRAME_ID, timestamp
from companion.tracking.geodesy import LocalFrame, ned_from_ecef
from companion.values import Carrier, FloatArray, Track, TrackState, Update

MAP: Final = "map"
CARRIER: Final = "carrier"
ARRAY: Final = "array"
LIFETIMES: Final = 3  # lifetime of an entity, in periods of the scene
WIDEST_RAD: Final = math.pi / 3
"""Widest beam drawn, radians: the beam of a line of elements has no limit in one direction."""
HALF_POWER: Final = 0.886
"""Full half-power width of a uniform aperture's beam, in wavelengths per aperture.

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
    """Drawing of updates for an array, at ``rate_hz`` (> 0)."""

    array: Array
    rate_hz: float

    def transforms(self, update: Update) -> list[Any]:
        """Return ``foxglove.FrameTransform``: the carrier in the map, and the array on it.

        Empty while the carrier's position is unknown.
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
        """Return ``foxglove.FrameTransform`` of the map's origin on the Earth.

        Degrees and metres; the parent is the Earth-fixed frame (EPSG 4978). Heights above sea level
        are used as heights above the ellipsoid, as everywhere here.
        """
        stands = LocalFrame(lat_deg, lon_deg, alt_m).origin_ecef_m
        ecef_from_map = (ENU_FROM_NED @ ned_from_ecef(lat_deg, lon_deg)).T
        return _transform(timestamp(t_ns), FRAME_ID, MAP, stands, ecef_from_map)

    def picture(self, update: Update) -> Any:
        """Return ``foxglove.SceneUpdate`` with an entity per UAV (position, bound) and per beam."""
        entities = [self._uav(track, update.t_ns) for track in update.tracks]
        if update.carrier is not None and update.beams.beams:
            entities += self._beams(update, update.carrier)
        return schemas.SceneUpdateMessage(entities=entities)

    def _uav(self, track: Track, t_ns: int) -> Any:
        """Return a name, a point, and the upright cylinder of a UAV's bound, if finite, to draw."""
        north_m, east_m, down_m = track.position_ned_m.tolist()
        pose = {"position": {"x": east_m, "y": north_m, "z": -down_m}, "orientation": {"w": 1.0}}
        colour = COLOURS[track.state]
        entity = self._entity(f"uav {track.uav}", t_ns)
        entity.texts.add(
            pose=pose, billboard=True, font_size=14, scale_invariant=True,
            color=_colour(colour, 1.0), text=f"{track.uav} {track.state}",
        )  # fmt: skip
        entity.spheres.add(pose=pose, size=_vector([2.0] * 3), color=_colour(colour, 1.0))
        if math.isfinite(track.bound_m):
            width_m, height_m = 2 * track.horizontal_bound_m, 2 * track.vertical_bound_m
            entity.cylinders.add(
                pose=pose, size=_vector([width_m, width_m, height_m]),
                bottom_scale=1, top_scale=1, color=_colour(colour, 0.25),
            )  # fmt: skip
        return entity

    def _beams(self, update: Update, carrier: Carrier) -> Iterator[Any]:
        """Yield half-power cones from the array to the range of each UAV."""
        towards = directions(update.beams)
        map_from_array = ENU_FROM_NED @ carrier.body_from_local.T @ self.array.array_from_body.T
        begin = ENU_FROM_NED @ line_of_sight.place_ned_m(carrier, self.array)
        ranges_m = np.array([beam.range_m for beam in update.beams.beams])
        turned = map_from_array @ _across(towards)
        ends = begin + turned[:, :, 2] * ranges_m[:, np.newaxis]
        sizes = np.c_[2 * ranges_m[:, np.newaxis] * np.tan(self.widths_rad(towards) / 2), ranges_m]
        middles = (begin + ends) / 2
        states = {track.uav: track.state for track in update.tracks}
        start = _vector(begin)
        for i, beam in enumerate(update.beams.beams):
            colour = COLOURS[states[beam.uav]]
            entity = self._entity(f"beam {beam.uav}", update.t_ns)
            entity.cylinders.add(
                pose={"position": _vector(middles[i]), "orientation": _quaternion(turned[i])},
                size=_vector(sizes[i]), bottom_scale=0, top_scale=1, color=_colour(colour, 0.2),
            )  # fmt: skip
            line = entity.lines.add(thickness=2, scale_invariant=True, color=_colour(colour, 0.8))
            line.points.add(**start)
            line.points.add(**_vector(ends[i]))
            yield entity

    def widths_rad(self, towards: FloatArray) -> FloatArray:
        """Return approximate half-power widths (N, 2) of beams at unit directions (N, 3).

        Full widths in the array frame, horizontal and vertical: the widths of a uniform aperture
        with the extent seen from the direction, at most ``WIDEST_RAD``. For drawing only;
        ``patterns`` computes the exact ones.
        """
        array = self.array
        seen_m = array.elements_m @ _across(towards)[:, :, :2]
        extents_m = np.ptp(seen_m, axis=1) + array.wavelength_m / 2
        widths: FloatArray = np.minimum(WIDEST_RAD, HALF_POWER * array.wavelength_m / extents_m)
        return widths

    def _entity(self, name: str, t_ns: int) -> Any:
        lifetime_ns = int(LIFETIMES * 1e9 / self.rate_hz)
        return schemas.SceneEntityMessage(
            timestamp=timestamp(t_ns), frame_id=MAP, id=name, lifetime=timestamp(lifetime_ns)
        )


def _across(towards: FloatArray) -> FloatArray:
    """Return rotations (N, 3, 3) to the array frame from axes right of, below, along directions."""
    x, y, z = towards.T
    lengths = np.hypot(x, y)
    upright = lengths <= 1e-9  # straight up or down
    lengths = np.where(upright, 1.0, lengths)
    right_x, right_y = np.where(upright, 0.0, -y / lengths), np.where(upright, 1.0, x / lengths)
    right = [right_x, right_y, np.zeros_like(x)]
    down = [-z * right_y, z * right_x, x * right_y - y * right_x]
    return np.array([right, down, [x, y, z]]).transpose(2, 1, 0)


def _map_from_carrier(carrier: Carrier) -> FloatArray:
    return ENU_FROM_NED @ carrier.body_from_local.T @ _UP


def _transform(at: Any, parent: str, child: str, place: FloatArray, turned: FloatArray) -> Any:
    return schemas.FrameTransformMessage(
        timestamp=at,
        parent_frame_id=parent,
        child_frame_id=child,
        translation=_vector(place),
        rotation=_quaternion(turned),
    )


def _vector(xyz: Any) -> dict[str, float]:
    x, y, z = xyz
    return {"x": float(x), "y": float(y), "z": float(z)}


def _quaternion(turned: FloatArray) -> dict[str, float]:
    """Return the quaternion of a rotation matrix, parent from child.

    The largest component is computed first (Shepperd 1978): the others are divided by it, so it
    must not be small.
    """
    m = turned.tolist()
    trace = m[0][0] + m[1][1] + m[2][2]
    squares = [*(1 + 2 * m[i][i] - trace for i in range(3)), 1 + trace]
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
    red, green, blue = rgb
    return {"r": red, "g": green, "b": blue, "a": alpha}
