"""Bytes to frames of MAVLink 1 and 2: one incremental splitter for each peer.

A frame on the wire (https://mavlink.io/en/guide/serialization.html):

    v1   FE len seq sys comp msg              payload crc_lo crc_hi
    v2   FD len incompat compat seq sys comp msg_lo msg_mid msg_hi   payload crc_lo crc_hi [sig 13]

The checksum is CRC-16/MCRF4XX over all but the magic byte, then over one seed byte per message id
(CRC_EXTRA), so a frame of an unknown id cannot be checked and is not trusted.

After a failed frame the search goes on at the next magic byte *inside* what that frame claimed,
never after its claimed length: a damaged length byte would otherwise take good frames with it. The
claimed length is remembered only so that false starts inside it are not counted as further
failures.
"""

import re
from typing import Final

from fastcrc import crc16

from companion.mavlink.wire.crc_extra import CRC_EXTRA
from companion.values import Frame, Reason, Rejection, Source

MAGIC_V1: Final = 0xFE
MAGIC_V2: Final = 0xFD
SIGNED: Final = 0x01
"""The only incompatibility flag defined; frames with any other must be dropped."""

SOURCES_MAX: Final = 1024
"""Distinct senders whose ``Source`` a splitter keeps for reuse."""

INCOMPLETE: Final = 0
NOT_A_FRAME: Final = -1
UNKNOWN_MESSAGE: Final = -2
BAD_CRC: Final = -3

_REASON: Final = {
    UNKNOWN_MESSAGE: Reason.UNKNOWN_MESSAGE,
    BAD_CRC: Reason.BAD_CRC,
}
_SEED: Final = {msgid: bytes([seed]) for msgid, seed in CRC_EXTRA.items()}
_mcrf4xx = crc16.mcrf4xx
_find_magic = re.compile(b"[\xfd\xfe]").search


def examine(buffer: bytes, at: int, end: int) -> int:
    """Length in bytes of the checked frame that starts at ``at``, or a verdict of at most 0.

    INCOMPLETE       the bytes so far fit a frame that goes on past ``end``
    NOT_A_FRAME      no magic byte, or undefined incompatibility flags
    UNKNOWN_MESSAGE  a message id without a checksum seed
    BAD_CRC          the checksum is wrong
    """
    magic = buffer[at]
    if magic == MAGIC_V2:
        if end - at < 10:
            return INCOMPLETE
        flags = buffer[at + 2]
        if flags > SIGNED:
            return NOT_A_FRAME
        msgid = buffer[at + 7] | buffer[at + 8] << 8 | buffer[at + 9] << 16
        crc_at = at + 10 + buffer[at + 1]
        stop = crc_at + (15 if flags else 2)
    elif magic == MAGIC_V1:
        if end - at < 6:
            return INCOMPLETE
        msgid = buffer[at + 5]
        crc_at = at + 6 + buffer[at + 1]
        stop = crc_at + 2
    else:
        return NOT_A_FRAME
    seed = _SEED.get(msgid)
    if seed is None:
        return UNKNOWN_MESSAGE
    if stop > end:
        return INCOMPLETE
    crc = buffer[crc_at] | buffer[crc_at + 1] << 8
    return stop - at if _mcrf4xx(buffer[at + 1 : crc_at] + seed) == crc else BAD_CRC


def claimed_length(buffer: bytes, at: int, end: int) -> int:
    """Length in bytes that the frame at ``at`` claims; 1 where the bytes do not say."""
    if end - at < 3 or buffer[at] not in (MAGIC_V1, MAGIC_V2):
        return 1
    if buffer[at] == MAGIC_V1:
        return 8 + buffer[at + 1]
    return 12 + buffer[at + 1] + (13 if buffer[at + 2] & SIGNED else 0)


def next_magic(buffer: bytes, at: int, end: int) -> int:
    """Index of the next magic byte at or after ``at``; ``end`` when there is none."""
    found = _find_magic(buffer, at, end)
    return found.start() if found else end


class Splitter:
    """Splits one peer's bytes into frames, in whatever pieces they arrive.

    ``wanted`` holds the message ids that are returned (None: all); other frames are only counted.
    At most one unfinished frame is held between calls.
    """

    def __init__(self, link: str, wanted: frozenset[int] | None = None) -> None:
        self.link = link
        self.frames = 0
        """Frames whose checksum held, wanted or not."""
        self._wanted = wanted
        self._pending = b""
        self._claimed = 0  # bytes ahead that a failed frame laid claim to
        self._sources: dict[tuple[int, int], Source] = {}

    def feed(self, t_ns: int, data: bytes) -> list[Frame | Rejection]:
        """Take in bytes that arrived at ``t_ns``; returns the frames that end in them.

        Bytes that were no frame are returned as rejections, one per reason.
        """
        return self._split(t_ns, self._pending + data if self._pending else data, last=False)

    def finish(self, t_ns: int) -> list[Frame | Rejection]:
        """End the stream: an unfinished frame is searched for others and given up."""
        return self._split(t_ns, self._pending, last=True)

    def _split(self, t_ns: int, buffer: bytes, *, last: bool) -> list[Frame | Rejection]:
        out: list[Frame | Rejection] = []
        lost: dict[Reason, int] = {}
        wanted = self._wanted
        at, end, claimed_to = 0, len(buffer), self._claimed
        while at < end:
            length = examine(buffer, at, end)
            if length > 0:
                self.frames += 1
                if wanted is None or self._msgid(buffer, at) in wanted:
                    out.append(self._frame(t_ns, buffer, at, length))
                at += length
                claimed_to = at
                continue
            if length == INCOMPLETE and not last:
                break
            resume = next_magic(buffer, at + 1, end)
            claimed_to = self._count(lost, length, at, resume, claimed_to, buffer)
            at = resume
        self._pending = buffer[at:]
        self._claimed = max(0, claimed_to - at)
        out.extend(Rejection(t_ns, self.link, why, count) for why, count in lost.items())
        return out

    @staticmethod
    def _count(
        lost: dict[Reason, int], verdict: int, at: int, resume: int, claimed_to: int, buffer: bytes
    ) -> int:
        """Count what is skipped from ``at`` to ``resume``.

        Returns how far the claims of failed frames reach.
        """
        reason = _REASON.get(verdict)
        if reason is not None and at >= claimed_to:
            lost[reason] = lost.get(reason, 0) + 1
            claimed_to = at + claimed_length(buffer, at, len(buffer))
        stray = resume - max(at, claimed_to)
        if stray > 0:
            lost[Reason.GARBAGE] = lost.get(Reason.GARBAGE, 0) + stray
        return claimed_to

    @staticmethod
    def _msgid(buffer: bytes, at: int) -> int:
        if buffer[at] == MAGIC_V2:
            return buffer[at + 7] | buffer[at + 8] << 8 | buffer[at + 9] << 16
        return buffer[at + 5]

    def _frame(self, t_ns: int, buffer: bytes, at: int, length: int) -> Frame:
        first = at + 5 if buffer[at] == MAGIC_V2 else at + 3
        ids = (buffer[first], buffer[first + 1])
        source = self._sources.get(ids)
        if source is None:
            if len(self._sources) >= SOURCES_MAX:
                self._sources.clear()  # a cache only: senders are made again when next seen
            source = self._sources.setdefault(ids, Source(*ids))
        return Frame(
            t_ns, self.link, source, self._msgid(buffer, at), bytes(buffer[at : at + length])
        )
