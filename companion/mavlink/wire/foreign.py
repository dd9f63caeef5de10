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
    """Base of the splitters of other formats, with the interface of ``framing.Splitter``.

    ``unfinished_ns`` is the arrival time of the first bytes since the last complete message; None
    if there are none. A subclass counts each complete message in ``_complete``, unusable ones too.
    While ``skips`` is set, messages are counted in ``skipped`` and not parsed.
    """

    def __init__(self, link: str) -> None:
        self.link = link
        self.unfinished_ns: int | None = None
        self.skips = False
        self.skipped = 0
        self._complete = 0
        self._pending = b""  # unfinished message
        self._overlong = False  # whether the rest of a too long line is being skipped
        self._seq = 0

    @property
    def is_incomplete(self) -> bool:
        """Whether bytes arrived, but no complete message yet."""
        return self.unfinished_ns is not None and not self._complete

    @property
    def has_more(self) -> bool:
        """Whether ``feed`` without bytes returns more of the same message."""
        return False

    def feed(self, t_ns: int, data: bytes) -> Items:
        """Parse bytes that arrived at ``t_ns``.

        Return the frames and rejections of their messages.
        """
        if not data and self.has_more:
            return self._parse(t_ns, data)
        complete = self._complete
        items = self._parse(t_ns, data)
        is_partial = bool(self._pending) or self._overlong
        if self._complete != complete:
            self.unfinished_ns = t_ns if is_partial else None
        elif self.unfinished_ns is None and (is_partial or items):  # partial, or only garbage
            self.unfinished_ns = t_ns
        return items

    def _parse(self, t_ns: int, data: bytes) -> Items:
        raise NotImplementedError

    def _is_skipped(self, messages: int = 1) -> bool:
        """Return whether messages must be skipped, before any work; count them then."""
        if self.skips:
            self.skipped += messages
        return self.skips

    def finish(self, t_ns: int) -> Items:
        """End the stream: an unfinished message counts as garbage."""
        stray, self._pending, self._overlong = len(self._pending), b"", False
        self.unfinished_ns = None
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
        try:
            payload = state.payload()
        except ValueError as error:
            return self._refused(t_ns, Reason.MALFORMED, str(error), ADSB_VEHICLE)
        return (
            [] if payload is None else [self._frame(t_ns, Outgoing(SENDER, ADSB_VEHICLE, payload))]
        )
