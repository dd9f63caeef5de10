"""``companion export``: tables as other programs read them, against the pipeline's numbers."""

import errno
import json
import os
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy
import pytest
from click.testing import CliRunner, Result
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.reader import make_reader
from pymavlink import mavutil  # the oracle: only tests may import it
from pymavlink.dialects.v20 import all as dialect
from support import ROOT

from companion.cli.main import main
from companion.node import replay as replaying
from companion.node.replay import log_events
from companion.pipeline.fold import Pipeline
from companion.recording.tables import folder, parquet_file
from companion.recording.tables.columns import ColumnKind, Table
from companion.recording.writer import open_alone
from companion.settings.model import Settings
from companion.values import Estimate, Notice, Output, Refuted, Rejection, Update
from companion.views.tables.said import TABLES

pandas = pytest.importorskip("pandas")
duckdb = pytest.importorskip("duckdb")
parquet = pytest.importorskip("pyarrow.parquet")

LOG = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
CENTER = ("--center", "5:1")
BY_NAME = {table.name: table for table in TABLES}
DUCKDB = {
    ColumnKind.TEXT: "VARCHAR",
    ColumnKind.NUMBER: "DOUBLE",
    ColumnKind.TIME: "TIMESTAMP",
    ColumnKind.INTEGER: "BIGINT",
    ColumnKind.TRUTH: "BOOLEAN",
}
ARROW = {
    ColumnKind.TEXT: "string",
    ColumnKind.NUMBER: "double",
    ColumnKind.TIME: "timestamp[us]",
    ColumnKind.INTEGER: "int64",
    ColumnKind.TRUTH: "bool",
}


def export(*arguments: Any) -> Result:
    return CliRunner().invoke(main, ["export", *map(str, arguments)])


def exported(where: Path, log: Path, *arguments: str) -> Path:
    done = export(log, "--out", where, *arguments)
    assert done.exit_code == 0, done.stderr
    return where


@pytest.fixture(scope="module")
def as_csv(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("csv"), LOG, *CENTER)


@pytest.fixture(scope="module")
def as_parquet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("parquet")
    return exported(where, LOG, *CENTER, "--format", "parquet")


@pytest.fixture(scope="module")
def outputs() -> list[Output]:
    """Return every output of the pipeline for the log, stepped by hand."""
    settings = Settings().override(center={"source": "5:1"})
    pipeline = Pipeline(settings)
    return [out for event in log_events([LOG], settings) for out in pipeline.step(event)]


def duck(file: Path) -> list[tuple[Any, ...]]:
    """Return all rows of a file with the types that DuckDB infers."""
    found: list[tuple[Any, ...]] = duckdb.sql(f"select * from '{file}'").fetchall()
    return found


