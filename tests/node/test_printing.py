"""Output on a thread: in order, bounded, and without waiting for who reads it."""

import os
import resource
import select
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from support import HANG_S

from companion.cli import voice
from companion.node import printing
from companion.node.printing import Printer


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    read, write = os.pipe()
    yield read, write
    for one in (read, write):
        os.close(one)


def test_lines_are_printed_in_order_without_control_characters(pipe: tuple[int, int]) -> None:
    read, write = pipe
    printer = Printer(write)
    for text in ("one", "two\x1b[2J"):
        printer.line(text)
    printer.status("only on a terminal")
    printer.finish()
    said = os.read(read, 1000)
    assert said.startswith(b"one\ntwo") and said.count(b"\n") == 2 and b"\x1b" not in said


def test_lines_that_nobody_reads_are_dropped_and_counted(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(printing, "LAST_S", 0.01)
    monkeypatch.setattr(printing, "_timed_out", threading.Event())
    read, write = pipe
    printer, line = Printer(write), "x" * 99
    for _ in range(30_000):  # 3 MB
        printer.line(line)
    said = b""
    while b"not printed" not in said:
        said += os.read(read, 1 << 20)
    lines = said.decode().splitlines()
    assert set(lines[:-1]) == {line}
    assert lines[-1] == f"lines not printed: {30_000 - len(lines[:-1])} (nobody read them)"
    assert len(said) < 2 * printing.WAITING_MAX


def test_nothing_is_printed_between_data_for_a_program(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(printing, "WAITING_MAX", 1000)
    read, write = pipe
    printer = Printer(write, are_data=True)
    for _ in range(30_000):
        printer.line("{}" + " " * 97)
    os.set_blocking(read, False)
    said = b""
    while printer._waiting or not printer._is_idle:
        with suppress(BlockingIOError):
            said += os.read(read, 1 << 20)
    assert printer.dropped and {line.strip() for line in said.splitlines()} == {b"{}"}


def test_end_of_the_reader_is_an_error_for_who_needs_one(pipe: tuple[int, int]) -> None:
    read, write = os.pipe()
    os.close(read)
    printer = Printer(write)
    printer.line("one")
    printer.finish()
    with pytest.raises(BrokenPipeError):
        printer.require_output()
    printer.line("two")
    printer.finish()
    os.close(write)


def test_reader_of_a_non_blocking_pipe_may_be_slow(pipe: tuple[int, int]) -> None:
    """The flag belongs to the pipe, so that another process may have set it."""
    read, write = pipe
    os.set_blocking(write, False)
    printer = Printer(write, are_data=True)
    for _ in range(5000):
        printer.line("x" * 99)
    said = b""
    while len(said) < 500_000:
        assert select.select((read,), (), (), HANG_S)[0]
        said += os.read(read, 1 << 12)
    printer.finish()
    printer.require_output()
    assert set(said.splitlines()) == {b"x" * 99} and not printer.dropped


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_full_disk_costs_only_the_lines_that_it_does_not_take(tmp_path: Path) -> None:
    descriptor = os.open("/dev/full", os.O_WRONLY)
    printer = Printer(descriptor)
    for text in ("one", "two"):
        printer.line(text)
        printer.finish()
    with pytest.raises(OSError, match="No space left"):
        printer.require_output()
    kept = tmp_path / "status"
    with kept.open("wb") as file:
        os.dup2(file.fileno(), descriptor)
    printer.line("three")
    printer.finish()
    lost = "lines not printed: 2 (No space left on device)"
    assert kept.read_text().splitlines() == ["three", lost]
    with Path("/dev/full").open("wb") as full:
        os.dup2(full.fileno(), descriptor)
    printer.line("lost")
    printer.finish()
    printer.require_output()
    with kept.open("ab") as file:
        os.dup2(file.fileno(), descriptor)
    printer.line("four")
    printer.finish()
    again = "lines not printed: 1 (No space left on device)"
    assert kept.read_text().splitlines() == ["three", lost, "four", again]
    os.close(descriptor)


def test_line_that_a_full_disk_cuts_spoils_no_other(tmp_path: Path) -> None:
    kept, limits = tmp_path / "status", resource.getrlimit(resource.RLIMIT_FSIZE)
    line = "x" * 299
    with kept.open("wb") as file:
        printer = Printer(file.fileno(), are_data=True)
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
            for _ in range(5):
                printer.line(line)
                printer.finish()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        for _ in range(2):
            printer.line(line)
            printer.finish()
    assert kept.read_text().splitlines() == [line, line, line, "x" * 100, line, line]
    assert printer.dropped == 2


def test_start_does_not_wait_for_who_reads_the_address(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    read, write = pipe
    os.set_blocking(write, False)
    with suppress(BlockingIOError):
        while True:
            os.write(write, bytes(1 << 16))
    os.set_blocking(write, True)
    monkeypatch.setattr(voice, "STDOUT", write)
    monkeypatch.setattr(printing, "LAST_S", 0.01)
    monkeypatch.setattr(printing, "_timed_out", threading.Event())
    unread = threading.Timer(10.0, os.read, (read, 1 << 20))
    unread.start()
    voice.Lines().serves("companion serves")
    assert unread.is_alive()
    unread.cancel()
    while b"companion serves" not in os.read(read, 1 << 20):
        pass


def test_end_waits_once_for_readers_that_do_not_read(
    full_pipe: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A service has four printers: one after the other they would delay its end by as many s."""
    waits = list[float]()
    wait_for = threading.Condition.wait_for

    def noted(of: threading.Condition, until: Callable[[], bool], most_s: float = -1) -> bool:
        if most_s < 0:  # the printer's thread
            return wait_for(of, until)
        waits.append(most_s)
        return wait_for(of, until, 0.01)

    monkeypatch.setattr(printing, "_timed_out", threading.Event())
    monkeypatch.setattr(threading.Condition, "wait_for", noted)
    printers = [Printer(full_pipe) for _ in range(3)]
    for one in printers:
        one.line("unread")
    for one in printers:
        one.finish()
    assert waits == [printing.LAST_S, printing.AFTER_TIMEOUT_S, printing.AFTER_TIMEOUT_S]


def test_what_packages_print_goes_to_stderr_line_by_line(capfd: pytest.CaptureFixture[str]) -> None:
    """It is no JSON, and may come in pieces."""
    with printing.prints_unblocked():
        print("one")
        print("two", file=sys.stderr)
        for piece in ("th", "ree", "\nfour\n"):
            sys.stderr.write(piece)
    assert capfd.readouterr() == ("", "one\ntwo\nthree\nfour\n")
