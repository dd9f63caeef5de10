"""``companion calibrate mount``: the mount that a recorded flight with observations suggests."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from companion.cli.main import main
from companion.recording.writer import Writer
from companion.tracking.carrier import body_from_ned
from tests.observed_flight import ObservedFlight

MOUNT_DEG = {"roll": 0.4, "pitch": -1.0, "yaw": 1.5}


def recorded(where: Path, seconds: float = 4.0) -> Path:
    """Record a flight whose array is mounted with an error."""
    flight = ObservedFlight(range_m=2000.0)
    flight.mount = body_from_ned(*np.radians(list(MOUNT_DEG.values())))
    path = where / "recording.mcap"
    with Writer(
        where=path,
        settings_toml=flight.pipeline.settings.to_toml(),
        versions={},
        weights_hz=1.0,
        started_ns=flight.t_ns,
    ) as writer:
        for event in flight.events(seconds):
            writer.event(event)
        return writer.close({})


def test_mount_of_a_flight_is_suggested(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["calibrate", "mount", str(recorded(tmp_path)), "--json"])
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["mount_deg"] == pytest.approx(MOUNT_DEG, abs=0.2)
    assert found["separate"] is False and found["compass_deg"] is None


def test_suggestion_can_be_copied_into_the_settings(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["calibrate", "mount", str(recorded(tmp_path))])
    assert done.exit_code == 0, done.stderr
    lines = done.stdout.splitlines()
    keys = [line.partition(" = ")[0] for line in lines[lines.index("[array]") + 1 :]]
    assert keys == ["mount_roll_deg", "mount_pitch_deg", "mount_yaw_deg"]


def test_flight_without_observations_is_an_error(tmp_path: Path) -> None:
    log = Path("tests/data/sitl_4circle_cut.tlog")
    done = CliRunner().invoke(main, ["calibrate", "mount", str(log), "--center", "5:1"])
    assert done.exit_code == 1
    assert "no observations of UAVs" in done.stderr