def arrow(file: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = parquet.read_table(file).to_pylist()
    return found


# --- schema -------------------------------------------------------------------------------------


def test_export_document_matches_the_tables() -> None:
    text = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    told = {}
    for section in text.split("\n## ")[1:]:
        name, _, rest = section.partition("\n")
        rows = re.findall(r"^\| `(\w+)` \| (\w+) \| (.*?) \| (.+) \|$", rest, re.MULTILINE)
        if rows:
            told[name] = [f"A row is {BY_NAME[name].row_is}." in rest, rows]
    columns = {
        table.name: [True, [(c.name, str(c.kind), c.unit, c.meaning) for c in table.columns]]
        for table in TABLES
    }
    assert told == columns


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_column_names_end_in_their_units(table: Table) -> None:
    endings = {
        "ns": "_ns", "UTC": "_utc", "s": "_s", "m": "_m", "deg": "_deg", "m/s": "_mps",
        "m/s²": "_mps2", "deg/s": "_degps", "dB": "_db",
    }  # fmt: skip
    names = [column.name for column in table.columns]
    assert len(set(names)) == len(names)
    for column in table.columns:
        assert column.name.endswith(endings[column.unit] if column.unit else column.name)
        if not column.unit:
            assert not column.name.endswith(tuple(endings.values())), column.name


# --- other readers ------------------------------------------------------------------------------


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_pandas_infers_the_column_types(table: Table, as_csv: Path) -> None:
    times = [column.name for column in table.columns if column.kind is ColumnKind.TIME]
    frame = pandas.read_csv(as_csv / f"{table.name}.csv", parse_dates=times)
    assert list(frame.columns) == [column.name for column in table.columns]
    assert len(frame) > 0
    for column in table.columns:
        found = frame[column.name]
        if found.isna().all():
            continue
        kind = {
            "i": ColumnKind.INTEGER,
            "f": ColumnKind.NUMBER,
            "b": ColumnKind.TRUTH,
            "M": ColumnKind.TIME,
        }
        assert kind.get(found.dtype.kind, ColumnKind.TEXT) is column.kind, column.name


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_duckdb_infers_the_column_types(table: Table, as_csv: Path) -> None:
    file = as_csv / f"{table.name}.csv"
    types = {row[0]: row[1] for row in duckdb.sql(f"describe select * from '{file}'").fetchall()}
    rows = duck(file)
    for i, column in enumerate(table.columns):
        if any(row[i] is not None for row in rows):
            assert types[column.name] == DUCKDB[column.kind], column.name


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_parquet_declares_types_and_holds_the_same_rows(
    table: Table, as_csv: Path, as_parquet: Path
) -> None:
    file = as_parquet / f"{table.name}.parquet"
    found = parquet.read_table(file)
    assert found.schema.metadata[b"row"].decode() == table.row_is
    for column, field in zip(table.columns, found.schema, strict=True):
        assert (field.name, str(field.type)) == (column.name, ARROW[column.kind])
        assert field.metadata[b"meaning"].decode() == column.meaning
        assert field.nullable == (column.kind not in (ColumnKind.INTEGER, ColumnKind.TRUTH))
    rows = [tuple(row.values()) for row in arrow(file)]
    assert rows == duck(as_csv / f"{table.name}.csv") == duck(file)
    assert json.loads((as_parquet / folder.CONTENTS).read_text())["rows"][file.name] == len(rows)


# --- values -------------------------------------------------------------------------------------


def test_report_rows_match_pymavlink(as_parquet: Path) -> None:
    """Every report has a row, in log order, accepted or not."""
    reader = mavutil.mavlogfile(str(LOG))
    wanted = []
    while (message := reader.recv_match(type=["GLOBAL_POSITION_INT", "ADSB_VEHICLE"])) is not None:
        wanted.append(message)
    reader.close()
    rows = arrow(as_parquet / "reports.parquet")
    assert len(rows) == len(wanted) > 1000
    for row, message in zip(rows, wanted, strict=True):
        assert row["message"] == message.get_type()
        assert row["sender"] == f"{message.get_srcSystem()}:{message.get_srcComponent()}"
        assert row["arrival_ns"] == pytest.approx(message._timestamp * 1e9, abs=1000)
        if row["message"] == "GLOBAL_POSITION_INT" and row["lat_deg"] is not None:
            place = (message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3)
            assert (row["lat_deg"], row["lon_deg"], row["alt_m"]) == pytest.approx(place, rel=1e-12)
            assert row["velocity_down_mps"] == pytest.approx(message.vz * 1e-2)
            assert row["boot_s"] == message.time_boot_ms / 1000


def test_exported_numbers_match_the_pipeline(as_parquet: Path, outputs: list[Output]) -> None:
    estimates = [out for out in outputs if isinstance(out, Estimate)]
    used = [row for row in arrow(as_parquet / "reports.parquet") if row["accepted"]]
    assert [(row["uav"], row["innovation_m"], row["bound_m"], row["dt_s"]) for row in used] == [
        (out.fix.uav, out.innovation_m, out.bound_m, out.dt_s) for out in estimates
    ]
    for row, out in zip(used, estimates, strict=True):
        assert row["arrival_ns"] - round(row["latency_s"] * 1e9) == out.fix.t_ns
        assert row["noise_horizontal_m"] == out.fix.noise.horizontal_m

    updates = [out for out in outputs if isinstance(out, Update)]
    assert [row["t_ns"] for row in arrow(as_parquet / "updates.parquet")] == [
        update.t_ns for update in updates
    ]
    assert [
        (row["valid_at_ns"], row["uav"], row["bound_m"], row["north_m"], row["gamma"])
        for row in arrow(as_parquet / "tracks.parquet")
    ] == [
        (track.valid_at_ns, track.uav, track.bound_m, track.position_ned_m[0], track.gamma)
        for update in updates
        for track in update.tracks
    ]
    beams = [(update, beam) for update in updates for beam in update.beams.beams]
    rows = arrow(as_parquet / "beams.parquet")
    assert len(rows) == len(beams) > 900
    for row, (update, beam) in zip(rows, beams, strict=True):
        assert (row["t_ns"], row["uav"], row["gain_db"]) == (update.t_ns, beam.uav, beam.gain_db)
        assert row["azimuth_deg"] == pytest.approx(beam.azimuth_rad * 57.29577951308232)
        assert row["range_m"] == beam.range_m


def test_rejections_and_notices_are_exported(as_parquet: Path, outputs: list[Output]) -> None:
    refused = [out for out in outputs if isinstance(out, Rejection)]
    rejections = arrow(as_parquet / "rejections.parquet")
    assert [(row["t_ns"], row["source"], row["reason"], row["count"]) for row in rejections] == [
        (out.t_ns, out.source, out.reason, out.count) for out in refused
    ]
    of_reports = [row for row in arrow(as_parquet / "reports.parquet") if not row["accepted"]]
    reasons = Counter(row["reason"] for row in of_reports)
    assert reasons and reasons <= Counter(str(out.reason) for out in refused)
    assert all(row[name] is None for row in of_reports for name in ("true_utc", "innovation_m"))
    events = arrow(as_parquet / "events.parquet")
    assert [row["text"] for row in events if row["kind"] == "notice"] == [
        out.text for out in outputs if isinstance(out, Notice)
    ]
    assert [row["proven"] for row in events if row["kind"] == "refuted"] == [
        out.proven for out in outputs if isinstance(out, Refuted)
    ]


def test_space_export_holds_tracks_and_beams_as_points(
    tmp_path: Path, outputs: list[Output]
) -> None:
    """Read by mcap and Foxglove's own class: the last point of a beam is at its UAV."""
    where = exported(tmp_path / "space", LOG, "--format", "rerun", *CENTER)
    updates = {one.t_ns: one for one in outputs if isinstance(one, Update)}
    seen: Counter[str] = Counter()
    with (where / "space.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if schema.name != "foxglove.PointCloud":
                assert (schema.name, channel.topic) == ("foxglove.FrameTransform", "/tf")
                continue
            cloud = PointCloud.FromString(message.data)
            assert (cloud.frame_id, cloud.point_stride, len(cloud.data) % 16) == ("map", 16, 0)
            points = numpy.frombuffer(cloud.data, "<f4").reshape(-1, 4)[:, :3]
            _, _, kind, uav = channel.topic.split("/")
            (track,) = [t for t in updates[message.log_time].tracks if t.uav == uav]
            north, east, down = track.position_ned_m
            assert numpy.linalg.norm(points[-1] - (east, north, -down)) < 1.0
            if kind == "beam":
                steps = numpy.linalg.norm(numpy.diff(points, axis=0), axis=1)
                assert len(points) == 64 and numpy.ptp(steps) < 0.01
            seen[kind] += 1
    assert seen["uav"] == seen["beam"] > 100
    assert sorted(path.name for path in where.iterdir()) == ["space.mcap"]


def test_space_export_of_an_unreadable_log_leaves_no_files(tmp_path: Path) -> None:
    (tmp_path / "x.tlog").write_bytes(b"")
    done = export(tmp_path / "x.tlog", "--out", tmp_path / "space", "--format", "rerun")
    assert done.exit_code != 0
    assert not list(tmp_path.glob("space/*"))


def test_space_export_leaves_the_file_of_another_export_alone(tmp_path: Path) -> None:
    other = tmp_path / "space.mcap.active"
    with open_alone(other) as file:
        file.write(b"points of the other export")
        file.flush()
        done = export(LOG, "--out", tmp_path, "--format", "rerun", *CENTER)
        assert done.exit_code == 1
        assert "space.mcap.active: in use by another process" in done.stderr
        assert other.read_bytes() == b"points of the other export"


@pytest.mark.parametrize(("form", "name"), [("csv", "reports.csv"), ("rerun", "space.mcap")])
def test_folder_in_place_of_a_file_is_named_at_once(tmp_path: Path, form: str, name: str) -> None:
    (tmp_path / name).mkdir()
    done = export(LOG, "--out", tmp_path, "--format", form, *CENTER)
    assert done.exit_code == 1
    assert f"{name}: Is a directory" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_exports_of_two_forms_share_no_folder(tmp_path: Path) -> None:
    """Both would write one export.json."""
    with open_alone(tmp_path / "export.json.active"):
        done = export(LOG, "--out", tmp_path, "--format", "csv", *CENTER)
    assert done.exit_code == 1
    assert "export.json.active: in use by another process" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["export.json.active"]


@pytest.mark.parametrize("name", ["reports.csv.active", "export.json.active"])
def test_pipe_in_place_of_a_file_is_an_error(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    done = export(LOG, "--out", tmp_path, "--format", "csv", *CENTER)
    assert done.exit_code == 1
    assert f"{name}: is a pipe, not a file" in done.stderr


def test_recording_exports_the_same_tables(tmp_path: Path, short_log: Path) -> None:
    recording, as_csv = tmp_path / "flight.mcap", exported(tmp_path / "csv", short_log, *CENTER)
    done = CliRunner().invoke(main, ["replay", str(short_log), *CENTER, "--out", str(recording)])
    assert done.exit_code == 0
    again = exported(tmp_path / "tables", recording)
    digests = [json.loads((at / folder.CONTENTS).read_text())["summary"]["digest"]
               for at in (again, as_csv)]  # fmt: skip
    assert digests[0] == digests[1]
    for table in TABLES:
        first, second = ((at / f"{table.name}.csv").read_bytes() for at in (again, as_csv))
        assert first == second, table.name


# --- hostile logs -------------------------------------------------------------------------------


def tlog(*messages: tuple[int, Any]) -> bytes:
    """Return messages of vehicle 7:1, each with its time in microseconds, as a telemetry log."""
    sender = dialect.MAVLink(None, srcSystem=7, srcComponent=1)
    return b"".join(us.to_bytes(8, "big") + message.pack(sender) for us, message in messages)


def position(boot_ms: int, lat: int, heading: int) -> Any:
    return dialect.MAVLink_global_position_int_message(
        boot_ms, lat, 85_000_000, 500_000, 10_000, 0, 0, 0, heading
    )


def test_unknown_values_are_null_not_zero(tmp_path: Path) -> None:
    begun_us = 1_795_314_424_300_000
    log = tmp_path / 'a, "b"\nc\udcff.tlog'
    log.write_bytes(
        tlog(
            *((begun_us + i * 100_000, position(i * 100, 470_000_000, 65_535)) for i in range(20)),
            (begun_us + 2_000_000, position(2000, 0, 0)),  # far from its previous position
            (begun_us + 2_100_000, position(2100, 950_000_000, 0)),
        )
    )
    tables = exported(tmp_path / "out", log)
    exported(tmp_path / "out", log, "--format", "parquet")  # beside the other vehicle
    rows = arrow(tmp_path / "out" / "reports.parquet")
    assert rows == [dict(zip(rows[0], row, strict=True)) for row in duck(tables / "reports.csv")]
    assert {row["link"] for row in rows} == {'a, "b"\nc\\udcff.tlog'}
    assert [row["heading_deg"] for row in rows[:21]] == [None] * 20 + [0.0]
    assert rows[0]["innovation_m"] is rows[0]["dt_s"] is None
    assert rows[1]["innovation_m"] is not None
    assert (rows[-1]["reason"], rows[-1]["lat_deg"], rows[-1]["uav"]) == ("malformed", None, "7:1")
    assert "latitude 95" in rows[-1]["detail"]
    of_place = re.search(
        r"^.*,\"latitude 95.*$", (tables / "reports.csv").read_text(), re.MULTILINE
    )
    assert of_place is not None
    after = of_place[0].partition("longitude")[2].split(",")[1:]
    assert set(after) == {"", "false"}  # no estimate, and it restarted no track


def test_log_without_positions_gives_empty_tables(tmp_path: Path) -> None:
    log = tmp_path / "quiet.tlog"
    heartbeat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    log.write_bytes(tlog((1_795_314_424_300_000, heartbeat), (1_795_314_424_400_000, heartbeat)))
    done = export(log, "--out", tmp_path / "out")
    assert done.exit_code == 0
    assert "no beam was computed" in done.stderr
    for table in TABLES:
        file = tmp_path / "out" / f"{table.name}.csv"
        names = [column.name for column in table.columns]
        assert list(pandas.read_csv(file).columns) == names
        assert duckdb.sql(f"select * from '{file}'").columns == names
    assert duck(tmp_path / "out" / "reports.csv") == []


def test_garbage_and_truncated_frames_are_counted(tmp_path: Path) -> None:
    data = bytearray(LOG.read_bytes()[: 1 << 17])
    for at in range(1000, len(data), 5000):
        data[at : at + 40] = bytes(40)
    log = tmp_path / "torn.tlog"
    log.write_bytes(data)
    done = export(log, "--out", tmp_path / "out", *CENTER, "--json")
    assert done.exit_code == 0, done.stderr
    summary = json.loads(done.stdout)
    found = Counter[str]()
    for _, _, _, reason, count, *_ in duck(tmp_path / "out" / "rejections.csv"):
        found[reason] += count
    assert found == summary["rejected"]
    assert found["garbage"] > 0


# --- files left behind --------------------------------------------------------------------------


def left(where: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in where.iterdir()} if where.exists() else {}


@pytest.mark.parametrize(
    ("form", "failure", "status", "says"),
    [
        ("csv", KeyboardInterrupt(), 130, "interrupted; nothing was exported"),
        ("parquet", OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), 1, "No space left"),
    ],
)
def test_interrupted_export_keeps_existing_files(
    *, form: str, failure: BaseException, status: int, says: str, short_log: Path,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    where, steps, before = tmp_path / "out", 0, dict[str, bytes]()
    step = replaying.Run.step

    def failing(run: replaying.Run, event: Any) -> Any:
        nonlocal steps
        steps += 1
        if steps == 500:
            new = left(where).keys() - before.keys()
            assert {name.rpartition(".")[2] for name in new} == {"active"}
            raise failure
        return step(run, event)

    def cut_short() -> dict[str, bytes]:
        with monkeypatch.context() as patched:
            patched.setattr(replaying.Run, "step", failing)
            done = export(short_log, "--out", where, *CENTER, "--format", form)
        assert done.exit_code == status
        assert says in done.stderr
        return left(where)

    assert cut_short() == {}
    before = left(exported(where, short_log, *CENTER, "--format", form))
    steps = 0
    assert cut_short() == before


def test_full_disk_leaves_no_new_files(
    short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(folder.os, "fsync", full)
    done = export(short_log, "--out", tmp_path / "out", *CENTER)
    assert (done.exit_code, left(tmp_path / "out")) == (1, {})
    assert "No space left" in done.stderr


def test_concurrent_exports_to_one_folder_are_rejected(short_log: Path, tmp_path: Path) -> None:
    with folder.TableFolder(tmp_path, "csv", TABLES):
        done = export(short_log, "--out", tmp_path, *CENTER)
        assert done.exit_code == 1
        assert done.stderr.count("\n") == 2  # the log is truncated
        assert (tmp_path / "reports.csv.active").exists()
    assert left(tmp_path) == {}


def test_missing_pyarrow_is_reported_with_the_package_to_install(
    short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    done = export(short_log, "--out", tmp_path / "out", *CENTER, "--format", "parquet")
    assert done.exit_code == 1
    assert "pip install 'uav-companion-beams[parquet]'" in done.stderr
    assert done.stderr.count("\n") == 2  # the log is truncated
    assert left(tmp_path / "out") == {}


def test_parquet_is_written_in_row_groups(
    short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parquet_file, "BATCH", 50)
    where = exported(tmp_path / "out", short_log, *CENTER, "--format", "parquet")
    found = parquet.ParquetFile(where / "tracks.parquet")
    groups = [found.metadata.row_group(i).num_rows for i in range(found.num_row_groups)]
    found.close()
    assert max(groups) == 50
    assert sum(groups) > 150
