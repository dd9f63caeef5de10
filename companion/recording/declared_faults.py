"""Faults declared for a log: ``LOG.events.json`` beside it, a list of faults with vehicle and time.

Each entry has ``unix`` (seconds), ``sysid`` and ``event``. A fault begins with such an entry and
ends with its counterpart (``gps_off`` with ``gps_on``, ``glitch25m`` with ``glitch_end``), or after
the seconds in its name (``link_drop12s``); without an end it lasts to the end of the log.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from companion.mavlink.links.regular_file import open_regular
from companion.recording.reader import LogError

LARGEST_BYTES: Final = 1 << 20  # largest list that is read, bytes: thousands of entries
SUFFIX: Final = ".events.json"
_LASTS: Final = re.compile(r"(\d+(?:\.\d+)?)s$")
_END_NS: Final = 2**62


@dataclass(frozen=True, slots=True, kw_only=True)
class DeclaredFault:
    """Fault of one vehicle, by system id, between two times of the log."""

    sysid: int
    name: str
    from_ns: int
    to_ns: int


def declared_faults(log: Path) -> tuple[DeclaredFault, ...]:
    """Return the faults declared beside a log; none if there is no such file.

    Raises ``LogError`` if the file is not a list of events.
    """
    path = log.with_name(log.name + SUFFIX)
    try:
        with open_regular(path) as file:
            text = file.read(LARGEST_BYTES + 1)
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    if len(text) > LARGEST_BYTES:
        raise LogError(f"{path}: larger than {LARGEST_BYTES >> 20} MiB")
    try:
        events = [
            (round(float(each["unix"]) * 1e9), int(each["sysid"]), str(each["event"]))
            for each in json.loads(text)
        ]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise LogError(f"{path}: must be a list of entries with unix, sysid and event") from error
    return tuple(_faults(sorted(events)))


def _faults(events: list[tuple[int, int, str]]) -> list[DeclaredFault]:
    found = []
    for number, (at_ns, sysid, name) in enumerate(events):
        if _is_end(name):
            continue
        lasts: Any = _LASTS.search(name)
        ends_ns = _END_NS if lasts is None else at_ns + round(float(lasts[1]) * 1e9)
        for later_ns, other, said in events[number + 1 :]:
            if lasts is None and other == sysid and _ends(name, said):
                ends_ns = later_ns
                break
        found.append(DeclaredFault(sysid=sysid, name=name, from_ns=at_ns, to_ns=ends_ns))
    return found


def _is_end(name: str) -> bool:
    return name.endswith(("_on", "_end"))


def _ends(name: str, said: str) -> bool:
    """Return whether an entry ends a fault: ``X_on`` ends ``X_off``, ``X_end`` all ``X...``."""
    if said.endswith("_on"):
        return name == f"{said.removesuffix('_on')}_off"
    return said.endswith("_end") and name.startswith(said.removesuffix("_end"))
