"""Table of positions as text, whose header names each column with its unit.

    # sysid = 3
    # mav_type = 2
    unix_s,lat_deg,lon_deg,alt_m,vn_mps,ve_mps,vd_mps,heading_deg
    1795314424.300,47.3984607,8.5455937,488.14,0.0,0.0,0.0,180.0

Time is ``unix_s``, ``time`` (RFC 3339 with its zone) or, if only relative time is known, ``t_s``.
Columns are separated by commas, semicolons or tabs, and a cell may be empty. Lines that begin with
``#`` may set ``sysid``, ``compid`` and ``mav_type``. See docs/recording.md.
"""

import csv
import io
import math
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from datetime import datetime
from functools import partial
from typing import Any, Final

import numpy as np

from companion.recording.foreign.columns import Bytes
from companion.recording.foreign.gps_time import FIRST_UNIX_US, LAST_UNIX_US, GpsTime
from companion.recording.foreign.onboard import (
    Attitudes,
    Fixes,
    Onboard,
    OnboardPositions,
    body_rates_of,
    earliest_us,
    on_earth,
    time_ordered,
    velocities_of,
)
from companion.recording.foreign.thinned import Thinned
from companion.values import FloatArray, IntArray, Reason

TIMES: Final = ("unix_s", "time", "t_s")
PLACE: Final = ("lat_deg", "lon_deg", "alt_m")
_VELOCITY: Final = ("vn_mps", "ve_mps", "vd_mps")
_EULER: Final = ("roll_deg", "pitch_deg", "yaw_deg")
_ACCURACY: Final = ("h_acc_m", "v_acc_m", "vel_acc_mps")
COLUMNS: Final = (
    *TIMES, *PLACE, "height_m", *_VELOCITY, "heading_deg", *_EULER, *_ACCURACY, "fix_type",
)  # fmt: skip
_ID_LIMITS: Final = {"sysid": 255, "compid": 255, "mav_type": 255}
_AUTOPILOT_GENERIC: Final = 0
_LINE_MAX: Final = 1 << 16
_NOTICES_MAX: Final = 100
_NAME_MAX: Final = 40  # characters of the name of a column that are shown
_NAMED_MAX: Final = 10  # columns that are not used and shown
_RESOLUTION_S: Final = 1e-3


class NoTableError(Exception):
    """Error of text that is not a table of positions; the message is one line for the user."""


def read(text: bytes | Bytes) -> Onboard:
    """Return the samples of a table. Raises ``NoTableError`` for an unsuitable header.

    Of very many lines only every n-th is kept.
    """
    lines = _lines(text)
    said, header = _header(lines)
    names = [name.strip().lower() for name in _cells(header)]
    timed = next((name for name in TIMES if name in names), None)
    missing = [name for name in PLACE if name not in names]
    if timed is None or missing:
        lacks = [*([] if timed else [" or ".join(TIMES)]), *missing]
        raise NoTableError(f"text without a column {', '.join(lacks)}; see docs/recording.md")
    if len(set(names)) != len(names):
        raise NoTableError("text whose header names a column twice; rename one")
    used = [(number, name) for number, name in enumerate(names) if name in COLUMNS]
    rows, bad = _rows(lines, header, used, timed)
    table = dict(zip([name for _, name in used], rows.T, strict=True))
    lost = {Reason.MALFORMED: bad} if bad else {}
    unused = [name for name in names if name and name not in COLUMNS]
    notes = [f"column not used: {name[:_NAME_MAX]}" for name in unused[:_NAMED_MAX]]
    if len(unused) > _NAMED_MAX:
        notes.append(f"{len(unused) - _NAMED_MAX} more columns not used")
    found = _onboard(table, timed, said, lost, notes)
    rest = bytes(text[-_LINE_MAX:]).splitlines(keepends=True)[-1:]
    is_cut = bool(rest) and not rest[0].endswith((b"\n", b"\r"))
    return replace(found, incomplete_bytes=len(rest[0]) if is_cut else 0)


