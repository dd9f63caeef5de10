"""Parser of MAVLink 1 and 2 frames: one incremental splitter per peer.

A frame on the wire (https://mavlink.io/en/guide/serialization.html):

    v1   FE len seq sys comp msg              payload crc_lo crc_hi
    v2   FD len incompat compat seq sys comp msg_lo msg_mid msg_hi   payload crc_lo crc_hi [sig 13]

The checksum is CRC-16/MCRF4XX over all but the magic byte, then over one seed byte per message id
(CRC_EXTRA), so a frame of an unknown id cannot be checked and is not trusted.

After a failed frame the search resumes at the next magic byte *inside* its claimed length, never
after it: a damaged length byte would otherwise discard good frames. The claimed length is kept only
so that false starts inside it are not counted as further failures.
"""

import re
from typing import Final, NamedTuple, Self

from fastcrc import crc16

from companion.mavlink.wire.crc_extra import CRC_EXTRA, LONGEST
from companion.values import Frame, Reason, Rejection, Source
from companion.values.budget import Budget

MAGIC_V1: Final = 0xFE
MAGIC_V2: Final = 0xFD
SIGNED: Final = 0x01  # the only incompatibility flag defined; frames with any other must be dropped

SHORTEST: Final = 8  # bytes of a MAVLink 1 frame without a payload
KNOWN_MAX: Final = 8192
"""Most distinct pairs of sender and message that are cached, about 2 MB."""

FALSE_STARTS_PER_S: Final = 20_000.0
"""False starts of frames that a link examines per second, each in a microsecond or two.

Random bytes have one in 130; a stranger's bytes may have one in two.
"""
FALSE_STARTS_SAVED: Final = 2000.0
SKIPPED_AS_ONE: Final = 5  # magic bytes skipped unexamined in the time of a false start

INCOMPLETE: Final = 0
NOT_A_FRAME: Final = -1
UNKNOWN_MESSAGE: Final = -2
BAD_CRC: Final = -3

REASONS: Final = {UNKNOWN_MESSAGE: Reason.UNKNOWN_MESSAGE, BAD_CRC: Reason.BAD_CRC}
_SEED: Final = {msgid: bytes([seed]) for msgid, seed in CRC_EXTRA.items()}
_mcrf4xx = crc16.mcrf4xx
_find_magic = re.compile(b"[\xfd\xfe]").search
_find_start = re.compile(rb"\xfd(?:.[\x00\x01]|.?\Z)|\xfe", re.DOTALL).search


