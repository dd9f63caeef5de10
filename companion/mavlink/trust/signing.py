"""MAVLink 2 message signing of a link with a key: received frames, and those that it sends.

The 13 bytes that follow the checksum of a signed frame
(https://mavlink.io/en/guide/message_signing.html):

    link id     1 byte    one of the sender's links; with the sender's ids it identifies a stream
    timestamp   6 bytes   little-endian, units of 10 µs since 2015-01-01T00:00:00Z
    signature   6 bytes   the first of SHA-256(key + frame, magic byte to timestamp)

**Acceptance.** A frame with a valid signature is accepted if it is newer than the newest accepted
one of its stream. A new stream must be at most a minute behind the local timestamp, which is the
newest of the own clock and all accepted timestamps. A datagram that was overtaken is rejected,
since it cannot be distinguished from a replay. Only accepted frames change any state. So a sender
without the key cannot block a stream by a bad signature with a high timestamp. SETUP_SIGNING is
handled like any other message: keys cannot be changed over the air.

**Several links with one key.** Each link has streams of its own: a router delivers the same signed
frame over two links, with the link id of its sender, and a slow link delivers after a fast one. So
a frame received on one link can be replayed once into another. To be harmless, it must be at most
``BEHIND_MAX`` behind the newest frame of its sender on all of these links: then a report that was
received is dropped as a duplicate, and one that was not is merely late. Links share nothing else.

**Frames of this node** are also a stream of the link. Otherwise, with one key for all, such a frame
sent back to the node would carry a valid signature.

**A wrong clock.** Any holder of the key may send a timestamp far ahead, and the local one follows,
as the standard requires. Streams of other senders continue by their own clocks; those of the sender
that is named in the frame are rejected on all links of the key, also after a restart, until time
has caught up. New streams on this link are rejected until their sender has received a frame of this
node with the high timestamp; a replay is never accepted instead.
``LinkSigning.ahead_ns`` shows it. Timestamps in the last ten years of the 48 bits (to 2104) are not
followed, because one frame could then exhaust all timestamps.

**Memory.** At most ``STREAMS_MAX`` streams are remembered. A new stream replaces the one that has
been silent for longest; from then on new streams must be newer than the forgotten one.

Over 300 lines: what is accepted, and what must be remembered for it, depend on each other.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from hmac import compare_digest
from typing import Final, NamedTuple, Self

from fastcrc import crc16

from companion.mavlink.wire.crc_extra import CRC_EXTRA
from companion.mavlink.wire.framing import MAGIC_V2, SIGNED
from companion.values import Frame, Reason, UserError

KEY_BYTES: Final = 32
EPOCH_NS: Final = 1_420_070_400_000_000_000
"""2015-01-01T00:00:00Z in nanoseconds since the Unix epoch."""
UNIT_NS: Final = 10_000  # nanoseconds per unit of a timestamp
SECOND: Final = 100_000  # units of a timestamp in a second
MINUTE: Final = 60 * SECOND
BEHIND_MAX: Final = 10 * SECOND
"""Largest lag of a frame behind its sender's newest one on any link of the key.

Reports that are later have no use, and duplicates are recognised for longer.
"""
STREAMS_MAX: Final = 4096  # streams remembered per link
LATEST: Final = (1 << 48) - 1  # largest timestamp of 48 bits
FOLLOWED_MAX: Final = LATEST - 3650 * 24 * 60 * MINUTE
"""Largest received timestamp that the local one follows: ten years before ``LATEST``."""
MARGIN: Final = 5 * SECOND
"""Largest lag of a killed process's state on disk: see ``State.after_crash``."""
PACE_WINDOW: Final = 10 * SECOND  # time over which the pace of a stream is measured
FIRST_PACE: Final = SECOND // 2  # time over which a pace is measured at least
COUNTING_MAX: Final = SECOND // 10  # largest pace of timestamps that count frames, units per second
BURST: Final = SECOND
"""Upper limit on frames sent in ``MARGIN``; each takes one time unit if the clock is behind."""

Stream = tuple[int, int, int]  # system id and component id of the sender, and its link id


