"""CSV tables whose header names their columns."""

import csv
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.recording.foreign import csv_table
from companion.recording.foreign.csv_table import NoTableError
from companion.recording.reader import LogError, read_log, vehicles
from companion.values import Frame, Reason

HEAD = "unix_s,lat_deg,lon_deg,alt_m"
ROWS = "\n".join(
    f"{1_795_000_000 + n / 10:.3f},{47 + n * 1e-5:.7f},8.5,{500 + n}" for n in range(50)
)


def read(text: str) -> csv_table.Onboard:
    return csv_table.read(text.encode())


def test_csv_positions_and_times_are_read_and_velocities_derived() -> None:
    log = read(f"# sysid = 42\n# mav_type = 2\n{HEAD}\n{ROWS}\n")
    assert (log.sysid, log.mav_type, log.lost) == (42, 2, {})
    at = log.positions
    assert at is not None and log.clock is not None
    unix_us = log.clock.unix_us(at.boot_us)
    assert unix_us.tolist() == [1_795_000_000_000_000 + n * 100_000 for n in range(50)]
    assert at.lat_1e7.tolist() == [470_000_000 + n * 100 for n in range(50)]
    assert at.velocity_ned_mps == pytest.approx(np.tile((11.1195, 0, -10.0), (50, 1)), rel=1e-3)
    assert log.notes == ("missing velocities are computed from the positions",)


@pytest.mark.parametrize("dt_s", [0.01, 1.0, 2.5, 59.0, 300.0])
@pytest.mark.parametrize("timed", ["t_s", "unix_s"])
def test_no_line_of_a_slow_table_is_lost(dt_s: float, timed: str) -> None:
    """The first line begins the time, also where the first few span minutes."""
    begin = 0 if timed == "t_s" else 1_795_000_000
    rows = (f"{begin + n * dt_s:.3f},47,8.5,{500 + n}\n" for n in range(20))
    log = read(f"{timed},lat_deg,lon_deg,alt_m\n" + "".join(rows))
    assert log.lost == {}
    assert log.positions is not None and len(log.positions.boot_us) == 20


@pytest.mark.parametrize("wild", ["-99999", "1e9"])
def test_a_wild_first_stamp_alone_is_lost(wild: str) -> None:
    rows = "".join(f"{n},47,8.5,{500 + n}\n" for n in range(1, 20))
    log = read(f"t_s,lat_deg,lon_deg,alt_m\n{wild},47,8.5,499\n{rows}")
    assert log.lost == {Reason.BAD_STAMP: 1}
    assert log.positions is not None and len(log.positions.boot_us) == 19


def test_velocities_are_derived_across_the_antimeridian() -> None:
    degrees = 20 / 111_195 / np.cos(np.radians(47))  # 20 m/s eastwards
    longitudes = [(179.999 + n * degrees + 180) % 360 - 180 for n in range(20)]
    rows = "".join(f"{n},47,{lon:.9f},500\n" for n, lon in enumerate(longitudes))
    at = read(f"t_s,lat_deg,lon_deg,alt_m\n{rows}").positions
    assert at is not None
    assert at.velocity_ned_mps == pytest.approx(np.tile((0.0, 20.0, 0.0), (20, 1)), rel=1e-2)


@pytest.mark.parametrize("before", [b"\xef\xbb\xbf", b"# temperature in \xb0C\n"])
def test_table_with_a_mark_or_other_encoding_is_recognised(before: bytes, tmp_path: Path) -> None:
    """A spreadsheet writes the mark. Names of columns are ASCII; other letters do not matter."""
    log = tmp_path / "table.csv"
    log.write_bytes(before + f"{HEAD}\n{ROWS}\n".encode())
    assert sum(isinstance(event, Frame) for event in read_log(log)) > 50


def test_table_in_utf_16_is_rejected_with_the_remedy(tmp_path: Path) -> None:
    log = tmp_path / "table.csv"
    log.write_bytes(f"{HEAD}\n{ROWS}\n".encode("utf-16"))
    with pytest.raises(LogError, match="text in UTF-16: save it as UTF-8"):
        list(read_log(log))


def test_frames_after_bytes_that_mark_utf_16_are_read(cut_log: Path, tmp_path: Path) -> None:
    """FE FF may also be the end of a MAVLink 1 frame, or the beginning of a damaged one."""
    log = tmp_path / "raw.bin"
    frames = [event for event in read_log(cut_log) if isinstance(event, Frame)]
    log.write_bytes(b"\xfe\xff" + b"".join(frame.raw for frame in frames))
    found = [event for event in read_log(log) if isinstance(event, Frame)]
    assert len(found) == len(frames)


