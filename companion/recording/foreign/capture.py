"""MAVLink frames from packets: network captures, and MCAP files of other programs.

Each flow of packets has its own splitter, like each peer of a live link; TCP segments are put in
order first. In an MCAP, channels whose encoding, schema or topic contains "mavlink" are searched
for frames; other bytes in their messages are ignored.
"""

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from companion.mavlink.wire.framing import Splitter
from companion.recording.container import Message, Walk
from companion.recording.foreign.packets import Segment, Skipped, packets, segment
from companion.recording.stamps import STEP_HOLD_NS, RepairedStamps
from companion.values import Event, Frame, Reason, Rejection

_FLOWS_MAX: Final = 512
"""Limit on concurrent flows of packets; beyond it, the least recently active flow is ended."""
_AHEAD_MAX: Final = 64
"""Limit on TCP segments that wait for a missing one, which then counts as lost."""
_MAGICS: Final = (b"\xfd", b"\xfe")


def read_capture(path: Path) -> Iterator[Event]:
    """Yield the events of a capture.

    Each flow is a link, such as ``udp:10.0.0.2:14555>10.0.0.1:14550``. Flows without a frame return
    nothing. Raises ``OSError`` if the file cannot be read.
    """
    flows: OrderedDict[str, _Flow] = OrderedDict()
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
            if found is None or not (found.payload or found.tcp_syn):
                continue
            if timeline is None:
                timeline = RepairedStamps([packet.t_ns])
            off_ns = timeline.place(packet.t_ns)
            flow = flows.get(found.flow)
            if flow is None:
                flow = flows.setdefault(found.flow, _Flow(found.flow))
                if len(flows) > _FLOWS_MAX:
                    _, oldest = flows.popitem(last=False)
                    yield from oldest.finish(timeline.t_ns)
            flows.move_to_end(found.flow)
            events = flow.take(timeline.t_ns, found)
            if events and off_ns is not None and abs(off_ns) > STEP_HOLD_NS:
                way = "before" if off_ns < 0 else "after"
                detail = f"{abs(off_ns) / 1e9:.6g} s {way} the log's time; the log's time is used"
                yield Rejection(
                    t_ns=timeline.t_ns, source=found.flow, reason=Reason.BAD_STAMP, detail=detail
                )
            yield from events
    for flow in flows.values():
        yield from flow.finish(0 if timeline is None else timeline.t_ns)


class _Flow:
    """Flow of packets, and the MAVLink frames in it; nothing is returned before its first frame."""

    def __init__(self, name: str) -> None:
        self._splitter = Splitter(name)
        self._next: int | None = None
        self._ahead: dict[int, bytes] = {}

    def take(self, t_ns: int, found: Segment) -> list[Frame | Rejection]:
        """Return the frames that end in a packet of this flow."""
        if found.tcp_seq is None:
            whole = self._splitter.feed(t_ns, found.payload)
            return self._frames_only(whole)
        return self._frames_only(self._splitter.feed(t_ns, self._in_order(found, found.tcp_seq)))

    def finish(self, t_ns: int) -> list[Frame | Rejection]:
        """Return the remaining frames when the flow ends."""
        rest = b"".join(self._ahead[seq] for seq in sorted(self._ahead))
        self._ahead.clear()
        return self._frames_only([*self._splitter.feed(t_ns, rest), *self._splitter.finish(t_ns)])

    def _frames_only(self, events: list[Frame | Rejection]) -> list[Frame | Rejection]:
        return events if self._splitter.frames else []

    def _in_order(self, found: Segment, seq: int) -> bytes:
        """Return the next bytes in TCP order: repeated ones are dropped, later ones wait."""
        if found.tcp_syn:
            self._next = (seq + 1) & 0xFFFF_FFFF
            self._ahead.clear()
            return b""
        if self._next is None:
            self._next = seq
        if len(found.payload) > len(self._ahead.get(seq, b"")):
            self._ahead[seq] = found.payload
        if len(self._ahead) > _AHEAD_MAX and not self._ready():
            self._next = min(self._ahead, key=self._distance)
        handed = []
        while ready := self._ready():
            first = min(ready, key=self._distance)
            fresh = self._ahead.pop(first)[-self._distance(first) :]
            handed.append(fresh)
            self._next = (self._next + len(fresh)) & 0xFFFF_FFFF
        return b"".join(handed)

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
    walk = Walk(path)
    for content in walk:
        if not isinstance(content, Message):
            continue
        channel = content.channel
        if channel.id not in splitters:
            schema = walk.schemas.get(channel.schema_id)
            said = (channel.topic, channel.message_encoding, schema.name if schema else "")
            speaks = any("mavlink" in word.lower() for word in said)
            splitters[channel.id] = Splitter(channel.topic) if speaks else None
        splitter = splitters[channel.id]
        if splitter is None or not any(magic in content.data for magic in _MAGICS):
            continue
        if timeline is None:
            timeline = RepairedStamps([content.log_time_ns])
        timeline.place(content.log_time_ns)
        found = [*splitter.feed(timeline.t_ns, content.data), *splitter.finish(timeline.t_ns)]
        yield from (event for event in found if isinstance(event, Frame) or _is_frame(event))
    if walk.lost_bytes:
        t_ns = 0 if timeline is None else timeline.t_ns
        yield Rejection(t_ns=t_ns, source=path.name, reason=Reason.GARBAGE, count=walk.lost_bytes)


def _is_frame(refused: Rejection) -> bool:
    """Return whether rejected bytes were a MAVLink frame, rather than bytes around one."""
    return refused.reason in (Reason.BAD_CRC, Reason.UNKNOWN_MESSAGE)
