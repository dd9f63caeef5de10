"""Messages to systemd by a real service over real Unix sockets."""

import asyncio
import os
import re
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml
from support import BIN, HANG_S, ROOT, run_async

from companion.node import systemd
from companion.node.service import Service
from companion.settings.model import Settings
from companion.values import UserError, shown

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
WATCHDOG_S = 1.0


class Listener:
    """The service manager's end of the socket."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + address[1:] if address.startswith("@") else address)

    def next(self, seconds: float) -> list[str] | None:
        """Return the lines of the next message; None after a timeout."""
        self.socket.settimeout(seconds)
        try:
            return self.socket.recv(4096).decode().split("\n")
        except TimeoutError:
            return None

    def wait_for(self, line: str, seconds: float = HANG_S) -> list[str]:
        """Return the first message with that line."""
        end = time.monotonic() + seconds
        while (left_s := end - time.monotonic()) > 0:
            lines = self.next(left_s)
            if lines and line in lines:
                return lines
        pytest.fail(f"no {line}")

    def drain(self) -> None:
        """Discard pending messages."""
        self.socket.setblocking(False)
        with pytest.raises(BlockingIOError):
            while True:
                self.socket.recv(4096)


@pytest.fixture(params=["path", "abstract"])
def listener(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Listener]:
    """Return a listener named in the environment, as systemd does."""
    names = {"path": str(tmp_path / "notify"), "abstract": f"@companion-test-{os.getpid()}"}
    monkeypatch.setenv("NOTIFY_SOCKET", names[request.param])
    heard = Listener(names[request.param])
    with closing(heard.socket):
        yield heard


@pytest.mark.full
def test_systemd_receives_ready_watchdog_and_stopping(
    listener: Listener, start_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", str(round(WATCHDOG_S * 1e6)))
    node = start_node(*RUN)
    first = listener.wait_for("READY=1")
    assert node.get("/healthz")[0] == 200  # at once after READY
    assert "STATUS=UAVs: none; links up: 1 of 1; recording: off" in first
    gaps_s, last_s = [], time.monotonic()
    for _ in range(5):
        lines = listener.wait_for("WATCHDOG=1", WATCHDOG_S)  # each one in time
        assert "READY=1" not in lines
        gaps_s.append(time.monotonic() - last_s)
        last_s += gaps_s[-1]
    assert sorted(gaps_s)[2] == pytest.approx(WATCHDOG_S / 2, abs=WATCHDOG_S / 8)

    node.process.send_signal(signal.SIGSTOP)  # equivalent to a blocked event loop
    listener.drain()
    assert listener.next(2 * WATCHDOG_S) is None
    node.process.send_signal(signal.SIGCONT)
    listener.wait_for("WATCHDOG=1", HANG_S)

    returncode, _, err = node.stop(signal.SIGTERM)
    assert returncode == 0, err
    listener.wait_for("STOPPING=1", HANG_S)
    assert listener.next(0.1) is None
    assert "systemd" not in err


@pytest.mark.full
def test_no_watchdog_messages_unless_requested(
    listener: Listener, start_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``WATCHDOG_PID`` belongs to another process: the variables were inherited."""
    monkeypatch.setenv("WATCHDOG_USEC", "100000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    node = start_node(*RUN)
    assert listener.wait_for("READY=1")
    assert listener.next(1.0) is None
    node.stop(signal.SIGINT)
    listener.wait_for("STOPPING=1", HANG_S)


def test_late_beams_suppress_watchdog_messages(tmp_path: Path) -> None:
    """The event loop runs, but no beam updates are made."""
    settings = Settings().override(center={"source": "5:1"}, links={"urls": ["udpin:127.0.0.1:0"]})
    heard = Listener(str(tmp_path / "notify"))
    said: list[str] = []

    async def told() -> None:
        service = Service(settings=settings, say=said.append)
        service.answering.set()
        until = asyncio.Event()
        manager = systemd.Manager(str(tmp_path / "notify"), watchdog_s=0.2)
        asyncio.get_running_loop().call_later(0.5, until.set)
        links = asyncio.create_task(service._traffic.run())
        await systemd.keep_informed(manager, service, said.append, until)
        links.cancel()
        await asyncio.wait([links])

    messages: list[list[str]] = []
    with closing(heard.socket), ThreadPoolExecutor(1) as beside:
        done = beside.submit(lambda: run_async(told()))
        while not messages or messages[-1][0] != "STOPPING=1":
            messages.append(heard.next(HANG_S) or pytest.fail("silent before it stopped"))
        done.result(HANG_S)
    assert "READY=1" in messages[0]
    assert "beam updates are late" in messages[0][-1]
    assert len(messages) > 10  # it checks often: a short delay must not cause a restart
    assert not any("WATCHDOG=1" in lines for lines in messages)


def test_absent_service_manager_is_announced_once_and_retried(
    start_node: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", "400000")
    node = start_node(*RUN)
    node.wait_until("/readyz", lambda answer: answer["reasons"] == ["no report yet"])
    heard = Listener(str(tmp_path / "notify"))
    with closing(heard.socket):
        heard.wait_for("READY=1", HANG_S)
        _, _, err = node.stop()
    complaints = [line for line in err.splitlines() if "systemd" in line]
    assert complaints == ["systemd cannot be notified: No such file or directory"]


def test_no_manager_without_notify_socket() -> None:
    assert systemd.manager({}) is None
    assert systemd.manager({"WATCHDOG_USEC": "1000000"}) is None


@pytest.mark.parametrize(
    ("watchdog", "expected_s"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "30000000"}, 30.0),
        ({"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": str(os.getpid())}, 30.0),
        ({"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": "1"}, None),
    ],
)
def test_watchdog_interval_is_parsed(watchdog: dict[str, str], expected_s: float | None) -> None:
    found = systemd.manager({"NOTIFY_SOCKET": "/run/notify", **watchdog})
    assert found is not None
    assert found.watchdog_s == expected_s