def examine(buffer: bytes, at: int, end: int) -> int:
    """Return the length in bytes of the valid frame at index ``at``, or a verdict of at most 0.

    INCOMPLETE       the bytes so far fit a frame that continues past ``end``
    NOT_A_FRAME      no magic byte, or undefined incompatibility flags
    UNKNOWN_MESSAGE  a message id without a checksum seed
    BAD_CRC          wrong checksum
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
    if magic == MAGIC_V1 and buffer[at + 1] > LONGEST[msgid]:
        return BAD_CRC  # longer than any MAVLink 1 payload; saves the cost of the checksum
    crc = buffer[crc_at] | buffer[crc_at + 1] << 8
    return stop - at if _mcrf4xx(buffer[at + 1 : crc_at] + seed) == crc else BAD_CRC


def claimed_length(buffer: bytes, at: int, end: int) -> int:
    """Return the length in bytes that the frame at index ``at`` claims; 1 if unknown."""
    if end - at < 3 or buffer[at] not in (MAGIC_V1, MAGIC_V2):
        return 1
    if buffer[at] == MAGIC_V1:
        return 8 + buffer[at + 1]
    return 12 + buffer[at + 1] + (13 if buffer[at + 2] & SIGNED else 0)


def is_shaped(raw: bytes) -> bool:
    """Return whether bytes have the start and length of one frame; contents are not checked."""
    return len(raw) >= SHORTEST and claimed_length(raw, 0, len(raw)) == len(raw)


def next_magic(buffer: bytes, at: int, end: int) -> int:
    """Return the index of the next magic byte from index ``at`` on; ``end`` without one."""
    found = _find_magic(buffer, at, end)
    return found.start() if found else end


def _next_start(buffer: bytes, at: int, end: int, claimed_to: int) -> tuple[int, int]:
    """Return the index from ``at`` on where a frame can begin, and the magic bytes skipped.

    The index is ``end`` without one. It skips bytes that cannot start a frame if that does not
    change the counts: undefined flags anywhere, and, within the claim of a failed frame, lengths
    that no MAVLink 1 message has. A flood of magic bytes then costs no more than frames do.
    """
    skipped = 0
    while found := _find_start(buffer, at, end):
        at = found.start()
        inside = at < claimed_to and at + 5 < end and buffer[at] == MAGIC_V1
        if not inside or buffer[at + 1] <= LONGEST[buffer[at + 5]]:
            return at, skipped
        at += 1
        skipped += 1
    return end, skipped


Checked = tuple[Source, int, bytes]
"""Whole frame with a correct checksum: sender, message id, and all of its bytes."""


class Checker:
    """Finder of whole frames in streams, with a cache per sender and message.

    ``at`` handles nearly every MAVLink 2 frame in one step: it looks up the five bytes of sender
    and message together. ``examine`` handles the others.
    """

    def __init__(self) -> None:
        self._known: dict[bytes, tuple[Source, int, bytes]] = {}
        self._sources: dict[tuple[int, int], Source] = {}

    def at(self, buffer: bytes, at: int, end: int) -> Checked | int:
        """Return the frame at an index, or the verdict of ``examine``, at most 0."""
        if end - at >= 12 and buffer[at] == MAGIC_V2 and not buffer[at + 2]:
            known = self._known.get(buffer[at + 5 : at + 10])
            stop = at + 12 + buffer[at + 1]
            if known is not None and stop <= end:
                raw = buffer[at:stop]
                source, msgid, seed = known
                if _mcrf4xx(raw[1:-2] + seed) == raw[-2] | raw[-1] << 8:
                    return source, msgid, raw
                return BAD_CRC
        length = examine(buffer, at, end)
        return self._cache_sender(buffer[at : at + length]) if length > 0 else length

    def _cache_sender(self, raw: bytes) -> Checked:
        if raw[0] == MAGIC_V2:
            ids, msgid = (raw[5], raw[6]), raw[7] | raw[8] << 8 | raw[9] << 16
        else:
            ids, msgid = (raw[3], raw[4]), raw[5]
        if len(self._known) >= KNOWN_MAX:
            self._known.clear()  # both are caches
            self._sources.clear()
        source = self._sources.get(ids)
        if source is None:
            source = self._sources[ids] = Source(*ids)
        if raw[0] == MAGIC_V2:
            self._known[raw[5:10]] = source, msgid, _SEED[msgid]
        return source, msgid, raw


def search_budget() -> Budget:
    """Return the budget of false starts for the peers of one link."""
    return Budget(per_s=FALSE_STARTS_PER_S, most=FALSE_STARTS_SAVED)


class SplitLimits(NamedTuple):
    """Limits on the work for one call of a ``Splitter``.

    search   budget of false starts that are examined; beyond it, the bytes of a call after a false
             start are garbage (None: no limit)
    at_once  frames that a call returns; a call without bytes continues with the same ones
             (None: no limit)
    """

    search: Budget | None = None
    at_once: int | None = None


NO_LIMITS: Final = SplitLimits()


class Splitter:
    """Incremental splitter of one peer's bytes into frames.

    ``wanted`` holds the message ids that are returned (None: all); other frames are only counted.
    Held between calls are one unfinished frame, or what ``limits`` leave for the next call, which
    ``has_more`` announces.
    """

    def __init__(
        self, link: str, wanted: frozenset[int] | None = None, limits: SplitLimits = NO_LIMITS
    ) -> None:
        self.link = link
        self.frames = 0  # frames with a correct checksum, wanted or not
        self.has_more = False
        self._wanted = wanted
        self._limits = limits
        self._pending = b""
        self._claimed = 0  # following bytes within the claimed length of a failed frame
        self._checker = Checker()

    @classmethod
    def sharing(cls, checker: Checker, link: str, limits: SplitLimits = NO_LIMITS) -> Self:
        """Return a splitter that shares a cache of senders, of up to 2 MB, with others."""
        made = cls(link, limits=limits)
        made._checker = checker
        return made

    def feed(self, t_ns: int, data: bytes) -> list[Frame | Rejection]:
        """Parse bytes that arrived at ``t_ns``; return the frames that these bytes complete.

        Other bytes are returned as rejections, one per reason.
        """
        if not self._pending:
            found = self._checker.at(data, 0, len(data)) if data else INCOMPLETE
            if not isinstance(found, int) and len(found[2]) == len(data):  # nearly every datagram
                self.frames += 1
                self._claimed = 0
                wanted = self._wanted is None or found[1] in self._wanted
                source, msgid, raw = found
                return (
                    [Frame(t_ns=t_ns, link=self.link, source=source, msgid=msgid, raw=raw)]
                    if wanted
                    else []
                )
        return self._split(t_ns, self._pending + data if self._pending else data, last=False)

    def finish(self, t_ns: int) -> list[Frame | Rejection]:
        """End the stream: search an unfinished frame for other frames and discard it."""
        return self._split(t_ns, self._pending, last=True)

    def _split(self, t_ns: int, buffer: bytes, *, last: bool) -> list[Frame | Rejection]:
        out: list[Frame | Rejection] = []
        lost: dict[Reason, int] = {}
        link, wanted, frame_at = self.link, self._wanted, self._checker.at
        search, now_s = self._limits.search, t_ns * 1e-9
        most = None if last else self._limits.at_once
        at, end, claimed_to, frames, garbage = 0, len(buffer), self._claimed, 0, 0
        while at < end:
            found = frame_at(buffer, at, end)
            if not isinstance(found, int):
                source, msgid, raw = found
                frames += 1
                at += len(raw)
                claimed_to = at
                if wanted is None or msgid in wanted:
                    out.append(Frame(t_ns=t_ns, link=link, source=source, msgid=msgid, raw=raw))
                    if most is not None and len(out) >= most:
                        break
                continue
            if found == INCOMPLETE and not last:
                break
            if found in REASONS and at >= claimed_to:
                reason = REASONS[found]
                lost[reason] = lost.get(reason, 0) + 1
                claimed_to = at + claimed_length(buffer, at, end)
            resume = end
            if search is None or search.spend(1, now_s):
                resume, skipped = _next_start(buffer, at + 1, end, claimed_to)
                if search is not None and skipped:
                    search.spend(min(skipped / SKIPPED_AS_ONE, search.left), now_s)
            garbage += max(0, resume - max(at, claimed_to))
            at = resume
        self._pending = buffer[at:]
        self.frames += frames
        self.has_more = most is not None and len(out) >= most and at < end
        self._claimed = max(0, claimed_to - at)
        if garbage:
            lost[Reason.GARBAGE] = garbage
        out.extend(
            Rejection(t_ns=t_ns, source=self.link, reason=why, count=count)
            for why, count in lost.items()
        )
        return out
