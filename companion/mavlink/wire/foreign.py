"""Base of the parsers of formats other than MAVLink; each converts its bytes to MAVLink frames."""

from collections.abc import Iterable
from typing import ClassVar, Final

from companion.mavlink.wire.encode import Outgoing, pack
from companion.mavlink.wire.transponder import ADSB_VEHICLE, SENDER, AircraftState
from companion.values import Frame, Reason, Rejection, Source

Items = list[Frame | Rejection]
MLAT: Final = "MLAT position: its accuracy is not stated"
"""Reason for not using a position that receivers computed from arrival times."""
LATE_MAX_NS: Final = 10_000_000_000  # delay beyond which the messages of a stream are not used
LATE_TEXT: Final = "over 10 s later than before, or its clock was set back"
PIECE: Final = 256
"""Bytes parsed at once: as many objects of a few bytes as take about a millisecond."""
PIECES: Final = 4  # most pieces parsed in one call
AT_ONCE: Final = 16  # messages and rejections after which a call ends


class ForeignSplitter:
    """Base of the splitters of other formats, with the interface of ``framing.Splitter``.

    ``unfinished_ns`` is the arrival time of the first bytes since the last complete message; None
    if there are none. A subclass counts each complete message in ``_complete``, unusable ones too.
    While ``skips`` is set, messages are counted in ``skipped`` and not parsed.

    ``feed`` parses a part of many bytes. While ``has_more``, a call without bytes continues.

    ``too_late`` says why the connection must begin anew: its messages are too late to be used.
    ``sender`` is the sender of the frames.
    """

    sender: ClassVar[Source] = SENDER

    def __init__(self, link: str) -> None:
        self.link = link
        self.unfinished_ns: int | None = None
        self.skips = False
        self.skipped = 0
        self.too_late: str | None = None
        self._complete = 0
        self._unread = b""  # received, not parsed yet
        self._is_end = True  # whether the bytes that are parsed are the last that were received
        self._pending = b""  # unfinished message
        self._overlong = False  # whether the rest of a too long line is being skipped
        self._stray = 0  # bytes of garbage that are not reported yet
        self._seq = 0

    @property
    def is_incomplete(self) -> bool:
        """Whether bytes arrived, but no complete message yet."""
        return self.unfinished_ns is not None and not self._complete

    @property
    def has_more(self) -> bool:
        """Whether ``feed`` without bytes parses more of what was received."""
        return bool(self._unread)

    def feed(self, t_ns: int, data: bytes) -> Items:
        """Parse bytes that arrived at ``t_ns``, or a part of them.

        Return the frames and rejections of their messages.
        """
        received, at = self._unread + data, 0
        items: Items = []
        complete = self._complete
        for _ in range(PIECES):
            piece = received[at : at + PIECE]
            at += len(piece)
            self._is_end = at == len(received)
            items += self._parsed(t_ns, piece)
            if self._is_end or len(items) + self._complete - complete >= AT_ONCE:
                break
        self._unread = received[at:]
        return items + self._garbage(t_ns)

    def drop(self) -> None:
        """Drop what was received and is not parsed; for datagrams, which begin with a message."""
        self._unread = self._pending = b""
        self._overlong = False

    def _parsed(self, t_ns: int, data: bytes) -> Items:
        """Parse bytes, and note whether they complete a message."""
        complete = self._complete
        items = self._parse(t_ns, data)
        is_partial = bool(self._pending) or self._overlong
        if self._complete != complete:
            self.unfinished_ns = t_ns if is_partial else None
        elif self.unfinished_ns is None and (is_partial or items or self._stray):
            self.unfinished_ns = t_ns
        return items

    def _parse(self, t_ns: int, data: bytes) -> Items:
        """Return the frames and rejections of bytes; garbage is counted in ``_stray``."""
        raise NotImplementedError

    def _is_skipped(self, messages: int = 1) -> bool:
        """Return whether messages must be skipped, before any work; count them then."""
        if self.skips:
            self.skipped += messages
        return self.skips

    def finish(self, t_ns: int) -> Items:
        """End the stream: an unfinished message counts as garbage."""
        self._stray += len(self._unread) + len(self._pending)
        self.drop()
        self.unfinished_ns = None
        return self._garbage(t_ns)

    def _lines(self, lines: Iterable[bytes], most: int) -> list[bytes]:
        """Return lines of at most ``most`` bytes; longer ones are garbage."""
        kept = []
        for line in lines:
            if self._overlong or len(line) > most:
                self._stray += len(line) + 1
                self._overlong = False
            else:
                kept.append(line)
        return kept

    def _drop_overlong(self, most: int) -> None:
        """Drop an unfinished line of more than ``most`` bytes, as garbage."""
        if len(self._pending) > most:
            self._stray += len(self._pending)
            self._pending, self._overlong = b"", True

    def _garbage(self, t_ns: int) -> Items:
        """Return one rejection for all garbage since the last call."""
        count, self._stray = self._stray, 0
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
