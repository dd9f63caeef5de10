"""MAVLink frames from packets: network captures, and MCAP files of other programs.

Each flow of packets has its own splitter, like each peer of a live link; TCP segments are put in
order first. In an MCAP, channels whose encoding, schema or topic contains "mavlink" are searched
for frames; other bytes in their messages are ignored.
"""

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from companion.mavlink.wire.framing import Checker, Splitter
from companion.recording.container import Message, Walk
from companion.recording.foreign.packets import Fragment, Segment, Skipped, packets, segment
from companion.recording.stamps import STEP_HOLD_NS, RepairedStamps
from companion.recording.tlog import feed_in_pieces
from companion.values import Event, Frame, Reason, Rejection

_FLOWS_MAX: Final = 512
"""Limit on concurrent flows of packets; beyond it, the least recently active flow is ended."""
_AHEAD_MAX: Final = 64
"""Limit on TCP segments that wait for a missing one, which then counts as lost."""
WAITING_BYTES: Final = 1 << 25
"""Limit on all segments that wait; beyond it, the least recently active flow is ended."""
_MAGICS: Final = (b"\xfd", b"\xfe")


def read_capture(path: Path) -> Iterator[Event]:
    """Yield the events of a capture.

    Each flow is a link, such as ``udp:10.0.0.2:14555>10.0.0.1:14550``. Flows without a frame return
    nothing. Raises ``OSError`` if the file cannot be read.
    """
    flows: OrderedDict[str, _Flow] = OrderedDict()
    waiting_bytes = fragment_bytes = 0
    checker = Checker()
    timeline: RepairedStamps | None = None
    with path.open("rb") as file:
        for packet in packets(file):
            if isinstance(packet, Skipped):
                t_ns = 0 if timeline is None else timeline.t_ns
                yield Rejection(
                    t_ns=t_ns, source=path.name, reason=Reason.GARBAGE, count=packet.size_bytes
                )
                continue
            found = segment(packet)
            if isinstance(found, Fragment):
                fragment_bytes += found.size_bytes
                continue
            if found is None or not (found.payload or found.tcp_syn):
                continue
            if timeline is None:
                timeline = RepairedStamps([packet.t_ns])
            off_ns = timeline.place(packet.t_ns)
            flow = flows.get(found.flow)
            if flow is None:
                flow = flows.setdefault(found.flow, _Flow(found.flow, checker))
            flows.move_to_end(found.flow)
            waiting_bytes -= flow.waiting_bytes
            data = flow.in_order(found)
            waiting_bytes += flow.waiting_bytes
            while len(flows) > _FLOWS_MAX or waiting_bytes > WAITING_BYTES:
                _, oldest = flows.popitem(last=False)
                waiting_bytes -= oldest.waiting_bytes
                yield from oldest.finish(timeline.t_ns)
            for event in flow.frames(timeline.t_ns, data):
                if off_ns is not None and abs(off_ns) > STEP_HOLD_NS:
                    yield _bad_stamp(timeline.t_ns, found.flow, off_ns)
                off_ns = None
                yield event
    t_ns = 0 if timeline is None else timeline.t_ns
    for flow in flows.values():
        yield from flow.finish(t_ns)
    if fragment_bytes:
        yield _lost(t_ns, path.name, fragment_bytes, "fragments of IP packets")


def _lost(t_ns: int, source: str, size_bytes: int, detail: str) -> Rejection:
    return Rejection(
        t_ns=t_ns, source=source, reason=Reason.GARBAGE, count=size_bytes, detail=detail
    )


def _bad_stamp(t_ns: int, link: str, off_ns: int) -> Rejection:
    way = "before" if off_ns < 0 else "after"
    detail = f"{abs(off_ns) / 1e9:.6g} s {way} the log's time; the log's time is used"
    return Rejection(t_ns=t_ns, source=link, reason=Reason.BAD_STAMP, detail=detail)


