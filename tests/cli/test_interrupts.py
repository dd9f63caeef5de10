"""Ctrl-C, SIGTERM and SIGHUP at any moment: never a traceback, and one exit status."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import BIN, HANG_S, ROOT, line_of, rounds, started

LOG = str(ROOT / "tests" / "data" / "sitl_4circle_cut.tlog")
CENTER = ("--center", "5:1")
HTTP = ("--listen", "127.0.0.1:0")
LINK = ("--link", "udpin:127.0.0.1:0")
TO = ("--to", "udpout:127.0.0.1:9")
SERVICES = ("run", "demo", "serve", "play", "fly")
"""Commands that end orderly, with status 0, once they serve or send."""
COMMANDS = {
    "run": ("companion", "run", *CENTER, *LINK, *HTTP),
    "demo": ("companion", "demo", "--port", "0"),
    "serve": ("companion", "replay", LOG, *CENTER, "--serve", *HTTP),
    "play": ("sitl-replay", "play", LOG, *TO),
    "fly": ("sitl-replay", "fly", "paper", *TO),
    "replay": ("companion", "replay", LOG, *CENTER),
    "study": ("companion", "study", "prediction", LOG, *CENTER, "--jobs", "2", "--out", "report"),
    "export": ("companion", "export", LOG, *CENTER, "--format", "csv", "--out", "tables"),
    "weights": ("companion", "weights", LOG, "--at", "5", *CENTER),
    "check": ("companion", "check", *LINK, *CENTER, *HTTP),
    "drive": ("companion", "drive", "none:pointing", "--service", "http://127.0.0.1:9"),
}
HOLDS = subprocess.run(
    ["env", "--block-signal=INT", "true"], check=False, capture_output=True, timeout=HANG_S
)


@pytest.fixture(autouse=True)
def default_hangup() -> Iterator[None]:
    """Commands that are started under ``nohup``, as these tests may be, ignore SIGHUP."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("name", COMMANDS)
def test_interrupt_is_never_a_traceback(name: str, tmp_path: Path) -> None:
    """To the whole process group, as a terminal sends it; workers of a study included."""
    if HOLDS.returncode:
        pytest.skip("env cannot block signals: a starting interpreter answers with a traceback")
    tries = rounds(3, 40)
    program, *words = COMMANDS[name]
    for attempt in range(tries):
        number = (signal.SIGINT, signal.SIGINT, signal.SIGHUP, signal.SIGTERM)[attempt % 4]
        if name == "study" and number is signal.SIGHUP:
            number = signal.SIGINT  # SIGHUP ends Python's resource tracker, which says so
        with (tmp_path / "said").open("w+") as said:
            command = [BIN / program, *words]
            where = {"cwd": tmp_path, "stdout": subprocess.DEVNULL, "stderr": said}
            with started(command, start_new_session=True, **where) as process:
                time.sleep(0.01 + 1.99 * (attempt / tries) ** 2)
                before = process.poll()
                if before is None:
                    os.killpg(process.pid, number)
                status = process.wait(HANG_S)
            said.seek(0)
            text = said.read()
        allowed = {130, 0} if name in SERVICES or before is not None else {130}
        if status == 0 and before is None:
            continue  # it ended by itself while the signal was sent
        assert status in allowed | {-number}, (attempt, text)  # -number: while env starts
        assert "Traceback" not in text and "Error" not in text, (attempt, text)
        if status == 130:
            assert "interrupted" in text.splitlines()[-1]


@pytest.mark.parametrize("name", ["companion", "sitl-replay"])
def test_script_catches_no_signal_that_it_would_forget(name: str, tmp_path: Path) -> None:
    """Of 3500 interrupts of a starting dash, which catches them by itself, 2 were lost."""
    caught = tmp_path / "caught"
    for program, text in (
        ("env", f"grep SigCgt /proc/$PPID/status > {caught}\nexit 1\n"),
        ("python", "exit 0\n"),
    ):
        (tmp_path / program).write_text(f"#!/bin/sh\n{text}")
        (tmp_path / program).chmod(0o755)
    shutil.copy(ROOT / "scripts" / name, tmp_path / name)
    path = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    shell = Path("/bin/sh").resolve()
    subprocess.run([shell, tmp_path / name], check=True, timeout=HANG_S, env=path)
    numbers = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    if shell.name == "bash":
        numbers.remove(signal.SIGINT)  # it ends itself by the signal that it caught
    signals = int(caught.read_text().split()[1], 16)
    assert not any(signals >> (number - 1) & 1 for number in numbers)


