"""Serial links over real pseudo-terminals: devices that appear, vanish, or are in use."""

import asyncio
import contextlib
import errno
import fcntl
import os
import pty
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from link_support import LOOPS, Run, frame, runner, running, until_true
from pymavlink.dialects.v20 import all as dialect
from support import HANG_S

from companion.mavlink.links import serial_port, transport
from companion.mavlink.links.kinds import FRAMES_AT_ONCE
from companion.mavlink.links.transport import Link
from companion.mavlink.links.urls import parse_link
from companion.mavlink.wire.encode import Outgoing, heartbeat
from companion.mavlink.wire.framing import Splitter
from companion.values import Frame, Rejection, Source

OURS = Source(5, 191)
TIOCVHANGUP = 0x5437  # what the kernel does to the terminal of an unplugged device


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest) -> Run:
    """Return ``run(test())``, on each of the two event loops."""
    return runner(request.param)


class Cable:
    """A pseudo-terminal: ``path`` is the device, and this object its other end."""

    def __init__(self) -> None:
        self.end, device = pty.openpty()
        self.path = os.ttyname(device)
        os.set_blocking(self.end, False)
        os.close(device)

    def read(self) -> bytes:
        """Return everything received so far."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self.end, 1 << 16)
        return b""

    def unplug(self) -> None:
        """Remove the device."""
        if self.end >= 0:
            os.close(self.end)
            self.end = -1


@contextlib.contextmanager
def cable() -> Iterator[Cable]:
    """Provide a cable, which is unplugged at the end."""
    made = Cable()
    try:
        yield made
    finally:
        made.unplug()


def frame_of_control_bytes(number: int) -> bytes:
    """Return a frame full of terminal control bytes: ^C, ^D, CR, LF, ^Q, ^S, DEL, 0xFF."""
    mav = dialect.MAVLink(None, 1, 1)
    mav.seq = number % 256
    awkward = b"\x03\x04\r\n\x11\x13\x7f\xff\x1a\x1c\x00"
    data = (awkward * 12)[: 100 + number] + bytes(range(256))
    return bytes(
        dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, data[:251].ljust(251)).pack(mav)
    )


def test_serial_link_carries_any_bytes_both_ways(run: Run) -> None:
    async def test() -> None:
        with cable() as wire:
            async with running(f"serial:{wire.path}:921600") as (link, inbox):
                assert link.send(heartbeat(OURS)) == 0  # not open yet
                await until_true(lambda: link.status.state == "up")
                made = [frame_of_control_bytes(n) for n in range(10)]
                for raw in made:
                    os.write(wire.end, raw[:100])
                    await asyncio.sleep(0.001)  # a frame comes in pieces
                    os.write(wire.end, raw[100:])
                await inbox.until(len(made))
                assert inbox.raws == made
                assert link.status.lost == {} and link.status.bytes == sum(map(len, made))
                payload = bytes(range(1, 256))
                assert link.send(Outgoing(OURS, 110, payload[:254])) == 1
                assert link.send_to(Source(1, 1), heartbeat(OURS))
                came = b""
                while len(came) < (10 + 254 + 2) + (10 + 9 + 2):
                    came += wire.read()
                    await asyncio.sleep(0.001)
                first, second = Splitter("wire").feed(0, came)
                assert isinstance(first, Frame) and isinstance(second, Frame)
                assert first.payload == payload[:254] and (first.seq, second.seq) == (0, 1)
                assert (link.status.state, link.status.peers) == ("up", 1)
            assert inbox.notices == []

    run(test())


def test_serial_link_recovers_after_unplugging(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The device is absent at first. Half a frame from before does no harm."""
    monkeypatch.setattr(transport, "RETRY_S", (0.01,))
    monkeypatch.setattr(transport, "STEADY_S", 0.02)
    device = tmp_path / "ttyUSB0"

    async def test() -> None:
        async with running(f"serial:{device}:57600") as (link, inbox):
            for n in range(3):
                await inbox.until_said(1 + 2 * n)
                assert link.status.state == "connecting"
                assert link.send(heartbeat(OURS)) == 0
                with cable() as wire:
                    device.symlink_to(wire.path)
                    await inbox.until_said(2 + 2 * n)
                    assert link.status.state == "up"
                    os.write(wire.end, frame(n) + frame(100 + n)[:20])
                    await inbox.until(n + 1)
                    device.unlink()
            await inbox.until_said(7)
            assert inbox.raws == [frame(0), frame(1), frame(2)]
            lost = link.status.lost["garbage"]
            assert lost == 60
            away = f"link {link.url} is down: No such file or directory; trying again"
            back = f"link {link.url} is back"
            assert inbox.texts[:2] == [away, back]
            assert inbox.texts[1::2] == [back] * 3
            for text in inbox.texts[2::2]:
                assert text.startswith(f"link {link.url} is down: ")

    run(test())


