"""One line for user errors, a traceback for program defects, one line for Ctrl-C."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from support import BIN, HANG_S, ROOT, started

from companion.cli import console, voice
from companion.cli.console import OneLineErrors
from companion.cli.main import main
from companion.values import UserError


@click.group(name="prog", cls=OneLineErrors)
def prog() -> None:
    """A program."""


@prog.command()
@click.argument("what")
def fail(what: str) -> None:
    """Fail in the given way."""
    match what:
        case "user":
            raise UserError("the file holds\n  no log")
        case "escapes":
            raise UserError("\x1b[2J\x1b]0;pwned\x07 is not a setting\x9b")
        case "long":
            raise UserError("x" * 100_000)
        case "file":
            Path("/nowhere/x").read_text()
        case "value":
            raise ValueError("operands could not be broadcast together")
        case "unpacking":
            _first, _second = (1, 2, 3)  # type: ignore[misc]
        case "interrupted":
            raise KeyboardInterrupt
        case "interrupted in an import":
            import interrupted_import

            assert interrupted_import.ended  # type: ignore[attr-defined]
            while True:
                time.sleep(HANG_S)


@pytest.mark.parametrize(
    ("what", "status", "said"),
    [
        ("user", 1, "prog: the file holds no log\n"),
        ("escapes", 1, "prog: [2J]0;pwned is not a setting\n"),
        ("long", 1, f"prog: {'x' * 5000}…\n"),
        ("file", 1, "prog: /nowhere/x: No such file or directory\n"),
        ("interrupted", 130, "prog: interrupted\n"),
    ],
)
def test_user_error_is_one_line(what: str, status: int, said: str) -> None:
    done = CliRunner().invoke(prog, ["fail", what])
    assert (done.exit_code, done.stderr) == (status, said)


def test_terminal_control_characters_are_stripped(capfd: pytest.CaptureFixture[str]) -> None:
    """Line breaks and letters of any script are kept."""
    lines, objects = voice.Lines(), voice.JsonLines()
    for say in (console.say, lines.say, objects.say):
        say("ü 王\n\x1b[2J\x1b]0;pwned\x07\r\b\x9b")  # as a reason or a name
    lines.finish()
    objects.finish()
    said = capfd.readouterr()
    assert said.out + said.err == 3 * "ü 王\n[2J]0;pwned\n"


@pytest.mark.parametrize("made_of_it", ["pass", "raise RuntimeError('no class')", "raise"])
def test_interrupt_during_an_import_waits_for_its_end(
    made_of_it: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a package might ignore it, raise another error, or be left half imported."""
    (tmp_path / "interrupted_import.py").write_text(
        "import signal\n"
        "try:\n    signal.raise_signal(signal.SIGINT)\n"
        f"except BaseException:\n    {made_of_it}\n"
        "else:\n    ended = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "interrupted_import", raising=False)
    done = CliRunner().invoke(prog, ["fail", "interrupted in an import"])
    assert (done.exit_code, done.stderr) == (130, "prog: interrupted\n")


@pytest.mark.parametrize("what", ["value", "unpacking"])
def test_defect_is_not_reported_as_a_user_error(what: str) -> None:
    done = CliRunner().invoke(prog, ["fail", what])
    assert type(done.exception) is ValueError
    assert done.stderr == ""


def test_every_user_facing_error_is_a_user_error() -> None:
    """Every error class that can leave a command is a UserError, or has its reason here."""
    inside = {
        "_RefusedError",  # becomes a Rejection where it is raised
        "UnsatisfiableRangeError",  # becomes a 416
        "CutShortError",  # ends the connection: the answer has begun
        "ServiceError",  # client side: the service's error response
        "InterruptedByUser",  # Ctrl-C
        "NotRegularError",  # an OSError: becomes the UserError that names the file
        "HungUpError",  # an orderly end of a connection: the link retries or ends
        "BusyError",  # a request is refused with a 409
        "PlaybackError",  # the same
        "DamagedChunkError",  # the chunk is passed over and counted
        "NoTableError",  # becomes the UserError of a file that is no log
        "UnknownFlagsError",  # the same
        "DeviceError",  # leads to the safe state and a retry, announced once
        "SourceLostError",  # the same
        "StalledError",  # the link connects again, announced once
        "_FormatError",  # becomes a Rejection where it is raised
        "ObservationRecordError",  # becomes a counted Rejection where the record is received
        "FleetMessageError",  # becomes a counted rejected sample
    }
    run = (
        "import pkgutil, importlib, companion\n"
        "for found in pkgutil.walk_packages(companion.__path__, 'companion.'):\n"
        "    if found.name != 'companion.studies.prediction.learned':\n"
        "        importlib.import_module(found.name)\n"
        "from companion.values import UserError\n"
        "def below(kind):\n"
        "    for one in kind.__subclasses__():\n"
        "        yield one\n"
        "        yield from below(one)\n"
        "print(*{one.__name__ for one in below(Exception)\n"
        "        if one.__module__.startswith('companion') and not issubclass(one, UserError)})\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", run], capture_output=True, text=True, check=True, timeout=HANG_S
    )
    assert set(done.stdout.split()) <= inside


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize(
    ("package", "asked", "ended"),
    [
        ("companion", ["replay", "/dev/zero.tlog"], "companion: /dev/zero.tlog: no such file"),
        (
            "sitl_replay",
            ["play", "/dev/zero.tlog"],
            "sitl-replay: Invalid value for 'LOG...': File '/dev/zero.tlog' does not exist."
            " See sitl-replay play --help",
        ),
    ],
)
def test_interrupt_while_loading_is_one_line(
    package: str, asked: list[str], ended: str, seed: int, tmp_path: Path
) -> None:
    """From the moment at which the handler is installed; interpreter start can take longer than any
    timeout on a busy machine."""
    began = tmp_path / "began"
    code = (
        f"import signal, sys\nfrom {package}.__main__ import main\n"
        "listen = signal.signal\n"
        "def told(*what):\n"
        "    signal.signal = listen\n"
        "    listen(*what)\n"
        f"    open({str(began)!r}, 'w').close()\n"
        "signal.signal = told\n"
        f"sys.argv = {[package, *asked]}\nmain()\n"
    )
    command = [sys.executable, "-c", code]
    with started(command, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        while not began.exists():
            assert process.poll() is None
            os.sched_yield()
        time.sleep(random.Random(seed).uniform(0.0, 0.5))  # anywhere during loading, or after it
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=HANG_S)
    lines = said.splitlines()
    assert len(lines) == 1, said
    assert lines[0] in (f"{package.replace('_', '-')}: interrupted", ended)