@pytest.mark.parametrize("name", ["companion", "sitl-replay"])
def test_script_starts_python_with_interrupts_blocked(name: str, tmp_path: Path) -> None:
    """A starting interpreter would answer with a traceback; also by a link from elsewhere."""
    if HOLDS.returncode:
        pytest.skip("env cannot block signals")
    python, script, link = tmp_path / "python", tmp_path / name, tmp_path / "bin" / name
    python.write_text("#!/bin/sh\nexec grep SigBlk /proc/self/status\n")
    shutil.copy(ROOT / "scripts" / name, script)
    link.parent.mkdir()
    link.symlink_to(script)
    python.chmod(0o755)
    for command in (script, link):
        done = subprocess.run([command], capture_output=True, text=True, timeout=HANG_S, check=True)
        blocked = int(done.stdout.split()[1], 16)
        assert all(
            blocked >> (number - 1) & 1 for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        )


def test_interrupt_in_a_finalizer_is_not_lost() -> None:
    """The interpreter prints and drops an exception that a finalizer raises."""
    code = (
        "import signal, time\n"
        "from companion.cli.interrupts import interrupts_raised\n"
        "class Last:\n"
        "    def __del__(self):\n"
        "        signal.raise_signal(signal.SIGINT)\n"
        "try:\n"
        "    with interrupts_raised():\n"
        "        Last()\n"
        f"        time.sleep({HANG_S})\n"
        "except KeyboardInterrupt:\n"
        "    print('raised')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=HANG_S, check=True
    )
    assert (done.stdout, done.stderr) == ("raised\n", "")


def without_terminal(process: "subprocess.Popen[bytes]", terminal: int) -> None:
    """Close a process's terminal, which tells it by SIGHUP; writing to it fails from then on."""
    os.close(terminal)
    process.send_signal(signal.SIGHUP)


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """A terminal: the side of its emulator, which a test closes, and that of a program."""
    outside, inside = os.openpty()
    yield outside, inside
    os.close(inside)


def test_closed_terminal_ends_a_service_in_order(terminal: tuple[int, int], tmp_path: Path) -> None:
    """An SSH connection that breaks: the recording is completed."""
    outside, inside = terminal
    command = [BIN / "companion", "run", *CENTER, *LINK, *HTTP, "--record", tmp_path]
    with started(command, stdout=subprocess.PIPE, stderr=inside) as process:
        assert b"serves" in line_of(process, process.stdout)
        without_terminal(process, outside)
        assert process.wait(HANG_S) == 0
    (recording,) = tmp_path.iterdir()
    assert recording.suffix == ".mcap"


def test_service_goes_on_without_a_terminal_for_its_notices(
    terminal: tuple[int, int], cut_log: Path
) -> None:
    """Started in the background of a session that ended; stderr on a full disk is the same."""
    outside, inside = terminal
    command = [BIN / "companion", "run", *CENTER, *LINK, *HTTP]
    with started(command, stdout=subprocess.PIPE, stderr=inside) as process:
        line = line_of(process, process.stdout).decode()
        os.close(outside)
        port = line.rsplit(":", 1)[1].strip()
        play = [BIN / "sitl-replay", "play", cut_log, "--to", f"udpout:127.0.0.1:{port}"]
        subprocess.run([*play, "--speed", "5"], check=True, timeout=HANG_S, capture_output=True)
        url = line.split()[2]
        with urllib.request.urlopen(f"{url}/v1/events", timeout=HANG_S) as answer:
            assert len(json.load(answer)["events"]) > 4
        process.terminate()
        assert process.wait(HANG_S) == 0


