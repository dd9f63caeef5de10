"""Fixtures of the command line's tests."""

import os
from collections.abc import Iterator
from contextlib import suppress

import pytest


@pytest.fixture
def full_pipe() -> Iterator[int]:
    """The writing side of a pipe that takes nothing more, since its reader is stopped."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    with suppress(BlockingIOError):
        while True:
            os.write(write, bytes(4096))
    os.set_blocking(write, True)
    yield write
    os.close(write)
    os.close(read)
