"""The product on arm64, under qemu-user: the same estimates to the last bit, weights to 1e-11.

``tests/arm/make_root.sh`` makes the interpreter; without it these tests are skipped.
"""

import json
import re
import subprocess
from pathlib import Path
from typing import Any, Final

import pytest
from arm import flight
from support import HANG_S, ROOT, shared_log

from companion.node.replay import replay, settings_for

PYTHON: Final = ROOT / "build" / "arm" / "python"
pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(not PYTHON.exists(), reason="no arm64: tests/arm/make_root.sh makes it"),
]
EMULATED: Final = 20  # slowness of an emulated processor
WEIGHTS_TO: Final = 1e-11
"""Largest difference of a weight of unit norm: both processors round sums in another order."""


def on_arm(*arguments: object) -> Any:
    """What a command of the arm64 interpreter prints, from JSON."""
    command = [str(PYTHON), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, check=True, timeout=EMULATED * HANG_S)
    return json.loads(done.stdout)


def test_a_flight_has_the_same_estimates_and_weights() -> None:
    theirs = on_arm(ROOT / "tests" / "arm" / "flight.py", 8, 2)
    pipeline = flight.fly(8, 2.0)
    assert pipeline.digest.of_estimates() == theirs["estimates"]
    assert pipeline.last_update is not None
    ours = pipeline.last_update.beams.weights.ravel()
    assert len(ours) == len(theirs["weights"]) == 8 * 64
    for one, (real, imag) in zip(ours.tolist(), theirs["weights"], strict=True):
        assert abs(one - complex(float.fromhex(real), float.fromhex(imag))) < WEIGHTS_TO


@pytest.mark.parametrize(
    ("log", "center"), [("real_dronekit_flight2015.tlog", None), ("sitl_planes_circle.tlog", "5:1")]
)
def test_a_log_has_the_same_estimates(log: str, center: str | None) -> None:
    logs = [Path(shared_log(log))]
    ours = replay(logs, settings_for(logs, None, center))
    options = ["--center", center] if center else []
    theirs = on_arm("-m", "companion", "replay", logs[0], *options, "--no-record", "--json")
    assert theirs["digest_estimates"] == ours["digest_estimates"]
    for key in ("duration_s", "frames", "rejected", "notices"):
        assert theirs.get(key) == ours.get(key)


def test_instructions_are_counted() -> None:
    counted = subprocess.run(
        [str(PYTHON), "-c", "sum(range(1_000_000))"],
        env={"QEMU_PLUGIN": str(PYTHON.parent / "count_instructions.so"), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=True,
        timeout=HANG_S,
    )
    found = re.search(r"instructions (\d+)", counted.stderr)
    assert found is not None
    assert int(found[1]) > 10_000_000