def test_interrupt_after_the_last_line_adds_no_other() -> None:
    code = (
        "import os, signal\n"
        "from companion.cli.interrupts import command_ended, interrupts_end\n"
        "with interrupts_end('x'):\n"
        "    command_ended()\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, timeout=HANG_S, cwd=ROOT
    )
    assert done.stderr == b""


def test_script_and_module_entry_points_are_equal() -> None:
    by_name = subprocess.run(
        [BIN / "companion", "--version"], capture_output=True, check=True, timeout=HANG_S
    )
    module = [sys.executable, "-m", "companion", "--version"]
    assert (
        subprocess.run(module, capture_output=True, check=True, timeout=HANG_S).stdout
        == by_name.stdout
    )


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_standard_streams_are_the_null_device(
    closed: str, cut_log: Path, tmp_path: Path
) -> None:
    """A file that is opened next would otherwise take a closed stream's number."""
    out = tmp_path / "weights.npy"
    command = f"'{BIN / 'companion'}' weights '{cut_log}' --center 5:1 --at 2 --format npy"
    done = subprocess.run(
        f"{command} --out '{out}' {closed} && {command} {closed}",
        check=False,
        shell=True,
        capture_output=True,
        timeout=HANG_S,
    )
    assert done.returncode == 0
    assert b"Traceback" not in done.stderr
    assert np.load(out).shape[0] == 64


@pytest.mark.parametrize("through_link", [False, True])
@pytest.mark.parametrize(
    "words",
    [
        ("weights", "LOG", "--at", "3", "--out", "OUT"),
        ("replay", "LOG", "--center", "1:1", "--out", "OUT"),
        ("calibrate", "channels", "LOG", "--out", "OUT"),
    ],
)
def test_output_that_is_an_input_is_refused(
    words: tuple[str, ...], through_link: bool, short_log: Path, tmp_path: Path
) -> None:
    log = tmp_path / "flight.mcap"
    log.write_bytes(short_log.read_bytes())
    out = tmp_path / "out.mcap"
    if through_link:
        out.symlink_to(log)
    else:
        out = log
    before = log.read_bytes()
    given = [{"LOG": str(log), "OUT": str(out)}.get(one, one) for one in words]
    done = CliRunner().invoke(main, given)
    assert done.exit_code == 1
    if words[0] != "calibrate":  # which reads its input first
        assert done.stderr.splitlines()[-1].endswith(
            f"{out}: is also an input of this command; name another file"
        )
    assert log.read_bytes() == before


def test_loop_of_symbolic_links_is_one_line(short_log: Path, tmp_path: Path) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    words = ["weights", str(short_log), "--center", "1:1", "--at", "1", "--out", str(loop)]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 1
    assert done.stderr.splitlines()[-1].endswith("it is a loop of symbolic links")


def test_earlier_file_is_kept_if_the_new_one_cannot_be_written(tmp_path: Path) -> None:
    out = tmp_path / "design.json"
    command = "design --model kinematic --dt-range 0.1,0.2"
    made = f"'{BIN / 'companion'}' {command} --out '{out}'"
    subprocess.run(made, shell=True, check=True, capture_output=True, timeout=HANG_S)
    earlier = out.read_bytes()
    limited = f"ulimit -f 1; trap '' XFSZ; {made} --acceleration 7"
    done = subprocess.run(
        ["bash", "-c", limited], check=False, capture_output=True, text=True, timeout=HANG_S
    )
    assert done.returncode == 1
    assert done.stderr == f"companion: {out}: cannot be written: File too large\n"
    assert out.read_bytes() == earlier
    assert [one.name for one in tmp_path.iterdir()] == [out.name]


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_export_to_a_full_disk_is_one_line(form: str, cut_log: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    export = f"export '{cut_log}' --center 5:1 --format {form} --out '{tmp_path / 'out'}'"
    limited = f"ulimit -f 8; trap '' XFSZ; '{BIN / 'companion'}' {export}"
    done = subprocess.run(
        ["bash", "-c", limited], check=False, capture_output=True, text=True, timeout=HANG_S
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1:] == [
        "companion: the output cannot be written: File too large"
    ]
    assert "Traceback" not in done.stderr
