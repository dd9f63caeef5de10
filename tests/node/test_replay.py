"""``companion replay``: third-party logs through the whole program."""

import json
import struct
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from pymavlink import mavutil  # the oracle: only tests may import it
from support import BIN, HANG_S, shared_log

from companion.beams.array.steering import steering_matrix
from companion.cli.main import main
from companion.mavlink.wire.framing import claimed_length
from companion.node import replay as replay_module
from companion.pipeline.fold import Pipeline
from companion.pipeline.ticks import with_ticks
from companion.recording.reader import read_log
from companion.settings.model import Settings
from companion.values import Tick, Update


def replay(*arguments: str | Path, check: bool = True) -> "subprocess.CompletedProcess[str]":
    """Run the command."""
    command = [BIN / "companion", "replay", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=check, timeout=HANG_S)


def counted(log: Path) -> tuple[int, Counter[str], Counter[str]]:
    """Return pymavlink's frame count, and per source the GLOBAL_POSITION_INT with and without
    position."""
    reader = mavutil.mavlogfile(str(log))
    frames, placed, zero = 0, Counter[str](), Counter[str]()
    while (message := reader.recv_match()) is not None:
        frames += message.get_type() != "BAD_DATA"
        if message.get_type() == "GLOBAL_POSITION_INT":
            source = f"{message.get_srcSystem()}:{message.get_srcComponent()}"
            (zero if message.lat == 0 and message.lon == 0 else placed)[source] += 1
    reader.close()
    return frames, placed, zero


@pytest.mark.full
def test_frame_counts_match_pymavlink(tmp_path: Path) -> None:
    log = shared_log("sitl_4circle.tlog")
    first = tmp_path / "first.mcap"
    summary = json.loads(replay(log, "--center", "5:1", "--out", first, "--json").stdout)
    frames, placed, zero = counted(log)
    assert summary["frames"] == frames == 116_764
    assert placed.pop("5:1") > 0
    telemetry = {uav: n for uav, n in summary["reports"].items() if not uav.startswith("icao:")}
    waited = {uav: placed[uav] - n for uav, n in telemetry.items()}  # waiting for a receiver status
    assert all(0 <= n <= 5 for n in waited.values())
    assert sum(waited.values()) <= summary["rejected"].get("no-fix", 0)
    assert set(telemetry) == {"1:1", "2:1", "3:1", "4:1"}
    assert set(summary["uavs"]) == set(summary["reports"])
    assert summary["rejected"]["zero-position"] == zero.total() == 255
    assert summary["recording"] == str(first)

    again = json.loads(replay(log, "--center", "5:1", "--no-record", "--json").stdout)
    of_recording = json.loads(replay(first, "--out", tmp_path / "second.mcap", "--json").stdout)
    assert again["digest"] == summary["digest"] == of_recording["digest"]
    assert of_recording["rejected"] == summary["rejected"]


def test_a_short_flight_replays_to_the_same_digest(short_log: Path, tmp_path: Path) -> None:
    recording = tmp_path / "cut.mcap"
    first = json.loads(replay(short_log, "--center", "5:1", "--out", recording, "--json").stdout)
    # Another process and this one give the same.
    done = CliRunner().invoke(main, ["replay", str(recording), "--no-record", "--json"])
    second = json.loads(done.stdout)
    assert second["digest"] == first["digest"]
    assert second["recording"] is None
    keys = {"reports", "dt_median_s", "dt_max_s", "latency_p50_s", "latency_p95_s"}
    keys |= {"innovation_rms_m", "gamma", "state", "restarts", "reacquired", "refuted", "rejected"}
    assert first["uavs"].keys() >= {"1:1", "2:1", "3:1", "4:1"}
    assert all(set(entry) == keys for entry in first["uavs"].values())
    assert first["uavs"]["1:1"]["state"] == "live"
    assert first["uavs"]["1:1"]["dt_median_s"] == pytest.approx(0.1, abs=0.01)
    assert first["uavs"]["1:1"]["restarts"] == first["uavs"]["1:1"]["reacquired"] == 0
    other = CliRunner().invoke(
        main, ["replay", str(short_log), "--center", "home", "--no-record", "--json"]
    )
    assert json.loads(other.stdout)["digest"] != first["digest"]


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "uavs"),
    [
        ("real_bluerobotics_server.tlog", 0),
        ("real_eagle_c2_gui.tlog", 1),
        ("real_dronekit_flight2015.tlog", 1),
        ("real_devmangrani_flight54.tlog", 1),
        ("adsb_pymodes_real.tlog", 1),
        ("sitl_4circle_wander.tlog", None),
    ],
)
def test_every_log_replays_without_a_traceback(name: str, uavs: int | None) -> None:
    done = replay(shared_log(name), "--no-record", "--json", check=False)
    summary = json.loads(done.stdout)
    assert "Traceback" not in done.stderr
    unaimed = {
        "real_bluerobotics_server.tlog": "no UAV reported a usable position",
        "adsb_pymodes_real.tlog": "only relayed aircraft were received",
    }
    assert done.returncode == (name in unaimed)
    assert (summary["unaimed"] or "").startswith(unaimed.get(name, ""))
    if uavs is not None:
        assert len(summary["uavs"]) == uavs
    if name == "real_bluerobotics_server.tlog":
        assert summary["rejected"] == {"zero-position": 724}