def test_hangup_ends_a_drive_in_its_safe_state() -> None:
    drive = [BIN / "companion", "drive", "none:pointing", "--service", "http://127.0.0.1:9"]
    command = [*drive, "--on-stale", "boresight"]
    with started(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert [line_of(process, process.stderr) for _ in range(3)][1] == "safe state: boresight\n"
        process.send_signal(signal.SIGHUP)
        assert process.stderr.readlines()[0] == "safe state: boresight\n"
        assert process.wait(HANG_S) == 130


def test_nohup_keeps_a_service_from_ending_with_its_terminal() -> None:
    with started(
        ["nohup", BIN / "companion", "demo", "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as process:
        url = line_of(process, process.stdout).decode().split()[2]

        def updates() -> int:
            with urllib.request.urlopen(f"{url}/v1/status", timeout=HANG_S) as answer:
                return int(json.load(answer)["updates"])

        process.send_signal(signal.SIGHUP)
        before = updates()
        while updates() < before + 10:
            time.sleep(0.02)  # between two questions to another process
        process.send_signal(signal.SIGTERM)
        assert process.wait(HANG_S) == 0


def test_stopped_reader_of_the_status_stops_nothing(full_pipe: int) -> None:
    """Ctrl-S on a terminal is the same."""
    command = [BIN / "companion", "run", *CENTER, *LINK, *HTTP, "--json"]
    with started(command, stdout=full_pipe, stderr=subprocess.PIPE) as process:
        url = line_of(process, process.stderr).decode().split()[2]

        def uptime_s() -> float:
            with urllib.request.urlopen(f"{url}/v1/status", timeout=HANG_S) as answer:
                return float(json.load(answer)["uptime_s"])

        while uptime_s() < 3.0:  # two objects would have been printed
            time.sleep(0.02)  # between two questions to another process
        process.terminate()
        assert process.wait(HANG_S) == 0


def test_stopped_reader_of_the_summary_stops_no_served_replay(
    full_pipe: int, cut_log: Path
) -> None:
    command = [BIN / "companion", "replay", cut_log, *CENTER, *HTTP, "--serve", "--no-record"]
    command += ["--speed", "max"]
    with started(command, stdout=full_pipe, stderr=subprocess.PIPE) as process:
        line = b""
        while b" serves " not in line:
            line = line_of(process, process.stderr)
        url, is_over = line.decode().split(" serves ")[1].split()[0], False
        while not is_over:
            with urllib.request.urlopen(f"{url}/v1/status", timeout=HANG_S) as answer:
                is_over = json.load(answer)["replay"]["state"] == "finished"
        process.terminate()
        assert process.wait(HANG_S) == 0


def test_notices_without_a_reader_stop_nothing(full_pipe: int, cut_log: Path) -> None:
    command = [BIN / "companion", "run", *CENTER, *LINK, *HTTP]
    with started(command, stdout=subprocess.PIPE, stderr=full_pipe) as process:
        line = line_of(process, process.stdout).decode()
        play = [BIN / "sitl-replay", "play", cut_log, "--to", f"udpout:{line.split('udpin:')[1]}"]
        subprocess.run(
            [*map(str.strip, map(str, play)), "--speed", "5"],
            check=True, timeout=HANG_S, capture_output=True,
        )  # fmt: skip
        with urllib.request.urlopen(f"{line.split()[2]}/v1/events", timeout=HANG_S) as answer:
            assert len(json.load(answer)["events"]) > 4
        process.terminate()
        assert process.wait(HANG_S) == 0


def test_import_delays_an_interrupt_only_for_seconds(tmp_path: Path) -> None:
    """On a busy machine, the imports of a starting service take far longer."""
    (tmp_path / "slow.py").write_text(
        "import time\nprint('imports', flush=True)\ntime.sleep(600)\n"
    )
    code = (
        "from companion.cli.interrupts import interrupts_end, interrupts_raised\n"
        "with interrupts_end('companion'), interrupts_raised():\n"
        "    import slow\n"
    )
    env = os.environ | {"PYTHONPATH": f"{tmp_path}:{ROOT}"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with started([sys.executable, "-c", code], env=env, **pipes) as process:
        assert process.stdout.readline() == "imports\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(HANG_S) == 130
        assert process.stderr.read() == "companion: interrupted\n"
