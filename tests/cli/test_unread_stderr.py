"""A stdout or stderr that nobody reads, and threads that never end: no command waits for them."""

import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from support import BIN, HANG_S, line_of, started

ROTATOR = (
    b"Min Azimuth: -180\nMax Azimuth: 180\nMin Elevation: 0\nMax Elevation: 90\n"
    b"Azimuth: 5\nElevation: 6\nRPRT 0\n"
)
"""An answer of rotctld that holds what any request may ask for."""
RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0")


@pytest.mark.parametrize(
    "words",
    [
        ("replay", "missing.tlog", "--center", "5:1"),
        ("run", "--no-such-option"),
        RUN,
        ("drive", "none:pointing", "--service", "http://127.0.0.1:9", "--seconds", "0.2"),
    ],
    ids=" ".join,
)
def test_mistake_of_a_user_ends_the_command(words: tuple[str, ...], full_pipe: int) -> None:
    with started([BIN / "companion", *words], stderr=full_pipe, stdout=subprocess.PIPE) as process:
        assert process.wait(HANG_S) in (1, 2)


def test_signal_ends_test_traffic_whose_summary_nobody_reads(full_pipe: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(HANG_S)
        to = f"udpout:127.0.0.1:{receiver.getsockname()[1]}"
        command = [BIN / "sitl-replay", "fly", "paper", "--to", to]
        with started(command, stdout=full_pipe, stderr=subprocess.DEVNULL) as process:
            assert receiver.recv(2000)
            process.terminate()
            assert process.wait(HANG_S) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["replay", "missing.tlog", "--center", "5:1"], "missing.tlog"),
        ([*RUN, "--center", "5:1"], "the system allows no more threads"),
        (["drive", "none:pointing", "--service", "http://127.0.0.1:9"], "no more threads"),
    ],
)
def test_error_is_one_line_while_the_system_allows_no_more_threads(
    words: list[str], said: str
) -> None:
    code = (
        "import threading\n"
        'def refused(self): raise RuntimeError("can\'t start new thread")\n'
        "threading.Thread.start = refused\n"
        "from companion.cli.main import main\n"
        f"main({list(words)})\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=HANG_S, check=False
    )
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1
    assert said in done.stderr


def test_interrupt_ends_a_command_that_loads(full_pipe: int) -> None:
    code = (
        "import time\n"
        "from companion.cli.interrupts import interrupts_end\n"
        "with interrupts_end('companion'):\n"
        "    print('loads', flush=True)\n"
        "    time.sleep(600)\n"
    )
    command = [sys.executable, "-c", code]
    with started(command, stderr=full_pipe, stdout=subprocess.PIPE) as process:
        assert line_of(process, process.stdout) == b"loads\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(HANG_S) == 130


def test_client_that_does_not_read_delays_no_end(full_pipe: int) -> None:
    """The HTTP server logs at its end how many clients it has left."""
    command = [BIN / "companion", *RUN, "--center", "5:1"]
    with (
        started(command, stderr=full_pipe, stdout=subprocess.PIPE) as process,
        client_that_reads_nothing(line_of(process, process.stdout).decode()),
    ):
        process.terminate()
        assert process.wait(HANG_S) == 0


def test_lines_of_the_http_server_about_its_clients_are_not_printed() -> None:
    command = [BIN / "companion", *RUN, "--center", "5:1"]
    with started(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        with client_that_reads_nothing(line_of(process, process.stdout).decode()):
            process.terminate()
            assert process.wait(HANG_S) == 0
        assert process.stderr.read() == b""


def client_that_reads_nothing(line: str) -> socket.socket:
    """A client of the service that printed this line, with a hundred answers to take."""
    url, client = line.split()[2], socket.socket()
    client.settimeout(HANG_S)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    client.connect(("127.0.0.1", int(url.rpartition(":")[2])))
    client.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 100)
    assert client.recv(12, socket.MSG_PEEK) == b"HTTP/1.1 200"
    return client


def test_device_goes_to_its_safe_state_while_clients_are_waited_for(tmp_path: Path) -> None:
    """A device may take 4 s, and HTTP 2 s: one after the other, they would be too long."""
    with socket.create_server(("127.0.0.1", 0)) as rotator:
        port = rotator.getsockname()[1]
        (tmp_path / "companion.toml").write_text(f'[drive]\ntarget = "rotctld:127.0.0.1:{port}"\n')
        command = [BIN / "companion", *RUN, "--center", "5:1", "--config", "companion.toml"]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        with started(command, cwd=tmp_path, **pipes) as process:
            line = line_of(process, process.stdout).decode()
            driven, _ = rotator.accept()
            with client_that_reads_nothing(line), ThreadPoolExecutor(1) as thread:
                left_s = thread.submit(time_of_the_end_s, driven)
                began_s = time.monotonic()
                process.terminate()
                assert process.wait(HANG_S) == 0
                ended_s = time.monotonic()
                device_s = left_s.result(HANG_S)
    assert device_s - began_s < (ended_s - began_s) / 2


def time_of_the_end_s(connection: socket.socket) -> float:
    """Answer each request of a rotator, until the service closes the connection."""
    connection.settimeout(HANG_S)
    with connection:
        while connection.recv(4096):
            connection.sendall(ROTATOR)
    return time.monotonic()


@pytest.mark.parametrize(("ends", "status"), [("sys.exit(3)", 3), ("sys.exit()", 0)])
def test_thread_of_a_package_keeps_no_command(ends: str, status: int) -> None:
    code = (
        "import sys, threading, time\n"
        "from companion.cli.interrupts import threads_abandoned\n"
        "with threads_abandoned():\n"
        "    threading.Thread(target=time.sleep, args=(600,)).start()\n"
        "    print('to the end')\n"
        f"    {ends}\n"
    )
    with started([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.wait(HANG_S) == status
        assert process.stdout.read() == b"to the end\n"