class StoredStream(NamedTuple):
    """What is stored of a stream.

    newest  its newest timestamp
    lead    how far that was ahead of the own clock when accepted; None for a stream of this node
    pace    units per second by which its timestamps advance, if they count frames; None: they
            follow a clock, or nothing is known
    """

    newest: int
    lead: int | None
    pace: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """Persistent signing state of a link; times in units of 10 µs since 2015."""

    clock: int = 0  # the own clock when this was saved
    local: int = 0  # the local timestamp
    sent: int = 0  # newest timestamp of this node's frames
    floor: int = -1  # new streams must be newer than this
    streams: Mapping[Stream, StoredStream] = field(default_factory=dict)

    def after_crash(self) -> Self:
        """Return the state to resume with if the process ended up to ``MARGIN`` after saving.

        Each stream advances to where its clock was ``MARGIN`` later. Its newest timestamp plus a
        margin would not do: a stream may have been silent for an hour before a frame in the lost
        second. Lost frames of this node were stamped at most ``MARGIN`` ahead of the own clock, or
        of a sender's clock that is ahead of it. Streams that began in the lost time are unknown:
        new streams must be newer than anything this node could have sent. Repeated crashes do not
        accumulate margins of clocks.

        The timestamps of ArduPilot and pymavlink do not follow a clock: they count frames, from a
        time that was received once. Such a sender would need hours to pass a clock's margin. Its
        stream advances by the frames that it sends in ``MARGIN``.

        Not covered: frames accepted in the lost time from a sender whose clock jumped ahead just
        then, that was new and ahead, or that was ahead and returned after a silence longer than
        that; and of a sender that counts frames, those beyond its usual rate. They can be replayed
        until the sender's next frame.
        """
        sent = max(self.sent + BURST, max(self.local, self.clock) + MARGIN)
        streams: dict[Stream, StoredStream] = {}
        for stream, (newest, lead, pace) in self.streams.items():
            if lead is None:
                continue
            if pace is None:
                moved = max(newest, self.clock + lead + MARGIN)
            else:
                moved = newest + pace * MARGIN // SECOND
            moved = min(moved, LATEST)
            streams[stream] = StoredStream(moved, lead, pace)
            if newest > self.clock:
                sent = max(sent, min(moved, FOLLOWED_MAX))
        ours = (stream for stream, known in self.streams.items() if known.lead is None)
        streams.update(dict.fromkeys(ours, StoredStream(sent, None)))
        return type(self)(
            clock=self.clock,
            local=self.local,
            sent=sent,
            floor=max(self.floor, sent),
            streams=streams,
        )


START: Final = State()  # nothing received and nothing sent


@dataclass(slots=True, kw_only=True)
class _OpenStream:
    """A stream while its link is open: fields as in ``StoredStream``.

    Its pace is measured over windows of ``PACE_WINDOW``; during the first one, it is the largest so
    far. ``window`` is the own clock and the stream's timestamp when the current one began; None
    until the stream is heard on this link.
    """

    newest: int
    lead: int | None
    pace: int | None = None
    window: tuple[int, int] | None = None
    is_first_window: bool = True

    def advance(self, stamp: int, lead: int | None, clock: int) -> None:
        """Note a newer timestamp."""
        self.newest, self.lead = stamp, lead
        if self.window is None:
            self.window = clock, stamp
        elapsed = clock - self.window[0]
        if elapsed >= (FIRST_PACE if self.is_first_window else PACE_WINDOW):
            pace = math.ceil((stamp - self.window[1]) * SECOND / elapsed)
            if self.is_first_window and self.pace is not None:
                pace = max(pace, self.pace)  # the stream may begin slowly
            self.pace = pace if pace <= COUNTING_MAX else None
        if elapsed >= PACE_WINDOW:
            self.window, self.is_first_window = (clock, stamp), False


class NewestTimestamps:
    """Newest timestamp of each sender, over any link of one key and any link of the sender."""

    def __init__(self) -> None:
        self._newest: dict[tuple[int, int], int] = {}  # by system id and component id

    def note(self, stream: Stream, stamp: int) -> bool:
        """Note a timestamp; return whether it is at most ``BEHIND_MAX`` behind the newest one."""
        sender = stream[:2]
        newest = self._newest.get(sender, stamp)
        self._newest[sender] = max(newest, stamp)
        return stamp >= newest - BEHIND_MAX

    def note_all(self, state: State) -> None:
        """Note the received streams of an earlier run."""
        for stream, known in state.streams.items():
            if known.lead is not None:
                self.note(stream, known.newest)


def fingerprint(key: bytes) -> str:
    """Return eight hex digits that identify a key and do not reveal it."""
    return sha256(sha256(key).digest()).hexdigest()[:8]


