"""A recorder on a thread of its own: the event loop hands over and goes on.

The queue is bounded. What does not fit is counted and said; beams never wait for a disk.
"""

import queue
import threading
import time
from collections.abc import Sequence
from typing import Final

from companion.recording.writer import Geodetic, Writer
from companion.values import Event, Output

QUEUE_MAX: Final = 50_000
"""Some seconds of the busiest stream."""
FLUSH_S: Final = 1.0

_Item = tuple[Event | None, Sequence[Output]]


class BackgroundRecorder:
    """Owns a ``Writer`` from ``start`` to ``stop``.

    A failing disk ends the recording, not the service: ``failure`` then says why.
    """

    def __init__(self, writer: Writer, geodetic: Geodetic) -> None:
        self.writer = writer
        self.bytes = 0
        self.dropped = 0
        self.failure: str | None = None
        self._geodetic = geodetic
        self._queue: queue.Queue[_Item | None] = queue.Queue(QUEUE_MAX)
        self._metadata: dict[str, str] = {}
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def put(self, event: Event | None, outputs: Sequence[Output]) -> None:
        """Hand over an event and what came of it; None for what came of no event. Never waits."""
        if self.failure is not None:
            self.dropped += 1
            return
        try:
            self._queue.put_nowait((event, outputs))
        except queue.Full:
            self.dropped += 1

    def stop(self, metadata: dict[str, str]) -> None:
        """Write what is queued, finish the file and return when it is on the disk."""
        self._metadata = metadata
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        try:
            self._write_until_stopped()
        except OSError as error:
            self._fail(error)
            self.writer.abandon()
            while self._queue.get() is not None:  # until `stop`, so that it need not wait
                self.dropped += 1
            return
        try:
            self.writer.close(self._metadata)
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failure = f"{self.writer.path}: {error.strerror or error}"

    def _write_until_stopped(self) -> None:
        flush_due_s = time.monotonic() + FLUSH_S
        while True:
            try:
                item = self._queue.get(timeout=max(0.0, flush_due_s - time.monotonic()))
                if item is None:
                    return
                event, outputs = item
                if event is not None:
                    self.writer.event(event)
                for output in outputs:
                    self.writer.output(output, self._geodetic)
            except queue.Empty:
                pass
            if time.monotonic() >= flush_due_s:
                self.writer.flush()
                self.bytes = self.writer.size_bytes
                flush_due_s = time.monotonic() + FLUSH_S
