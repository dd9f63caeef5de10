"""``aircraft.json`` of readsb and dump1090, converted to one ADSB_VEHICLE per aircraft.

A document holds the whole state of a receiver, written about once a second; it is polled
(``links/http_poll.py``). Its keys: ``README-json.md`` of https://github.com/wiedehopf/readsb.
The age of its positions is known within limits (``document_times``), which the frames state.
Rejected are aircraft whose position others computed (TIS-B, multilateration), because its accuracy
is unknown, and addresses that are not ICAO's (``~``).
"""

import json
import re
from collections import OrderedDict
from typing import Any, Final

from companion.mavlink.wire.document_times import DocumentTimes, Written
from companion.mavlink.wire.foreign import LATE_TEXT, ForeignSplitter, Items
from companion.mavlink.wire.transponder import ADSB_VEHICLE, AircraftState
from companion.values import Reason, Rejection

DOCUMENT_MAX: Final = 8 << 20  # largest document, bytes: some 10 000 aircraft
AIRCRAFT_MAX: Final = 10_000  # most aircraft read from a document, and remembered
HEAD_MAX: Final = 16 << 10  # most bytes of a document without its aircraft
ENTRY_MAX: Final = 8 << 10  # most bytes of an aircraft; readsb writes up to 1.2 kB
AT_ONCE: Final = 8  # aircraft returned by one call; tracking one takes up to 0.3 ms
AGE_ROUNDING_S: Final = 0.05  # largest error of an age in tenths of seconds
TRANSPONDER_LATENCY_S: Final = 0.6
"""Largest age of a position as it is sent (14 CFR 91.227(e), uncompensated latency)."""
_LIST: Final = re.compile(rb'"aircraft"\s*:\s*\[\s*')
_BETWEEN: Final = re.compile(rb"\s*(?:,\s*|\Z)")
_DECODER: Final = json.JSONDecoder()
_ICAO: Final = re.compile(r"[0-9A-Fa-f]{6}")
_NOT_SEEN: Final = ("mlat", "tisb_icao", "tisb_trackfile", "tisb_other", "mode_s", "mode_ac")
"""Types of aircraft that do not report their position themselves."""


class AircraftJson(ForeignSplitter):
    """Converter of documents to frames; ``feed`` takes a whole one and returns what changed.

    It parses ``AT_ONCE`` aircraft, and each call without bytes the next ones, since a document of
    8 MB may take a second. All have the arrival time of their document. ``requested`` is called
    when a document is requested.
    """

    def __init__(self, link: str) -> None:
        super().__init__(link)
        self._times = DocumentTimes()
        self._stated_s = 0.0  # time of the newest document, by its server
        self._written = Written(0, 0)
        self._arrived_ns = 0
        self._rest = b""  # list of the newest document's aircraft
        self._at = self._read = 0  # bytes and aircraft of it that are parsed
        self._true_at: OrderedDict[int, float] = OrderedDict()  # by ICAO address

    @property
    def has_more(self) -> bool:
        """Whether aircraft of the newest document are not processed yet."""
        return bool(self._rest)

    def requested(self, t_ns: int) -> None:
        """Note that a document is requested."""
        self._times.requested(t_ns)

    def feed(self, t_ns: int, data: bytes) -> Items:
        """Read a whole document, or continue with the newest one."""
        is_continued = self._rest and not data
        items = self._parse(t_ns, data) if is_continued else self._parsed(t_ns, data)
        return items + self._garbage(t_ns)

    def _parse(self, t_ns: int, data: bytes) -> Items:
        unplaced = self._begin(t_ns, data) if data or not self._rest else []
        if unplaced:
            return unplaced
        if self._rest and self.skips:  # only then are they counted: it takes milliseconds
            self._is_skipped(_aircraft_in(self._rest, self._at))
            self._rest = b""
            return []
        items: Items = []
        for _ in range(AT_ONCE):
            if not self._rest:
                break
            items += self._next()
        return items

    def _next(self) -> Items:
        """Parse one aircraft; what follows a malformed or endless one is garbage."""
        piece = self._rest[self._at : self._at + ENTRY_MAX]
        try:
            entry, size = _DECODER.raw_decode(piece.decode("latin-1"))  # a character a byte
            between = _BETWEEN.match(self._rest, self._at + size)
            if between is None:
                raise ValueError("no comma")
        except (ValueError, RecursionError):
            self._stray += len(self._rest) - self._at
            self._rest = b""
            return []
        self._at, self._read = between.end(), self._read + 1
        if self._at == len(self._rest) or self._read == AIRCRAFT_MAX:
            self._rest = b""
        return self._one(entry)

    def _begin(self, t_ns: int, data: bytes) -> Items:
        """Read a document; an unusable one is garbage, and one of unknown age is rejected."""
        self._rest, self._at, self._read = b"", 0, 0
        try:
            stated_s, aircraft = _split(data)
        except (ValueError, RecursionError):
            self._stray += len(data) or 1
            return []
        self._complete += 1
        stated_ns = round(stated_s * 1e9)
        is_new = self._times.is_new(stated_ns)
        written = self._times.arrived(t_ns, stated_ns)
        if self._times.is_late:
            self.too_late = f"documents are {LATE_TEXT}"
        if written is not None:
            self._stated_s, self._written, self._arrived_ns = stated_s, written, t_ns
            self._rest = aircraft
        elif is_new and aircraft:
            return [
                Rejection(
                    t_ns=t_ns,
                    source=self.link,
                    reason=Reason.UNPLACED_STAMP,
                    msgid=ADSB_VEHICLE,
                    count=max(1, _aircraft_in(aircraft)),
                    detail="age of the document is unknown",
                )
            ]
        return []

    def _one(self, entry: object) -> Items:
        t_ns = self._arrived_ns
        try:
            message = _aircraft_state(entry)
            position_age_s = _number(entry, "seen_pos", 0, 86_400)
        except (ValueError, OverflowError) as error:
            return self._refused(t_ns, Reason.MALFORMED, str(error), ADSB_VEHICLE)
        if isinstance(message, str):
            return self._refused(t_ns, Reason.UNKNOWN_MESSAGE, message)
        if (
            message is None
            or position_age_s is None
            or not self._is_news(message, self._stated_s - position_age_s)
        ):
            return []
        least_s = (t_ns - self._written.latest_ns) * 1e-9 + position_age_s - AGE_ROUNDING_S
        most_s = (t_ns - self._written.earliest_ns) * 1e-9 + position_age_s + AGE_ROUNDING_S
        age_s = max(0.0, (least_s + most_s) / 2)
        message = message._replace(age_s=age_s, time_error_s=most_s - age_s + TRANSPONDER_LATENCY_S)
        return self._aircraft(t_ns, message)

    def _is_news(self, message: AircraftState, true_at: float) -> bool:
        """Return whether a position is newer than the last read, by ages in tenths of seconds."""
        before = self._true_at.pop(message.icao, None)
        self._true_at[message.icao] = true_at
        if len(self._true_at) > AIRCRAFT_MAX:
            self._true_at.popitem(last=False)
        return before is None or not before - 60 < true_at <= before + 0.15


