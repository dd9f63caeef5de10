"""Weights pushed over UDP to a receiver that does not listen yet."""

import asyncio
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support import BALLAST, HANG_S, ROOT, fill, free_port, run_async

from companion.node import moment
from companion.node.push import RECOVERED_AFTER, RING_RETRY_NS, Push
from companion.node.ring import SLOT_BYTES, SLOTS, Ring
from companion.node.service import Service
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.settings.outlets import RecordSettings
from companion.values import Notice, Severity, Update, UserError
from companion.views import records


def pushing(
    way: RecordSettings, now_ns: Callable[[], int] = lambda: 0
) -> tuple[Push, Update, list[Notice]]:
    """Outputs that are not open yet, an update, and the list of their notices."""
    settings = Settings().override(center={"source": "5:1"})
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    pipeline, update = moment.look([log], settings, "3")
    equipment, notices = assembly.equipment(settings, pipeline.array), list[Notice]()
    push = Push(
        settings=way, pipeline=pipeline, equipment=equipment, notify=notices.append, now_ns=now_ns
    )
    return push, update, notices


def test_full_shared_memory_is_announced_and_tried_again(small_disk: Path) -> None:
    """A page that cannot be allocated ends the process at its first write."""
    path, clock = small_disk / "ring", [0]
    push, update, notices = pushing(RecordSettings(shared_memory=str(path)), lambda: clock[0])
    fill(small_disk)
    push.open()
    push.newest(update, 0)
    assert [one.severity for one in notices] == [Severity.ERROR]
    assert "No space left" in notices[0].text
    assert [one.name for one in small_disk.iterdir()] == [BALLAST]
    (small_disk / BALLAST).unlink()
    push.newest(update, 1)
    assert not path.exists()
    path.write_text("of another program")
    clock[0] = RING_RETRY_NS
    push.newest(update, 2)
    assert path.read_text() == "of another program"
    path.unlink()
    clock[0] = 2 * RING_RETRY_NS
    push.newest(update, 3)
    assert [one.severity for one in notices] == [Severity.ERROR, Severity.INFO]
    assert path.stat().st_blocks * 512 >= path.stat().st_size > SLOTS * SLOT_BYTES
    push.close()


def test_ring_of_a_killed_service_makes_room_for_the_next(small_disk: Path) -> None:
    """Memory that holds one ring holds no second one beside it."""
    path = small_disk / "ring"
    code = "import sys; from companion.node.ring import Ring, Path; Ring(Path(sys.argv[1]))"
    subprocess.run([sys.executable, "-c", code, path], check=True, timeout=HANG_S)  # not closed
    room = os.statvfs(small_disk)
    assert room.f_bavail * room.f_frsize < SLOTS * SLOT_BYTES
    Ring(path).close()
    assert list(small_disk.iterdir()) == []


def test_refused_udp_push_and_recovery_are_announced_once() -> None:
    to = ("127.0.0.1", free_port(socket.SOCK_DGRAM))
    push, update, notices = pushing(RecordSettings(udp=(f"{to[0]}:{to[1]}",)))

    async def test() -> None:
        task = asyncio.create_task(push.run())

        async def pushed(number: int) -> None:
            for n in range(number):
                push.newest(update, n)
                await asyncio.sleep(0)
                await asyncio.sleep(0)

        await pushed(
            RECOVERED_AFTER
        )  # every second datagram reports that the previous one was refused
        assert [one.text.partition(":")[2] for one in notices] == [
            f"{to[1]} fail: Connection refused"
        ]
        with socket.socket(type=socket.SOCK_DGRAM) as listener:
            listener.bind(to)
            await pushed(RECOVERED_AFTER + 1)
        assert [one.text for one in notices[1:]] == [
            f"records to {to[0]}:{to[1]} can be sent again"
        ]
        task.cancel()

    push.open()
    run_async(test())
    push.close()


def test_records_are_sent_without_guaranteed_gains_while_no_thread_can_be_started(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A limit of processes, or of memory, ended the service."""

    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    async def sent(push: Push, update: Update, listener: socket.socket, number: int) -> list[bool]:
        push.newest(update, number)
        loop, found = asyncio.get_running_loop(), list[bool]()
        while len(found) < len(update.beams.beams):
            record = await loop.sock_recv(listener, 1 << 16)
            header = np.frombuffer(record, records.HEADER, 1)[0]
            beams = np.frombuffer(record, records.BEAM, header["beams"], header["beams_at"])
            found += np.isfinite(beams["guaranteed_gain_db"]).tolist()
        return found

    async def test(push: Push, update: Update, listener: socket.socket) -> None:
        async with asyncio.TaskGroup() as group:
            task = group.create_task(push.run())
            with monkeypatch.context() as patch:
                patch.setattr(threading.Thread, "start", refuse)
                assert not any(await sent(push, update, listener, 0))
            assert any(await sent(push, update, listener, 1))
            task.cancel()

    with socket.socket(type=socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.setblocking(False)
        to = f"127.0.0.1:{listener.getsockname()[1]}"
        push, update, _ = pushing(RecordSettings(udp=(to,), guaranteed=True))
        push.open()
        run_async(test(push, update, listener))
        push.close()


def test_ring_of_a_running_service_is_not_replaced(small_disk: Path) -> None:
    path = small_disk / "ring"
    running = Ring(path)
    with pytest.raises(UserError, match="in use by another process"):
        Ring(path)
    assert list(small_disk.iterdir()) == [path]
    running.close()


@pytest.mark.parametrize("fails", ["ring", "recording"])
def test_start_that_fails_leaves_no_files(fails: str, small_disk: Path) -> None:
    """Neither a recording without content nor a ring without a writer."""
    ring, folder = small_disk / "ring", small_disk / "recordings"
    if fails == "ring":
        running = Ring(ring)
    else:
        folder.write_text("no folder")
    settings = Settings().override(
        center={"source": "5:1"},
        records={"shared_memory": str(ring)},
        recording={"directory": str(folder)},
    )
    with pytest.raises((OSError, UserError)):
        Service(settings=settings, say=lambda _: None)
    if fails == "ring":
        running.close()
        assert not folder.exists() or not list(folder.iterdir())
    assert not ring.exists()
