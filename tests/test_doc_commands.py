"""Every command line of the documents that tests/test_readme.py does not run.

A command on a log runs to its end on the tests' short flight. A command that needs a device, a
peer or a network is only parsed by the program itself, so a wrong option or argument is found.
``NOT_RUN`` gives the reason for the remaining ones.
"""

import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from support import BIN, HANG_S, ROOT
from test_readme import PAGES as GUIDES

from companion.cli.main import main as companion
from sitl_replay.cli import main as sitl_replay

WRITTEN = ("api.md", "export.md", "messages.md")  # read by programs
PAGES = [
    page
    for page in sorted([*(ROOT / "docs").rglob("*.md"), ROOT / "CONTRIBUTING.md"])
    if page not in GUIDES and page.name not in WRITTEN
]
PROGRAMS = {"companion": companion, "sitl-replay": sitl_replay}
NOT_RUN = {
    "pip": "installs from a registry",
    "/opt/companion/bin/pip": "installs from a registry",
    "docker": "needs a container engine; tests/test_deployment.py carries out the steps",
    "python3": "needs GNU Radio, or writes to /opt; tests/examples runs the former's block",
    "mosquitto_sub": "needs a broker",
}
SHELL = ("printf", "gcc", "g++", "ADDRESSES=IP:192.0.2.11")
TO_THE_END = ("replay", "weights", "export", "study")
START = "|".join(map(re.escape, (*PROGRAMS, *NOT_RUN, *SHELL, "make")))
ELLIPSIS = "…"


def commands(page: Path) -> list[str]:
    """Return the command lines of a page, without placeholders for the reader's own arguments."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"(?:^    .*\n?|^\n(?=    ))+", text, re.M)
    lines = [line.strip() for block in blocks for line in block.replace("\\\n", " ").split("\n")]
    found = [line for line in lines if re.match(rf"({START})\s", line)]
    found += re.findall(rf"`((?:{'|'.join(PROGRAMS)}|make) [^`]*)`", text)
    return [one for one in found if ELLIPSIS not in one]


ALL = sorted({one for page in PAGES for one in commands(page)})
RUN = [one for one in ALL if one.split()[0] not in NOT_RUN]


def parsed(words: list[str]) -> None:
    """Parse a command with the program itself, without running it."""
    command: click.Command = PROGRAMS[words[0]]
    context = click.Context(command)
    rest = words[1:]
    while isinstance(command, click.Group):
        name, found, rest = command.resolve_command(context, rest)
        assert found is not None
        command, context = found, click.Context(found, context, name)
    if not rest:
        return  # the name of a command
    if len(rest) == 1 and rest[0].startswith("--"):  # the name of an option
        assert any(rest[0] in one.opts for one in [*command.params, HELP])
        return
    command.make_context(words[0], rest)


HELP = click.Option(["--help"])


def ended(words: list[str], where: Path, studied: Callable[..., Path]) -> None:
    """Run a command on a log to its end."""
    if words[1] == "study":
        log = str(ROOT / "tests/data/sitl_4circle_cut.tlog")
        given = [log if one.endswith(".tlog") or one == "LOG" else one for one in words[2:-2]]
        assert words[-2] == "--out"
        assert (studied(*given) / f"{given[0]}.html").exists()
        return
    done = subprocess.run(
        [BIN / words[0], *words[1:]],
        cwd=where, capture_output=True, text=True, timeout=HANG_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def is_run(words: list[str]) -> bool:
    """Return whether a command is run to its end: it reads the reader's flight and writes a
    report.
    """
    return words[0] == "companion" and (
        (words[1] == "study" and "--out" in words and "fleet" not in words)
        or (words[1] in TO_THE_END and "flight.tlog" in words and "--config" not in words)
        or words[1:3] == ["replay", "uav.bin"]
    )


def marked(line: str) -> object:
    """Return a command as a parameter; studies are left to `make test-all`."""
    long = line.startswith("companion study")
    return pytest.param(line, marks=pytest.mark.full if long else ())


@pytest.mark.parametrize("line", [marked(line) for line in RUN])
def test_documented_command_works(
    *,
    line: str,
    tmp_path: Path,
    short_log: Path,
    aeroplane: Path,
    carrier: Path,
    studied: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    for file, name in (
        (short_log, "flight.tlog"),
        (aeroplane, "uav.bin"),
        (carrier, "carrier.bin"),
    ):
        shutil.copy(file, tmp_path / name)
    words = shlex.split(line, comments=True)
    if words[0] == "make":
        command = ["make", "--dry-run", "--always-make", words[1]]
        subprocess.run(command, cwd=ROOT, capture_output=True, check=True, timeout=HANG_S)
    elif words[0] in SHELL:
        if words[0] in ("gcc", "g++") and not shutil.which(words[0]):
            pytest.skip("no compiler here")
        shutil.copytree(ROOT / "examples", tmp_path / "examples")
        shell = line.split(" && ./", maxsplit=1)[0]  # follow_ring is run by tests/examples
        subprocess.run(shell, shell=True, cwd=tmp_path, check=True, timeout=HANG_S)
    elif is_run(words):
        ended(words, tmp_path, studied)
    else:
        for name in ("phaser.toml", "settings.toml", "panel.toml", "responses.csv", "heard.tlog"):
            (tmp_path / name).touch()
        (tmp_path / "phaser-files").mkdir()
        parsed(words)


def test_wrong_option_is_detected() -> None:
    with pytest.raises(click.UsageError):
        parsed(["companion", "run", "--lnik", "udpin:0.0.0.0:14550"])
    with pytest.raises(click.UsageError):
        parsed(["companion", "dirve", "rotctld:127.0.0.1:4533"])


def test_every_exception_from_running_is_used() -> None:
    words = {line.split()[0] for line in ALL}
    assert len(ALL) > 50
    assert set(NOT_RUN) - words <= {"mosquitto_sub"}
