"""A hanging test is terminated and named, wherever it hangs, and the others run."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support import HANG_S, ROOT

PATIENT, HASTY = "LAST_RESORT_S = 120.0", "LAST_RESORT_S = 1.0"
HANGING = """
import asyncio
import pytest
import uvloop

def test_in_a_loop_that_handles_no_signals():
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(asyncio.sleep(10_000))

@pytest.fixture
def endless():
    yield
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(asyncio.sleep(10_000))

def test_in_the_teardown_after_a_failure(endless):
    assert False

def test_that_does_not():
    pass
"""


@pytest.mark.full
def test_hanging_test_is_terminated_and_named(tmp_path: Path) -> None:
    text = (ROOT / "tests" / "conftest.py").read_text(encoding="utf-8")
    assert PATIENT in text
    (tmp_path / "conftest.py").write_text(text.replace(PATIENT, HASTY), encoding="utf-8")
    (tmp_path / "test_some.py").write_text(HANGING)
    command = [sys.executable, "-m", "pytest", "-q", "-n", "1", "--timeout", "1"]
    command += ["-p", "no:cacheprovider", "-c", ROOT / "pyproject.toml", "--rootdir", tmp_path]
    done = subprocess.run(
        [*command, tmp_path],
        env=os.environ | {"PYTHONPATH": str(ROOT / "tests")},
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    said = done.stdout + done.stderr
    assert done.returncode == 1, said
    crashed = set(re.findall(r"crashed while running '.*::(\w+)'", said))
    assert crashed == {
        "test_in_a_loop_that_handles_no_signals", "test_in_the_teardown_after_a_failure"
    }, said  # fmt: skip
    assert "1 passed" in said
    assert "test_some.py" in done.stderr, "it does not show where it was"
