"""The live service as users run it: real processes, real UDP, real HTTP."""

import io
import json
import math
import os
import signal
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
import siege
from device_reading import parse
from support import BIN, HANG_S, read_metadata, started

from companion.beams.hardware.calibration import Calibration
from companion.beams.hardware.devices import Beamformer
from companion.mavlink.wire.decode import decode
from companion.recording.reader import read_log, read_settings
from companion.values import Frame, Report, WeightFormat

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")


PAPER_BOUNDS = """[observer]
lag_s = [0.0, 0.0]
speed_max_mps = 151.0
acceleration_max_mps2 = 190.0
position_noise_m = 1.0
velocity_noise_mps = 0.1
"""
STAMPS_OFF_DEG = 0.5
"""Error of the flown log's own (sending) stamps at 29 degrees/s."""


def fly(port: int, record: Path, seconds: float = 5.0) -> Any:
    """Send the paper's four UAVs and the carrier as real traffic."""
    to = f"udpout:127.0.0.1:{port}"
    command = [BIN / "sitl-replay", "fly", "paper", "--to", to, "--duration", str(seconds)]
    return started([*command, "--record", str(record)], stdout=subprocess.PIPE, text=True)


def true_bearings_deg(tlog: Path) -> dict[str, Any]:
    """Return, per UAV, a function from Unix seconds to the true bearing from the carrier; NaN
    outside the flight."""
    seen: dict[str, list[tuple[float, float, float, float]]] = {}
    for event in read_log(tlog):
        message = decode(event) if isinstance(event, Frame) else None
        if isinstance(message, Report) and message.alt_m is not None:
            entry = (event.t_ns * 1e-9, message.lat_deg, message.lon_deg, message.alt_m)
            seen.setdefault(message.uav, []).append(entry)
    _, *home = seen.pop("5:1")[0]
    bearings = {}
    for uav, entries in seen.items():
        t, lat, lon, alt = np.array(entries).T
        north, east, _ = pymap3d.geodetic2ned(lat, lon, alt, *home)
        angle = np.unwrap(np.arctan2(east, north))
        bearings[uav] = lambda at, t=t, angle=angle: math.degrees(
            np.interp(at, t, angle, left=math.nan, right=math.nan)
        )
    return bearings


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, marks=pytest.mark.full), signal.SIGTERM]
)
def test_follows_flying_vehicles_and_stops_cleanly(
    start_node: Any, tmp_path: Path, number: signal.Signals
) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text(PAPER_BOUNDS)
    record = ("--config", str(settings), "--record", str(tmp_path / "recordings"))
    node = start_node(*RUN, *record)
    with fly(node.udp_port, tmp_path / "flown.tlog") as flight:
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        assert json.loads(node.get("/readyz")[1])["ready"]
        asked = []
        while flight.poll() is None:
            asked.append(node.json("/v1/beams"))
        uavs = node.json("/v1/uavs")["uavs"]
        returncode, out, err = node.stop(number)
        assert flight.communicate(timeout=HANG_S)[0].startswith("sent")

    assert returncode == 0, err
    assert "Traceback" not in err
    assert {uav["id"] for uav in uavs} == {"1:1", "2:1", "3:1", "4:1"}
    bearing_at = true_bearings_deg(tmp_path / "flown.tlog")
    errors_deg: list[float] = []
    bounded = 0
    travelled: dict[str, list[float]] = {uav: [] for uav in bearing_at}
    for answer in asked:
        assert answer["age_s"] < 0.2
        at = datetime.fromisoformat(answer["valid_at"]).timestamp()
        for beam in answer["beams"]:
            true_deg = bearing_at[beam["uav"]](at)
            if math.isnan(true_deg):  # after the end of the flight
                continue
            off_deg = abs((beam["bearing_deg"] - true_deg + 180) % 360 - 180)
            bound_deg = beam[
                "pointing_bound_deg"
            ]  # null means any direction, before the clock settles
            assert off_deg <= (180 if bound_deg is None else bound_deg) + STAMPS_OFF_DEG, beam
            bounded += bound_deg is not None and bound_deg < 10
            errors_deg.append(off_deg)
            travelled[beam["uav"]].append(true_deg)
    assert len(errors_deg) > 4  # a very busy machine answers only once or twice
    assert bounded > len(errors_deg) / 20  # not in the first seconds or while the machine lags
    assert np.median(errors_deg) < 0.5
    assert all(max(angles) - min(angles) > 30 for angles in travelled.values())

    (recording,) = (tmp_path / "recordings").iterdir()
    assert recording.suffix == ".mcap"
    replayed = subprocess.run(
        [BIN / "companion", "replay", recording, "--no-record", "--json"],
        capture_output=True,
        check=True,
        timeout=HANG_S,
    )
    assert json.loads(replayed.stdout)["digest"] == read_metadata(recording)["summary"]["digest"]
    assert recording.name in out


