"""Kernel arrival time of a datagram, over real sockets on loopback.

``time.sleep`` in the loop's own thread delays this process on purpose.
"""

import asyncio
import contextlib
import socket
import sys
import time
from collections.abc import Iterator

import pytest
from link_support import LIMIT_S, LOOPS, Run, frame, port_of, runner, running, stamping, until_true

from companion.mavlink.links import kernel_time, stale_bytes, udp
from companion.mavlink.links.transport import Link
from companion.mavlink.links.urls import parse_link
from companion.mavlink.wire.encode import heartbeat
from companion.values import Reason, Source

BLOCKED_S = 0.5
SOON_S = 0.25
"""Sending and reading clocks takes less than this, also on a busy machine."""
DAY_NS = 86_400_000_000_000
HOUR_NS = DAY_NS // 24

linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux stamps datagrams")


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest) -> Run:
    """Return ``run(test())``, on each of the two event loops."""
    return runner(request.param)


@pytest.fixture(scope="module", autouse=True)
def _stamped() -> Iterator[None]:
    with stamping():
        yield


@contextlib.contextmanager
def peer() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        yield made


async def sent_while_blocked(link: Link, sender: socket.socket, to: object) -> list[int]:
    """Send ten frames and block the loop; return when each was sent, on the link's time."""
    await until_true(lambda: link.status.state == "up")
    sent_ns = []
    for number in range(10):
        sent_ns.append(time.monotonic_ns())
        sender.sendto(frame(number), to)  # type: ignore[call-overload]
        time.sleep(BLOCKED_S / 10)
    return sent_ns


def late_s(sent_ns: list[int], arrived_ns: list[int]) -> list[float]:
    return [(arrived - sent) * 1e-9 for sent, arrived in zip(sent_ns, arrived_ns, strict=True)]


@linux
def test_queued_frame_has_its_kernel_arrival_time(run: Run) -> None:
    async def test() -> None:
        with peer() as sender:
            async with running("udpin:127.0.0.1:0", time.monotonic_ns) as (link, inbox):
                to = ("127.0.0.1", port_of(link))
                sent_ns = await sent_while_blocked(link, sender, to)
                await inbox.until(10)
                late = late_s(sent_ns, [one.t_ns for one in inbox.frames])
                assert min(late) >= -0.001 and max(late) < SOON_S
                assert late[0] < BLOCKED_S / 2
                assert (link.status.arrival, link.status.misstamped) == ("kernel", 0)

    run(test())


