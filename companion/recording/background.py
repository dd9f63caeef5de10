"""A recorder on a thread of its own, so that the event loop never waits for a disk.

The queue is bounded; what does not fit is counted and reported. A disk that fails is tried again,
less and less often, and one that is full as soon as it has room. What had not reached it is kept as
far as the queue goes, and the recording goes on in a new file, which says what is missing.

Over 300 lines: one thread: its queue, its failures, its parts.
"""

import errno
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from companion.recording.entries import Geodetic
from companion.recording.parts import Hole, Part
from companion.recording.writer import Writer
from companion.values import ClockSet, Event, Output, Severity

QUEUE_MAX: Final = 50_000
"""Events waiting to be written at most: some seconds of the busiest stream.

About 60 MB where twenty UAVs report ten times a second (1.3 kB for an event with its outputs)."""
GATHER_S: Final = 0.02
"""How long events are left to gather: to wake the thread for each costs as much as to write it."""
AT_ONCE: Final = 500  # events between two looks at whether a flush is due
FLUSH_S: Final = 1.0  # time between two flushes to disk
FLUSH_FIRST_S: Final = 0.1
"""The same where a file begins, and twice as long after each: a short life leaves something too."""
RETRY_FIRST_S: Final = 1.0
"""Time before the first new attempt after a disk error; it doubles from one to the next.

Whether a full disk has room is asked without trying it, at the pace of the first attempt.
"""
RETRY_MAX_S: Final = 30.0  # longest time between two attempts
STOP_MAX_S: Final = 30.0  # how long the end of the service waits for a disk that does not answer
GO_ON_WITH: Final = 2000
"""Events that are written at once where a recording goes on: some hundred kilobytes."""
ROOM_BYTES: Final = 8 << 20
"""Free space needed to resume a recording; with less it would soon end again."""

_TOO_SLOW: Final = "the disk was too slow"


@dataclass(frozen=True, slots=True)
class Rotation:
    """When a new part is begun: at a size in bytes, or after so many seconds; None: never."""

    size_bytes: float | None = None
    after_s: float | None = None


NEVER: Final = Rotation()  # never begin a new part


class _Item(NamedTuple):
    """An event and its outputs; ``missed`` events before it did not fit into the queue."""

    event: Event | None
    outputs: Sequence[Output]
    missed: int

    @property
    def t_ns(self) -> int:
        return self.event.t_ns if self.event is not None else 0