@pytest.mark.parametrize("divider", [",", ";", "\t"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_csv_separators_and_line_endings_are_accepted(
    divider: str, newline: str, mark: str
) -> None:
    text = mark + f"{HEAD},vn_mps,ve_mps,vd_mps,heading_deg,extra\n"
    text += "1795000000,47,8.5,500,1.5,-2.5,0.5,90,x\n1795000001,47,8.5,500,,,,,\n"
    log = read(text.replace(",", divider).replace("\n", newline))
    at = log.positions
    assert at is not None
    assert at.velocity_ned_mps.tolist() == [[1.5, -2.5, 0.5], [0.0, 0.0, 0.0]]
    assert at.heading_deg[0] == 90 and np.isnan(at.heading_deg[1])
    assert "column not used: extra" in log.notes


def test_columns_that_are_not_used_are_named_within_limits() -> None:
    many = ",".join(f"{'x' * 90}{number}" for number in range(500))
    log = read(f"{HEAD},{many}\n1795000000,47,8.5,500\n1795000001,47,8.5,501\n")
    assert "490 more columns not used" in log.notes
    assert sum(map(len, log.notes)) < 1000


def test_iso_times_with_and_without_zone_are_parsed() -> None:
    times = ("2026-11-22T12:00:00.5+01:00", "2026-11-22T11:00:01Z", "2026-11-22T11:00:02")
    log = read("time,lat_deg,lon_deg,alt_m\n" + "".join(f"{time},47,8,5\n" for time in times))
    assert log.positions is not None and log.clock is not None
    assert log.clock.unix_us(log.positions.boot_us).tolist() == [
        1_795_345_200_500_000,
        1_795_345_201_000_000,
    ]
    assert log.lost == {Reason.MALFORMED: 1}  # the last one has no time zone


def test_csv_attitudes_and_accuracies_become_frames(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text(
        f"{HEAD},roll_deg,pitch_deg,yaw_deg,h_acc_m,v_acc_m,vel_acc_mps,fix_type\n"
        "1795000000,47,8.5,500,0,0,0,1.5,2.5,0.3,3\n1795000001,47,8.5,500,0,0,10,1.5,2.5,0.3,3\n"
    )
    (one,) = vehicles([path])
    assert one.log.attitudes is not None and one.log.fixes is not None
    assert one.log.attitudes.rates_radps[:, 2] == pytest.approx(np.radians(10), rel=1e-6)
    assert one.log.fixes.accuracies.tolist() == [[1.5, 2.5, 0.3]] * 2
    kinds = [event.msgid for event in read_log(path) if isinstance(event, Frame)]
    assert kinds == [0, 2, 24, 30, 33] * 2
    assert "its time is used unchanged" in one.notice()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("lat,lon\n47.1,8.5\n", "without a column unix_s or time or t_s, lat_deg, lon_deg, alt_m"),
        ("unix_s,lat_deg,lon_deg\n1,47,8\n", "without a column alt_m"),
        (f"{HEAD},alt_m\n", "twice"),
        (f"# sysid = 999\n{HEAD}\n", "sysid is not 1 to 255"),
        ("# only words\n" * 200, "text without a table"),
        ("\n\n", "text without a table"),
    ],
)
def test_invalid_csv_table_is_rejected_with_a_reason(text: str, why: str) -> None:
    with pytest.raises(NoTableError, match=why):
        read(text)


def test_malformed_csv_lines_are_counted() -> None:
    bad = [
        "1795000001,47,8.5",
        "1795000002,x,8.5,5",
        ",,,",
        "1795000003,47,8.5,nan",
        "inf,47,8.5,5",
    ]
    log = read(f"{HEAD}\n{ROWS}\n" + "\n".join(bad))
    assert log.positions is not None and len(log.positions.boot_us) == 50
    assert sum(log.lost.values()) == len(bad)


@given(st.text(max_size=300), st.booleans())
def test_arbitrary_text_is_a_table_or_rejected(text: str, with_header: bool) -> None:
    try:
        log = read(f"{HEAD}\n{text}" if with_header else text)
    except NoTableError:
        return
    assert log.positions is None or len(log.positions.boot_us) <= text.count("\n") + 300


def counted_calls(text: str) -> tuple[int, int]:
    """How often functions of the reader are called, and exceptions raised."""
    calls = raised = 0

    def count(frame: FrameType, event: str, arg: Any) -> Any:
        nonlocal calls, raised
        if frame.f_code.co_filename != csv_table.__file__:
            return None
        calls += event == "call" and frame.f_code.co_name in ("_cells_of", "_finite")
        raised += event == "exception"
        return count

    lines = csv_table._lines(text.encode())
    _, header = csv_table._header(lines)
    used = list(enumerate(header.split(",")))
    sys.settrace(count)
    try:
        csv_table._rows(lines, header, used, "unix_s")
    finally:
        sys.settrace(None)
    return calls, raised


def test_work_for_a_line_is_bounded() -> None:
    """By counted calls: one for the line and one a cell, and no exception for a short line."""
    for line, calls in (("1795000000,47,8.5,500", 5), ("1", 1)):
        few, many = (counted_calls(f"{HEAD}\n" + f"{line}\n" * n) for n in (100, 1100))
        assert [b - a for a, b in zip(few, many, strict=True)] == [1000 * calls, 0]


CELLS = ["1", "47", "", " ", '"1"', '"1,2"', '"', "a", "nan", "1_0", "\0", '8""5', "\x0b", "\u2028"]


@given(
    st.lists(st.lists(st.sampled_from(CELLS), min_size=2, max_size=6), max_size=6),
    st.sampled_from(",;\t"),
)
def test_cells_are_those_of_the_csv_module(rows: list[list[str]], divider: str) -> None:
    for line in (divider.join(row) + "\n" for row in rows):
        assert csv_table._cells_of(line, divider) == next(csv.reader([line], delimiter=divider))