@linux
def test_backlog_is_dropped_oldest_first_and_counted(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frames read are then new ones, not seconds old."""
    monkeypatch.setattr(udp, "STALE_NS", round(BLOCKED_S * 0.55e9))
    monkeypatch.setattr(udp, "OVERFLOW_CHECK_S", 0.1)

    async def test() -> None:
        with peer() as sender:
            async with running("udpin:127.0.0.1:0", time.monotonic_ns) as (link, inbox):
                to = ("127.0.0.1", port_of(link))
                sent_ns = await sent_while_blocked(link, sender, to)
                await until_true(lambda: bool(link.status.overflowed))
                await until_true(lambda: len(inbox.frames) + link.status.overflowed == 10)
                assert 1 <= link.status.overflowed <= 9
                assert link.status.lost == {Reason.SOCKET_OVERFLOW: link.status.overflowed}
                newest = late_s(sent_ns[-1:], [inbox.frames[-1].t_ns])
                assert abs(newest[0]) < SOON_S

    run(test())


@linux
def test_connected_socket_has_kernel_arrival_times(run: Run) -> None:
    async def test() -> None:
        with peer() as sender:
            port = sender.getsockname()[1]
            async with running(f"udpout:127.0.0.1:{port}", time.monotonic_ns) as (link, inbox):
                await until_true(lambda: link.send(heartbeat(Source(5, 191))) == 1)
                ours = sender.recvfrom(1000)[1]
                sent_ns = await sent_while_blocked(link, sender, ours)
                await inbox.until(10)
                late = late_s(sent_ns, [one.t_ns for one in inbox.frames])
                assert min(late) >= -0.001 and max(late) < SOON_S
                assert link.status.arrival == "kernel"

    run(test())


@pytest.mark.parametrize("why", ["another system", "refused", "no control message"])
def test_frame_without_kernel_stamp_arrives_when_read(
    run: Run, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if why == "another system":
        monkeypatch.setattr(kernel_time.sys, "platform", "plan9")
    elif why == "refused":
        monkeypatch.setattr(kernel_time, "SO_TIMESTAMPNS", 9999)
    else:
        monkeypatch.setattr(kernel_time, "stamped", lambda _: True)

    async def test() -> None:
        with peer() as sender:
            async with running("udpin:127.0.0.1:0", time.monotonic_ns) as (link, inbox):
                to = ("127.0.0.1", port_of(link))
                sent_ns = await sent_while_blocked(link, sender, to)
                read_ns = time.monotonic_ns()
                await inbox.until(10)
                assert min(one.t_ns for one in inbox.frames) >= read_ns > sent_ns[-1]
                assert (link.status.arrival, link.status.misstamped) == ("read", 0)

    run(test())


@linux
@pytest.mark.parametrize("step_ns", [3_000_000_000, -3_000_000_000, 20_000_000, DAY_NS])
def test_kernel_stamps_from_before_a_clock_set_are_ignored(
    run: Run, step_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing else of the node's time depends on the wall clock."""
    true_ns, step = time.time_ns, [0]
    monkeypatch.setattr(time, "time_ns", lambda: true_ns() + step[0])
    monkeypatch.setattr(udp, "SLICE_S", LIMIT_S)  # the socket is read until it is empty

    async def test() -> None:
        with peer() as sender:
            async with running("udpin:127.0.0.1:0", time.monotonic_ns) as (link, inbox):
                to = ("127.0.0.1", port_of(link))
                await sent_while_blocked(link, sender, to)
                step[0] = step_ns
                read_ns = time.monotonic_ns()
                await inbox.until(10)
                assert min(one.t_ns for one in inbox.frames) >= read_ns
                assert link.status.misstamped == 10
                step[0] = 0
                sender.sendto(b"nothing waits any more", to)  # by which the step is noticed
                await until_true(lambda: link.status.misstamped == 11)
                await asyncio.sleep(0)
                sent_ns = await sent_while_blocked(link, sender, to)
                await inbox.until(20)
                late = late_s(sent_ns, [one.t_ns for one in inbox.frames[10:]])
                assert max(late) < SOON_S
                assert (link.status.arrival, link.status.misstamped) == ("kernel", 11)

    run(test())


@linux
def test_datagrams_received_before_a_suspend_are_dropped(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A datagram waits while the machine is suspended for an hour, which both clocks count."""

    async def test() -> None:
        with peer() as sender:
            async with running("udpin:127.0.0.1:0", time.monotonic_ns) as (link, inbox):
                to = ("127.0.0.1", port_of(link))
                await sent_while_blocked(link, sender, to)
                await inbox.until(10)
                sender.sendto(frame(1), to)
                for module, name in ((time, "time_ns"), (kernel_time, "since_boot_ns")):
                    real = getattr(module, name)
                    monkeypatch.setattr(module, name, lambda real=real: real() + HOUR_NS)
                await until_true(lambda: "socket-overflow" in link.status.lost)
                assert len(inbox.frames) == 10
                assert link.status.misstamped == 0

    run(test())


def test_stream_frames_arrive_when_read(run: Run) -> None:
    async def test() -> None:
        async with running("tcpin:127.0.0.1:0", time.monotonic_ns) as (link, inbox):
            _, writer = await asyncio.open_connection("127.0.0.1", port_of(link))
            read_ns = time.monotonic_ns()
            writer.write(frame(1))
            await inbox.until(1)
            assert inbox.frames[0].t_ns >= read_ns
            assert link.status.arrival == "read"
            writer.close()
            await writer.wait_closed()

    run(test())


def test_stale_stream_data_is_dropped(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """After SIGSTOP or a suspend, old frames must not look current."""
    away_ns = [0]
    monkeypatch.setattr(stale_bytes, "since_boot_ns", lambda: away_ns[0])

    async def test() -> None:
        async with running("tcpin:127.0.0.1:0", time.monotonic_ns) as (link, inbox):
            _, writer = await asyncio.open_connection("127.0.0.1", port_of(link))
            writer.write(frame(1))
            await inbox.until(1)
            writer.write(b"".join(frame(n) for n in range(2, 102)))
            away_ns[0] += stale_bytes.STALE_NS + 1
            await until_true(lambda: link.status.lost.get("socket-overflow") == 100)
            writer.write(frame(102))
            await inbox.until(2)
            assert [one.seq for one in inbox.frames] == [1, 102]
            assert link.status.overflowed == 100
            writer.close()
            await writer.wait_closed()

    run(test())


def test_stale_byte_count_covers_only_old_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [0]
    monkeypatch.setattr(stale_bytes, "since_boot_ns", lambda: now_ns[0])
    ours, theirs = socket.socketpair()
    with ours, theirs:
        watch = stale_bytes.StaleBytes(ours.fileno())
        theirs.send(bytes(30))
        assert watch.stale(b"") == 0
        now_ns[0] += stale_bytes.STALE_NS + 1
        assert watch.stale(b"") == 0
        theirs.send(bytes(5))  # after it
        assert [watch.stale(ours.recv(20)), watch.stale(ours.recv(20))] == [20, 10]


@linux
def test_receiver_exception_ends_the_link(run: Run) -> None:
    """An exception of the node's own code must not be lost in the loop."""

    async def test() -> None:
        def broken(_: object) -> None:
            raise ValueError("a defect")

        link = Link(url=parse_link("udpin:127.0.0.1:0"), receive=broken, now_ns=time.monotonic_ns)
        link.open()
        with peer() as sender:
            sender.sendto(frame(1), ("127.0.0.1", port_of(link)))
            with pytest.raises(ValueError, match="a defect"):
                await link.run()

    run(test())


def test_clock_watch_detects_a_wall_clock_set(monkeypatch: pytest.MonkeyPatch) -> None:
    wall_ns, monotonic_ns = [10 * DAY_NS], [5]
    monkeypatch.setattr(time, "time_ns", lambda: wall_ns[0])
    monkeypatch.setattr(kernel_time, "since_boot_ns", lambda: monotonic_ns[0])
    watch = kernel_time.SetWatch()
    wall_ns[0] += 7_000_000_000
    monotonic_ns[0] += 7_000_000_000
    assert not watch.was_set()  # time passes on both
    for step_ns in (kernel_time.SET_NS + 1, -kernel_time.SET_NS - 1, DAY_NS):
        wall_ns[0] += step_ns
        assert watch.was_set()
        watch.note()
        assert not watch.was_set()


def test_pause_between_clock_readings_is_not_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may preempt this process between the clock readings."""
    now_ns, pause_ns = [0], [0]

    def read() -> int:
        now_ns[0] += pause_ns[0]
        return now_ns[0]

    monkeypatch.setattr(time, "time_ns", read)
    monkeypatch.setattr(kernel_time, "since_boot_ns", read)
    for before_ns, after_ns in ((0, 30_000_000), (30_000_000, 0), (30_000_000, 60_000_000)):
        pause_ns[0] = before_ns
        watch = kernel_time.SetWatch()
        pause_ns[0] = after_ns
        assert not watch.was_set()
