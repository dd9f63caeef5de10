"""Ports in use and shutdown at a bad time: reported, and no data is lost."""

import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support import BIN, HANG_S, run_async, started

from companion.mavlink.links import daemon_threads
from companion.node import serving
from companion.recording import schemas
from companion.recording.container import MAGIC

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "home")


def started_in_the_background(*arguments: str) -> "subprocess.Popen[str]":
    """Start as by ``companion run … &`` in a script, where the shell ignores SIGINT."""
    ignoring = "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN);"
    code = f"{ignoring} os.execv(sys.argv[1], sys.argv[1:])"
    return subprocess.Popen(
        [sys.executable, "-c", code, str(BIN / "companion"), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def test_background_process_ends_on_sigterm(tmp_path: Path) -> None:
    with started_in_the_background(*RUN, "--record", str(tmp_path)) as process:
        assert process.stdout is not None
        assert "serves" in process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert process.wait(HANG_S) == 0
    assert [file.suffix for file in tmp_path.iterdir()] == [".mcap"]


def ended(save: Callable[[], None], told: list[str], *, most_s: float | None) -> bool:
    found = list[bool]()

    async def test() -> None:
        found.append(await serving.saved_at_end(save, "it", told.append, most_s=most_s))

    run_async(test())
    return found[0]


def test_disk_that_does_not_answer_at_the_end_is_told_and_waited_for_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(serving, "DISK_WAIT_NOTICE_S", 0.05)
    told, answers = list[str](), threading.Event()
    assert ended(lambda: None, told, most_s=None)
    assert told == []
    assert not ended(lambda: [answers.wait()][0] and None, told, most_s=0.05)
    assert told == ["waiting for the disk to take it; a signal ends the service at once"]
    late = threading.Timer(0.3, answers.set)
    answers.clear()
    late.start()
    assert ended(lambda: [answers.wait(HANG_S)][0] and None, told, most_s=None)
    assert len(told) == 2


def no_thread(_: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def test_end_needs_no_new_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under a limit of processes a recording would be left unfinished."""
    monkeypatch.setattr(threading.Thread, "start", no_thread)
    monkeypatch.setattr(serving, "DISK_WAIT_NOTICE_S", 0.05)
    told, saved = list[str](), list[int]()
    assert ended(lambda: saved.append(1), told, most_s=0.05)
    assert (saved, told) == ([1], [])


def test_work_in_the_background_waits_for_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shortage that passes ends no service."""
    monkeypatch.setattr(daemon_threads, "THREAD_RETRY_S", 0.0)
    start, refused = threading.Thread.start, list[int]()

    def third(thread: threading.Thread) -> None:
        if len(refused) < 2:
            refused.append(1)
            no_thread(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", third)
    assert run_async(daemon_threads.in_daemon_thread(threading.current_thread)).name == "background"
    assert len(refused) == 2


WAITS = """
import asyncio, sys, threading
from companion.node import serving

serving.DISK_WAIT_NOTICE_S = 0.1

def say(text):
    print(text, file=sys.__stdout__, flush=True)  # what others print goes to stderr

async def main(until):
    say("ready")
    await until.wait()
    say("ending")
    await asyncio.to_thread(input)
    forever = threading.Event().wait
    await serving.saved_at_end(forever, "it", say, most_s=None)

serving.run_until_stopped(main)
"""


def test_signal_ends_a_service_that_waits_for_its_disk() -> None:
    """Not one that comes before: a wrapper may send the first one twice."""
    with started(
        [sys.executable, "-c", WAITS],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        assert process.stdout.readline() == "ending\n"
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGTERM)
        print(file=process.stdin, flush=True)
        assert "waiting for the disk" in process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert process.wait(HANG_S) == 1
        said = process.stderr.read()
        assert said == "companion: ended by a signal, without waiting for the disk\n"


@pytest.mark.full
def test_shutdown_does_not_wait_for_recovery(tmp_path: Path, start_node: Any) -> None:
    """Recovery takes half a minute; the leftover file remains for the next start."""
    leftover = tmp_path / "companion-1.mcap.active"
    leftover.write_bytes(MAGIC + _many_messages() * 10)
    node = start_node(*RUN, "--record", str(tmp_path))
    partial = tmp_path / "companion-1.mcap.recovering"
    until = time.monotonic() + HANG_S
    while not partial.exists() and time.monotonic() < until:
        time.sleep(0.01)  # polling interval for another process
    assert partial.exists()
    returncode, _, err = node.stop()
    assert returncode == 0, err
    assert leftover.exists()  # it did not wait for recovery


def _many_messages() -> bytes:
    """Return an uncompressed chunk of half a million messages."""
    name, protobuf = schemas.FRAMES_TOPIC.encode(), b"protobuf"
    schema = struct.pack("<H", 1) + _text(b"companion.Frame") + _text(protobuf) + _text(b"")
    channel = struct.pack("<HH", 1, 1) + _text(name) + _text(protobuf) + _text(b"")
    contents = _record(3, schema) + _record(4, channel)
    contents += _record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + b"\x09" + bytes(8)) * 500_000
    head = struct.pack("<QQQI", 0, 0, len(contents), 0) + _text(b"")
    return _record(6, head + struct.pack("<Q", len(contents)) + contents)


def _text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


@pytest.mark.parametrize("way", ["link", pytest.param("listen", marks=pytest.mark.full)])
def test_second_service_on_the_same_ports_fails_with_one_line(start_node: Any, way: str) -> None:
    node = start_node(*RUN)
    taken = {
        "link": f"udpin:127.0.0.1:{node.udp_port}",
        "listen": node.url.removeprefix("http://"),
    }[way]
    free = {"link": "udpin:127.0.0.1:0", "listen": "127.0.0.1:0"} | {way: taken}
    done = subprocess.run(
        [BIN / "companion", "run", "--link", free["link"], "--listen", free["listen"],
         "--center", "home"],
        capture_output=True, text=True, check=False, timeout=HANG_S,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr == f"companion: {taken}: Address already in use\n"
    assert node.get("/healthz")[0] == 200