@pytest.mark.full
def test_weights_point_along_their_beams(start_node: Any, tmp_path: Path) -> None:
    node = start_node(*RUN)
    with fly(node.udp_port, tmp_path / "flown.tlog", seconds=4) as flight:
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        status, body = node.get("/v1/beams/weights?lead_ms=100", "application/x-npy")
        weights = np.load(io.BytesIO(body))
        liked = node.get("/v1/beams/weights", "application/json;q=0.5, application/x-npy;q=0.9")[1]
        as_json = node.json("/v1/beams/weights")
        raw = np.frombuffer(node.get("/v1/beams/weights", "application/octet-stream")[1], "<c8")
        flight.wait(HANG_S)
    assert status == 200
    assert weights.shape == (64, 4)
    assert weights.dtype == np.complex64
    assert np.array(as_json["re"]).shape == (64, 4) == np.array(as_json["im"]).shape
    assert sorted(as_json["uavs"]) == ["1:1", "2:1", "3:1", "4:1"]
    assert raw.size == 64 * 4
    assert np.load(io.BytesIO(liked)).shape == (64, 4)
    assert np.all(np.isfinite(weights))


@pytest.mark.full
def test_beams_report_gain_guarantee_sinr_and_codebook(start_node: Any, tmp_path: Path) -> None:
    """Gain, guaranteed gain, SINR, and the codebook beams to sweep."""
    config = tmp_path / "settings.toml"
    config.write_text(PAPER_BOUNDS + '[codebook]\nkind = "dft"\n', encoding="utf-8")
    node = start_node(*RUN, "--config", str(config))
    with fly(node.udp_port, tmp_path / "flown.tlog", seconds=8) as flight:
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        node.wait_until(
            "/v1/beams",
            lambda answer: all(b["guaranteed_gain_db"] is not None for b in answer["beams"]),
        )  # the clocks have settled
        answers = [node.json(f"/v1/beams?lead_ms={lead}") for lead in (0, 50, 500)]
        pattern = node.json("/v1/pattern?cut=azimuth&points=721")
        one = node.json("/v1/pattern?cut=elevation&points=19&uav=2:1")
        unknown = node.get("/v1/pattern?uav=9:9")[0]
        flight.terminate()
    for answer in answers:
        assert answer["normalisation"] == "unit-response"
        assert (answer["policy"], answer["groups"]) == ("regularise", 1)
        assert answer["codebook_beams"] == 64
        for beam in answer["beams"]:
            guaranteed_db = beam["guaranteed_gain_db"]
            assert guaranteed_db is None or guaranteed_db <= beam["gain_db"] + 1e-6
            assert beam["cost_db"] == beam["loss_db"] >= -1e-9
            assert -40 < beam["sinr_db"] < 80
            stored = beam["codebook"]
            assert stored["best"] == stored["ssb_candidates"][0]
            assert sorted(stored["ssb_candidates"]) == stored["candidates"]
            assert stored["sweep_share"] == len(stored["candidates"]) / 64
            assert stored["next"] is None or stored["next_in_s"] > 0
    assert pattern["angles_deg"][0] == -180
    assert {entry["uav"] for entry in pattern["patterns"]} == {"1:1", "2:1", "3:1", "4:1"}
    for entry in pattern["patterns"]:
        assert len(entry["response_db"]) == 721
        at = np.interp(entry["target_deg"], pattern["angles_deg"], entry["response_db"])
        # The lobe that contains the target; a widened one beside a null may peak elsewhere.
        assert entry["peak_db"] - 15 < at <= entry["peak_db"] + 0.5
        assert len(entry["null_depths_db"]) == 3
        if pattern["method"] == "zf":
            assert all(depth < -100 for depth in entry["null_depths_db"].values())
    assert [entry["uav"] for entry in one["patterns"]] == ["2:1"]
    assert len(one["angles_deg"]) == 19
    assert unknown == 404


@pytest.mark.full
def test_device_weights_or_the_reason_are_returned(start_node: Any, tmp_path: Path) -> None:
    node = start_node(*RUN)
    with fly(node.udp_port, tmp_path / "flown.tlog", seconds=4) as flight:
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        status, table = node.get("/v1/beams/weights", WeightFormat.ADAR1000.media_type)
        refused, why = node.get("/v1/beams/weights", WeightFormat.TMYTEK.media_type)
        flight.wait(HANG_S)
    assert status == 200
    read = parse(Beamformer.ADAR1000, table.decode(), Calibration.ideal(range(64)))
    assert sorted(read.uavs) == ["1:1", "2:1", "3:1", "4:1"]
    assert read.weights.shape == (64, 4)
    assert refused == 409
    assert json.loads(why)["title"] == "tmytek drives 16 elements, the array has 64"


