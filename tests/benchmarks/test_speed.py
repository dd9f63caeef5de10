"""Speed as ratios to other programs, measured in the same run: ``make bench``."""

import json
import statistics
import subprocess
import time
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from figures import Figures
from support import BIN, HANG_S, shared_log

from companion.beams.array import geometry, steering
from companion.beams.weights import zero_forcing
from companion.mavlink.links.peers import Peer
from companion.mavlink.links.transport import Link, Received
from companion.mavlink.links.urls import parse_link
from companion.mavlink.trust.fair_share import Account
from companion.mavlink.wire.framing import Splitter
from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.recording.reader import read_log
from companion.settings.model import Settings
from companion.values import (
    AltitudeDatum,
    ComplexArray,
    Fix,
    Frame,
    Report,
    ReportNoise,
    SenderTime,
    Source,
)

pytestmark = pytest.mark.benchmark
ROUNDS = 5


def interleaved(
    *works: Callable[[], object],
    rounds: int = ROUNDS,
    clock: Callable[[], float] = time.perf_counter,
) -> list[list[float]]:
    """Seconds of each per round, interleaved, so that a slow phase affects all."""
    took: list[list[float]] = [[] for _ in works]
    for _ in range(rounds):
        for times, work in zip(took, works, strict=True):
            begin = clock()
            work()
            times.append(clock() - begin)
    return took


def test_replay_against_reading_the_log(tmp_path: Path, figures: Figures) -> None:
    """The whole command, against mavlogdump printing the reports of the same log."""
    log = shared_log("sitl_4circle.tlog")
    ours = [BIN / "companion", "replay", log, "--center", "5:1", "--json"]
    theirs = [BIN / "mavlogdump.py", "--types", "GLOBAL_POSITION_INT", log]
    flown_s: list[float] = []

    def runs(command: list[Any]) -> Callable[[], None]:
        def work() -> None:
            done = subprocess.run(command, capture_output=True, check=True, timeout=HANG_S)
            if command[0] == ours[0]:
                flown_s.append(json.loads(done.stdout)["duration_s"])

        return work

    recorded = [*ours, "--out", tmp_path / "x.mcap"]
    recorded_s, plain_s, dump_s = interleaved(
        runs(recorded), runs([*ours, "--no-record"]), runs(theirs), rounds=3
    )
    for name, took_s in (("recorded", recorded_s), ("--no-record", plain_s)):
        figures.note(f"replay, {name}", [flown_s[0] / s for s in took_s], "x the flight", "more")
    figures.ratio("replay, --no-record, over mavlogdump", plain_s, dump_s)
    assert figures.ratio("replay, recorded, over mavlogdump", recorded_s, dump_s) < 16


def test_splitting_against_pymavlink(figures: Figures) -> None:
    from pymavlink import mavutil
    from pymavlink.dialects.v20 import all as dialect

    log = shared_log("sitl_4circle.tlog")
    data = log.read_bytes()[:2_000_000]

    def peer() -> None:
        parser = dialect.MAVLink(None)
        parser.robust_parsing = True
        parser.parse_buffer(data)

    ours_s, theirs_s = interleaved(lambda: Splitter("bench").feed(0, data), peer)
    assert figures.ratio("splitting, parse_buffer over ours", theirs_s, ours_s, "more") > 5

    def received(types: list[str] | None) -> None:
        reader = mavutil.mavlink_connection(str(log))
        while reader.recv_match(type=types) is not None:
            pass
        reader.close()

    ours_s, all_s, some_s = interleaved(
        lambda: sum(1 for _ in read_log(log)),
        lambda: received(None),
        lambda: received(["GLOBAL_POSITION_INT"]),
        rounds=3,
    )
    figures.ratio("reading a log, recv_match() over ours", all_s, ours_s, "more")
    figures.ratio("reading a log, recv_match(type=...) over ours", some_s, ours_s, "more")


class Unlimited(Link):
    """Link that admits every sender, and charges none for its frames."""

    def _charge(self, peer: Peer, used: list[Received], each_s: float) -> None:
        pass

    def _is_admitted(self, peer: Peer, frame: Frame) -> bool:
        peer.served.add(frame.source)
        peer.accounts[frame.source] = Account(frame.source)
        return True


def test_admission_of_a_frame_against_its_processing(figures: Figures) -> None:
    """A datagram of each frame, from a port of each vehicle, through a link and the fold."""
    log = read_log(shared_log("sitl_4circle.tlog"))
    frames = list(islice((event for event in log if isinstance(event, Frame)), 30_000))
    settings = Settings().override(center={"source": "5:1"})

    def serve(kind: type[Link]) -> None:
        pipeline, t_ns = Pipeline(settings), 0

        def receive(items: list[Received]) -> None:
            for item in items:
                pipeline.step(item)

        link = kind(url=parse_link("udpin:127.0.0.1:1"), receive=receive, now_ns=lambda: t_ns)
        for frame in frames:
            t_ns = frame.t_ns
            link.take(("127.0.0.1", 10_000 + frame.source.sysid), frame.raw, 0)
        assert link.status.frames == len(frames)

    links = (partial(serve, Link), partial(serve, Unlimited))
    with_s, without_s = interleaved(*links, rounds=9, clock=time.thread_time)
    assert figures.ratio("a frame with admission over one without", with_s, without_s) < 1.05


