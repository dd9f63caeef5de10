"""What this node tells the others: each report is told once, by whoever is its speaker.

Nodes that hear the same vehicle would all tell the same. So one of them speaks for it, at once; the
others hold what they heard for a moment and tell it only if nobody has. Who had to tell two in a
row becomes the speaker; of two speakers the one whose name comes first stays. No message is needed
for that, and what only one hears is never lost: a vehicle that only B hears has B for its speaker
after two reports.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar

from companion.mavlink.wire.positions import OWN
from companion.pipeline.fleet.reception import VEHICLES_MAX, RecentFrames
from companion.values import Frame, RoundTrip, Shared, SharedFrame, Source

HOLD_NS: Final = (60_000_000, 2_000_000_000)
"""Least and greatest time for which a report is held back: longer than a word from another node."""
HOLD: Final = 1.5  # multiple of the longest way of another's word for which a report is held
HOLD_DECAY: Final = 0.999  # share of that time left after each report that another shared in time
SPEAKER_AFTER: Final = 2
"""Reports in a row that nobody else told, after which this node speaks for the vehicle."""
HELD_MAX: Final = 20_000
"""Frames held back, frames to be told and round trips to be told, of each at most."""
AT_ONCE: Final = 500
"""Most frames, and most round trips, that are told at once; the others come with the next word."""


_T = TypeVar("_T")


@dataclass(slots=True)
class _SpeakerState:
    """A vehicle heard here: when last, whether this node speaks for it, and how many reports in a
    row it told late.
    """

    heard_ns: int
    is_own: bool = False
    late: int = 0


class _Held(NamedTuple):
    due_ns: int
    key: bytes
    frame: Frame


class Sharing:
    """Decide which frames and round trips this node shares with the others.

    ``name`` is this node's; ``every_ns`` is the least time between two messages.

    ``dropped`` counts frames and round trips that were not shared because the queue was full.
    """

    def __init__(self, name: str, every_ns: int = 0) -> None:
        self.dropped = 0
        self._every_ns = every_ns
        self._said_ns = -every_ns
        self._name = name
        self._speakers: dict[Source, _SpeakerState] = {}
        self._hold_ns: float = HOLD_NS[0]
        self._held: deque[_Held] = deque()
        self._by_others = RecentFrames()
        self._by_me = RecentFrames()
        self._frames: deque[SharedFrame] = deque()
        self._trips: deque[RoundTrip] = deque()

    def frame_received(self, now_ns: int, frame: Frame, key: bytes) -> None:
        """Take in a frame heard here, with its content, as it is read.

        It is held from now on and not from when it came: where frames wait to be read, what others
        tell of them waits as well. Else a node that is short of time would tell everybody's
        reports too, and leave the others less.
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
            self._wait(self._held, _Held(now_ns + round(self._hold_ns), key, frame))

    def round_trip_measured(self, trip: RoundTrip) -> None:
        """Take in a round trip with a vehicle for which this node speaks."""
        speaker = self._speakers.get(trip.source)
        if speaker is not None and speaker.is_own:
            self._wait(self._trips, trip)

    def note_shared(self, now_ns: int, node: str, source: Source, key: bytes, way_ns: int) -> None:
        """Note that another node shared a report, and the most that its message took."""
        self._by_others.note(now_ns, key)
        if key in self._by_me:
            speaker = self._speakers.get(source)
            if speaker is not None and node < self._name:
                speaker.is_own, speaker.late = False, 0
            self._hold_ns = min(max(self._hold_ns, HOLD * way_ns), HOLD_NS[1])
        else:
            self._hold_ns = max(HOLD_DECAY * self._hold_ns, HOLD_NS[0])

    def next_message(self, now_ns: int) -> Shared | None:
        """The message to publish now; None if nothing waits, or if the last was just now."""
        self._release_held(now_ns)
        if 0 <= now_ns - self._said_ns < self._every_ns:
            return None
        frames, trips = _first(self._frames), _first(self._trips)
        if not frames and not trips:
            return None
        self._said_ns = now_ns
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
            speaker.is_own = speaker.is_own or speaker.late >= SPEAKER_AFTER
            self._queue_frame(now_ns, key, frame)

    def wait_ns(self, now_ns: int) -> int | None:
        """How long it is until something is to be told; None: nothing is, and nothing is held."""
        if self._frames or self._trips:
            due_ns = self._said_ns + self._every_ns
        elif self._held:
            due_ns = self._held[0].due_ns
        else:
            return None
        return max(due_ns - now_ns, 0)

    def forget(self, now_ns: int, after_ns: int) -> None:
        """Forget vehicles that were not heard here for so long."""
        self._speakers = {k: v for k, v in self._speakers.items() if now_ns - v.heard_ns < after_ns}

    def clear(self) -> None:
        """Forget all: no other node is connected."""
        self._speakers.clear()
        self._held.clear()
        self._frames.clear()
        self._trips.clear()
        self._hold_ns = HOLD_NS[0]

    def _queue_frame(self, now_ns: int, key: bytes, frame: Frame) -> None:
        self._by_me.note(now_ns, key)
        self._wait(self._frames, SharedFrame(frame.t_ns, frame.raw))

    def _wait(self, waiting: deque[_T], one: _T) -> None:
        """Let one more wait; where there is no room the oldest is given up."""
        if len(waiting) >= HELD_MAX:
            waiting.popleft()
            self.dropped += 1
        waiting.append(one)


def _first(waiting: deque[_T]) -> tuple[_T, ...]:
    """Take the first ``AT_ONCE``."""
    return tuple(waiting.popleft() for _ in range(min(AT_ONCE, len(waiting))))