class BackgroundRecorder:
    """Records on a thread, with one ``Writer`` for each part from ``start`` to ``stop``.

        open_part  makes the writer of a part. The first is made at once, and its ``OSError`` is
                   raised to the caller; errors of later ones are handled here
        geodetic   converts positions, for ``Encoder.output``
        rotation   when a new part is begun
        queue_max  events that may wait

    Attributes: ``failure`` says why nothing is written at present, ``dropped`` counts what was
    handed over and is not recorded, ``messages`` what is, and ``bytes`` is the size of the newest
    file.
    """

    def __init__(
        self,
        *,
        open_part: Callable[[Part], Writer],
        geodetic: Geodetic,
        rotation: Rotation = NEVER,
        queue_max: int = QUEUE_MAX,
    ) -> None:
        self.bytes = 0
        self.dropped = 0
        self.written_ns: int | None = None
        """Time of the newest event that was written; None before the first."""
        self.failure: str | None = None
        self._open_part = open_part
        self._geodetic = geodetic
        self._rotation = rotation
        self._part = Part.first()
        self._writer = open_part(self._part)
        self._begun_s = time.monotonic()
        self._finished_messages = 0  # messages in the parts before this one
        self._queue: deque[_Item] = deque()  # bounded by ``put``; nobody waits at it
        self._queue_max = queue_max
        self._missed = 0
        self._overrun = False
        self._unsafe: list[_Item] = []  # written, but not yet on the disk
        self._clock_set: ClockSet | None = None
        self._lost = 0  # events that may or may not be on a disk
        self._why = _TOO_SLOW
        self._retry_s = RETRY_FIRST_S
        self._news: deque[tuple[Severity, str]] = deque(maxlen=100)
        self._metadata: dict[str, str] = {}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    # --- the side of the event loop ---------------------------------------------------------

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def put(self, event: Event | None, outputs: Sequence[Output]) -> None:
        """Hand over an event and its outputs; an event of None for outputs without one.

        Never waits. Called on one thread only.

        Once the queue is full, nothing is accepted until half of it is written: one long hole can
        be reported, a thousand short ones would be a recording of holes.
        """
        if self._overrun and len(self._queue) <= self._queue_max // 2:
            self._overrun = False
            self._tell(Severity.INFO, f"recording again: {self._missed} events are missing")
        if not self._overrun:
            if len(self._queue) < self._queue_max:
                self._queue.append(_Item(event, outputs, self._missed))
                self._missed = 0
                return
            self._overrun = True
            if self.failure is None:
                self._tell(Severity.ERROR, "not all is recorded: the disk is too slow")
        self.dropped += 1
        self._missed += event is not None

    def stop(self, metadata: dict[str, str]) -> None:
        """Write what is queued, finish the file and return when it is on the disk.

        A disk that fails is tried once more; one that does not answer is waited for ``STOP_MAX_S``
        seconds.
        """
        self._metadata = metadata
        self._stopping.set()
        self._thread.join(STOP_MAX_S)
        if self._thread.is_alive():
            self._tell(Severity.ERROR, f"{self._writer.path} is not finished: no answer from disk")

    def news(self) -> list[tuple[Severity, str]]:
        """Messages for the operator since the last call."""
        told = []
        while self._news:
            told.append(self._news.popleft())
        return told

    @property
    def degraded(self) -> bool:
        """True while something is not being recorded."""
        return self.failure is not None or self._overrun

    @property
    def file(self) -> str:
        """Name of the newest file."""
        return self._writer.path.name

    @property
    def messages(self) -> int:
        """Messages recorded in all parts so far."""
        return self._finished_messages + self._writer.messages

    @property
    def queued(self) -> int:
        """Events that wait to be written."""
        return len(self._queue)

    # --- the side of the thread -------------------------------------------------------------

    def _run(self) -> None:
        while not self._record():
            if not self._reopen():
                return

    def _record(self) -> bool:
        """Write until stopped; False if that failed."""
        try:
            self._go_on()
            self._write_until_stopped()
            self._finish()
        except OSError as error:
            self._fail(error)
            return False
        return True

    def _go_on(self) -> None:
        """Begin a file with what the file before did not get."""
        if self._lost:
            t_ns = next((item.t_ns for item in self._unsafe if item.t_ns), self.written_ns or 0)
            self._writer.hole(Hole(t_ns, self._lost, self._why))
        waiting = self._unsafe
        for begin in range(0, len(waiting), GO_ON_WITH):  # what fits into little room is kept
            for item in waiting[begin : begin + GO_ON_WITH]:
                self._write(item)
            self._writer.flush()
            self._unsafe, self._lost = waiting[begin + GO_ON_WITH :], 0
        self._flush()
        self._lost = 0
        if self.failure is not None:
            self.failure = None
            self._tell(Severity.INFO, f"recording again, into {self.file}")

    def _write_until_stopped(self) -> None:
        every_s = FLUSH_FIRST_S
        flush_due_s = time.monotonic() + every_s
        while self._queue or not self._stopping.wait(GATHER_S) or self._queue:
            for _ in range(min(AT_ONCE, len(self._queue))):
                item = self._queue.popleft()
                self._unsafe.append(item)
                self._write(item)
            if time.monotonic() >= flush_due_s or len(self._unsafe) >= self._queue_max:
                self._flush()
                self._rotate_if_due()
                every_s = min(2 * every_s, FLUSH_S)
                flush_due_s = time.monotonic() + every_s

    def _write(self, item: _Item) -> None:
        if item.missed:
            self._writer.hole(Hole(item.t_ns, item.missed, self._why))
        if item.event is not None:
            self._say_utc(item.event)
            self._writer.event(item.event)
            self.written_ns = item.event.t_ns
        for output in item.outputs:
            self._writer.output(output, self._geodetic)

    def _say_utc(self, event: Event) -> None:
        """Begin each file with what its times lack to be UTC, so that it can be read alone."""
        known = self._clock_set
        if isinstance(event, ClockSet):
            self._clock_set = event
        elif known is not None and not self._writer.messages:
            self._writer.event(replace(known, t_ns=event.t_ns))

    def _flush(self) -> None:
        self._writer.flush()
        self._unsafe.clear()
        self._retry_s = RETRY_FIRST_S
        self.bytes = self._writer.size_bytes

    def _finish(self) -> None:
        if self._missed:
            self._writer.hole(Hole(self.written_ns or 0, self._missed, self._why))
        self._flush()
        self._writer.close(self._metadata)
        self.bytes = self._writer.size_bytes

    def _rotate_if_due(self) -> None:
        size_bytes, after_s = self._rotation.size_bytes, self._rotation.after_s
        large = size_bytes is not None and self.bytes >= size_bytes
        old = after_s is not None and time.monotonic() - self._begun_s >= after_s
        if self._writer.flushed and (large or old):
            self._writer.close({})
            self._open_next()

    def _open_next(self) -> None:
        """Open the next part, or the same one again if nothing of it is on a disk."""
        before = self._writer
        part = self._part.after(before.path.name) if before.flushed else self._part
        made = self._open_part(part)
        self._finished_messages += before.flushed
        self._writer, self._part, self._begun_s = made, part, time.monotonic()

    # --- when the disk fails ----------------------------------------------------------------

    def _fail(self, error: OSError) -> None:
        """Handle a disk error; it is reported once, however often the disk is tried again."""
        self._why = error.strerror or str(error)
        if self.failure is None:
            text = f"nothing is recorded: {self._writer.path}: {self._why}; trying again"
            self._tell(Severity.ERROR, text)
        self.failure = f"{self._writer.path}: {self._why}"
        if not self._writer.salvage():
            self._lost += sum(item.event is not None for item in self._unsafe)
            self.dropped += len(self._unsafe)
            self._unsafe.clear()

    def _reopen(self) -> bool:
        """Try again until it works; False if the service ended before that."""
        while True:
            stopped = self._stopping.wait(self._retry_s)
            try:
                self._require_room()  # asked again as soon: it costs the disk nothing
                self._retry_s = min(2 * self._retry_s, RETRY_MAX_S)
                self._open_next()
                return True
            except OSError as error:
                self._fail(error)
            if stopped:
                self._give_up()
                return False

    def _require_room(self) -> None:
        try:
            found = os.statvfs(self._writer.path.parent)
        except FileNotFoundError:
            return  # the folder is made anew
        if found.f_bavail * found.f_frsize < ROOM_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _give_up(self) -> None:
        self.dropped += len(self._unsafe)
        self.dropped += len(self._queue)
        self._queue.clear()

    def _tell(self, severity: Severity, text: str) -> None:
        self._news.append((severity, text))
