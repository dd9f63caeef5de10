"""Tracks and beams in 3D as point clouds, a form that Rerun draws.

Rerun opens MCAP files and draws Foxglove's PointCloud and FrameTransform, but not the SceneUpdate
of a recording; its own package has 500 MB and is not needed. A track is the positions of its last
``TRAIL_S``, a beam is points along its axis from the array to its UAV. A lost UAV or beam becomes a
cloud without points.
"""

from collections import deque
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.writer import Writer

from companion.beams import line_of_sight
from companion.beams.aim import directions
from companion.recording import schemas
from companion.recording.codec import timestamp
from companion.recording.scene import COLOURS, ENU_FROM_NED, MAP, Scene
from companion.recording.writer import ACTIVE, open_beside
from companion.tracking.geodesy import LocalFrame
from companion.values import FloatArray, Update

TRAIL_S: Final = 30.0
BEAM_POINTS: Final = 64
_FLOAT32: Final = 7  # foxglove.PackedElementField
_UINT8: Final = 1
_POINT: Final = np.dtype([("place", "<f4", 3), ("rgba", "u1", 4)])
_FIELDS: Final = (
    *((name, 4 * number, _FLOAT32) for number, name in enumerate("xyz")),
    *((name, 12 + number, _UINT8) for number, name in enumerate(("red", "green", "blue", "alpha"))),
)


class SpaceFile:
    """File of point clouds, open for writing; a context manager.

    It gets its name when it is complete. Raises ``OSError`` if it cannot be written,
    ``BlockingIOError`` if another process is writing it.
    """

    def __init__(self, path: Path, scene: Scene) -> None:
        self.clouds = 0
        self._scene = scene
        self._path, self._made = path, path.with_name(path.name + ACTIVE)
        self._file = open_beside(path)
        self._writer: Any = Writer(self._file)
        self._writer.start(library="companion")
        self._channels: dict[str, int] = {}
        self._schemas = {
            schema: self._writer.register_schema(schema.name, "protobuf", schema.descriptor_set)
            for schema in (schemas.POINT_CLOUD, schemas.FRAME_TRANSFORM)
        }
        self._trails: dict[str, deque[tuple[int, FloatArray]]] = {}
        self._drawn: set[str] = set()
        self._due_ns = 0
        self._origin: tuple[float, float, float] | None = None

    def __enter__(self) -> "SpaceFile":
        return self

    def __exit__(self, failed: object, *_: object) -> None:
        with self._file, ExitStack() as undo:  # locked until it has its name, or is removed
            undo.callback(self._made.unlink, missing_ok=True)
            if failed is None:
                self._writer.finish()
                self._file.flush()
                self._made.rename(self._path)
                undo.pop_all()

    def add(self, update: Update, local: LocalFrame | None) -> None:
        """Draw an update, at most at the rate of the scene."""
        if update.t_ns < self._due_ns or local is None:
            return
        self._due_ns = update.t_ns + round(1e9 / self._scene.rate_hz)
        if local.origin != self._origin:
            self._origin = local.origin
            self._transform(update.t_ns, self._scene.origin(update.t_ns, *local.origin))
        for transform in self._scene.transforms(update):
            self._transform(update.t_ns, transform)
        clouds = {**self._tracks(update), **self._beams(update)}
        for topic in self._drawn - clouds.keys():
            self._cloud(update.t_ns, topic, np.empty((0, 3)), (0.0, 0.0, 0.0))
        for topic, (points, colour) in clouds.items():
            self._cloud(update.t_ns, topic, points, colour)
        self._drawn = set(clouds)

    def _tracks(self, update: Update) -> dict[str, tuple[FloatArray, tuple[float, float, float]]]:
        found = {}
        for track in update.tracks:
            trail = self._trails.setdefault(track.uav, deque())
            trail.append((update.t_ns, ENU_FROM_NED @ track.position_ned_m))
            while update.t_ns - trail[0][0] > TRAIL_S * 1e9:
                trail.popleft()
            points = np.array([place for _, place in trail])
            found[f"/space/uav/{track.uav}"] = points, COLOURS[track.state]
        for uav in self._trails.keys() - {track.uav for track in update.tracks}:
            del self._trails[uav]
        return found

    def _beams(self, update: Update) -> dict[str, tuple[FloatArray, tuple[float, float, float]]]:
        carrier, array = update.carrier, self._scene.array
        if carrier is None or not update.beams.beams:
            return {}
        map_from_array = ENU_FROM_NED @ carrier.body_from_local.T @ array.array_from_body.T
        begin = ENU_FROM_NED @ line_of_sight.place_ned_m(carrier, array)
        states = {track.uav: track.state for track in update.tracks}
        steps = np.linspace(0.0, 1.0, BEAM_POINTS)[:, None]
        towards = directions(update.beams)
        return {
            f"/space/beam/{beam.uav}": (
                begin + steps * beam.range_m * (map_from_array @ direction),
                COLOURS[states[beam.uav]],
            )
            for beam, direction in zip(update.beams.beams, towards, strict=True)
        }

    def _cloud(
        self, t_ns: int, topic: str, places: FloatArray, colour: tuple[float, float, float]
    ) -> None:
        packed = np.zeros(len(places), _POINT)
        packed["place"] = places
        packed["rgba"] = [*(round(255 * part) for part in colour), 255]
        message = schemas.PointCloudMessage(
            timestamp=timestamp(t_ns),
            frame_id=MAP,
            pose={"orientation": {"w": 1.0}},
            point_stride=_POINT.itemsize,
            fields=[{"name": name, "offset": at, "type": kind} for name, at, kind in _FIELDS],
            data=packed.tobytes(),
        )
        self._write(topic, schemas.POINT_CLOUD, t_ns, message)
        self.clouds += 1

    def _transform(self, t_ns: int, transform: Any) -> None:
        self._write(schemas.TF_TOPIC, schemas.FRAME_TRANSFORM, t_ns, transform)

    def _write(self, topic: str, schema: schemas.Schema, t_ns: int, message: Any) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            made = self._writer.register_channel(topic, "protobuf", self._schemas[schema])
            channel = self._channels.setdefault(topic, made)
        self._writer.add_message(channel, t_ns, message.SerializeToString(), t_ns)
