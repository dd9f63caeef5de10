"""Output of a run: a live status line on a terminal, plain lines in a pipe, JSON on request."""

import json
import os
import pty
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from support import BIN, HANG_S, line_of, started

from companion.cli.console import bearer_token
from companion.values import UserError

DEMO = [BIN / "companion", "demo", "--port", "0"]


def test_json_output_is_one_object_per_second_with_new_events(tmp_path: Path) -> None:
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    found: list[dict[str, Any]] = []
    with started([*DEMO, "--json"], cwd=tmp_path, **pipes) as process:
        while not (found and len(found[-1]["uavs"]) == 4 and len(found) > 1):
            found.append(json.loads(line_of(process, process.stdout)))
        process.terminate()
        process.communicate(timeout=HANG_S)
    assert re.fullmatch(r"\d of \d links good|no UAV to aim at", found[-1]["headline"])
    assert {each["id"] for each in found[-1]["uavs"]} == {"1:1", "2:1", "3:1", "4:1"}
    assert found[-1]["links"][0]["state"] == "up"
    assert found[-1]["recording"]["state"] == "recording"
    said = [event["text"] for each in found for event in each["events"]]
    assert any("local frame: origin set to" in text for text in said)
    assert len(said) == len({(e["at"], e["text"]) for each in found for e in each["events"]})


@pytest.mark.full
def test_piped_output_is_plain_lines(tmp_path: Path) -> None:
    done = subprocess.run(
        [*DEMO, "--seconds", "3"],
        cwd=tmp_path, capture_output=True, text=True, timeout=HANG_S, check=True,
    )  # fmt: skip
    first, last = done.stdout.splitlines()
    assert first.startswith("companion serves http://127.0.0.1:")
    assert last.startswith("recording ")
    assert "\r" not in done.stderr
    assert "links up" not in done.stderr


def test_terminal_status_line_fits_80_columns(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    with started([*DEMO], cwd=tmp_path, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        shown = b""
        while not re.search(rb"\r\x1b\[K1 of 1 links up, \d+ frames/s", shown):
            shown += os.read(ours, 4096)
        process.terminate()
        process.wait(timeout=HANG_S)
        os.close(ours)
    lines = shown.decode().split("\r")
    assert max(len(line.removeprefix("\x1b[K")) for line in lines if "links up" in line) < 80


@pytest.mark.parametrize(
    "token", ["line\nof_a_long_enough_token", "beyond_latin_\u0142_and_long_enough"]
)
def test_token_that_http_cannot_transmit_is_an_error(
    token: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COMPANION_TOKEN", token)
    with pytest.raises(UserError, match="ASCII letters"):
        bearer_token()


def test_line_end_after_a_token_is_none_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """As from a file of variables with the line ends of Windows."""
    monkeypatch.setenv("COMPANION_TOKEN", "sixteen_letters_x\r\n")
    assert bearer_token() == "sixteen_letters_x"
