"""What several rooms' tests share: where recordings are, and a running ``companion``."""

import json
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared" / "data"
BIN = Path(sys.executable).parent
HANG_S = 300.0
"""What takes longer hangs. No limit on time in a test says how fast the machine has to be."""
HANG_MS = HANG_S * 1000
LONGEST_FRAME = 10 + 255 + 2 + 13
"""Bytes of a MAVLink 2 frame at most: header, payload, checksum, signature."""


def shared_log(name: str) -> Path:
    """A recording that is not part of the product; the test is skipped where it is missing."""
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"{name} is not here: it is not part of the product")
    return path


def read_metadata(path: Path) -> dict[str, dict[str, str]]:
    """The metadata of a finished recording by name, as MCAP's own reader has it."""
    with path.open("rb") as file:
        return {found.name: found.metadata for found in make_reader(file).iter_metadata()}


class Node:
    """A ``companion`` process that serves, and its address."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [BIN / "companion", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        found = re.search(r"serves (http://\S+) and listens on udpin:127\.0\.0\.1:(\d+)", line)
        if found is None:
            self.process.kill()
            pytest.fail(f"did not start: {line!r} {self.process.communicate()[1]}")
        self.url, self.udp_port = found[1], int(found[2])

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
        out, err = self.process.communicate(timeout=HANG_S)
        return self.process.returncode, out, err