class LinkSigning:
    """Signing state of one link: its key, and the frames received and sent with it.

    key             32 bytes
    link_id         0 to 255, carried by this node's frames; different for each link of one key
    allow_unsigned  accept frames without a signature, including MAVLink 1; signatures must still
                    be valid
    state           the state of an earlier run
    senders         newest timestamp of each sender, which all links with this key share

    Raises ``UserError`` for a key of another length, ``ValueError`` for another link id.
    """

    def __init__(
        self,
        *,
        key: bytes,
        link_id: int,
        allow_unsigned: bool = False,
        state: State = START,
        senders: NewestTimestamps | None = None,
    ) -> None:
        if len(key) != KEY_BYTES:
            raise UserError(f"signing key has {len(key)} bytes; give {KEY_BYTES}")
        if not 0 <= link_id <= 255:
            raise ValueError(f"link id is {link_id}, allowed: 0 to 255")
        self.link_id = link_id
        self.allow_unsigned = allow_unsigned
        self.moves = 0  # number of times the remembered state has changed
        self._key = key
        self._local = state.local
        self._sent = state.sent
        self._floor = state.floor
        self._streams = {
            stream: _OpenStream(newest=newest, lead=lead, pace=pace)
            for stream, (newest, lead, pace) in state.streams.items()
        }
        self._senders = NewestTimestamps() if senders is None else senders
        self._senders.note_all(state)

    def refusal(self, frame: Frame) -> Reason | None:
        """Return the rejection of a frame: UNSIGNED, BAD_SIGNATURE, REPLAYED; None to accept it.

        ``frame.raw`` is a whole frame with a correct checksum; ``frame.t_ns`` is the own clock, ns
        since the Unix epoch. An accepted frame is remembered, so call this once per frame.
        """
        raw = frame.raw
        if raw[0] != MAGIC_V2 or not raw[2] & SIGNED:
            return None if self.allow_unsigned else Reason.UNSIGNED
        if not compare_digest(sha256(self._key + raw[:-6]).digest()[:6], raw[-6:]):
            return Reason.BAD_SIGNATURE
        clock = (frame.t_ns - EPOCH_NS) // UNIT_NS
        stamp = int.from_bytes(raw[-12:-6], "little")
        stream = (raw[5], raw[6], raw[-13])
        known = self._streams.get(stream)
        if stamp <= (self._too_old(clock) if known is None else known.newest):
            return Reason.REPLAYED
        if not self._senders.note(stream, stamp):
            return Reason.REPLAYED
        self._remember(stream, stamp, stamp - clock, clock)
        self._local = max(self._local, min(stamp, FOLLOWED_MAX))
        return None

    def sign(self, raw: bytes, now_ns: int) -> bytes:
        """Sign an unsigned MAVLink 2 frame; ``now_ns`` is the own clock, ns since the Unix epoch.

        The timestamp is that of the clock, or one more than the newest sent or accepted. Raises
        ``ValueError`` for any other frame, ``OverflowError`` from the year 2104 on.
        """
        if raw[0] != MAGIC_V2 or raw[2] != 0:
            raise ValueError("only an unsigned MAVLink 2 frame can be signed")
        body = bytes([raw[1], SIGNED]) + raw[3:-2]
        seed = bytes([CRC_EXTRA[int.from_bytes(raw[7:10], "little")]])
        crc = crc16.mcrf4xx(body + seed).to_bytes(2, "little")
        clock = (now_ns - EPOCH_NS) // UNIT_NS
        stamp = max(clock, self._local + 1, self._sent + 1)
        signed = raw[:1] + body + crc + bytes([self.link_id]) + stamp.to_bytes(6, "little")
        self._remember((raw[5], raw[6], self.link_id), stamp, None, clock)
        self._sent = stamp
        return signed + sha256(self._key + signed).digest()[:6]

    def state(self, now_ns: int) -> State:
        """Return the state to save; ``now_ns`` is the own clock, ns since the Unix epoch."""
        clock = (now_ns - EPOCH_NS) // UNIT_NS
        return State(
            clock=clock,
            local=max(self._local, clock),
            sent=self._sent,
            floor=self._floor,
            streams={
                stream: StoredStream(known.newest, known.lead, known.pace)
                for stream, known in self._streams.items()
            },
        )

    def ahead_ns(self, now_ns: int) -> int:
        """Return how far the local timestamp is ahead of the own clock, ns, at least 0.

        Minutes or more mean that a sender's clock is or was wrong, or the own clock.
        """
        return max(0, self._local * UNIT_NS + EPOCH_NS - now_ns)

    def _too_old(self, clock: int) -> int:
        """Return the newest timestamp that a new stream must exceed."""
        return max(self._floor, max(self._local, clock) - MINUTE - 1)

    def _remember(self, stream: Stream, stamp: int, lead: int | None, clock: int) -> None:
        streams = self._streams
        known = streams.pop(stream, None)
        if known is None:
            if len(streams) >= STREAMS_MAX:
                oldest = next(iter(streams))  # they are in the order of their newest frames
                self._floor = max(self._floor, streams.pop(oldest).newest)
            known = _OpenStream(newest=stamp, lead=lead, window=(clock, stamp))
        else:
            known.advance(stamp, lead, clock)
        streams[stream] = known
        self.moves += 1
