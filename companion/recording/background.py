"""Recorder on its own thread, so that the event loop never waits for a disk.

The queue is bounded; events that do not fit are counted and reported. After a disk error, writing
is retried with growing delays; on a full disk, as soon as the disk has space. Events not yet on the
disk are kept in the queue, and the recording continues in a new file, which states what is missing.
A disk that is full or read-only at the start is treated alike: the service must serve beams.

Over 300 lines: one thread with its queue, its failures and its parts.
"""

import errno
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from companion.recording.entries import Geodetic
from companion.recording.folders import DISK_FAULTS
from companion.recording.parts import Hole, Part
from companion.recording.writer import Writer
from companion.values import ClockSet, Event, Output, Severity, Update

QUEUE_MAX: Final = 50_000
"""Limit on events waiting to be written: some seconds of the busiest traffic.

About 60 MB if twenty UAVs report ten times a second (1.3 kB per event with its outputs).
"""
GATHER_S: Final = 0.02
"""Time for which events are collected: waking the thread costs as much as writing one event."""
UPDATES_MAX_BYTES: Final = 32 << 20
"""Limit on the updates that wait to be written; a replay computes those that do not fit."""
TRACK_BYTES: Final = 3000  # memory that an update takes for each track, and its beam
AT_ONCE: Final = 500  # events between two checks whether a flush is due
FLUSH_S: Final = 1.0  # time between two flushes to disk
FLUSH_FIRST_S: Final = 0.1
"""Time before the first flush of a file; it then doubles, so that a short run is saved too."""
RETRY_FIRST_S: Final = 1.0
"""Time before the first retry after a disk error; the time doubles with each retry.

Free space on a full disk is checked without writing, at the interval of the first retry.
"""
RETRY_MAX_S: Final = 30.0  # longest time between two retries
STALLED_S: Final = 5.0
"""Time without a flush after which the disk is reported not to answer."""
STOP_MAX_S: Final = 10.0
"""Longest wait at the end of the service for a disk that takes nothing, seconds."""
RESUME_BATCH: Final = 2000
"""Events written at once when a recording continues: some hundred kilobytes."""
INDEX_MAX_BYTES: Final = 8 << 20
"""Size of a part's index, which is kept in memory until its end, at which a new part begins."""
CHANNELS_MAX: Final = 20_000
"""Topics of a part after which a new one begins, as each UAV has its own: MCAP allows 65 535."""
MIN_FREE_BYTES: Final = 8 << 20
"""Free space needed to continue a recording; with less, it would soon stop again."""

_TOO_SLOW: Final = "the disk was too slow"


@dataclass(frozen=True, slots=True)
class Rotation:
    """When a new part of a recording begins: at a size in bytes or after seconds; None: never.

    With either limit, one also begins when the index of a part reaches ``INDEX_MAX_BYTES``; with or
    without, at ``CHANNELS_MAX`` topics.
    """

    size_bytes: float | None = None
    after_s: float | None = None


NEVER: Final = Rotation()  # never begin a new part


class _Item(NamedTuple):
    """Event with its outputs; ``missed`` events before it did not fit into the queue.

    ``size_bytes`` is the memory that updates among the outputs take.
    """

    event: Event | None
    outputs: Sequence[Output]
    missed: int
    size_bytes: int

    @property
    def t_ns(self) -> int:
        return self.event.t_ns if self.event is not None else 0