class _Reading(io.RawIOBase):
    """File object that reads bytes without copying all of them."""

    def __init__(self, data: bytes | Bytes) -> None:
        self._data = memoryview(data) if isinstance(data, bytes) else data.data
        self._at = 0

    def readable(self) -> bool:
        return True

    def readinto(self, room: Any) -> int:
        some = self._data[self._at : self._at + len(room)]
        room[: len(some)] = some
        self._at += len(some)
        return len(some)


def _lines(data: bytes | Bytes) -> Iterator[str]:
    raw = io.BufferedReader(_Reading(data))
    text = io.TextIOWrapper(raw, encoding="utf-8-sig", errors="replace")
    return iter(partial(text.readline, _LINE_MAX), "")


def _header(lines: Iterator[str]) -> tuple[dict[str, int], str]:
    said: dict[str, int] = {}
    for number, line in enumerate(lines):
        if number > _NOTICES_MAX:
            break
        if not line.strip():
            continue
        if not line.startswith("#"):
            return said, line.rstrip("\n")
        name, equals, value = (part.strip() for part in line[1:].partition("="))
        if equals and name in _ID_LIMITS:
            if not value.isdecimal() or not 0 < int(value[:9]) <= _ID_LIMITS[name]:
                raise NoTableError(f"a table whose {name} is not 1 to {_ID_LIMITS[name]}")
            said[name] = int(value)
    raise NoTableError("text without a table")


def _cells(line: str) -> list[str]:
    divider = max(",;\t", key=line.count)
    return next(csv.reader([line], delimiter=divider), [])


def _rows(
    lines: Iterable[str], header: str, used: list[tuple[int, str]], timed: str
) -> tuple[FloatArray, int]:
    """Return the used columns of all numeric lines, (N, K), and how many lines are not numeric.

    An empty cell is NaN.
    """
    divider = max(",;\t", key=header.count)
    columns = [(number, _reader(name, timed)) for number, name in used]
    least = 1 + max(number for number, _ in used)
    found: Thinned[array[float]] = Thinned([])
    bad = 0
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        try:
            cells = _cells_of(line, divider)
            if len(cells) < least:  # an exception for each of millions of lines takes seconds
                bad += 1
                continue
            found.add(array("d", [read(cells[number]) for number, read in columns]))
        except (ValueError, csv.Error, OverflowError):
            bad += 1
    return np.array(found.kept, dtype=np.float64).reshape(-1, len(used)), bad


def _cells_of(line: str, divider: str) -> list[str]:
    """Return the cells of a line. Without quotes they are what is between the dividers."""
    if '"' in line:
        return next(csv.reader([line], delimiter=divider))
    return line.rstrip("\n").split(divider)


def _reader(name: str, timed: str) -> Callable[[str], float]:
    """Return the function that reads a cell of a column; it raises ``ValueError``."""
    if name == "time":
        return _instant
    return _finite if name in (timed, *PLACE) else _number


def _instant(cell: str) -> float:
    then = datetime.fromisoformat(cell.strip())
    if then.tzinfo is None:
        raise ValueError
    return then.timestamp()


def _finite(cell: str) -> float:
    value = float(cell)
    if not math.isfinite(value):
        raise ValueError
    return value


def _number(cell: str) -> float:
    return float(cell) if cell.strip() else math.nan


def _onboard(
    table: dict[str, FloatArray],
    timed: str,
    said: dict[str, int],
    lost: dict[Reason, int],
    notes: list[str],
) -> Onboard:
    boot_us, clock = _times(table[timed], timed)
    rows, wild = time_ordered(boot_us)
    if wild:
        lost[Reason.BAD_STAMP] = wild
    lat, lon, alt_m = (table[name][rows] for name in PLACE)
    small = (np.abs(lat) <= 90) & (np.abs(lon) <= 180)
    lat_1e7, lon_1e7 = (
        np.round(np.where(small, each, 0.0) * 1e7).astype(np.int64) for each in (lat, lon)
    )
    sound = small & on_earth(lat_1e7, lon_1e7, alt_m)
    if not sound.all():
        lost[Reason.MALFORMED] = lost.get(Reason.MALFORMED, 0) + int((~sound).sum())
    rows, boot_us = rows[sound], boot_us[rows][sound]
    place = lat_1e7[sound], lon_1e7[sound], alt_m[sound]
    table = {name: values[rows] for name, values in table.items()}
    return Onboard(
        sysid=said.get("sysid"),
        compid=said.get("compid", 1),
        mav_type=said.get("mav_type", 0),
        autopilot=_AUTOPILOT_GENERIC,
        positions=_positions(boot_us, place, table, notes) if len(rows) else None,
        attitudes=_attitudes(boot_us, table) if len(rows) else None,
        fixes=_fixes(boot_us, place, table) if len(rows) else None,
        clock=clock,
        lost=lost,
        notes=tuple(notes),
    )


