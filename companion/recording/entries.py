"""Events and outputs as messages on topics: what a recording holds and a live viewer is sent.

What drove the pipeline goes out whole and in order. Of what came of it every fix does, and
tracks, weights and the scene as often as asked, since a replay derives them again.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from companion.recording import messages, schemas
from companion.recording.scene import Scene
from companion.recording.schemas import Schema
from companion.values import (
    BeamSet,
    Estimate,
    Event,
    FloatArray,
    Frame,
    Notice,
    Output,
    Rejection,
    RoundTrip,
    Tick,
    Track,
    Update,
)

Geodetic = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""(N, 3) positions in the local frame, metres, to latitude and longitude in degrees and altitude
in metres, each (N,)."""

Emit = Callable[[str, Schema, int, bytes], None]
"""Takes topic, schema, time in nanoseconds and the message's bytes."""

NAMED: Final = (
    (schemas.FRAMES_TOPIC, schemas.FRAME),
    (schemas.TICKS_TOPIC, schemas.TICK),
    (schemas.REJECTIONS_TOPIC, schemas.REJECTION),
    (schemas.TRACKS_TOPIC, schemas.TRACK),
    (schemas.WEIGHTS_TOPIC, schemas.WEIGHTS),
    (schemas.TF_TOPIC, schemas.FRAME_TRANSFORM),
    (schemas.SCENE_TOPIC, schemas.SCENE_UPDATE),
    (schemas.LOG_TOPIC, schemas.LOG),
)
"""The topics that are there in any run; those of each UAV come with it."""


class Pace:
    """At most so often a second, by the times of what comes; None: always."""

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = 0 if rate_hz is None else int(1e9 / rate_hz)
        self._due_ns: int | None = None

    def is_due(self, t_ns: int) -> bool:
        """Whether it is time again; what comes a little early is not made up for by a burst."""
        due_ns = self._due_ns
        if due_ns is None or not due_ns - self._period_ns <= t_ns < due_ns + self._period_ns:
            due_ns = t_ns
        if t_ns < due_ns:
            return False
        self._due_ns = due_ns + self._period_ns
        return True


class Encoder:
    """Hands each message to ``emit``. ``weights_hz``: how often at most, by the updates' own
    time, tracks and weights go out (None: at every update); without a ``scene`` none is drawn."""

    def __init__(self, emit: Emit, weights_hz: float | None, scene: Scene | None) -> None:
        self._emit = emit
        self._weights = Pace(weights_hz)
        self._scene = scene
        self._scenes = Pace(scene.rate_hz if scene else None)
        self._last_event: Event | None = None
        self._frame_bytes = schemas.FrameEncoder().encode

    def event(self, event: Event) -> None:
        """What drives the pipeline: in the order of the calls, before its outputs."""
        self._last_event = event
        match event:
            case Frame():
                data = self._frame_bytes(event)
                self._emit(schemas.FRAMES_TOPIC, schemas.FRAME, event.t_ns, data)
            case Tick():
                data = schemas.encode_tick(event.t_ns)
                self._emit(schemas.TICKS_TOPIC, schemas.TICK, event.t_ns, data)
            case Rejection():
                self._rejection(event, is_event=True)
            case RoundTrip():
                data = messages.round_trip(event).SerializeToString()
                self._emit(schemas.ROUND_TRIPS_TOPIC, schemas.ROUND_TRIP, event.t_ns, data)

    def output(self, output: Output, geodetic: Geodetic) -> None:
        """What came of an event. A rejection that is that very event does not go out twice.

        A fix goes out at its arrival, its message bearing the time at which it was true.
        ``geodetic`` is only called with the positions of an update's tracks, when there are any.
        """
        match output:
            case Estimate(fix=fix):
                data = messages.fix(fix).SerializeToString()
                self._emit(f"/uav/{fix.uav}/fix", schemas.LOCATION_FIX, fix.arrival_ns, data)
            case Update():
                if self._weights.is_due(output.t_ns):
                    self._tracks(output.t_ns, output.tracks, geodetic)
                    self._beams(output.beams)
                if self._scene and self._scenes.is_due(output.t_ns):
                    self._draw(self._scene, output)
            case Rejection():
                if output is not self._last_event:
                    self._rejection(output, is_event=False)
            case Notice():
                data = messages.log(output).SerializeToString()
                self._emit(schemas.LOG_TOPIC, schemas.LOG, output.t_ns, data)

    def _rejection(self, rejection: Rejection, *, is_event: bool) -> None:
        data = messages.rejection(rejection, is_event=is_event).SerializeToString()
        self._emit(schemas.REJECTIONS_TOPIC, schemas.REJECTION, rejection.t_ns, data)

    def _tracks(self, t_ns: int, tracks: tuple[Track, ...], geodetic: Geodetic) -> None:
        if not tracks:
            return
        positions = geodetic(np.array([track.position_ned_m for track in tracks], dtype=float))
        for track, lat_deg, lon_deg, alt_m in zip(tracks, *positions, strict=True):
            where = messages.predicted(track, float(lat_deg), float(lon_deg), float(alt_m))
            topic = f"/uav/{track.uav}/predicted"
            self._emit(topic, schemas.LOCATION_FIX, t_ns, where.SerializeToString())
            data = messages.track(track, t_ns).SerializeToString()
            self._emit(schemas.TRACKS_TOPIC, schemas.TRACK, t_ns, data)

    def _beams(self, beams: BeamSet) -> None:
        data = messages.weights(beams).SerializeToString()
        self._emit(schemas.WEIGHTS_TOPIC, schemas.WEIGHTS, beams.t_ns, data)

    def _draw(self, scene: Scene, update: Update) -> None:
        for transform in scene.transforms(update):
            data = transform.SerializeToString()
            self._emit(schemas.TF_TOPIC, schemas.FRAME_TRANSFORM, update.t_ns, data)
        data = scene.picture(update).SerializeToString()
        self._emit(schemas.SCENE_TOPIC, schemas.SCENE_UPDATE, update.t_ns, data)