class BackgroundRecorder:
    """Recorder on a thread, with one ``Writer`` for each part from ``start`` to ``stop``.

        open_part  creates the writer of a part. The first is created at once, and its ``OSError``
                   is raised to the caller if it is none of ``DISK_FAULTS``
        folder     where the parts are written
        geodetic   converts positions, for ``Encoder.output``
        rotation   when a new part begins
        queue_max  limit on queued events

    Attributes: ``failure`` is the current error, ``dropped`` counts events that were not recorded,
    ``messages`` those that were, and ``bytes`` is the size of the newest file.
    """

    def __init__(
        self,
        *,
        open_part: Callable[[Part], Writer],
        folder: Path,
        geodetic: Geodetic,
        rotation: Rotation = NEVER,
        queue_max: int = QUEUE_MAX,
    ) -> None:
        self.bytes = 0
        self.dropped = 0
        self.written_ns: int | None = None
        """Time of the newest written event; None before the first."""
        self.failure: str | None = None
        self._open_part = open_part
        self._geodetic = geodetic
        self._rotation = rotation
        self._folder = folder
        self._part = Part.first()
        self._begun_s = self._flushed_s = time.monotonic()
        self._watched_s = self._resumed_s = self._begun_s
        self._is_stalled = False
        self._finished_messages = 0  # messages in earlier parts
        self._queue: deque[_Item] = deque()  # bounded by ``put``, which never blocks
        self._queue_max = queue_max
        self._put_bytes = self._freed_bytes = 0  # of updates; each is counted on one thread
        self._missed = 0
        self._overrun = False
        self._has_ended = False  # by a defect
        self._unflushed: list[_Item] = []  # written, but not yet flushed to the disk
        self._clock_set: ClockSet | None = None
        self._lost = 0  # events that may or may not be on the disk
        self._why = _TOO_SLOW
        self._retry_s = RETRY_FIRST_S
        self._news: deque[tuple[Severity, str]] = deque(maxlen=100)
        self._metadata: dict[str, str] = {}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._open: Writer | None = None
        try:
            self._open = open_part(self._part)
        except OSError as error:
            if error.errno not in DISK_FAULTS:
                raise
            self._fail(error)

    # --- called on the event loop -----------------------------------------------------------

    def start(self) -> None:
        """Start to write events."""
        self._thread.start()

    def put(self, event: Event | None, outputs: Sequence[Output]) -> None:
        """Queue an event and its outputs; the event is None for outputs without an event.

        Never blocks. Call it on one thread only.

        Once the queue is full, nothing is accepted until half of it is written: one long gap can be
        reported, a thousand short ones would make the recording useless.
        """
        if self._has_ended:
            self.dropped += 1
            return
        if self._overrun and len(self._queue) <= self._queue_max // 2:
            self._overrun = False
            self._tell(Severity.INFO, f"recording again: {self._missed} events are missing")
        if not self._overrun:
            if len(self._queue) < self._queue_max:
                outputs, size_bytes = self._that_fit(outputs)
                self._queue.append(
                    _Item(event=event, outputs=outputs, missed=self._missed, size_bytes=size_bytes)
                )
                self._missed = 0
                return
            self._overrun = True
            if self.failure is None:
                self._tell(Severity.ERROR, "some events are not recorded: the disk is too slow")
        self.dropped += 1
        self._missed += event is not None

    def _that_fit(self, outputs: Sequence[Output]) -> tuple[Sequence[Output], int]:
        """Return the outputs without updates that do not fit, and the bytes of those that do."""
        if not outputs:
            return outputs, 0
        size_bytes = sum(
            one.beams.weights.nbytes + TRACK_BYTES * len(one.tracks)
            for one in outputs
            if isinstance(one, Update)
        )
        if self._put_bytes - self._freed_bytes + size_bytes <= UPDATES_MAX_BYTES:
            self._put_bytes += size_bytes
            return outputs, size_bytes
        return [one for one in outputs if not isinstance(one, Update)], 0

    def stop(self, metadata: dict[str, str]) -> None:
        """Write the queue, finish the file and return when it is on the disk.

        After a disk error, writing is retried once. A disk that takes nothing for ``STOP_MAX_S``
        seconds is not waited for.
        """
        self._metadata = metadata
        self._stopping.set()
        taken = None
        while self._thread.is_alive() and taken != (self.messages, self._flushed_s):
            taken = (self.messages, self._flushed_s)
            self._thread.join(STOP_MAX_S)
        if self._thread.is_alive():
            self._tell(Severity.ERROR, f"{self._where} is incomplete: the disk does not answer")

    def news(self) -> list[tuple[Severity, str]]:
        """Return the messages for the operator since the last call. Call it regularly."""
        self._watch_for_stall()
        told = []
        while self._news:
            told.append(self._news.popleft())
        return told

    @property
    def degraded(self) -> bool:
        """Whether some events are not being recorded, or wait for a disk that does not answer."""
        return self.failure is not None or self._overrun or self._is_stalled

    @property
    def file(self) -> str | None:
        """Name of the newest file of the recording; None before the first."""
        return None if self._open is None else self._open.path.name

    @property
    def messages(self) -> int:
        """Messages recorded in all parts so far."""
        return self._finished_messages + (0 if self._open is None else self._open.messages)

    @property
    def queued(self) -> int:
        """Number of events that wait to be written."""
        return len(self._queue)

    def _watch_for_stall(self) -> None:
        """Publish a notice when the disk does not answer, and when it does again."""
        is_waiting = bool(self._queue or self._unflushed) and self.failure is None
        now_s = time.monotonic()
        if now_s - self._watched_s > STALLED_S / 2:  # the process was stopped meanwhile
            self._resumed_s = now_s
        self._watched_s = now_s
        waited_s = now_s - max(self._flushed_s, self._resumed_s)
        was_stalled, self._is_stalled = self._is_stalled, is_waiting and waited_s > STALLED_S
        if self._is_stalled and not was_stalled:
            text = f"the disk has not answered for {STALLED_S:.0f} s; events wait in memory"
            self._tell(Severity.ERROR, f"{self._where}: {text}")
        elif was_stalled and not self._is_stalled and self.failure is None:
            self._tell(Severity.INFO, "the disk answers again")

    # --- called on the thread ---------------------------------------------------------------

    @property
    def _writer(self) -> Writer:
        """Writer of the newest part, once there is one."""
        assert self._open is not None
        return self._open

    @property
    def _where(self) -> Path:
        return self._folder if self._open is None else self._open.path

    def _run(self) -> None:
        try:
            self._write_parts()
        except Exception as defect:  # must not end the recording silently
            self._why = f"{type(defect).__name__}: {defect}"
            self.failure = f"{self._where}: {self._why}"
            self._tell(Severity.ERROR, f"nothing is recorded any more: {self.failure}")
            self._has_ended = True
            self._give_up()
            raise

    def _write_parts(self) -> None:
        tried = False  # whether writing was tried again since the stop
        while self._open is None or not self._record():
            if tried:
                self._give_up()
                return
            tried = self._stopping.is_set()
            if not self._reopen():
                return

    def _record(self) -> bool:
        """Write queued events until stopped; return False after an error."""
        try:
            self._resume()
            self._write_until_stopped()
            self._finish()
        except OSError as error:
            self._fail(error)
            return False
        return True

    def _resume(self) -> None:
        """Begin a file with the events that could not be written to the previous file."""
        if self._lost:
            t_ns = next((item.t_ns for item in self._unflushed if item.t_ns), self.written_ns or 0)
            self._writer.hole(Hole(t_ns, self._lost, self._why))
        waiting = self._unflushed
        for begin in range(0, len(waiting), RESUME_BATCH):  # as much as fits on the disk is kept
            for item in waiting[begin : begin + RESUME_BATCH]:
                self._write(item)
            self._writer.flush()
            self._free(waiting[begin : begin + RESUME_BATCH])
            self._unflushed, self._lost = waiting[begin + RESUME_BATCH :], 0
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
                self._unflushed.append(item)
                self._write(item)
            is_full = len(self._unflushed) >= self._queue_max or self._has_many_channels()
            if is_full or time.monotonic() >= flush_due_s:
                self._flush()
                self._rotate_if_due()
                every_s = min(2 * every_s, FLUSH_S)
                flush_due_s = time.monotonic() + every_s

    def _write(self, item: _Item) -> None:
        if item.missed:
            self._writer.hole(Hole(item.t_ns, item.missed, self._why))
        if item.event is not None:
            self._write_utc(item.event)
            self._writer.event(item.event)
            self.written_ns = item.event.t_ns
        for output in item.outputs:
            self._writer.output(output, self._geodetic)

    def _write_utc(self, event: Event) -> None:
        """Begin each file with the offset to UTC, so that one file alone can be read."""
        known = self._clock_set
        if isinstance(event, ClockSet):
            self._clock_set = event
        elif known is not None and not self._writer.messages:
            self._writer.event(replace(known, t_ns=event.t_ns))

    def _flush(self) -> None:
        self._writer.flush()
        self._free(self._unflushed)
        self._unflushed.clear()
        self._retry_s = RETRY_FIRST_S
        self.bytes = self._writer.size_bytes
        self._flushed_s = time.monotonic()

    def _free(self, written: Sequence[_Item]) -> None:
        self._freed_bytes += sum(item.size_bytes for item in written)

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
        indexed = self._rotation != NEVER and self._writer.index_bytes >= INDEX_MAX_BYTES
        if self._writer.flushed and (large or old or indexed or self._has_many_channels()):
            self._writer.close({}, is_continued=True)
            self.bytes = self._writer.size_bytes  # also if the next part cannot be opened
            self._open_next()

    def _has_many_channels(self) -> bool:
        return self._writer.channels >= CHANNELS_MAX

    def _open_next(self) -> None:
        """Open the next part, or the same part again if none of it is on the disk."""
        before, part, flushed = self._open, self._part, 0
        if before is not None and before.flushed:
            part, flushed = part.after(before.path.name), before.flushed
        made = self._open_part(part)
        self._finished_messages += flushed
        self.bytes = made.size_bytes
        self._open, self._part = made, part
        self._begun_s = self._flushed_s = time.monotonic()

    # --- disk errors ------------------------------------------------------------------------

    def _fail(self, error: OSError) -> None:
        """Handle a disk error; publish a notice of the first, but not of failed retries."""
        self._why = error.strerror or str(error)
        if self.failure is None:
            text = f"nothing is recorded: {self._where}: {self._why}; trying again"
            self._tell(Severity.ERROR, text)
        self.failure = f"{self._where}: {self._why}"
        if self._open is not None and not self._open.salvage():
            self._lost += sum(item.event is not None for item in self._unflushed)
            self.dropped += len(self._unflushed)
            self._free(self._unflushed)
            self._unflushed.clear()

    def _reopen(self) -> bool:
        """Retry to open a file until that succeeds; return False if the service ends before."""
        while True:
            stopped = self._stopping.wait(self._retry_s)
            try:
                self._require_room()  # checked at the same short interval, as it costs nothing
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
            found = os.statvfs(self._folder if self._open is None else self._open.path.parent)
        except FileNotFoundError:
            return  # the folder will be created
        if found.f_bavail * found.f_frsize < MIN_FREE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _give_up(self) -> None:
        lost = len(self._unflushed) + len(self._queue)
        self.dropped += lost
        self._unflushed.clear()
        self._queue.clear()
        if lost:
            self._tell(Severity.ERROR, f"the last {lost} events are not recorded: {self._why}")

    def _tell(self, severity: Severity, text: str) -> None:
        self._news.append((severity, text))
