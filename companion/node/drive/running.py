"""Driving a device: as a command, and inside a service."""

import asyncio
import contextlib
import signal
import threading
from collections.abc import Callable
from typing import Final

from companion.node.drive.loop import Drive, DriveStatus
from companion.node.signals import ENDS

STATUS_EVERY_S: Final = 1.0
ENDS_S: Final = 3.5
"""Time limit for a device to reach its safe state at the end; printing may take another second."""


def run_until_stopped(
    drive: Drive, show: Callable[[DriveStatus], None], seconds: float | None
) -> bool:
    """Drive a device until a signal of ``ENDS``, or ``seconds`` have passed.

    ``show`` is called once a second. Return whether a signal stopped it. Raises the exception that
    ended the drive.
    """
    stop, received = threading.Event(), list[int]()

    def interrupt(number: int, _frame: object) -> None:
        received.append(number)
        stop.set()

    for known in ENDS:
        signal.signal(known, interrupt)
    failed: list[BaseException] = []
    thread = threading.Thread(target=_run, args=(drive, stop, failed), name="drive", daemon=True)
    thread.start()
    left_s = seconds
    try:
        while thread.is_alive() and not stop.is_set():
            step_s = STATUS_EVERY_S if left_s is None else min(STATUS_EVERY_S, left_s)
            if stop.wait(step_s):
                break
            drive.report_wait()
            show(drive.status())
            if left_s is not None:
                left_s -= step_s
                if left_s <= 0:
                    stop.set()
    finally:  # also if nobody can be shown anything any more
        stop.set()
        thread.join(ENDS_S)
        if thread.is_alive():
            drive.report_unsafe()
    if failed:
        raise failed[0]
    return bool(received)


async def run_in_thread(drive: Drive) -> None:
    """Drive a device on a thread until cancelled; raises the exception that ended the drive."""
    stop, failed = threading.Event(), list[BaseException]()
    loop, ended = asyncio.get_running_loop(), asyncio.Event()

    def run() -> None:
        _run(drive, stop, failed)
        with contextlib.suppress(RuntimeError):  # nobody waited for the device, and the loop ended
            loop.call_soon_threadsafe(ended.set)

    thread = threading.Thread(target=run, name="drive", daemon=True)
    thread.start()
    try:
        while not ended.is_set():
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(ended.wait(), STATUS_EVERY_S)
            drive.report_wait()
    finally:
        stop.set()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(ended.wait(), ENDS_S)
        if not ended.is_set():
            drive.report_unsafe()
    if failed:
        raise failed[0]


def _run(drive: Drive, stop: threading.Event, failed: list[BaseException]) -> None:
    try:
        drive.run(stop)
    except BaseException as error:  # the caller waits for the thread, whatever ended it
        failed.append(error)
        stop.set()
