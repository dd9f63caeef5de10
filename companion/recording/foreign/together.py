"""Onboard logs of one vehicle each, joined to one flight: distinct ids and one timeline.

The timeline is Unix time, by the GPS time in each log (``gps_time``). A vehicle has the system id
in its log; if two logs have the same, the later one gets the next free id.
"""

import functools
import heapq
import mmap
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from companion.recording.errors import LogError
from companion.recording.foreign import ardupilot, csv_table, px4, said
from companion.recording.foreign.columns import Bytes
from companion.recording.foreign.gps_time import RECEIVER_LAG_S
from companion.recording.foreign.onboard import Onboard
from companion.recording.stamps import LARGEST_LEAP_NS
from companion.values import Event, IntArray, Source

READERS: Final[dict[str, Callable[[Bytes], Onboard]]] = {
    "dataflash": ardupilot.read,
    "ulog": px4.read,
    "csv": csv_table.read,
}
"""Readers of onboard logs, by the kind of log."""
KEPT: Final = 8  # logs that are cached after reading
_NAMES: Final = {"dataflash": "DataFlash", "ulog": "ULog", "csv": "a table"}


class Vehicle(NamedTuple):
    """Onboard log of one vehicle of a flight, and the id that the vehicle gets."""

    path: Path
    kind: str
    source: Source
    log: Onboard

    @property
    def apart_s(self) -> float:
        """Bound on the error of the log's times relative to other logs; 0 if used unchanged.

        Receivers are late by 0 to ``RECEIVER_LAG_S``: by at most half of it off the middle.
        """
        clock = self.log.clock
        if clock is None or self.kind == "csv":
            return 0.0
        return clock.uncertainty_s + RECEIVER_LAG_S / 2

    @property
    def span_us(self) -> tuple[int, int]:
        """Times of the first and the last position, microseconds; since boot without GPS time."""
        assert self.log.positions is not None
        boot_us, clock = _ends(self.log.positions.boot_us), self.log.clock
        first, last = (boot_us if clock is None else clock.unix_us(boot_us)).tolist()
        return first, last

    def notice(self) -> str:
        """Return one line for the user: vehicle, accuracy of its time, and substitutions."""
        clock = self.log.clock
        if clock is None:
            when = "no GPS time: its time is that since boot"
        elif self.kind == "csv":
            when = "its time is used unchanged"
        else:
            when = (
                f"on GPS time to {clock.uncertainty_s:.3f} s by {clock.fixes} fixes, plus the"
                f" receiver's delay of up to {RECEIVER_LAG_S:g} s"
            )
        own = "" if self.log.sysid == self.source.sysid else self._renamed()
        who = f"{self.path.name}: {_NAMES[self.kind]}, vehicle {self.source}{own}"
        return "; ".join((who, when, *self.log.notes))

    def _renamed(self) -> str:
        if self.log.sysid is None:
            return " (no id in the log)"
        return f" (id {self.log.sysid} in the log is taken by another)"

    def as_json(self) -> dict[str, Any]:
        """Return vehicle, accuracy of its time, and substitutions as JSON."""
        clock = self.log.clock
        return {
            "log": self.path.name,
            "kind": self.kind,
            "uav": str(self.source),
            "sysid_in_log": self.log.sysid,
            "gps_fixes": None if clock is None else clock.fixes,
            "clock_uncertainty_s": None if clock is None else clock.uncertainty_s,
            "drift_ppm": None if clock is None else clock.drift * 1e6,
            "notes": list(self.log.notes),
        }


def opened(logs: Sequence[tuple[Path, str]]) -> list[Vehicle]:
    """Return the vehicles whose onboard logs are given, each with its kind of log.

    Raises ``LogError`` for an unusable log, or for logs of different flights.
    """
    read = [(path, kind, _read(path, kind)) for path, kind in logs]
    taken = {log.sysid for _, _, log in read if log.sysid is not None}
    given: set[int] = set()
    found = []
    for path, kind, log in read:
        sysid = log.sysid
        if sysid is None or sysid in given:
            sysid = next((free for free in range(1, 250) if free not in taken | given), None)
            if sysid is None:
                raise LogError(f"{path}: no free system id is left; give fewer logs")
        given.add(sysid)
        found.append(Vehicle(path=path, kind=kind, source=Source(sysid, log.compid), log=log))
    if len(found) > 1:
        _require_one_flight(found)
    return found


def events(vehicles: Sequence[Vehicle], latency_s: float) -> Iterator[Event]:
    """Return the vehicles' events in order of time; a sample arrives after ``latency_s``."""
    each = [said.frames(one.log, one.path.name, one.source, latency_s) for one in vehicles]
    return heapq.merge(*each, key=lambda event: event.t_ns)


def _read(path: Path, kind: str) -> Onboard:
    try:
        seen = path.stat()
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    return _read_once(path, kind, (seen.st_ino, seen.st_size, seen.st_mtime_ns))


@functools.lru_cache(maxsize=KEPT)
def _read_once(path: Path, kind: str, _seen: tuple[int, int, int]) -> Onboard:
    """Return the samples in a file with status ``_seen``; cached for repeated reads."""
    try:
        with path.open("rb") as file:  # the map is closed with its last reference
            whole = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        with np.errstate(all="ignore"):  # damaged numbers are NaN, and filtered
            log = READERS[kind](np.frombuffer(whole, dtype=np.uint8))
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    except csv_table.NoTableError as error:
        raise LogError(f"{path}: no MAVLink frame in it: it is {error}") from None
    except px4.UnknownFlagsError:
        raise LogError(f"{path}: ULog with unsupported flags; update this program") from None
    if log.positions is None:
        raise LogError(f"{path}: {_NAMES[kind]}, but no position in it")
    return log


def _require_one_flight(vehicles: Sequence[Vehicle]) -> None:
    spans = []
    for one in vehicles:
        if one.log.clock is None:
            raise LogError(
                f"{one.path}: no GPS time, so other logs cannot be joined; give it alone"
            )
        spans.append((*one.span_us, one.path))
    spans.sort(key=lambda span: span[:2])
    for before, after in pairwise(spans):
        apart_s = (after[0] - before[1]) * 1e-6
        if apart_s > LARGEST_LEAP_NS * 1e-9:
            raise LogError(
                f"{after[2]}: begins {apart_s / 3600:.1f} h after {before[2].name} ends;"
                " give the logs of one flight"
            )


def _ends(boot_us: IntArray) -> IntArray:
    return np.array([boot_us.min(), boot_us.max()])
