"""Faults declared for a log: ``LOG.events.json`` beside it, a list of faults with vehicle and time.

Each entry has ``unix`` (seconds), ``sysid`` and ``event``. A fault begins with such an entry and
ends with its counterpart (``gps_off`` with ``gps_on``, ``glitch25m`` with ``glitch_end``), or after
the seconds in its name (``link_drop12s``); without an end it lasts to the end of the log.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from companion.mavlink.links.regular_file import open_regular
from companion.recording.reader import LogError

LARGEST_BYTES: Final = 1 << 20  # largest list that is read, bytes: thousands of entries
NAME_MAX: Final = 64  # characters of an entry's name
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
            (round(float(each["unix"]) * 1e9), int(each["sysid"]), _name(each["event"]))
            for each in json.loads(text)
        ]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise LogError(f"{path}: must be a list of entries with unix, sysid and event") from error
    return tuple(_faults(sorted(events)))


def _name(text: object) -> str:
    if not isinstance(text, str) or len(text) > NAME_MAX:
        raise TypeError
    return text


def _faults(events: list[tuple[int, int, str]]) -> list[DeclaredFault]:
    """Return the faults by their beginning; from the last entry back, so that ends are known."""
    found = []
    next_ns: dict[tuple[int, str], int] = {}  # of each end, by vehicle and its entry
    for at_ns, sysid, name in reversed(events):
        if name.endswith(("_on", "_end")):
            next_ns[sysid, name] = at_ns
            continue
        lasts: Any = _LASTS.search(name)
        if lasts is None:
            ends = (next_ns.get((sysid, end), _END_NS) for end in _ends_of(name))
            to_ns = min(ends, default=_END_NS)
        else:
            to_ns = min(at_ns + round(float(lasts[1]) * 1e9), _END_NS)
        found.append(DeclaredFault(sysid=sysid, name=name, from_ns=at_ns, to_ns=to_ns))
    return found[::-1]


def _ends_of(name: str) -> Iterator[str]:
    """Yield the entries that end a fault: ``X_on`` ends ``X_off``, ``X_end`` all ``X...``."""
    if name.endswith("_off"):
        yield f"{name.removesuffix('_off')}_on"
    for length in range(len(name) + 1):
        yield f"{name[:length]}_end"
