"""A program defect: the service ends with a traceback and a finished recording."""

import subprocess
import sys
from pathlib import Path

import pytest
from support import HANG_S, read_metadata

BROKEN = """
import sys
from companion.pipeline.fold import Pipeline
from companion.values import {kind}
from companion.__main__ import main

right = Pipeline.step

def step(self, event):
    if isinstance(event, {kind}) and self.updates >= 3:
        raise {error}
    return right(self, event)

Pipeline.step = step
sys.argv = ["companion", "demo", "--port", "0", "--seconds", "60"]
main()
"""


@pytest.mark.parametrize(
    ("kind", "error"),
    [
        pytest.param("Frame", "ValueError('wrong shapes')", id="in a link's callback"),
        pytest.param("Tick", "KeyError('1:1')", id="in the timer's task", marks=pytest.mark.full),
    ],
)
def test_pipeline_defect_ends_the_service_with_a_traceback(
    tmp_path: Path, kind: str, error: str
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", BROKEN.format(kind=kind, error=error)],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=HANG_S,
    )  # fmt: skip
    assert done.returncode not in (0, 130)
    assert "Traceback" in done.stderr
    assert f"{error.partition('(')[0]}: " in done.stderr
    (recording,) = (tmp_path / "recordings").iterdir()
    assert recording.suffix == ".mcap"
    assert "digest" in read_metadata(recording)["summary"]
