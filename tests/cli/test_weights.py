"""``companion weights``: the same beams in every format, every form of time, and errors."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from device_reading import parse
from support import ROOT

from companion.beams.hardware.calibration import CALIBRATION_HEADER, Calibration, parse_calibration
from companion.beams.hardware.devices import Beamformer
from companion.cli.main import main
from companion.node import moment
from companion.node.replay import log_events
from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.recording.parts import Part
from companion.recording.writer import Writer
from companion.settings.model import Settings
from companion.values import ClockSet, Event, Update
from companion.views import quantised

AT_S = 3.0
CENTER = ("--center", "5:1")
HUGE = b"\x93NUMPY\x01\x00v\x00" + (
    b"{'descr': '<c16', 'fortran_order': False, 'shape': (64, 10000000000000), }".ljust(117) + b"\n"
)
"""A header that claims 10 petabytes."""
SMALL = '[array]\nkind = "ura"\nrows = 4\ncolumns = 4\n'


def weights(log: Path, *arguments: str, at: str = str(AT_S)) -> bytes:
    answer = CliRunner().invoke(main, ["weights", str(log), "--at", at, *CENTER, *arguments])
    assert answer.exit_code == 0, answer.stderr
    return answer.stdout_bytes


def mistake(log: Path, *arguments: str, at: str = "1") -> str:
    """Return the single stderr line; stdout must be empty."""
    command = ["weights", str(log), "--at", at, *CENTER, *arguments]
    answer = CliRunner().invoke(main, command)
    assert answer.exit_code not in (0, None)
    assert answer.stdout_bytes == b""
    assert "\n" not in answer.stderr.rstrip("\n")
    said: str = answer.stderr.removeprefix("companion: ").rstrip("\n")
    return said


@pytest.fixture(scope="module")
def looked() -> tuple[Pipeline, Update]:
    """Return the pipeline stepped by hand to the time, and its update with a lead of 100 ms."""
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    settings = Settings().override(center={"source": "5:1"})
    pipeline, at_ns = Pipeline(settings), None
    for event in log_events([log], settings):
        at_ns = at_ns or event.t_ns + round(AT_S * 1e9)
        if event.t_ns > at_ns:
            break
        pipeline.step(event)
    assert at_ns is not None
    return pipeline, pipeline.look(at_ns, 0.1)


def test_every_format_holds_the_pipeline_weights(
    cut_log: Path, looked: tuple[Pipeline, Update]
) -> None:
    _, update = looked
    expected = update.beams.weights
    assert expected.shape == (64, 4)
    lead = ("--lead-ms", "100")
    told = json.loads(weights(cut_log, *lead))
    assert np.array_equal(np.array(told["re"]) + 1j * np.array(told["im"]), expected)
    assert tuple(told["uavs"]) == update.beams.uavs
    assert [beam["uav"] for beam in told["beams"]] == told["uavs"]
    assert (told["lead_ms"], told["normalisation"]) == (100.0, "unit-response")
    single = np.load(io.BytesIO(weights(cut_log, *lead, "--format", "npy")))
    assert single.dtype == np.complex64
    assert np.array_equal(single, expected.astype(np.complex64))
    raw = np.frombuffer(weights(cut_log, *lead, "--format", "raw"), "<c8")
    assert np.array_equal(raw.reshape(64, 4), expected.astype(np.complex64))


def test_lead_gives_later_weights(cut_log: Path, looked: tuple[Pipeline, Update]) -> None:
    _, update = looked
    now = np.load(io.BytesIO(weights(cut_log, "--format", "npy")))
    assert now.shape == update.beams.weights.shape
    assert not np.allclose(now, update.beams.weights)


def test_device_table_round_trips(cut_log: Path, looked: tuple[Pipeline, Update]) -> None:
    pipeline, update = looked
    text = weights(cut_log, "--lead-ms", "100", "--format", "adar1000").decode()
    ideal = Calibration.ideal(range(64))
    read = parse(Beamformer.ADAR1000, text, ideal)
    equipment = assembly.equipment(pipeline.settings, pipeline.array)
    fitted = quantised.device_table(Beamformer.ADAR1000, update.beams, pipeline.array, equipment)
    assert read.uavs == update.beams.uavs
    assert np.array_equal(read.codes, fitted.codes)
    for i, wanted in enumerate(update.beams.weights.T):
        alike = abs(np.vdot(read.weights[:, i], wanted))
        alike /= np.linalg.norm(read.weights[:, i]) * np.linalg.norm(wanted)
        assert alike > 0.99


def test_calibration_changes_codes_but_not_radiation(cut_log: Path, tmp_path: Path) -> None:
    """The channel responses are compensated: equal radiation with different codes."""
    config = tmp_path / "settings.toml"
    table = tmp_path / "measured.csv"
    lines = [f"{c},{15 - c},{20 * c},{-0.1 * c}" for c in range(16)]
    table.write_text("\n".join([CALIBRATION_HEADER, *lines]) + "\n", encoding="utf-8")
    config.write_text(SMALL, encoding="utf-8")
    plain = weights(cut_log, "--config", str(config), "--format", "sivers").decode()
    config.write_text(f'{SMALL}[hardware]\ncalibration = "{table}"\n', encoding="utf-8")
    turned = weights(cut_log, "--config", str(config), "--format", "sivers").decode()
    measured = parse_calibration(table.read_text(encoding="utf-8"))
    one = parse(Beamformer.SIVERS, plain, Calibration.ideal(range(16)))
    other = parse(Beamformer.SIVERS, turned, measured)
    assert plain != turned
    for a, b in zip(one.weights.T, other.weights.T, strict=True):
        assert abs(np.vdot(a, b)) > 0.99 * np.linalg.norm(a) * np.linalg.norm(b)


def test_unit_gains_come_from_its_file(cut_log: Path, tmp_path: Path) -> None:
    config, unit = tmp_path / "settings.toml", tmp_path / "unit.toml"
    unit.write_text(
        'mode = "TX"\ncommon_db = [[-1, 9.5], [-1, 9.5], [-1, 9.5], [-1, 9.5]]\n'
        "element_db = [4.0, 4.0, 4.0, 4.0]\n"
    )
    config.write_text(f'{SMALL}field_of_view_deg = 90.0\n[hardware]\nunit = "{unit}"\n')
    text = weights(cut_log, "--config", str(config), "--format", "tmytek").decode()
    gains = [float(line.split(",")[8]) for line in text.splitlines()[1:]]
    assert max(gains) == 13.5
    assert min(gains) >= 9.5
    unit.write_text("mode = 'TX'\n")
    said = mistake(cut_log, "--config", str(config), "--format", "tmytek")
    assert said.startswith("hardware.unit: keys are mode; give common_db, element_db, mode")


def test_output_file_equals_stdout(cut_log: Path, tmp_path: Path) -> None:
    out = tmp_path / "w.npy"
    assert weights(cut_log, "--format", "npy", "--out", str(out)) == b""
    assert out.read_bytes() == weights(cut_log, "--format", "npy")


def test_time_of_day_equals_seconds_into_the_log(cut_log: Path) -> None:
    """The same instant, in any time zone."""
    begins = next(iter(log_events([cut_log], Settings()))).t_ns
    at = np.datetime64(begins // 1000, "us") + np.timedelta64(2_000_000, "us")
    told = json.loads(weights(cut_log, at=f"{at}Z"))
    assert told["valid_at"] == json.loads(weights(cut_log, at="2"))["valid_at"]
    shifted = json.loads(weights(cut_log, at=f"{at + np.timedelta64(2, 'h')}+02:00"))
    assert shifted["re"] == told["re"]


def test_utc_is_that_of_the_clock_as_last_set(tmp_path: Path, cut_log: Path) -> None:
    """The time in the answer is the time that was asked for."""
    hour_ns, settings = 3_600_000_000_000, Settings()
    events: list[Event] = list(log_events([cut_log], settings))
    begins_ns = events[0].t_ns
    events.insert(len(events) // 2, ClockSet(events[len(events) // 2].t_ns, hour_ns))
    writer = Writer(
        where=tmp_path / "a.mcap",
        settings_toml=settings.to_toml(),
        versions={},
        weights_hz=None,
        started_ns=begins_ns,
        part=Part.first(),
    )
    for event in events:
        writer.event(event)
    log = writer.close({})
    for at_s in (3, 20):  # before and after the clock was set
        at = np.datetime64((begins_ns + hour_ns) // 1_000_000, "ms") + np.timedelta64(at_s, "s")
        told = json.loads(weights(log, "--lead-ms", "0", at=f"{at}Z"))
        late = np.datetime64(told["valid_at"].rstrip("Z")) - at
        assert np.timedelta64(0) <= late <= np.timedelta64(10, "ms")  # the next hundredth
    before = np.datetime64(begins_ns // 1_000_000, "ms") + np.timedelta64(3, "s")
    start = np.datetime64((begins_ns + hour_ns) // 1_000_000, "ms")
    assert f"the log begins at {start}Z" in mistake(log, at=f"{before}Z")


def test_missing_parts_of_a_recording_are_named(tmp_path: Path, cut_log: Path) -> None:
    events: list[Event] = list(log_events([cut_log], Settings()))
    writer = Writer(
        where=tmp_path / "b.mcap",
        settings_toml=Settings().to_toml(),
        versions={},
        weights_hz=None,
        started_ns=events[0].t_ns,
        part=Part.first().after("a.mcap"),
    )
    for event in events:
        writer.event(event)
    log = writer.close({})
    command = ["weights", str(log), "--at", str(AT_S), *CENTER]
    answer = CliRunner().invoke(main, command)
    assert answer.exit_code == 0
    assert answer.stderr == f"{log}: part 1 of the run is missing\n"


@pytest.mark.parametrize(
    ("at", "said"),
    [
        ("-1", "--at -1: the log begins later"),
        ("1999-01-01T00:00:00Z", "Z: the log begins at 2026-11-20T11:55:42.520Z"),
        ("1e6", "--at 1e6: the log is 24.9 s long"),
        ("9999-01-01T00:00:00Z", "the log is 24.9 s long, from 2026-11-20T11:55:42.520Z"),
        ("nan", "neither seconds"),
        ("inf", "neither seconds"),
        ("noon", "neither seconds"),
        ("", "neither seconds"),
        ("2026-01-01T00:00:00", "time zone is missing"),
        ("0", "no beams at 0: no report yet"),
    ],
)
def test_time_outside_the_log_is_rejected(cut_log: Path, at: str, said: str) -> None:
    assert said in mistake(cut_log, at=at)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--lead-ms", "nan"], "'nan' is not a finite number"),
        (["--lead-ms", "10001"], "--lead-ms"),
        (["--format", "tmytek"], "tmytek drives 16 elements, the array has 64"),
        (["--format", "mat"], "'mat' is not one of"),
        (["--out", "/nowhere/w.npy"], "folder /nowhere does not exist"),
        (["--config", "missing.toml"], "missing.toml: No such file"),
        (["--center", "99:1"], "no position from the carrier 99:1"),
    ],
)
def test_unsupported_arguments_are_reported(cut_log: Path, arguments: list[str], said: str) -> None:
    assert said in mistake(cut_log, *arguments)


def test_missing_log_is_reported() -> None:
    assert mistake(Path("missing.tlog")) == "missing.tlog: no such file"


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("none.npy", None, "No such file"),
        ("empty.npy", b"", "not a .npy file"),
        ("text.npy", b"1 2 3\n4 5 6\n", "not a .npy file"),
        ("zip.npy", b"PK\x03\x04" + bytes(200), "not a .npy file"),
        ("huge.npy", HUGE, "array is too large for the memory"),
        ("torn.npy", HUGE.replace(b"}", b"("), "not a .npy file"),
        ("words.npy", np.array([["a", "b"]]), "unsupported dtype"),
        ("fields.npy", np.zeros((64, 1), dtype=[("a", "f8")]), "unsupported dtype"),
        ("line.npy", np.ones(64), "not a matrix"),
        ("small.npy", np.ones((5, 3)), "do not match 64 elements"),
        ("zero.npy", np.zeros((64, 2)), "column 0 of the weights is zero"),
        ("nan.npy", np.full((64, 2), np.nan), "finite"),
    ],
)
def test_invalid_codebook_is_reported_once(
    cut_log: Path, tmp_path: Path, name: str, content: Any, said: str
) -> None:
    """Reported once, before the log is read."""
    file = tmp_path / name
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content is not None:
        np.save(file, content)
    config = tmp_path / "settings.toml"
    config.write_text(f'[codebook]\nkind = "file"\nfile = "{file}"\n', encoding="utf-8")
    message = mistake(cut_log, "--config", str(config), at="1e6")
    assert said in message
    assert message.replace(str(tmp_path), "").count("codebook") == 1


def test_integer_codebook_is_accepted(cut_log: Path, tmp_path: Path) -> None:
    file, config = tmp_path / "beams.npy", tmp_path / "settings.toml"
    np.save(file, np.eye(64, dtype=np.int8)[:, :5])
    config.write_text(f'[codebook]\nkind = "file"\nfile = "{file}"\n', encoding="utf-8")
    told = json.loads(weights(cut_log, "--config", str(config)))
    assert told["codebook_beams"] == 5
    assert {beam["codebook"]["best"] for beam in told["beams"]} <= set(range(5))


def test_progress_reporting_does_not_change_the_result(
    cut_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(moment, "PROGRESS_EVERY", 200)
    told: list[float] = []
    settings = Settings().override(center={"source": "5:1"})
    _, update = moment.look([cut_log], settings, "3", progress=told.append)
    _, plain = moment.look([cut_log], settings, "3")
    assert np.array_equal(update.beams.weights, plain.beams.weights)
    assert told == sorted(told)
    assert 0 < told[0] < told[-1] <= 3.0
