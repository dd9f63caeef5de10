"""Reading of datagrams: the direct call against the standard library's, on real sockets."""

import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from support import HANG_S

from companion.mavlink.links import datagrams, kernel_time
from companion.mavlink.links.datagrams import Datagram

pytestmark = pytest.mark.skipif(not datagrams.IS_DIRECT, reason="for Linux on x86-64 and arm64")

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture(params=["127.0.0.1", "::1"])
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    """A receiving socket with time stamps, and a sending one."""
    family = socket.AF_INET6 if ":" in request.param else socket.AF_INET
    with (
        socket.socket(family, socket.SOCK_DGRAM) as receiving,
        socket.socket(family, socket.SOCK_DGRAM) as sending,
    ):
        receiving.bind((request.param, 0))
        receiving.setblocking(False)
        sending.bind((request.param, 0))
        sending.connect(receiving.getsockname())
        assert kernel_time.stamped(receiving)
        yield receiving, sending


def standard(monkeypatch: pytest.MonkeyPatch, sock: socket.socket) -> Callable[[], Datagram]:
    with monkeypatch.context() as patch:
        patch.setattr(datagrams, "IS_DIRECT", False)
        return datagrams.reader(sock)


@pytest.mark.parametrize("size", [0, 1, 280, 60_000])
def test_datagram_is_as_of_the_standard_library(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    receiving, sending = pair
    sent = bytes(n % 251 for n in range(size))
    found = []
    for read in (datagrams.reader(receiving), standard(monkeypatch, receiving)):
        before_ns = time.time_ns()
        sending.send(sent)
        found.append(read())
        assert found[-1].stamp_ns is not None
        assert before_ns <= found[-1].stamp_ns <= time.time_ns()
    assert found[0].data == found[1].data == sent
    assert found[0].sender == found[1].sender == sending.getsockname()


def test_errors_are_those_of_the_standard_library(pair: Pair) -> None:
    receiving, _ = pair
    read = datagrams.reader(receiving)
    with pytest.raises(BlockingIOError):
        read()
    receiving.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        read()


def test_refusal_is_raised_once(pair: Pair) -> None:
    """The system reports that nobody listens at the other end of a connected socket."""
    receiving, sending = pair
    receiving.close()
    sending.setblocking(False)
    read, until_s = datagrams.reader(sending), time.monotonic() + HANG_S
    sending.send(b"x")
    while time.monotonic() < until_s:
        try:
            read()
        except BlockingIOError:
            time.sleep(0.001)
        except ConnectionRefusedError:
            break
    with pytest.raises(BlockingIOError):
        read()


def test_datagrams_without_a_stamp_have_none(pair: Pair) -> None:
    receiving, sending = pair
    receiving.setsockopt(socket.SOL_SOCKET, kernel_time.SO_TIMESTAMPNS, 0)
    sending.send(b"x")
    assert datagrams.reader(receiving)().stamp_ns is None


def test_cache_of_senders_is_bounded(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(datagrams, "SENDERS_MAX", 2)
    receiving, _ = pair
    read = datagrams._Direct(receiving)
    for _ in range(5):
        with socket.socket(receiving.family, socket.SOCK_DGRAM) as other:
            other.connect(receiving.getsockname())
            other.send(b"x")
            assert read.read().sender == other.getsockname()
    assert len(read._senders) <= 2


def turns_while_reading(pair: Pair, datagrams_read: int) -> int:
    """Return how many turns a thread that waits for the interpreter got meanwhile."""
    receiving, sending = pair
    receiving.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    read, stop, turns = datagrams.reader(receiving), threading.Event(), [0]

    def compute() -> None:
        while not stop.is_set():
            turns[0] += 1
            time.sleep(0)

    for _ in range(datagrams_read):
        sending.send(b"x")
    interval_s = sys.getswitchinterval()
    thread = threading.Thread(target=compute)
    thread.start()
    try:
        sys.setswitchinterval(HANG_S)
        while not turns[0]:
            time.sleep(0.001)
        before = turns[0]
        for _ in range(datagrams_read):
            read()
        return turns[0] - before
    finally:
        sys.setswitchinterval(interval_s)
        stop.set()
        thread.join()


def test_reading_does_not_give_up_the_interpreter(pair: Pair) -> None:
    """A thread that waits for the interpreter does not get it, however many datagrams are read.

    A thread of the test runner may ask for it, and then that one gets a turn as well: but not each
    time.
    """
    assert min(turns_while_reading(pair, 500) for _ in range(5)) == 0