def users_of_a_line(elements: int, users: int) -> ComplexArray:
    """The steering matrix of a half-wavelength linear array for users in distinct directions."""
    array = geometry.uniform_linear(
        elements, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)
    )
    sines = np.linspace(-0.9, 0.9, users)
    directions = np.c_[np.sqrt(1 - sines**2), sines, np.zeros(users)]
    return steering.steering_matrix(array, directions)


@pytest.mark.parametrize(
    ("elements", "users"), [(64, 4), (64, 16), (128, 4), (256, 32), (1024, 64), (1024, 256)]
)
def test_zero_forcing_against_pinv(elements: int, users: int, figures: Figures) -> None:
    """From the steering matrix to weights and loss factors."""
    matrix = users_of_a_line(elements, users)
    many = max(1, 25_000 // (elements * users))

    def repeated(work: Callable[[], object], times: int) -> Callable[[], None]:
        def works() -> None:
            for _ in range(times):
                work()

        return works

    theirs_s, ours_s = interleaved(
        repeated(lambda: np.linalg.pinv(matrix.T), many),
        repeated(lambda: zero_forcing.solve(matrix), 5 * many),
        rounds=3 * ROUNDS,
    )
    each_s = [seconds / 5 for seconds in ours_s]
    name = f"zero forcing {elements}x{users}, pinv over ours"
    assert figures.ratio(name, theirs_s, each_s, "more") >= 5


@pytest.mark.parametrize("uavs", [4, 64])
def test_update_and_prediction_cost_is_independent_of_fleet_size(
    uavs: int, figures: Figures
) -> None:
    """One report received and one prediction made; the cost must not grow with the number of
    UAVs."""
    each_us = {count: _update_us(count) for count in (4, uavs)}
    figures.note(f"update and prediction, {uavs} UAVs", each_us[uavs], "us each", "less")
    assert each_us[uavs] < 2 * each_us[4]


def _update_us(uavs: int) -> float:
    settings = Settings()
    tracker = assembly.tracker(settings)
    noise = ReportNoise(horizontal_m=1.0, vertical_m=1.0, position_m=1.4, velocity_mps=0.3)
    report = Report(
        t_ns=0,
        uav="",
        source=Source(1, 1),
        lat_deg=47.0,
        lon_deg=8.0,
        alt_m=500.0,
        alt_datum=AltitudeDatum.MSL,
        relative_alt_m=None,
        velocity_ne_mps=None,
        velocity_down_mps=None,
        heading_deg=None,
        boot_ms=0,
        tslc_s=None,
    )
    velocity = (5.0, 0.0, 0.0)
    rounds = 4000 // uavs

    begin_ns = 1_000_000_000

    def fly() -> None:
        nonlocal begin_ns
        for n in range(rounds):
            t_ns = begin_ns + n * 100_000_000
            position = (5.0 * (t_ns * 1e-9), 0.0, 0.0)
            for uav in range(uavs):
                name = str(uav)
                tracker.accept(
                    Fix(
                        uav=name,
                        sender_ns=t_ns,
                        t_ns=t_ns,
                        arrival_ns=t_ns,
                        position_ned_m=position,
                        velocity_ned_mps=velocity,
                        noise=noise,
                        report=report,
                    )
                )
                later_ns = t_ns + 50_000_000
                tracker.track(
                    name,
                    t_ns,
                    SenderTime(node_ns=later_ns, sender_ns=later_ns, before_s=0.01, after_s=0.01),
                )
        begin_ns += rounds * 100_000_000

    (seconds,) = interleaved(fly)
    return statistics.median(seconds) / (rounds * uavs) * 1e6


def test_onboard_log_reading_against_reference_readers(figures: Figures) -> None:
    """All frames of a log, against its reference reader: all messages, and only the used ones."""
    from pymavlink.DFReader import DFReader_binary

    from companion.recording.foreign import ardupilot, px4

    used = [
        "POS",
        "ATT",
        "GPS",
        "GPA",
        "XKF1",
        "XKF4",
        "NKF1",
        "NKF4",
        "RATE",
        "SIM",
        "SIM2",
        "PARM",
    ]

    def ours(log: Path) -> None:
        assert sum(1 for _ in read_log(log)) > 1000

    def dataflash(log: Path, types: list[str] | None) -> None:
        reader = DFReader_binary(str(log))
        while reader.recv_match(type=types) is not None:
            pass
        reader.filehandle.close()

    for name in ("sitl_planes_circle_1.bin", "sitl_planes_circle_5.bin"):
        log = shared_log(name)
        ours_s, all_s, used_s = interleaved(
            partial(ours, log),
            partial(dataflash, log, None),
            partial(dataflash, log, used),
            rounds=3,
        )
        assert figures.ratio(f"{name} over DFReader", ours_s, all_s) < 1.2
        assert figures.ratio(f"{name} over DFReader, what is used", ours_s, used_s) < 1.2
    assert set(used) <= {*ardupilot._WANTED}

    pyulog = pytest.importorskip("pyulog")
    log = shared_log("px4_sample_small.ulg")
    ours_s, all_s, used_s = interleaved(
        partial(ours, log),
        lambda: pyulog.ULog(str(log)),
        lambda: pyulog.ULog(str(log), list(px4._WANTED)),
    )
    figures.ratio(f"{log.name} over pyulog, what is used", ours_s, used_s)
    assert figures.ratio(f"{log.name} over pyulog", ours_s, all_s) < 1.5
