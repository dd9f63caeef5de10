"""Progress through a log: a line that is overwritten, and lines where stderr is no terminal."""

import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.cli import console
from companion.cli.console import Progress, log_progress
from companion.cli.main import main
from companion.node import replay as replaying

HEAD = "unix_s,lat_deg,lon_deg,alt_m\n"


def table(begins_s: float = 1_795_000_000, seconds: int = 30) -> str:
    return HEAD + "".join(
        f"{begins_s + n / 10:.1f},47.{n:04d},8.5,500\n" for n in range(10 * seconds + 1)
    )


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    at_s = [100.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: at_s[0])
    return at_s


def test_progress_is_a_line_every_ten_seconds_without_a_terminal(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    progress = Progress()
    show = log_progress(progress, 200.0)
    for n in range(1, 26):
        clock[0] += 1
        show(n, float(n), float(n))
        progress.show("only on a terminal")
    progress.clear()
    assert capsys.readouterr().err.splitlines() == [
        "10 frames, 10 s of log of 200 s, 190 s to go",
        "20 frames, 20 s of log of 200 s, 180 s to go",
    ]


def test_progress_on_a_terminal_is_overwritten(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    progress = Progress()
    log_progress(progress, None)(7, 2.0, 1.0)
    progress.clear()
    assert capsys.readouterr().err == "\r\x1b[K7 frames, 2 s of log\r\x1b[K"


@pytest.mark.parametrize("command", ["replay", "export", "weights"])
def test_table_is_read_and_replayed_with_progress(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its reading is announced, and its replay states the time that is left."""
    monkeypatch.setattr(console, "LOG_EVERY_S", 0.0)
    monkeypatch.setattr(replaying, "FLUSH_EVERY_S", 0.0)
    monkeypatch.setattr("companion.node.moment.PROGRESS_EVERY", 10)
    shown: list[str] = []
    monkeypatch.setattr(Progress, "show", lambda self, text: shown.append(text))
    path = tmp_path / "walk.csv"
    path.write_text(table())
    options = {
        "replay": ["--no-record"],
        "export": ["--out", str(tmp_path / "out")],
        "weights": ["--at", "20"],
    }
    done = CliRunner().invoke(main, [command, str(path), *options[command]])
    assert done.exit_code == 0, done.output
    assert shown[0] == "reading walk.csv"
    lines = [line for line in done.stderr.splitlines() if "of log" in line]
    assert lines
    if command == "replay":
        assert "of log of 30 s, " in lines[-1]


def test_length_of_tables_is_known_before_the_replay(tmp_path: Path) -> None:
    first, second = tmp_path / "a.csv", tmp_path / "b.csv"
    first.write_text(table())
    second.write_text(table(1_795_000_010, 50))
    assert replaying.length_s([first]) == 30.0
    assert replaying.length_s([first, second]) == 60.0
    second.write_text(table().replace("unix_s", "t_s"))
    assert replaying.length_s([second]) == 30.0
