"""Logs of other programs: telemetry logs (.tlog), and raw MAVLink.

A telemetry log (.tlog) has, before every frame, the Unix time in microseconds as eight bytes,
big-endian. Raw MAVLink has no stamps; the sender's boot clock replaces them.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Final, Literal

from companion.mavlink.wire.framing import (
    REASONS,
    Checked,
    Checker,
    Splitter,
    claimed_length,
    examine,
    next_magic,
)
from companion.mavlink.wire.stamps import boot_ms
from companion.recording.stamps import STEP_HOLD_NS, RepairedStamps
from companion.values import Event, Frame, Reason, Rejection, Source

STAMP: Final = 8  # bytes of the stamp before each frame of a telemetry log
_PIECE: Final = 1 << 16
_PAIRS_MIN: Final = 50
_SEARCHED_BYTES: Final = 1 << 26  # bytes of a file that are searched for MAVLink
_TIMED: Final = frozenset((33, 30, 2))
"""Messages whose boot stamps date raw MAVLink: GLOBAL_POSITION_INT, ATTITUDE, SYSTEM_TIME."""
_stamp_us = struct.Struct(">Q").unpack_from
_magics = re.compile(b"[\xfd\xfe]").finditer


# --- detection ----------------------------------------------------------------------------------


def sniff(data: bytes) -> Literal["tlog", "mavlink"] | None:
    """Return the kind of a log, by the bytes between consecutive MAVLink frames.

    None without MAVLink. A single frame counts only at the start of the file, since twenty
    megabytes of noise contain one by chance.
    """
    stamped = bare = 0
    at, end = 0, min(len(data), _SEARCHED_BYTES)
    while at < end and max(stamped, bare) < _PAIRS_MIN:
        at, length = _next_frame(data, at, end)
        after = at + length
        if not length:
            break
        if after < end and examine(data, after, end) > 0:
            bare += 1
        elif after + STAMP < end and examine(data, after + STAMP, end) > 0:
            stamped += 1
        at = after
    if stamped or bare:
        return "tlog" if stamped > bare else "mavlink"
    if data and examine(data, 0, end) > 0:
        return "mavlink"
    return "tlog" if end > STAMP and examine(data, STAMP, end) > 0 else None


def _next_frame(data: bytes, at: int, end: int) -> tuple[int, int]:
    """Return start and length of the first valid frame at or after ``at``; length 0: none."""
    for found in _magics(data, at, end):
        length = examine(data, found.start(), end)
        if length > 0:
            return found.start(), length
    return end, 0


# --- telemetry logs -----------------------------------------------------------------------------


_StampedFrame = tuple[int | None, Checked | None, dict[Reason, int]]
"""Frame of a telemetry log: its stamp, ns; the frame; bytes skipped before it.