class _Flow:
    """Flow of packets, and the MAVLink frames in it; nothing is returned before its first frame."""

    def __init__(self, name: str, checker: Checker) -> None:
        self._splitter = Splitter.sharing(checker, name)
        self._next: int | None = None
        self._ahead: dict[int, bytes] = {}
        self._name = name
        self._missing_bytes = 0

    @property
    def waiting_bytes(self) -> int:
        """Size of the segments that wait for a missing one."""
        return sum(map(len, self._ahead.values()))

    def frames(self, t_ns: int, data: bytes) -> Iterator[Frame | Rejection]:
        """Yield the frames that end in some bytes of this flow."""
        for event in feed_in_pieces(self._splitter, t_ns, data):
            if self._splitter.frames:
                yield event

    def finish(self, t_ns: int) -> Iterator[Frame | Rejection]:
        """Yield the remaining frames when the flow ends, and what the capture lacks of it."""
        for seq in sorted(self._ahead, key=self._distance):
            self._note_gap(seq)
            data = self._ahead.pop(seq)
            self._next = (seq + len(data)) & 0xFFFF_FFFF
            yield from self.frames(t_ns, data)
        last = self._splitter.finish(t_ns)
        if self._splitter.frames:
            yield from last
            if self._missing_bytes:
                yield _lost(t_ns, self._name, self._missing_bytes, "missing in the capture")

    def in_order(self, found: Segment) -> bytes:
        """Return the next bytes in TCP order: repeated ones are dropped, later ones wait."""
        seq = found.tcp_seq
        if seq is None:
            return found.payload
        if found.tcp_syn:
            self._next = (seq + 1) & 0xFFFF_FFFF
            self._ahead.clear()
            return b""
        if self._next is None:
            self._next = seq
        if len(found.payload) > len(self._ahead.get(seq, b"")):
            self._ahead[seq] = found.payload
        if len(self._ahead) > _AHEAD_MAX and not self._ready():
            first = min(self._ahead, key=self._distance)
            self._note_gap(first)
            self._next = first
        handed = []
        while ready := self._ready():
            first = min(ready, key=self._distance)
            fresh = self._ahead.pop(first)[-self._distance(first) :]
            handed.append(fresh)
            self._next = (self._next + len(fresh)) & 0xFFFF_FFFF
        return b"".join(handed)

    def _note_gap(self, seq: int) -> None:
        """Count the bytes before a segment that the capture lacks."""
        self._missing_bytes += max(0, self._distance(seq))

    def _ready(self) -> list[int]:
        return [seq for seq in self._ahead if self._distance(seq) <= 0]

    def _distance(self, seq: int) -> int:
        """Return how far a TCP sequence number is ahead of the next expected one, modulo 2^32."""
        assert self._next is not None
        return (seq - self._next + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000


# --- MCAP of other programs -----------------------------------------------------------------------


def read_mcap(path: Path) -> Iterator[Event]:
    """Yield the frames in the MAVLink channels of an MCAP file of another program.

    Each link is a topic. Raises ``OSError`` if the file cannot be read.
    """
    timeline: RepairedStamps | None = None
    splitters: dict[int, Splitter | None] = {}
    checker = Checker()
    walk = Walk(path)
    for content in walk:
        if not isinstance(content, Message):
            continue
        channel = content.channel
        if channel.id not in splitters:
            schema = walk.schemas.get(channel.schema_id)
            said = (channel.topic, channel.message_encoding, schema.name if schema else "")
            speaks = any("mavlink" in word.lower() for word in said)
            splitters[channel.id] = Splitter.sharing(checker, channel.topic) if speaks else None
        splitter = splitters[channel.id]
        if splitter is None or not any(magic in content.data for magic in _MAGICS):
            continue
        if timeline is None:
            timeline = RepairedStamps([content.log_time_ns])
        timeline.place(content.log_time_ns)
        found = feed_in_pieces(splitter, timeline.t_ns, content.data)
        yield from filter(_is_frame, found)
        yield from filter(_is_frame, splitter.finish(timeline.t_ns))
    if walk.lost_bytes:
        t_ns = 0 if timeline is None else timeline.t_ns
        yield Rejection(t_ns=t_ns, source=path.name, reason=Reason.GARBAGE, count=walk.lost_bytes)


def _is_frame(event: Frame | Rejection) -> bool:
    """Return whether an event is a frame, valid or not, rather than bytes around one."""
    if isinstance(event, Frame):
        return True
    return event.reason in (Reason.BAD_CRC, Reason.UNKNOWN_MESSAGE)
