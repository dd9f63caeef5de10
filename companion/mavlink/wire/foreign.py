"""Base of the parsers of formats other than MAVLink; each converts its bytes to MAVLink frames."""

from collections.abc import Iterable
from typing import Final

from companion.mavlink.wire.encode import Outgoing, pack
from companion.mavlink.wire.transponder import ADSB_VEHICLE, SENDER, AircraftState
from companion.values import Frame, Reason, Rejection

Items = list[Frame | Rejection]
MLAT: Final = "MLAT position: its accuracy is not stated"
"""Reason for not using a position that receivers computed from arrival times."""


class ForeignSplitter:
    """Base of the splitters of other formats, with the interface of ``framing.Splitter``."""

    def __init__(self, link: str) -> None:
        self.link = link
        self._pending = b""  # unfinished message
        self._overlong = False  # whether the rest of a too long line is being skipped
        self._seq = 0

    def finish(self, t_ns: int) -> Items:
        """End the stream: an unfinished message counts as garbage."""
        stray, self._pending, self._overlong = len(self._pending), b"", False
        return self._garbage(t_ns, stray)

    def _lines(self, lines: Iterable[bytes], most: int) -> tuple[list[bytes], int]:
        """Return lines of at most ``most`` bytes, and the number of bytes of the longer ones."""
        kept, garbage = [], 0
        for line in lines:
            if self._overlong or len(line) > most:
                garbage += len(line) + 1
                self._overlong = False
            else:
                kept.append(line)
        return kept, garbage

    def _drop_overlong(self, most: int) -> int:
        """Drop an unfinished line of more than ``most`` bytes. Return the bytes dropped so far."""
        if len(self._pending) <= most:
            return 0
        stray, self._pending, self._overlong = len(self._pending), b"", True
        return stray

    def _garbage(self, t_ns: int, count: int) -> Items:
        if not count:
            return []
        return [Rejection(t_ns=t_ns, source=self.link, reason=Reason.GARBAGE, count=count)]

    def _refused(self, t_ns: int, reason: Reason, detail: str, msgid: int | None = None) -> Items:
        return [Rejection(t_ns=t_ns, source=self.link, reason=reason, msgid=msgid, detail=detail)]

    def _frame(self, t_ns: int, message: Outgoing) -> Frame:
        raw = pack(message, self._seq)
        self._seq = (self._seq + 1) & 0xFF
        return Frame(t_ns=t_ns, link=self.link, source=message.source, msgid=message.msgid, raw=raw)

    def _aircraft(self, t_ns: int, state: AircraftState) -> Items:
        """Return the ADSB_VEHICLE of an aircraft's state; no frame if nothing is known."""
        payload = state.payload()
        return (
            [] if payload is None else [self._frame(t_ns, Outgoing(SENDER, ADSB_VEHICLE, payload))]
        )
