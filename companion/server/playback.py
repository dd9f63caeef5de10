"""Samples of whole recordings, for playing one on the page: read by a process beside the service.

A replay takes as much interpreter time as a live run, so it must not share the interpreter of the
links and beams. One recording is read at a time. A request starts the process, and further ones get
its progress, until the samples are complete. They are kept until another recording is requested. A
process for which nobody asks any more is ended.
"""

import asyncio
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import orjson

from companion.server.recordings import Version
from companion.server.shared_work import seen
from companion.server.threads import in_thread
from companion.values.described import Meaning

IDLE_S: Final = 10.0  # time without a request after which another recording may be read
READ_MAX_S: Final = 900.0  # longest time for one recording
LINE_MAX_BYTES: Final = 1 << 25  # largest answer of the process
MODULE: Final = "companion.node.recorded_history"


@dataclass(slots=True, kw_only=True)
class Reading:
    """Progress of a recording that is being read."""

    at_s: Annotated[float, Meaning("time within the recording that has been read")] = 0.0
    of_s: Annotated[float | None, Meaning("length of the recording; null: unknown")] = None


class BusyError(Exception):
    """Error of a request for a recording while another one is being read."""


class PlaybackError(Exception):
    """Error of a recording that cannot be read; the text says why."""


class Playback:
    """Samples of the recording that was requested last, used on the event loop."""

    def __init__(self) -> None:
        self._version: Version | None = None
        self._task: asyncio.Task[bytes] | None = None
        self._reading = Reading()
        self._asked_s = 0.0

    async def samples(self, version: Version) -> bytes | Reading:
        """Return the samples of a recording as JSON, or the progress while it is being read.

        Raises ``BusyError`` while another recording is being read for a client that still asks, and
        ``PlaybackError``.
        """
        now_s = asyncio.get_running_loop().time()
        task, previous = self._task, None
        if version != self._version and task is not None:
            if not task.done() and now_s - self._asked_s < IDLE_S:
                raise BusyError
            task.cancel()
            task, previous = None, task
        self._asked_s = now_s
        if task is None:
            self._version, self._reading = version, Reading()
            self._task = task = asyncio.create_task(
                self._read(version.path, self._reading, previous)
            )
            task.add_done_callback(seen)
        reading = self._reading
        await asyncio.wait([task], timeout=1.0)  # a short recording is answered at once
        if not task.done():
            return reading
        if task.cancelled() or task.exception() is not None:
            if self._task is task:
                self._version = self._task = None  # the next request tries again
            raise PlaybackError("reading it was ended" if task.cancelled() else task.exception())
        return task.result()

    async def _read(
        self, path: Path, reading: Reading, previous: "asyncio.Task[bytes] | None"
    ) -> bytes:
        """Start the process, and end it when it takes too long or nobody asks any more.

        It starts once the process of the ``previous`` recording has ended.
        """
        if previous is not None:
            await asyncio.wait([previous])
        loop = asyncio.get_running_loop()
        begun_s, process = loop.time(), await _started(path)
        following = asyncio.create_task(in_thread(_last_line, process, reading))
        try:
            while loop.time() - begun_s < READ_MAX_S and loop.time() - self._asked_s < IDLE_S:
                await asyncio.wait([following], timeout=1.0)
                if following.done():
                    break
        finally:
            process.kill()
            line = await following
        if line.startswith(b'{"valid_at"'):
            return line
        if line.startswith(b'{"problem"'):
            raise PlaybackError(orjson.loads(line)["problem"])
        raise PlaybackError("reading it took too long, or was ended")


async def _started(path: Path) -> "subprocess.Popen[bytes]":
    """Start the process on a thread; end it if the caller is cancelled meanwhile."""
    starting = asyncio.create_task(in_thread(_start, path))
    try:
        return await asyncio.shield(starting)
    except asyncio.CancelledError:
        process = await starting
        process.kill()
        await in_thread(_last_line, process, Reading())
        raise


def _start(path: Path) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        [sys.executable, "-m", MODULE, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )


def _last_line(process: "subprocess.Popen[bytes]", reading: Reading) -> bytes:
    """Follow the progress of a process; return its last line."""
    with process:
        assert process.stdout is not None
        while line := process.stdout.readline(LINE_MAX_BYTES):
            if not line.startswith(b'{"at_s"'):
                return line
            progress = orjson.loads(line)
            reading.at_s, reading.of_s = progress["at_s"], progress["of_s"]
    return b""