The stamp is None without room for one before the frame; the frame is None at the end.
"""


_NOTHING: Final[dict[Reason, int]] = {}


def read_tlog(data: bytes, link: str) -> Iterator[Event]:
    """Yield the events of a telemetry log, on a time line that never steps back or jumps.

    A rejection has the time of the following frame. A frame with a bad stamp is still returned,
    after a rejection for the stamp.
    """
    first = [one[0] for one in islice(_stamped_frames(data), 3) if one[0] is not None]
    timeline = RepairedStamps(first)
    place = timeline.place
    for stamp_ns, frame, lost in _stamped_frames(data):
        off_ns = None if stamp_ns is None else place(stamp_ns)
        t_ns = timeline.t_ns
        if lost:  # seldom
            for reason, count in lost.items():
                yield Rejection(t_ns=t_ns, source=link, reason=reason, count=count)
        if frame is None:
            return
        if off_ns is not None:
            yield _bad_stamp(t_ns, link, off_ns)
        elif stamp_ns is None:
            yield Rejection(t_ns=t_ns, source=link, reason=Reason.BAD_STAMP, detail="no stamp")
        source, msgid, raw = frame
        yield Frame(t_ns=t_ns, link=link, source=source, msgid=msgid, raw=raw)


def _bad_stamp(t_ns: int, link: str, off_ns: int) -> Rejection:
    way = "before" if off_ns < 0 else "after"
    return Rejection(
        t_ns=t_ns,
        source=link,
        reason=Reason.BAD_STAMP,
        detail=f"{abs(off_ns) / 1e9:.6g} s {way} the log's time; the log's time is used",
    )


def _stamped_frames(data: bytes) -> Iterator[_StampedFrame]:
    at, end = 0, len(data)
    frame_at = Checker().at
    while at < end:
        start = at + STAMP
        found = frame_at(data, start, end) if start < end else 0
        if not isinstance(found, int):
            yield _stamp_us(data, at)[0] * 1000, found, _NOTHING
            at = start + len(found[2])
            continue
        start, length = _next_frame(data, at, end)
        stop = max(at, start - STAMP) if length else end
        lost = _skipped(data, at, stop)
        found = frame_at(data, start, end) if length else 0
        if isinstance(found, int):
            yield None, None, lost
            return
        stamped = start - STAMP >= at
        yield _stamp_us(data, start - STAMP)[0] * 1000 if stamped else None, found, lost
        at = start + len(found[2])


def _skipped(data: bytes, at: int, stop: int) -> dict[Reason, int]:
    """Count the contents of [at, stop), which holds no valid frame, as ``Splitter`` does.

    Each invalid frame counts once, including its 8-byte time stamp; other bytes are garbage.
    """
    lost: dict[Reason, int] = {}
    end = len(data)
    while at < stop:
        for start in (at + STAMP, at):
            verdict = examine(data, start, end) if start < stop else 0
            if reason := REASONS.get(verdict):
                lost[reason] = lost.get(reason, 0) + 1
                at = start + claimed_length(data, start, end)
                break
        else:
            resume = min(next_magic(data, at + 1, end), stop)
            lost[Reason.GARBAGE] = lost.get(Reason.GARBAGE, 0) + resume - at
            at = resume
    return lost


# --- raw MAVLink --------------------------------------------------------------------------------


def read_raw(data: bytes, link: str) -> Iterator[Event]:
    """Yield the events of raw MAVLink, timed by the boot clock of the first source that sends one.

    The time starts at the epoch and never steps back; earlier frames get the time of the first
    stamp.
    """
    frames = (event for event in _split(data, link) if isinstance(event, Frame))
    first = next((one for one in frames if _boot_ns(one, one.source) is not None), None)
    clock = None if first is None else first.source
    timeline = RepairedStamps([] if first is None else [_boot_ns(first, clock) or 0])
    for event in _split(data, link):
        stamp_ns = _boot_ns(event, clock) if isinstance(event, Frame) else None
        off_ns = None if stamp_ns is None else timeline.place(stamp_ns)
        # Messages of one sender may be slightly out of order: only more is a bad stamp.
        if off_ns is not None and abs(off_ns) > STEP_HOLD_NS:
            yield _bad_stamp(timeline.t_ns, link, off_ns)
        yield _at(event, timeline.t_ns)


def _split(data: bytes, link: str) -> Iterator[Frame | Rejection]:
    splitter = Splitter(link)
    yield from feed_in_pieces(splitter, 0, data)
    yield from splitter.finish(0)


def feed_in_pieces(splitter: Splitter, t_ns: int, data: bytes) -> Iterator[Frame | Rejection]:
    """Yield what a splitter finds in bytes, in pieces: frames take 20 times their memory."""
    for at in range(0, len(data), _PIECE):
        yield from splitter.feed(t_ns, data[at : at + _PIECE])


def _at(event: Event, t_ns: int) -> Event:
    if isinstance(event, Frame):
        return event._replace(t_ns=t_ns)
    if isinstance(event, Rejection):
        return replace(event, t_ns=t_ns)
    return event


def _boot_ns(frame: Frame, clock: Source | None) -> int | None:
    if frame.msgid not in _TIMED or clock != frame.source:
        return None
    return boot_ms(frame) * 1_000_000