def _split(data: bytes) -> tuple[float, bytes]:
    """Return a document's time, and the text of the list of its aircraft.

    Raises ``ValueError`` or ``RecursionError`` for anything else.
    """
    found = _LIST.search(data)
    end = data.rfind(b"]")
    if found is None or end < found.end() or len(data) > DOCUMENT_MAX:
        raise ValueError("no aircraft")
    if found.end() + len(data) - end > HEAD_MAX:
        raise ValueError("too long without its aircraft")
    document = json.loads(data[: found.end()] + data[end:])
    if not isinstance(document, dict) or document.get("aircraft") != []:
        raise ValueError("not an object with a list of aircraft")
    stated_s = _number(document, "now", 0, 1e11)
    if stated_s is None:
        raise ValueError("no time")
    return stated_s, data[found.end() : end]


def _aircraft_in(entries: bytes, at: int = 0) -> int:
    """Return the number of aircraft from an index on, without parsing them."""
    return min(entries.count(b'"hex"', at), AIRCRAFT_MAX)


def _aircraft_state(entry: object) -> AircraftState | str | None:
    """Return the state of one aircraft; None without a position; a text if it must be rejected.

    Raises ``ValueError`` for impossible field values.
    """
    if not isinstance(entry, dict):
        raise ValueError("aircraft entry is not a JSON object")
    name = entry.get("hex")
    if not isinstance(name, str) or not _ICAO.fullmatch(name.removeprefix("~")):
        raise ValueError("aircraft has no valid address")
    if name.startswith("~"):
        return "not an ICAO address"
    lat_deg, lon_deg = _number(entry, "lat", -90, 90), _number(entry, "lon", -180, 180)
    if lat_deg is None or lon_deg is None:
        return None
    relayed = [one for key in ("mlat", "tisb") for one in _texts(entry, key)]
    if entry.get("type") in _NOT_SEEN or "lat" in relayed:
        return "position computed by others: its accuracy is not stated"
    if entry.get("alt_baro") == "ground":
        entry = {key: value for key, value in entry.items() if key != "alt_baro"}
    above_ellipsoid = _number(entry, "alt_geom", -2000, 200_000)
    altitude_ft = above_ellipsoid
    if altitude_ft is None:
        altitude_ft = _number(entry, "alt_baro", -2000, 200_000)
    climb_fpm = _number(entry, "geom_rate", -60_000, 60_000)
    if climb_fpm is None:
        climb_fpm = _number(entry, "baro_rate", -60_000, 60_000)
    callsign = entry.get("flight", "")
    return AircraftState(
        icao=int(name, 16),
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        altitude_ft=altitude_ft,
        geometric=above_ellipsoid is not None,
        speed_kt=_number(entry, "gs", 0, 1200),
        track_deg=_number(entry, "track", 0, 360),
        climb_fpm=climb_fpm,
        callsign=callsign.strip() if isinstance(callsign, str) and callsign.isascii() else "",
        nac_p=int(_number(entry, "nac_p", 0, 15) or 0),
        nac_v=int(_number(entry, "nac_v", 0, 7) or 0),
        gva=int(_number(entry, "gva", 0, 3) or 0),
    )


def _number(entry: Any, key: str, least: float, most: float) -> float | None:
    """Return the number under a key; None if absent. Raises ``ValueError`` beyond the limits."""
    value = entry.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise ValueError(f"{key} {value!r:.20} is not a number from {least:g} to {most:g}")
    return float(value)


def _texts(entry: dict[str, Any], key: str) -> list[str]:
    value = entry.get(key)
    return [one for one in value if isinstance(one, str)] if isinstance(value, list) else []
