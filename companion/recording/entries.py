"""Encoding of events and outputs as messages on topics, for recordings and viewers.

Events, which drive the pipeline, are all sent, in order. Of the outputs, every fix is sent;
tracks, weights and the scene are sent at a limited rate, since a replay computes them again.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from companion.recording import codec, fields, schemas
from companion.recording.scene import Scene
from companion.recording.schemas import Schema
from companion.values import (
    Estimate,
    Event,
    FloatArray,
    Frame,
    Notice,
    Output,
    Rejection,
    Track,
    Update,
)

Geodetic = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""Function from (N, 3) positions in the local frame, metres, to latitude, longitude and altitude.

Latitude and longitude are in degrees, altitude is in metres, each (N,).
"""

Emit = Callable[[str, Schema, int, bytes], None]
"""Function to which topic, schema, time in nanoseconds and the message's bytes are passed."""

NAMED: Final = (
    *(
        (schemas.TOPICS[name], schemas.schema(name))
        for name in ("Frame", "Tick", "Rejection", "Track", "Weights")
    ),
    (schemas.TF_TOPIC, schemas.FRAME_TRANSFORM),
    (schemas.SCENE_TOPIC, schemas.SCENE_UPDATE),
    (schemas.LOG_TOPIC, schemas.LOG),
)
"""Topics that exist in every run; a UAV's topics are added with the UAV."""
FRAME: Final = schemas.schema("Frame")


class RateLimit:
    """Rate limit by the times of the limited items; a rate of None is no limit."""

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = 0 if rate_hz is None else int(1e9 / rate_hz)
        self._due_ns: int | None = None

    def is_due(self, t_ns: int) -> bool:
        """Return whether the next item is due. An early item does not cause a burst later."""
        due_ns = self._due_ns
        if due_ns is None or not due_ns - self._period_ns <= t_ns < due_ns + self._period_ns:
            due_ns = t_ns
        if t_ns < due_ns:
            return False
        self._due_ns = due_ns + self._period_ns
        return True


class Encoder:
    """Encoder of events and outputs into messages, which it passes to ``emit``.

    weights_hz  largest rate of tracks and weights, by the updates' own time; None: every
                update
    scene       draws the scene; None: no scene
    """

    def __init__(self, emit: Emit, weights_hz: float | None, scene: Scene | None) -> None:
        self._emit = emit
        self._weights = RateLimit(weights_hz)
        self._scene = scene
        self._scenes = RateLimit(scene.rate_hz if scene else None)
        self._last_event: Event | None = None
        self._frame_bytes = schemas.FrameEncoder().encode

    def event(self, event: Event) -> None:
        """Send an event that drives the pipeline: in the order of calls, before its outputs."""
        self._last_event = event
        if isinstance(event, Frame):  # first, since nearly all events are frames
            self._emit(schemas.FRAMES_TOPIC, FRAME, event.t_ns, self._frame_bytes(event))
        elif isinstance(event, Rejection):
            self._rejection(event, is_event=True)
        else:
            self._described(type(event).__name__, event.t_ns, event)

    def _described(self, name: str, t_ns: int, value: Any) -> None:
        """Send a described value as the message of this name."""
        data = schemas.encode(name, value)
        self._emit(schemas.TOPICS[name], schemas.schema(name), t_ns, data)

    def output(self, output: Output, geodetic: Geodetic) -> None:
        """Send an output, except a rejection that is itself the last event sent.

        A fix is sent at its arrival; its message contains the time at which it was true.
        ``geodetic`` is only called with the positions of an update's tracks, if there are any.
        """
        match output:
            case Estimate(fix=fix):
                data = codec.fix(fix).SerializeToString()
                self._emit(f"/uav/{fix.uav}/fix", schemas.LOCATION_FIX, fix.arrival_ns, data)
            case Update():
                if self._weights.is_due(output.t_ns):
                    self._tracks(output.t_ns, output.tracks, geodetic)
                    weights = fields.RecordedWeights(output.beams)
                    self._described("Weights", weights.made.t_ns, weights)
                if self._scene and self._scenes.is_due(output.t_ns):
                    self._draw(self._scene, output, geodetic)
            case Rejection():
                if output is not self._last_event:
                    self._rejection(output, is_event=False)
            case Notice():
                data = codec.log(output).SerializeToString()
                self._emit(schemas.LOG_TOPIC, schemas.LOG, output.t_ns, data)

    def _rejection(self, rejection: Rejection, *, is_event: bool) -> None:
        recorded = fields.RecordedRejection(rejection, is_event)
        self._described("Rejection", rejection.t_ns, recorded)

    def _tracks(self, t_ns: int, tracks: tuple[Track, ...], geodetic: Geodetic) -> None:
        if not tracks:
            return
        positions = geodetic(np.array([track.position_ned_m for track in tracks], dtype=float))
        for track, lat_deg, lon_deg, alt_m in zip(tracks, *positions, strict=True):
            where = codec.predicted(track, float(lat_deg), float(lon_deg), float(alt_m))
            topic = f"/uav/{track.uav}/predicted"
            self._emit(topic, schemas.LOCATION_FIX, t_ns, where.SerializeToString())
            self._described("Track", t_ns, fields.RecordedTrack(track, t_ns))

    def _draw(self, scene: Scene, update: Update, geodetic: Geodetic) -> None:
        transforms = scene.transforms(update)
        if transforms:
            origin = [float(each[0]) for each in geodetic(np.zeros((1, 3)))]
            transforms.insert(0, scene.origin(update.t_ns, *origin))
        for transform in transforms:
            data = transform.SerializeToString()
            self._emit(schemas.TF_TOPIC, schemas.FRAME_TRANSFORM, update.t_ns, data)
        data = scene.picture(update).SerializeToString()
        self._emit(schemas.SCENE_TOPIC, schemas.SCENE_UPDATE, update.t_ns, data)
