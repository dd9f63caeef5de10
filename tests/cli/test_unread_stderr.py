"""A stderr that nobody reads, and threads that never end: no command waits for either."""

import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from support import BIN, HANG_S, line_of, started

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0")
UPGRADE = (
    b"GET /v1/stream HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


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


def test_client_that_does_not_close_its_websocket_delays_no_end(full_pipe: int) -> None:
    """The HTTP server logs at its end how many clients it has left."""
    command = [BIN / "companion", *RUN, "--center", "5:1"]
    with (
        started(command, stderr=full_pipe, stdout=subprocess.PIPE) as process,
        websocket(line_of(process, process.stdout).decode()),
    ):
        process.terminate()
        assert process.wait(HANG_S) == 0


def test_lines_of_the_http_server_about_its_clients_are_not_printed() -> None:
    command = [BIN / "companion", *RUN, "--center", "5:1"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with started(command, **pipes) as process:
        with websocket(line_of(process, process.stdout).decode()):
            process.terminate()
            assert process.wait(HANG_S) == 0
        assert process.stderr.read() == b""


def websocket(line: str) -> socket.socket:
    """A client of the service that printed this line; it answers nothing."""
    url = line.split()[2]
    client = socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])), HANG_S)
    client.sendall(UPGRADE)
    assert client.recv(12) == b"HTTP/1.1 101"
    return client


def test_device_goes_to_its_safe_state_while_clients_still_read(tmp_path: Path) -> None:
    """A device may take 4 s, and HTTP 2 s: one after the other, they would be too long."""
    ended = list[str]()
    with socket.create_server(("127.0.0.1", 0)) as rotator:
        port = rotator.getsockname()[1]
        (tmp_path / "companion.toml").write_text(f'[drive]\ntarget = "rotctld:127.0.0.1:{port}"\n')
        command = [BIN / "companion", *RUN, "--center", "5:1", "--config", "companion.toml"]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        with started(command, cwd=tmp_path, **pipes) as process:
            client = websocket(line_of(process, process.stdout).decode())
            driven, _ = rotator.accept()
            readers = [
                threading.Thread(target=read_to_the_end, args=(one, name, ended))
                for name, one in (("device", driven), ("client", client))
            ]
            for one in readers:
                one.start()
            process.terminate()
            assert process.wait(HANG_S) == 0
            for one in readers:
                one.join(HANG_S)
    assert ended == ["device", "client"]


def read_to_the_end(connection: socket.socket, name: str, ended: list[str]) -> None:
    """Answer each request of a rotator, until the service closes the connection."""
    connection.settimeout(HANG_S)
    with connection:
        while connection.recv(4096):
            if name == "device":
                connection.sendall(b"RPRT 0\n")
    ended.append(name)


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
