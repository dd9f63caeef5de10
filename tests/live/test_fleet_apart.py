"""Three live nodes over a network with delay, loss and partitions: namespaces and TUN devices."""

import json
import os
import subprocess
import sys
from typing import Any

import pytest
from support import BIN, HANG_S, ROOT

pytest.importorskip("zenoh")
pytestmark = pytest.mark.full
PARTED_S = 30.0


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Ten UAVs over 20 ms delay and 2 % loss each way, with one node cut off for 30 s."""
    try:
        given = ("unshare", "--net", "test", "-w", "/dev/net/tun")
        subprocess.run(given, check=True, capture_output=True, timeout=HANG_S)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("the system gives no network namespace, or no TUN device")
    path = os.pathsep.join((str(ROOT / "tests"), str(ROOT)))
    words = ["fleet_apart.py", BIN / "companion", tmp_path_factory.mktemp("apart")]
    done = subprocess.run(
        ["unshare", "--net", sys.executable, *map(str, [*words, 10, 0.02, 0.02, PARTED_S])],
        cwd=ROOT / "tests",
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=4 * HANG_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    assert found["lost"] > 0.01 * found["carried"] > 10
    return found


def test_no_uav_is_unserved_before_or_during_a_partition(seen: dict[str, Any]) -> None:
    """Healing times are in docs/fleet.md; a fleet that does not heal fails the run."""
    for when in ("whole", "parted"):
        assert sum(seen[when].values()) > 50
        assert seen[when]["none"] == 0
    assert seen["parted"]["twice"] > seen["parted"]["once"]  # the partition took effect


def test_no_bound_was_violated_over_tun_links(seen: dict[str, Any]) -> None:
    assert seen["checked"] > 500
    assert seen["broken"] == []
