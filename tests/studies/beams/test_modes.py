"""Beam widths and predictors over links: against a second pipeline, and by required properties."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from support import ROOT

from companion.beams.worth import guarantee
from companion.cli.main import main
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.studies.beams import modes
from companion.studies.prediction.radio_link import CLEAN, RADIO
from companion.values import Tick

CUT = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
SETTINGS = Settings().override(center={"source": "5:1"})


WORDS = ["study", "beams", "--center", "5:1", "--hz", "1", "--links"]


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first half of the log; the last frame may be truncated."""
    log = tmp_path_factory.mktemp("log") / "begun.tlog"
    whole = CUT.read_bytes()
    log.write_bytes(whole[: len(whole) // 2])
    return log


@pytest.fixture(scope="module")
def report(begun: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The comparison written by the command."""
    out = tmp_path_factory.mktemp("modes")
    done = CliRunner().invoke(main, [*WORDS, "clean", "--out", str(out), str(begun)])
    assert done.exit_code == 0, done.output
    assert "kalman-peng, sharp" in done.output
    return out


@pytest.fixture(scope="module")
def rows(report: Path) -> dict[str, modes.Row]:
    told = json.loads((report / "beams.json").read_text(encoding="utf-8"))
    return {row["beams"]: row for row in told["modes"]}


def test_each_width_improves_its_target_gain(rows: dict[str, modes.Row]) -> None:
    likely, sure, sharp = (rows[name] for name in ("likely", "guarantee", "no"))
    assert sure["guaranteed_gain_median_db"] > likely["guaranteed_gain_median_db"] > 0
    assert likely["true_gain_median_db"] > sure["true_gain_median_db"] + 2
    assert sharp["predicted_gain_median_db"] > likely["predicted_gain_median_db"]
    assert sure["guaranteed_above_0_db_share"] > 0.75 > sharp["guaranteed_above_0_db_share"]
    assert [row["violations"] for row in rows.values()] == [0] * 6
    for row in (likely, sure):
        assert row["changed_shape_share"] < 0.1
        assert row["jump_share"] < 0.1
    assert rows["hold, sharp"]["true_gain_median_db"] < sharp["true_gain_median_db"] - 3
    assert set(rows) == {
        "likely",
        "guarantee",
        "no",
        *(f"{name}, sharp" for name in modes.OTHER_PREDICTORS),
    }


def test_likely_row_uses_the_beams_of_the_pipeline(begun: Path, rows: dict[str, modes.Row]) -> None:
    pipeline = Pipeline(SETTINGS)
    heard, _, _ = modes.events([begun], CLEAN, SETTINGS)
    ticks, gains_db, sure_db = 0, [], []
    for event in heard:
        pipeline.step(event)
        update = pipeline.last_update
        if not isinstance(event, Tick) or update is None or update.carrier is None:
            continue
        if not update.tracks:
            continue
        ticks += 1
        if ticks % modes.LOOK_EVERY == 0:
            gains_db += [beam.gain_db for beam in update.beams.beams]
            towards = modes.directions(update.beams)
            bounds = [beam.pointing_bound_rad for beam in update.beams.beams]
            weights = update.beams.weights
            sure_db += guarantee.guaranteed_gains_db(pipeline.array, towards, bounds, weights)
    row = rows["likely"]
    assert row["n"] == len(gains_db)
    assert row["predicted_gain_median_db"] == np.percentile(gains_db, 50, method="inverted_cdf")
    above = np.mean([one is not None and one > 0 for one in sure_db])
    assert row["guaranteed_above_0_db_share"] == pytest.approx(above)


def test_radio_link_leaves_carrier_frames_unchanged() -> None:
    heard, observed, _ = modes.events([CUT], RADIO, SETTINGS)
    events = list(heard)
    times = [event.t_ns for event in events]
    assert times == sorted(times)
    clean, logged, _ = modes.events([CUT], CLEAN, SETTINGS)
    sources = [str(e.source) for e in events if not isinstance(e, Tick)]
    before = [str(e.source) for e in clean if not isinstance(e, Tick)]
    assert sources.count("5:1") == before.count("5:1")
    assert sources.count("1:1") < 0.5 * before.count("1:1")
    assert len(observed["1:1"]) < 0.5 * len(logged["1:1"])


def test_command_compares_over_the_given_links(
    report: Path, rows: dict[str, modes.Row], tmp_path: Path
) -> None:
    assert list(rows)[:3] == ["likely", "guarantee", "no"]
    assert "Three widths" in (report / "beams.html").read_text(encoding="utf-8")
    wrong = CliRunner().invoke(main, [*WORDS, "best", "--out", str(tmp_path), str(CUT)])
    assert wrong.exit_code != 0
    assert "give some of clean, radio, hostile, noisy" in str(wrong.output) + str(wrong.exception)


def test_onboard_logs_form_one_flight(tmp_path: Path) -> None:
    """The carrier is one file, the UAV another, and both have the simulator's truth."""
    folder = ROOT / "tests" / "data"
    logs = [str(folder / f"sitl_planes_cut_{number}.bin") for number in (1, 5)]
    words = ["study", "beams", *logs, "--center", logs[1], "--hz", "1", "--out", str(tmp_path)]
    done = CliRunner().invoke(main, [*words, "--links", "clean", "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["command"].split()[3:5] == logs
    (log,) = told["logs"]
    assert log["log"] == "sitl_planes_cut_1.bin + sitl_planes_cut_5.bin"
    assert (log["center"], log["truth"]) == ("5:1", "SIM_STATE")
    assert [row["uav"] for row in told["rows"]] == ["1:1"]
    assert {row["log"] for row in told["modes"]} == {log["log"]}
    assert all(row["truth"] == "SIM_STATE" for row in told["modes"])
