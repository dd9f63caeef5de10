"""Output on a thread: in order, bounded, and without waiting for who reads it."""

import os
from collections.abc import Iterator
from contextlib import suppress

import pytest

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
    read, write = pipe
    printer, line = Printer(write), "x" * 99
    for _ in range(30_000):  # 3 MB
        printer.line(line)
    said = b""
    while b"not printed" not in said:
        said += os.read(read, 1 << 20)
    lines = said.decode().splitlines()
    assert set(lines[:-1]) == {line}
    assert lines[-1] == f"{30_000 - len(lines[:-1])} lines were not printed: nobody read them"
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
        printer.require_reader()
    printer.line("two")
    printer.finish()
    os.close(write)