@pytest.mark.full
def test_missing_carrier_is_reported(start_node: Any) -> None:
    node = start_node(*RUN)
    node.wait_until("/readyz", lambda answer: answer["reasons"] == ["no report yet"])
    assert node.get("/readyz")[0] == 503
    assert node.get("/healthz")[0] == 200
    assert node.json("/v1/beams")["beams"] == []
    assert node.json("/v1/beams")["condition_number"] is None
    assert node.json("/v1/status")["recording"]["state"] == "off"


@pytest.mark.full
@pytest.mark.parametrize(
    ("path", "accept", "expected"),
    [
        ("/v1/uavs/9:9", "application/json", 404),
        ("/v1/nothing", "application/json", 404),
        ("/v1/beams?lead_ms=x", "application/json", 422),
        ("/v1/beams?lead_ms=-1", "application/json", 422),
        ("/v1/beams?lead_ms=nan", "application/json", 422),
        ("/v1/beams/weights", "image/png", 406),
        ("/v1/beams/weights", "application/x-npy;q=0", 406),
        ("/v1/beams/weights", "application/vnd.adi.adar1000+csv", 409),
        ("/v1/pattern?cut=sideways", "application/json", 422),
        ("/v1/pattern?points=1", "application/json", 422),
        ("/v1/pattern?uav=1:1", "application/json", 404),
    ],
)
def test_errors_are_problem_json(start_node: Any, path: str, accept: str, expected: int) -> None:
    node = start_node(*RUN)
    status, body = node.get(path, accept)
    assert status == expected
    assert json.loads(body)["status"] == expected
    assert json.loads(body)["title"]


@pytest.mark.full
def test_the_page_is_served(start_node: Any) -> None:
    node = start_node(*RUN)
    status, body = node.get("/", "text/html")
    assert status == 200
    assert b"<canvas" in body
    assert node.json("/openapi.json")["info"]["title"] == "companion"


@pytest.mark.full
def test_token_is_required(start_node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMPANION_TOKEN", "s3cret")
    node = start_node(*RUN)
    asked = ("/v1/status", "/readyz", "/metrics", "/v1/../v1/uavs")
    assert [node.get(path)[0] for path in asked] == [401] * len(asked)
    open_to_all = (
        "/healthz",
        "/",
        "/index.html",
        "/token.js",
        "/vendor/uPlot.min.css",
        "/docs",
        "/openapi.json",
    )
    assert [node.get(path, "*/*")[0] for path in open_to_all] == [200] * len(open_to_all)


def test_demo_runs_without_loading_unused_modules(tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "from companion.cli.main import main\n"
        "main(['demo', '--seconds', '2', '--port', '0'], standalone_mode=False)\n"
        "unused = {'cvxpy', 'clarabel', 'pymavlink.mavutil', 'scipy', 'numpy.random'}\n"
        "assert not unused & set(sys.modules), unused & set(sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (recording,) = (tmp_path / "recordings").glob("*.mcap")
    assert any(isinstance(event, Frame) for event in read_log(recording))


def test_restart_replaces_no_recording_of_the_same_name(tmp_path: Path, start_node: Any) -> None:
    """Neither the leftover of a killed service, which is recovered, nor a finished one."""
    wanted = tmp_path / "flight.mcap"
    run = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
    node = start_node(*run, "--record", str(wanted))
    with siege.flight(node.udp_port):
        node.wait_until("/v1/status", lambda said: said["recording"]["bytes"] > 20_000)
    node.process.kill()
    node.process.wait(HANG_S)
    left = (tmp_path / "flight.mcap.active").stat().st_size
    for _ in range(2):
        again = start_node(*run, "--record", str(wanted))
        again.wait_until("/v1/status", lambda _: wanted.exists())
        assert again.stop()[0] == 0
    assert wanted.stat().st_size > left / 2
    assert len(list(tmp_path.glob("companion-*.mcap"))) == 2


def test_folder_whose_name_is_not_utf_8_is_recorded_to(tmp_path: Path, start_node: Any) -> None:
    folder = tmp_path / os.fsdecode(b"fl\xfcge")
    node = start_node(*RUN, "--record", str(folder))
    assert node.stop()[0] == 0
    (recording,) = folder.iterdir()
    assert "[recording]" in read_settings(recording).text