def test_serial_hangup_takes_the_link_down(run: Run) -> None:
    async def test() -> None:
        with cable() as wire:
            async with running(f"serial:{wire.path}:57600") as (link, inbox):
                await until_true(lambda: link.status.state == "up")
                descriptor = os.open(wire.path, os.O_RDWR | os.O_NOCTTY)
                try:
                    fcntl.ioctl(descriptor, TIOCVHANGUP)
                except PermissionError:
                    pytest.skip("it takes a privilege to hang up a terminal")
                finally:
                    os.close(descriptor)
                await inbox.until_said(1)
                why = os.strerror(errno.ENODEV)
                assert inbox.texts == [f"link {link.url} is down: {why}; trying again"]
                await until_true(lambda: link.status.state == "up")  # the other end still exists
                os.write(wire.end, frame(1))
                await inbox.until(1)

    run(test())


def test_serial_link_waits_for_a_locked_device(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "RETRY_S", (0.01,))

    async def test() -> None:
        with cable() as wire:
            other = serial.Serial(wire.path, 57600, exclusive=True)
            async with running(f"serial:{wire.path}:57600") as (link, inbox):
                await inbox.until_said(1)
                busy = "Device or resource busy"
                assert inbox.texts == [f"link {link.url} is down: {busy}; trying again"]
                os.write(wire.end, frame(9))
                await asyncio.sleep(0.05)
                assert other.read(len(frame(9))) == frame(9)  # no byte was taken from it
                other.close()
                await until_true(lambda: link.status.state == "up")
                with pytest.raises(serial.SerialException):
                    serial.Serial(wire.path, 57600, exclusive=True)
                os.write(wire.end, frame(1))
                await inbox.until(1)

    run(test())


def test_serial_link_waits_when_the_path_is_not_a_terminal(run: Run) -> None:
    async def test() -> None:
        async with running("serial:/dev/null:57600") as (link, inbox):
            await inbox.until_said(1)
            assert "Inappropriate ioctl" in inbox.texts[0] and "\n" not in inbox.texts[0]
            assert link.status.state == "connecting"

    run(test())


def test_blocked_serial_device_drops_messages_without_blocking(run: Run) -> None:
    """It eventually receives whole frames only; dropped ones are counted."""

    async def test() -> None:
        with cable() as wire:
            async with running(f"serial:{wire.path}:57600") as (link, _):
                await until_true(lambda: link.status.state == "up")
                message, tries = Outgoing(OURS, 11030, bytes(range(1, 45))), 5000
                taken = sum(link.send(message) for _ in range(tries))
                status = link.status
                assert (status.sent, status.send_dropped) == (taken, tries - taken)
                assert 0 < taken < tries / 2 and status.state == "up"
                splitter, numbers = Splitter("wire"), []
                while len(numbers) < taken:
                    for item in splitter.feed(0, wire.read()):
                        assert isinstance(item, Frame)
                        numbers.append(item.seq)
                    await asyncio.sleep(0)
                assert numbers == [n % 256 for n in range(taken)]
                assert link.send(heartbeat(OURS)) == 1  # there is space again
                while not any(splitter.feed(0, wire.read())):
                    await asyncio.sleep(0)

    run(test())


def test_serial_port_is_configured_raw(run: Run) -> None:
    async def test() -> None:
        with cable() as wire:
            async with running(f"serial:{wire.path}:115200") as (link, _):
                await until_true(lambda: link.status.state == "up")
                _, _, cflag, lflag, speed_in, speed_out, control = termios.tcgetattr(wire.end)
                assert speed_in == speed_out == termios.B115200
                assert cflag & termios.CSIZE == termios.CS8
                assert not lflag & (termios.ECHO | termios.ICANON | termios.ISIG)
                # With 0, an empty read looks like the end of the device.
                assert control[termios.VMIN] in (1, b"\x01")

    run(test())


class FaultError(Exception):
    """A program defect."""


def test_program_error_is_raised_by_run(run: Run) -> None:
    def receive(_: list[Frame | Rejection]) -> None:
        raise FaultError

    async def test() -> None:
        with cable() as wire:
            link = Link(
                url=parse_link(f"serial:{wire.path}:57600"), receive=receive, now_ns=lambda: 0
            )
            link.open()
            task = asyncio.create_task(link.run())
            await until_true(lambda: link.status.state == "up")
            os.write(wire.end, frame(1))
            with pytest.raises(FaultError):
                await task
            assert link.status.state == "down"

    run(test())


def test_serial_write_buffer_holds_less_than_one_second() -> None:
    assert serial_port.WRITE_BUFFER_BYTES * 10 / 57_600 < 1.0


def test_pyserial_is_imported_only_for_serial_links() -> None:
    run = "import sys, companion.mavlink.links.transport; sys.exit('serial' in sys.modules)"
    done = subprocess.run(
        (sys.executable, "-c", run), capture_output=True, check=False, timeout=HANG_S
    )
    assert done.returncode == 0, done.stderr.decode() or "pyserial was loaded"


def test_frames_read_at_once_are_processed_a_few_at_a_time(run: Run) -> None:
    async def test() -> None:
        with cable() as at:
            async with running(f"serial:{at.path}:57600") as (link, inbox):
                await until_true(lambda: link.status.state == "up")
                raws = [frame(number, seq=number) for number in range(60)]
                for begin in (0, 30):  # reading goes on after what was processed in parts
                    os.write(at.end, b"".join(raws[begin : begin + 30]))
                    await inbox.until(begin + 30)
                assert inbox.raws == raws
                assert max(inbox.batches) <= FRAMES_AT_ONCE

    run(test())
