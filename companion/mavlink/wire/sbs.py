"""BaseStation lines (SBS-1, port 30003), converted to the ADSB_VEHICLE of a MAVLink receiver.

One line is one message of one aircraft, with the fields of that message; ``mavlink/trust/adsb.py``
merges the fields, as for all relays. The fields, their units and the sample that the tests read:
http://woodair.net/SBS/Article/Barebones42_Socket_Data.htm. Altitude is pressure altitude; with a
trailing H, which dump1090 writes as an option (``net_io.c``), it is above the ellipsoid.

A line has two times of its writer's clock: when the message was received and when the line was
written. Their difference is the age of the message, since some writers delay everything by five
minutes. If it is negative or missing, the line counts as new. No line states an accuracy.

A line that arrives later than others after it was written is late, or the writer's clock was set
back: half of that time is added to its age, and half to the error of the age. Beyond
``LATE_MAX_NS`` the stream has to begin anew. A single line with another time is rejected.
"""

import re
from datetime import datetime, timedelta
from typing import Final

from companion.mavlink.wire.foreign import LATE_MAX_NS, LATE_TEXT, MLAT, ForeignSplitter, Items
from companion.mavlink.wire.stream_lateness import StreamLateness
from companion.mavlink.wire.transponder import ADSB_VEHICLE, AircraftState
from companion.values import RELAYED_DELAY_S, RELAYED_TIME_ERROR_S, Reason

LINE_MAX: Final = 512  # longest line, bytes; a longer one is garbage
_SILENT: Final = frozenset((b"SEL", b"ID", b"AIR", b"STA", b"CLK"))
"""Kinds of lines about the writer's own display, which are ignored."""
_NUMBER: Final = re.compile(r"-?\d{1,9}(?:\.\d{1,9})?")


class SbsSplitter(ForeignSplitter):
    """Converter of the lines of one connection to frames."""

    def __init__(self, link: str) -> None:
        super().__init__(link)
        self._lateness = StreamLateness(LATE_MAX_NS)

    def _parse(self, t_ns: int, data: bytes) -> Items:
        *lines, self._pending = (self._pending + data).split(b"\n")
        out: Items = []
        for line in self._lines(lines, LINE_MAX):
            kind = line.partition(b",")[0].strip()
            if kind in (b"MSG", b"MLAT"):
                out += self._line(t_ns, line, kind)
            elif line.strip() and kind not in _SILENT:
                self._stray += len(line) + 1
                continue
            self._complete += 1  # an empty line is the heartbeat of readsb
        self._drop_overlong(LINE_MAX)
        return out

    def _line(self, t_ns: int, line: bytes, kind: bytes) -> Items:
        if self._is_skipped():
            return []
        if kind == b"MLAT":
            return self._refused(t_ns, Reason.UNKNOWN_MESSAGE, MLAT)
        try:
            state, written_ns = aircraft_state(line.decode("ascii"))
        except ValueError as error:
            text = error.reason if isinstance(error, UnicodeDecodeError) else str(error)
            return self._refused(t_ns, Reason.MALFORMED, text, ADSB_VEHICLE)
        late_ns = 0 if written_ns is None else self._lateness.observe_ns(t_ns, written_ns)
        if late_ns is None:
            if self._lateness.is_late:
                self.too_late = f"lines are {LATE_TEXT}"
            text = "the line's time does not fit that of the others"
            return self._refused(t_ns, Reason.UNPLACED_STAMP, text, ADSB_VEHICLE)
        half_s = 0.5e-9 * late_ns
        if 2 * half_s > RELAYED_DELAY_S:
            time_error_s = RELAYED_TIME_ERROR_S + half_s
            state = state._replace(age_s=state.age_s + half_s, time_error_s=time_error_s)
        return self._aircraft(t_ns, state)


def aircraft_state(line: str) -> tuple[AircraftState, int | None]:
    """Parse a MSG line; return its state, and when it was written by its writer's clock, ns.

    Raises ``ValueError`` for impossible field values.
    """
    fields = [field.strip() for field in line.split(",")]
    if len(fields) < 10:
        raise ValueError(f"line has {len(fields)} of 22 fields")
    fields += [""] * (22 - len(fields))
    if not re.fullmatch(r"[0-9A-Fa-f]{6}", fields[4]):
        raise ValueError(f"{fields[4]!r:.20} is not an ICAO address")
    age_s, written_ns = _times(fields[6:10])
    state = AircraftState(
        icao=int(fields[4], 16),
        lat_deg=_number(fields[14], -90, 90),
        lon_deg=_number(fields[15], -180, 180),
        altitude_ft=_number(fields[11].removesuffix("H"), -2000, 200_000),
        geometric=fields[11].endswith("H"),
        speed_kt=_number(fields[12], 0, 1200),
        track_deg=_number(fields[13], 0, 360),
        climb_fpm=_number(fields[16], -60_000, 60_000),
        callsign=fields[10],
        age_s=age_s,
    )
    return state, written_ns


def _number(text: str, least: float, most: float) -> float | None:
    """Parse a decimal number; None for an empty field. Raises ``ValueError`` beyond the limits."""
    if not text:
        return None
    if not _NUMBER.fullmatch(text) or not least <= float(text) <= most:
        raise ValueError(f"field {text!r:.20} is not a number from {least:g} to {most:g}")
    return float(text)


def _times(stamps: list[str]) -> tuple[float, int | None]:
    """Return the time from the message to its line, seconds, and that of the line, ns.

    Without valid times: 0 and None.
    """
    try:
        came, written = (
            datetime.strptime(f"{day} {time}", "%Y/%m/%d %H:%M:%S.%f")
            for day, time in (stamps[:2], stamps[2:])
        )
    except ValueError:
        return 0.0, None
    written_us = (written - datetime.min) // timedelta(microseconds=1)
    return max(0.0, (written - came).total_seconds()), written_us * 1000