def _times(seconds: FloatArray, timed: str) -> tuple[IntArray, GpsTime | None]:
    sound = np.abs(seconds) < LAST_UNIX_US * 1e-6
    whole_us = np.round(np.where(sound, seconds, -1.0) * 1e6).astype(np.int64)
    begin_us = earliest_us(whole_us)
    boot_us = np.where(sound, whole_us - begin_us + 1_000_000, -1)
    if timed == "t_s" or begin_us < FIRST_UNIX_US:
        return boot_us, None
    offset_us = begin_us - 1_000_000
    return boot_us, GpsTime(
        offset_us=offset_us, drift=0.0, at_us=0, uncertainty_s=_RESOLUTION_S, fixes=len(boot_us)
    )


Place = tuple[IntArray, IntArray, FloatArray]


def _positions(
    boot_us: IntArray, place: Place, table: dict[str, FloatArray], notes: list[str]
) -> OnboardPositions:
    lat_1e7, lon_1e7, alt_m = place
    velocity = velocities_of(boot_us, lat_1e7, lon_1e7, alt_m)
    nothing = np.full(len(boot_us), np.nan)
    given = np.stack([table.get(name, nothing) for name in _VELOCITY], axis=1)
    given = np.where(np.abs(given) < 1e4, given, np.nan)
    if np.isnan(given).any():
        notes.append("missing velocities are computed from the positions")
    height_m = table.get("height_m", nothing)
    return OnboardPositions(
        boot_us=boot_us,
        lat_1e7=lat_1e7,
        lon_1e7=lon_1e7,
        alt_m=alt_m,
        height_m=np.where(np.abs(height_m) < 1e6, height_m, alt_m - alt_m[0]),
        velocity_ned_mps=np.where(np.isnan(given), velocity, given),
        heading_deg=table.get("heading_deg", table.get("yaw_deg", nothing)),
    )


def _attitudes(boot_us: IntArray, table: dict[str, FloatArray]) -> Attitudes | None:
    if not set(_EULER) <= set(table):
        return None
    euler = np.radians(np.stack([table[name] for name in _EULER], axis=1))
    sound = (np.abs(euler) < 1e3).all(axis=1)
    if not sound.any():
        return None
    return Attitudes(boot_us[sound], euler[sound], body_rates_of(boot_us[sound], euler[sound]))


def _fixes(boot_us: IntArray, place: Place, table: dict[str, FloatArray]) -> Fixes | None:
    if not {*_ACCURACY, "fix_type"} & set(table):
        return None
    nothing = np.full(len(boot_us), np.nan)
    fix_type = table.get("fix_type", np.full(len(boot_us), 3.0))
    sound = (fix_type >= 0) & (fix_type <= 255)
    accuracies = np.stack([table.get(name, nothing) for name in _ACCURACY], axis=1)
    return Fixes(
        boot_us=boot_us[sound],
        unix_us=np.zeros(int(sound.sum()), dtype=np.int64),
        fix_type=fix_type[sound].astype(np.int64),
        satellites=np.full(int(sound.sum()), 255),
        lat_1e7=place[0][sound],
        lon_1e7=place[1][sound],
        alt_m=place[2][sound],
        accuracies=accuracies[sound],
        speed_mps=nothing[sound],
        course_deg=nothing[sound],
    )
