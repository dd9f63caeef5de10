"""Sharing of this node's frames with other nodes: one node, the speaker, shares each report.

Several nodes that receive the same vehicle would all share the same reports. So one of them is its
speaker and shares at once; the others hold a report for a moment and share it only if no other node
has. A node that had to do so for two reports in a row becomes a speaker; of two speakers the one
whose name comes first remains. This needs no extra message and loses no report: a vehicle that only
B receives has B as its speaker after two reports.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar

from companion.mavlink.wire.positions import OWN
from companion.pipeline.fleet.reception import VEHICLES_MAX, RecentFrames
from companion.values import Frame, RoundTrip, Shared, SharedFrame, Source

HOLD_NS: Final = (60_000_000, 2_000_000_000)
"""Least and largest time for which a report is held; longer than a message's delay."""
HOLD: Final = 1.5  # hold time as a multiple of the longest message delay
HOLD_DECAY: Final = 0.999  # factor on the hold time after each report shared by another in time
SPEAKER_FRAMES: Final = 2
"""Reports in a row that no other node shared, after which this node becomes the speaker."""
HELD_MAX: Final = 20_000
"""Limit on held frames, on queued frames, and on queued round trips."""
AT_ONCE: Final = 500
"""Limit on frames, and on round trips, per message; the rest follows in the next message."""


_T = TypeVar("_T")


@dataclass(slots=True)
class _SpeakerState:
    """Vehicle received by this node: last reception, speaker, and late reports.

    ``is_own``: this node is the speaker. ``late`` counts reports in a row that this node had to
    share after holding them.
    """

    heard_ns: int
    is_own: bool = False
    late: int = 0


class _Held(NamedTuple):
    due_ns: int
    key: bytes
    frame: Frame


class Sharing:
    """Selection of the frames and round trips that this node shares with the others.

    ``name`` is this node's; ``every_ns`` is the least time between two messages.
    ``dropped`` counts frames and round trips that were not shared because the queue was full.
    """

    def __init__(self, name: str, every_ns: int = 0) -> None:
        self.dropped = 0
        self._every_ns = every_ns
        self._sent_ns = -every_ns
        self._name = name
        self._speakers: dict[Source, _SpeakerState] = {}
        self._hold_ns: float = HOLD_NS[0]
        self._held: deque[_Held] = deque()
        self._by_others = RecentFrames()
        self._shared_by_self = RecentFrames()
        self._frames: deque[SharedFrame] = deque()
        self._trips: deque[RoundTrip] = deque()

    def frame_received(self, now_ns: int, frame: Frame, key: bytes) -> None:
        """Process a frame received by this node, with its content.

        The hold time starts now, not at its arrival: if frames are queued here, so are the other
        nodes' messages. Otherwise an overloaded node would also share what the others have shared,
        and slow them down too.
        """
        speaker = self._speakers.get(frame.source)
        if speaker is None:
            if len(self._speakers) >= VEHICLES_MAX:
                self.dropped += 1
                return
            speaker = self._speakers.setdefault(frame.source, _SpeakerState(frame.t_ns))
        speaker.heard_ns = frame.t_ns
        if speaker.is_own:
            self._queue_frame(frame.t_ns, key, frame)
        elif key in self._by_others:
            speaker.late = 0
        elif frame.msgid in OWN:
            self._enqueue(self._held, _Held(now_ns + round(self._hold_ns), key, frame))

    def round_trip_measured(self, trip: RoundTrip) -> None:
        """Process a round trip; share it if this node is the vehicle's speaker."""
        speaker = self._speakers.get(trip.source)
        if speaker is not None and speaker.is_own:
            self._enqueue(self._trips, trip)

    def note_shared(self, now_ns: int, node: str, source: Source, key: bytes, way_ns: int) -> None:
        """Note that another node shared a report, and the largest delay of its message."""
        self._by_others.note(now_ns, key)
        if key in self._shared_by_self:
            speaker = self._speakers.get(source)
            if speaker is not None and node < self._name:
                speaker.is_own, speaker.late = False, 0
            self._hold_ns = min(max(self._hold_ns, HOLD * way_ns), HOLD_NS[1])
        else:
            self._hold_ns = max(HOLD_DECAY * self._hold_ns, HOLD_NS[0])

    def next_message(self, now_ns: int) -> Shared | None:
        """Return the message to publish now; None if empty, or if the last one is too recent."""
        self._release_held(now_ns)
        if 0 <= now_ns - self._sent_ns < self._every_ns:
            return None
        frames, trips = _first(self._frames), _first(self._trips)
        if not frames and not trips:
            return None
        self._sent_ns = now_ns
        return Shared(now_ns, frames, trips)

    def _release_held(self, now_ns: int) -> None:
        """Drop held frames that another node shared; queue those that none shared in time."""
        while self._held:
            due_ns, key, frame = self._held[0]
            speaker = self._speakers.get(frame.source)
            is_told = speaker is None or key in self._by_others
            if not is_told and now_ns < due_ns:
                return
            self._held.popleft()
            if speaker is None:
                continue
            if is_told:
                speaker.late = 0
                continue
            speaker.late += 1
            speaker.is_own = speaker.is_own or speaker.late >= SPEAKER_FRAMES
            self._queue_frame(now_ns, key, frame)

    def wait_ns(self, now_ns: int) -> int | None:
        """Return the time until the next message; None if nothing is queued or held."""
        if self._frames or self._trips:
            due_ns = self._sent_ns + self._every_ns
        elif self._held:
            due_ns = self._held[0].due_ns
        else:
            return None
        return max(due_ns - now_ns, 0)

    def forget(self, now_ns: int, after_ns: int) -> None:
        """Forget vehicles that this node has not received for a given time."""
        self._speakers = {k: v for k, v in self._speakers.items() if now_ns - v.heard_ns < after_ns}

    def clear(self) -> None:
        """Forget everything, since no other node is connected."""
        self._speakers.clear()
        self._held.clear()
        self._frames.clear()
        self._trips.clear()
        self._hold_ns = HOLD_NS[0]

    def _queue_frame(self, now_ns: int, key: bytes, frame: Frame) -> None:
        self._shared_by_self.note(now_ns, key)
        self._enqueue(self._frames, SharedFrame(frame.t_ns, frame.raw))

    def _enqueue(self, waiting: deque[_T], one: _T) -> None:
        """Add to a queue of frames or round trips; drop its oldest entry if it is full."""
        if len(waiting) >= HELD_MAX:
            waiting.popleft()
            self.dropped += 1
        waiting.append(one)


def _first(waiting: deque[_T]) -> tuple[_T, ...]:
    """Remove and return the first ``AT_ONCE`` entries of a queue."""
    return tuple(waiting.popleft() for _ in range(min(AT_ONCE, len(waiting))))
