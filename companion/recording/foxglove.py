"""Live channels with a recording's messages on a WebSocket, for Foxglove and Lichtblick.

Needs the package foxglove-sdk, which the extra ``live`` installs. The package's server runs on its
own threads; messages are encoded on another thread, for at most ``SHARE`` of the time. The event
loop only queues events; updates and events for which that is not enough are dropped.
"""

import contextlib
import queue
import threading
import time
from collections.abc import Sequence
from typing import Any, Final

from companion.recording import schemas
from companion.recording.entries import NAMED, Encoder, Geodetic
from companion.recording.scene import Scene
from companion.recording.schemas import Schema
from companion.values import Estimate, Event, Output, Update, UserError
from companion.values.extras import needs

QUEUE_MAX: Final = 10_000  # events waiting to be sent at most
UPDATES_MAX: Final = 2  # updates waiting at most: with many UAVs each takes megabytes
SHARE: Final = 0.25
"""Largest share of the time for encoding: with 1000 UAVs an update has 2000 messages."""
TURN_S: Final = 0.002  # time of the processor after which the thread rests
RATE_HZ: Final = 10.0  # largest rate of tracks and weights; faster changes are not visible
LOOK_S: Final = 0.2  # time between two checks for viewers
NAME: Final = "companion"  # name of the server in viewers

_Item = tuple[Event | None, Sequence[Output]]


class LiveChannels:
    """Live server of events and outputs, from ``start`` to ``stop``.

        host, port  address, bound at once; port 0: any free one, and ``port`` is then its number
        geodetic    converts positions, for ``Encoder.output``
        scene       draws the scene; None: no scene
        rate_hz     largest rate of tracks and weights; None: every update

    Without viewers, no messages are encoded. Raises ``UserError`` without the package, or if
    the port is unavailable.
    """

    def __init__(
        self,
        *,
        host: str,
        port: int,
        geodetic: Geodetic,
        scene: Scene | None,
        rate_hz: float | None = RATE_HZ,
    ) -> None:
        self.dropped = 0
        self._foxglove = foxglove = _foxglove()
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name=NAME, host=host, port=port, context=self._context
            )
        except (OSError, RuntimeError) as error:
            raise UserError(f"server.foxglove: cannot listen on {host}:{port}: {error}") from error
        self.port: int = self._server.port
        self._channels: dict[str, Any] = {}
        self._announced: set[str] = set()
        self._geodetic = geodetic
        self._encoder = Encoder(self._send, rate_hz, scene)
        for topic, schema in NAMED:
            self._channel(topic, schema)
        self._queue: queue.Queue[_Item | None] = queue.Queue(QUEUE_MAX)
        self._updates_put = self._updates_taken = 0  # by the event loop, by the thread
        self._turn_began_s = 0.0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="foxglove", daemon=True)

    def start(self) -> None:
        """Start to send messages."""
        self._thread.start()

    def put(self, event: Event | None, outputs: Sequence[Output]) -> None:
        """Queue an event and its outputs; the event is None for outputs without an event.

        Never blocks.
        """
        updates = _updates_in(outputs)
        if updates and self._updates_put - self._updates_taken >= UPDATES_MAX:
            outputs = [one for one in outputs if not isinstance(one, Update)]
            self.dropped += updates
            updates = 0
        try:
            self._queue.put_nowait((event, outputs))
        except queue.Full:
            self.dropped += 1
        else:
            self._updates_put += updates

    def stop(self) -> None:
        """Stop the live server."""
        self._stopping.set()
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)
        if self._thread.is_alive():
            self._thread.join()
        self._server.stop()

    def _run(self) -> None:
        self._turn_began_s = time.thread_time()
        watched, look_due_s = False, 0.0
        while not self._stopping.is_set():
            item = self._queue.get()
            if time.monotonic() >= look_due_s:
                watched = any(channel.has_sinks() for channel in self._channels.values())
                look_due_s = time.monotonic() + LOOK_S
            if item is None:
                continue
            event, outputs = item
            self._updates_taken += _updates_in(outputs)
            self._announce(outputs)
            if not watched:
                continue
            if event is not None:
                self._encoder.event(event)
            for output in outputs:
                self._encoder.output(output, self._geodetic)

    def _announce(self, outputs: Sequence[Output]) -> None:
        """Announce the topics of each new UAV: viewers can subscribe only to announced topics."""
        for output in outputs:
            if isinstance(output, Estimate) and output.fix.uav not in self._announced:
                self._announced.add(output.fix.uav)
                for kind in ("fix", "predicted"):
                    self._channel(f"/uav/{output.fix.uav}/{kind}", schemas.LOCATION_FIX)

    def _send(self, topic: str, schema: Schema, t_ns: int, data: bytes) -> None:
        channel = self._channels.get(topic) or self._channel(topic, schema)
        channel.log(data, log_time=max(0, t_ns))
        now_s = time.thread_time()
        worked_s = now_s - self._turn_began_s
        if worked_s >= TURN_S:
            self._stopping.wait(worked_s * (1 / SHARE - 1))
            self._turn_began_s = now_s

    def _channel(self, topic: str, schema: Schema) -> Any:
        described = self._foxglove.Schema(
            name=schema.name, encoding="protobuf", data=schema.descriptor_set
        )
        channel = self._foxglove.Channel(
            topic, schema=described, message_encoding="protobuf", context=self._context
        )
        return self._channels.setdefault(topic, channel)


def _updates_in(outputs: Sequence[Output]) -> int:
    return sum(isinstance(one, Update) for one in outputs)


def _foxglove() -> Any:
    with needs("foxglove", "live", "server.foxglove"):
        import foxglove
    return foxglove
