"""What several rooms' tests share: where recordings are, and a running ``companion``."""

import asyncio
import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
import weakref
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import IO, Any, TypeVar

import pytest
from mcap.reader import make_reader

T = TypeVar("T")

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared" / "data"
BIN = Path(sys.executable).parent
HANG_S = 300.0
"""What takes longer hangs. No limit on time in a test says how fast the machine has to be."""
HANG_MS = HANG_S * 1000
BALLAST = "ballast"
"""What fills a disk in tests."""
LONGEST_FRAME = 10 + 255 + 2 + 13
"""Bytes of a MAVLink 2 frame at most: header, payload, checksum, signature."""


def examples(most: int) -> int:
    """Of a property that wants ``most`` of them: all in `make test-all`, else a quarter."""
    return most if os.environ.get("HYPOTHESIS_PROFILE") == "full" else min(most, max(10, most // 4))


def rounds(few: int, most: int) -> int:
    """How often a seeded test draws anew: ``most`` in `make test-all`, else ``few``."""
    return most if os.environ.get("HYPOTHESIS_PROFILE") == "full" else few


def shared_log(name: str) -> Path:
    """A recording that is not part of the product; the test is skipped where it is missing."""
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"{name} is not here: it is not part of the product")
    return path


def fill(folder: Path) -> None:
    """Not a byte is left."""
    with (folder / BALLAST).open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(1 << 16))
        except OSError as error:
            assert error.errno == 28


def read_metadata(path: Path) -> dict[str, dict[str, str]]:
    """The metadata of a finished recording by name, as MCAP's own reader has it."""
    with path.open("rb") as file:
        return {found.name: found.metadata for found in make_reader(file).iter_metadata()}


def end(process: "subprocess.Popen[Any]") -> None:
    """Kill a process that has not ended, and close its pipes.

    They are not read to their end, for a process that it left behind may keep them open.
    """
    process.kill()
    process.wait(HANG_S)
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()


@contextlib.contextmanager
def started(command: Any, **options: Any) -> "Iterator[subprocess.Popen[Any]]":
    """A process that is killed at the end if it has not ended by then, whatever has happened.

    ``subprocess.Popen`` as a context waits for it: after a failure, for ever.
    """
    process = subprocess.Popen(command, **options)
    try:
        yield process
    finally:
        end(process)


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port of loopback that nobody has now, for a program that cannot say which one it got."""
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@contextlib.contextmanager
def dummy_rotator() -> Iterator[int]:
    """Port of hamlib's rotctld with its dummy rotator; skips where there is none."""
    if shutil.which("rotctld") is None:
        pytest.skip("hamlib's rotctld is not here")
    port = free_port()
    command = ["rotctld", "-m", "1", "-T", "127.0.0.1", "-t", str(port)]
    with started(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL):
        yield port


def line_of(process: "subprocess.Popen[Any]", pipe: IO[Any] | None) -> Any:
    """The next line that a process writes; empty where it has ended, or hangs and is killed."""
    assert pipe is not None
    limit = threading.Timer(HANG_S, process.kill)
    limit.daemon = True
    limit.start()
    try:
        return pipe.readline()
    finally:
        limit.cancel()


def run_async(
    work: Coroutine[Any, Any, T], loop: Callable[[], asyncio.AbstractEventLoop] | None = None
) -> T:
    """What a coroutine returns, on an event loop of its own; ``TimeoutError`` where it hangs.

    The limit of pytest-timeout does not do: uvloop does not handle signals while it waits.
    """

    async def limited() -> T:
        async with asyncio.timeout(HANG_S):
            return await work

    with asyncio.Runner(loop_factory=loop) as runner:
        return runner.run(limited())


class Node:
    """A ``companion`` process that serves, and its address."""

    def __init__(self, *arguments: str, code: str | None = None) -> None:
        """``code`` is run in place of the command, with its arguments; None: the command is."""
        # A file: a full pipe that nobody reads would hold the service up.
        self._errors, name = tempfile.mkstemp()
        Path(name).unlink()
        weakref.finalize(self, os.close, self._errors)
        self.process = subprocess.Popen(
            [*([BIN / "companion"] if code is None else [sys.executable, "-c", code]), *arguments],
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        line = line_of(self.process, self.process.stdout)
        found = re.search(r"serves (http://\S+) and listens on .*", line)
        if found is None:
            end(self.process)
            pytest.fail(f"did not start: {line!r} {self.errors()}")
        self.url = found[1]
        udp = re.search(r"udpin:127\.0\.0\.1:(\d+)", found[0])
        self.udp_port = int(udp[1]) if udp else 0  # links may all be receivers

    def errors(self) -> str:
        """What it has written to stderr so far."""
        return os.pread(self._errors, os.fstat(self._errors).st_size, 0).decode()

    def get(self, path: str, accept: str = "application/json") -> tuple[int, bytes]:
        """Status and body."""
        request = urllib.request.Request(self.url + path, headers={"accept": accept})
        try:
            with urllib.request.urlopen(request, timeout=HANG_S) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read()

    def json(self, path: str) -> Any:
        """A body that must be there."""
        status, body = self.get(path)
        assert status == 200, body
        return json.loads(body)

    def wait_until(self, path: str, good: Any, seconds: float = HANG_S) -> Any:
        """Ask until the answer is good; returns it."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            answer = json.loads(self.get(path)[1])
            if good(answer):
                return answer
            time.sleep(0.02)  # between two questions to another process
        pytest.fail(f"{path} still answers {answer}")

    def stop(self, number: signal.Signals = signal.SIGTERM) -> tuple[int, str, str]:
        """Exit status, stdout and stderr after a signal."""
        self.process.send_signal(number)
        out, _ = self.process.communicate(timeout=HANG_S)
        return self.process.returncode, out, self.errors()