@pytest.mark.parametrize(
    "environ",
    [
        {"NOTIFY_SOCKET": "run/notify"},
        {"NOTIFY_SOCKET": "@"},
        {"NOTIFY_SOCKET": "vsock:2:1"},
        {"NOTIFY_SOCKET": "/run/notify", "WATCHDOG_USEC": "soon"},
        {"NOTIFY_SOCKET": "/run/notify", "WATCHDOG_USEC": "0"},
        {"NOTIFY_SOCKET": "/run/notify", "WATCHDOG_USEC": "-1"},
        {"NOTIFY_SOCKET": "/run/notify", "WATCHDOG_USEC": "9" * 400},
        {"NOTIFY_SOCKET": "/run/notify", "WATCHDOG_USEC": "9" * 5000},
    ],
)
def test_invalid_systemd_environment_is_rejected(environ: dict[str, str]) -> None:
    name, value = list(environ.items())[-1]
    with pytest.raises(UserError, match=f"^{name}: {re.escape(shown(value))} is "):
        systemd.manager(environ)


def test_invalid_environment_is_reported_in_one_line() -> None:
    done = subprocess.run(
        [BIN / "companion", *RUN],
        env=os.environ | {"NOTIFY_SOCKET": "run/notify"},
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("companion: NOTIFY_SOCKET: 'run/notify' is ")
    assert len(done.stderr.splitlines()) == 1


def test_unreachable_notify_socket_returns_a_reason() -> None:
    assert systemd.Manager("/" + "x" * 200).tell("READY=1") == "AF_UNIX path too long"
    assert systemd.Manager("@nobody-listens-here").tell("READY=1") == "Connection refused"


def test_full_notify_socket_does_not_block_the_service(tmp_path: Path) -> None:
    """Nothing reads the socket: the kernel accepts some messages, then refuses at once."""
    heard = Listener(str(tmp_path / "notify"))
    with closing(heard.socket):
        manager = systemd.Manager(str(tmp_path / "notify"))
        began_s = time.monotonic()
        answers = [manager.tell("WATCHDOG=1") for _ in range(5000)]
        assert time.monotonic() - began_s < 5
        assert answers[0] is None
        assert answers[-1] == "Resource temporarily unavailable"


EXPOSURE = {"companion": 15, "companion-serial": 20}
"""Largest exposure level of each documented unit, in tenths; versions of systemd differ."""


@pytest.fixture
def units() -> dict[str, str]:
    """The documented unit, and the unit with the drop-in for serial links."""
    text = (ROOT / "docs" / "deployment.md").read_text(encoding="utf-8")
    unit, drop_in = (block.split("```")[0] for block in text.split("```ini\n")[1:3])
    program = "/opt/companion/bin/companion"
    assert f"ExecStart={program} run " in unit
    unit = unit.replace(program, "/bin/true")
    assert drop_in.startswith("[Service]\n")
    serial = drop_in.removeprefix("[Service]\n") + "\n[Install]"
    return {"companion": unit, "companion-serial": unit.replace("[Install]", serial)}


def analyze(*arguments: object) -> "subprocess.CompletedProcess[str]":
    """Run systemd-analyze; skips where there is none."""
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("no systemd-analyze: install systemd")
    command = [program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANG_S)


@pytest.mark.parametrize("name", EXPOSURE)
def test_documented_systemd_unit_is_valid(tmp_path: Path, units: dict[str, str], name: str) -> None:
    path = tmp_path / "companion.node.service"
    path.write_text(units[name], encoding="utf-8")
    done = analyze("verify", "--man=no", path)
    ours = [line for line in done.stderr.splitlines() if "companion.node.service" in line]
    assert (done.returncode, ours) == (0, [])
    path.write_text(units[name].replace("WatchdogSec", "WatchDogSec"), encoding="utf-8")
    assert "WatchDogSec" in analyze("verify", "--man=no", path).stderr  # the check is effective


@pytest.mark.parametrize("name", EXPOSURE)
def test_documented_systemd_unit_exposes_little(
    tmp_path: Path, units: dict[str, str], name: str
) -> None:
    path = tmp_path / f"{name}.service"

    def is_confined(unit: str) -> bool:
        path.write_text(unit, encoding="utf-8")
        level = f"--threshold={EXPOSURE[name]}"
        done = analyze("security", "--no-pager", "--offline=true", level, path)
        assert "Overall exposure level" in done.stdout, done.stderr
        return done.returncode == 0

    assert is_confined(units[name])
    assert not is_confined(units[name].replace("\nCapabilityBoundingSet=\n", "\n"))


@pytest.mark.parametrize("name", EXPOSURE)
def test_documented_systemd_unit_has_the_containers_limits(
    units: dict[str, str], name: str
) -> None:
    compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))
    container = compose["services"]["companion"]
    lines = units[name].splitlines()
    assert f"TasksMax={container['pids_limit']}" in lines
    assert f"MemoryMax={container['mem_limit'].upper()}" in lines
    for line in ("NoNewPrivileges=yes", "CapabilityBoundingSet=", "ProtectSystem=strict"):
        assert line in lines
    assert [line for line in lines if "ReadWritePaths" in line] == []  # StateDirectory alone