def test_zero_forcing_holds_at_every_update(cut_log: Path) -> None:
    """With narrow beams; widened ones give up nulls that would cost too much guaranteed gain."""
    settings = Settings().override(center={"source": "5:1"}, beams={"widen": "no"})
    pipeline, checked = Pipeline(settings), 0
    for event in with_ticks(read_log(cut_log), settings.beams.update_hz):
        for output in pipeline.step(event):
            if isinstance(output, Update) and output.beams.beams and not output.beams.regularised:
                azimuth = np.array([beam.azimuth_rad for beam in output.beams.beams])
                elevation = np.array([beam.elevation_rad for beam in output.beams.beams])
                level = np.cos(elevation)
                towards = [level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(elevation)]
                matrix = steering_matrix(pipeline.array, np.array(towards).T)
                error = matrix.T @ output.beams.weights - np.eye(len(azimuth))
                assert np.abs(error).max() < 1e-9
                checked += 1
    assert checked > 200


@pytest.mark.full
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda path: None, id="missing"),
        pytest.param(lambda path: path.mkdir(), id="directory"),
        pytest.param(lambda path: path.write_bytes(b""), id="empty"),
        pytest.param(lambda path: path.write_bytes(bytes(range(256)) * 40), id="no frame in it"),
    ],
)
@pytest.mark.parametrize("command", ["replay", "recover"])
def test_invalid_log_is_reported_in_one_line(make: Any, command: str, tmp_path: Path) -> None:
    path = tmp_path / "x"
    make(path)
    done = subprocess.run(
        [BIN / "companion", command, path],
        capture_output=True,
        text=True,
        check=False,
        timeout=HANG_S,
    )
    assert done.returncode != 0
    errors = [line for line in done.stderr.splitlines() if line.startswith("companion: ")]
    assert len(errors) == 1
    assert str(path) in errors[0]
    assert "Traceback" not in done.stderr


def test_log_that_begins_at_zero_has_a_duration(cut_log: Path, tmp_path: Path) -> None:
    """Stamps of a tlog may count from its start."""
    data = bytearray(cut_log.read_bytes())
    at, (first_us,) = 0, struct.unpack_from(">Q", data)
    while at < len(data):
        (stamp_us,) = struct.unpack_from(">Q", data, at)
        struct.pack_into(">Q", data, at, stamp_us - first_us)
        at += 8 + claimed_length(data, at + 8, len(data))
    (tmp_path / "a.tlog").write_bytes(data)
    found = []
    for log in (cut_log, tmp_path / "a.tlog"):
        done = CliRunner().invoke(
            main, ["replay", str(log), "--center", "5:1", "--no-record", "--json"]
        )
        found.append(json.loads(done.stdout)["duration_s"])
    assert found[0] == pytest.approx(found[1])
    assert found[1] > 1


def test_pause_of_a_century_is_slept_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording may state any time: the system refused to sleep that long, with a traceback."""
    passed_s, slept = [0.0], list[float]()

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        passed_s[0] += 1e6 * seconds

    monkeypatch.setattr(replay_module.time, "monotonic", lambda: passed_s[0])
    monkeypatch.setattr(replay_module.time, "sleep", sleep)
    events = [Tick(0), Tick(1 << 62)]
    assert list(replay_module._paced(events, 0.1)) == events
    assert len(slept) > 1 and max(slept) <= replay_module.SLEEP_S
