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

from companion import assembly
from companion.beams import arrays, steering, zero_forcing
from companion.config import Settings
from companion.mavlink.framing import Splitter
from companion.tracking.fleet import SenderTime
from companion.values import AltitudeDatum, ComplexArray, Fix, Report, ReportNoise, Source

pytestmark = pytest.mark.benchmark
ROUNDS = 5


def interleaved_s(*works: Callable[[], object], rounds: int = ROUNDS) -> list[float]:
    """Median seconds of each, one after the other in turn, so that a slow spell hits all."""
    took: list[list[float]] = [[] for _ in works]
    for _ in range(rounds):
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


def users_of_a_line(elements: int, users: int) -> tuple[zero_forcing.Symmetry, ComplexArray]:
    """A half-wave line and the steering matrix of users in directions that are all different."""
    array = arrays.uniform_linear(elements, 30e9, 0.5, np.eye(3))
    symmetry = zero_forcing.Symmetry.of(array)
    assert symmetry is not None
    sines = np.linspace(-0.9, 0.9, users)
    directions = np.c_[np.sqrt(1 - sines**2), sines, np.zeros(users)]
    return symmetry, steering.steering_matrix(array, directions)


@pytest.mark.parametrize(
    ("elements", "users", "border_at_least"),
    [
        (64, 4, None),
        (64, 16, None),
        (128, 4, None),
        (256, 32, 20),
        (1024, 64, 60),
        (1024, 256, 200),
    ],
)
def test_zero_forcing_against_pinv(
    elements: int, users: int, border_at_least: float | None
) -> None:
    """From the steering matrix to weights and loss factors: in full on a line, in full on any
    array, and by border update after one user has moved."""
    symmetry, matrix = users_of_a_line(elements, users)
    tracked = zero_forcing.ZeroForcing(matrix, symmetry)
    # Every other update undoes the one before.
    moves = [
        matrix[:, 1:2] * np.exp(1j * x * np.arange(elements))[:, np.newaxis] for x in (1e-3, 0)
    ]
    many = max(1, 25_000 // (elements * users))

    def repeated(work: Callable[[], object], times: int) -> Callable[[], None]:
        def works() -> None:
            for _ in range(times):
                work()

        return works

    def there_and_back() -> None:
        for moved in moves:
            tracked.update([1], moved)

    theirs_s, full_s, any_s, border_s = interleaved_s(
        repeated(lambda: np.linalg.pinv(matrix.T), many),
        repeated(lambda: zero_forcing.solve(matrix, symmetry), 5 * many),
        repeated(lambda: zero_forcing.solve(matrix), 5 * many),
        repeated(there_and_back, 10 * many),
        rounds=3 * ROUNDS,
    )
    full, whatever, border = theirs_s / full_s * 5, theirs_s / any_s * 5, theirs_s / border_s * 20
    print(
        f"\n{elements}x{users}: pinv {theirs_s / many * 1e6:.0f} us; on a line {full:.1f} times as "
        f"fast, on any array {whatever:.1f}, one user moved {border:.1f}"
    )
    assert tracked.border_updates > 0 or border_at_least is None
    assert full >= 5
    assert border_at_least is None or border >= border_at_least


def test_ten_thousand_border_updates_against_a_fresh_solution() -> None:
    symmetry, matrix = users_of_a_line(256, 32)
    tracked = zero_forcing.ZeroForcing(matrix, symmetry)
    rng = np.random.default_rng(1)
    now = matrix.copy()
    for n in rng.integers(32, size=10_000).tolist():
        now[:, n] = matrix[:, n] * np.exp(1j * rng.uniform(-0.05, 0.05) * np.arange(256))
        tracked.update([n], now[:, n : n + 1])
    fresh, found = zero_forcing.solve(now), tracked.found
    assert fresh is not None
    assert found is not None
    off = np.abs(found.weights - fresh.weights).max() / np.abs(fresh.weights).max()
    print(f"\noff by {off:.1e} after {tracked.border_updates} border updates in a row")
    assert tracked.border_updates > 9000
    assert off <= 1e-12


@pytest.mark.parametrize("uavs", [4, 64])
def test_a_kinematic_update_with_prediction_and_bound(uavs: int) -> None:
    """One report taken in and one prediction made; the cost must not grow with the fleet."""
    each_us = {count: _update_us(count) for count in (4, uavs)}
    print(f"\n{each_us[uavs]:.0f} us for an update and a prediction with {uavs} UAVs")
    assert each_us[uavs] < 2 * each_us[4]


def _update_us(uavs: int) -> float:
    settings = Settings()
    fleet = assembly.fleet(settings, lambda _uav, t_ns: SenderTime(t_ns, 0.01))
    noise = ReportNoise(1.0, 1.0, 1.4, 0.3)
    report = Report(
        0, "bench", "", Source(1, 1), 47.0, 8.0, 500.0, AltitudeDatum.MSL, None, None, None, None,
        0, None,
    )  # fmt: skip
    velocity = np.array([5.0, 0.0, 0.0])
    rounds = 4000 // uavs

    begin_ns = 1_000_000_000

    def fly() -> None:
        nonlocal begin_ns
        for n in range(rounds):
            t_ns = begin_ns + n * 100_000_000
            position = velocity * (t_ns * 1e-9)
            for uav in range(uavs):
                name = str(uav)
                fleet.accept(Fix(name, t_ns, t_ns, t_ns, position, velocity, noise, report))
                fleet.track(name, t_ns, t_ns + 50_000_000)
        begin_ns += rounds * 100_000_000

    (seconds,) = interleaved_s(fly)
    return seconds / (rounds * uavs) * 1e6
