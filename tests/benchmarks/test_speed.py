"""Speed as ratios against peers, measured in the same run: ``make bench``."""

import json
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support import BIN, shared_log

from companion.beams import arrays, precoding, steering
from companion.mavlink.framing import Splitter

pytestmark = pytest.mark.benchmark
ROUNDS = 5


def interleaved_s(*works: Callable[[], object]) -> list[float]:
    """Median seconds of each, one after the other in turn, so that a slow spell hits all."""
    took: list[list[float]] = [[] for _ in works]
    for _ in range(ROUNDS):
        for times, work in zip(took, works, strict=True):
            begin = time.perf_counter()
            work()
            times.append(time.perf_counter() - begin)
    return [statistics.median(times) for times in took]


def test_replay_outruns_the_flight(tmp_path: Path) -> None:
    log = shared_log("sitl_4circle.tlog")
    command = [BIN / "companion", "replay", log, "--center", "5:1", "--json", "--out"]
    summaries: list[dict[str, float]] = []

    def replay() -> None:
        done = subprocess.run([*command, tmp_path / "x.mcap"], capture_output=True, check=True)
        summaries.append(json.loads(done.stdout))

    (replay_s,) = interleaved_s(replay)
    times = summaries[0]["duration_s"] / replay_s
    print(f"\nthe whole command, recording included: {times:.0f} times the flight's speed")
    assert times > 60


def test_splitting_against_pymavlink() -> None:
    from pymavlink.dialects.v20 import all as dialect

    data = shared_log("sitl_4circle.tlog").read_bytes()[:2_000_000]

    def peer() -> None:
        parser = dialect.MAVLink(None)
        parser.robust_parsing = True
        parser.parse_buffer(data)

    ours_s, theirs_s = interleaved_s(lambda: Splitter("bench").feed(0, data), peer)
    print(f"\nsplitting: {theirs_s / ours_s:.1f} times as fast as pymavlink's parse_buffer")
    assert theirs_s / ours_s > 5


@pytest.mark.parametrize(("elements", "users"), [(64, 4), (64, 16), (256, 32)])
def test_zero_forcing_against_pinv(elements: int, users: int) -> None:
    array = arrays.uniform_linear(elements, 30e9, 0.5, np.eye(3))
    sines = np.linspace(-0.9, 0.9, users)
    directions = np.c_[np.sqrt(1 - sines**2), sines, np.zeros(users)]
    matrix = steering.steering_matrix(array, directions)
    settings, repeat = precoding.Precoder(), 200
    ours_s, theirs_s = interleaved_s(
        lambda: [precoding.precode(matrix, settings) for _ in range(repeat)],
        lambda: [np.linalg.pinv(matrix.T) for _ in range(repeat)],
    )
    print(f"\n{elements}x{users}: {theirs_s / ours_s:.1f} times as fast as pinv")
    assert theirs_s > ours_s
