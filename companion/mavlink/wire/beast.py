"""Beast protocol (port 30005), converted to the ADSB_VEHICLE of a MAVLink receiver.

A message is 0x1a, its kind, six bytes of the receiver's 12 MHz counter, one of signal strength, and
a Mode S message of two (kind 1), seven (2) or fourteen bytes (3); a 0x1a within is doubled. Source:
https://wiki.jetvision.de/wiki/Mode-S_Beast:Data_Output_Formats, and ``net_io.c`` of readsb for kind
4 (status) and 0xe3 (receiver number, of several). ``mode_s`` decodes the fourteen bytes.

The counter gives the age of a message: its delay beyond the least delayed earlier message.
Messages with the counter of multilateration (FF 00 4D 4C 41 54) are rejected, because their
accuracy is unknown.
"""

import re
from typing import Final

from companion.mavlink.wire.foreign import MLAT, ForeignSplitter, Items
from companion.mavlink.wire.mode_s import SIZE, Transponders
from companion.mavlink.wire.stream_lateness import StreamLateness
from companion.values import Reason

_ESCAPE: Final = b"\x1a"
_SIZES: Final = {0x31: 9, 0x32: 14, 0x33: 21, 0x34: 21, 0xE3: 8}  # bytes after a message's kind
_START: Final = re.compile(rb"\x1a(?=[\x31-\x34\xe3])")
_MLAT: Final = b"\xff\x00MLAT"
_TICK_NS: Final = 1000 / 12
_OLDEST_NS: Final = 120_000_000_000  # a counter that is further off was restarted


class BeastSplitter(ForeignSplitter):
    """Converter of the messages of one connection to frames."""

    def __init__(self, link: str) -> None:
        super().__init__(link)
        self._transponders = Transponders()
        self._lateness = StreamLateness(_OLDEST_NS)

    def _parse(self, t_ns: int, data: bytes) -> Items:
        data, at = self._pending + data, 0
        out: Items = []
        while True:
            found = _START.search(data, at)
            if found is None:
                keep = 1 if data.endswith(_ESCAPE) and at < len(data) else 0
                self._stray += len(data) - at - keep
                self._pending = data[len(data) - keep :]
                break
            self._stray += found.start() - at
            at = found.start()
            body, end = _unescaped(data, at + 2, _SIZES[data[at + 1]])
            if body is None and end == len(data):
                self._pending = data[at:]
                break
            if body is None:  # another message begins within this one
                self._stray += end - at
            else:
                self._complete += 1
                out += self._message(t_ns, data[at + 1], body)
            at = end
        return out

    def _message(self, t_ns: int, kind: int, body: bytes) -> Items:
        if kind != 0x33:  # too short to hold a position, or not of an aircraft
            return []
        if self._is_skipped():
            return []
        if body.startswith(_MLAT):
            return self._refused(t_ns, Reason.UNKNOWN_MESSAGE, MLAT)
        late_ns = self._late_ns(t_ns, int.from_bytes(body[:6], "big") * _TICK_NS)
        try:
            state = self._transponders.read(t_ns - late_ns, body[7 : 7 + SIZE])
        except ValueError:
            return self._refused(t_ns, Reason.BAD_CRC, "")
        if state is None:
            return []
        return self._aircraft(t_ns, state._replace(age_s=late_ns * 1e-9))

    def _late_ns(self, t_ns: int, counted_ns: float) -> int:
        """Return the delay of a message; 0 if its counter does not run, or is another one."""
        if counted_ns == 0:
            return 0
        late_ns = self._lateness.observe_ns(t_ns, counted_ns)
        if self._lateness.is_late:
            self._lateness.restart(t_ns - counted_ns)
        return late_ns or 0


def _unescaped(data: bytes, at: int, size: int) -> tuple[bytes | None, int]:
    """Unescape ``size`` message bytes from an index; return them and the index after them.

    The bytes are None if another message begins within them, or if the data end there.
    """
    plain = data[at : at + size]
    if _ESCAPE not in plain:
        return (plain, at + size) if len(plain) == size else (None, len(data))
    body = bytearray()
    while len(body) < size:
        if at >= len(data):
            return None, len(data)
        if data[at] == 0x1A:
            if at + 1 == len(data):
                return None, len(data)
            if data[at + 1] != 0x1A:
                return None, at
            at += 1
        body.append(data[at])
        at += 1
    return bytes(body), at
