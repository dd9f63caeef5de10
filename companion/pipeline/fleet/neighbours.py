"""Other nodes, and their clocks on this node's timeline.

Each node's timeline is its own. A question sent at s and answered at r, with the other clock's
reading x in between, proves that

    s - x  <=  this timeline less the other  <=  r - x

(docs/math.md 6). What the other heard is put at the latest time at which it can have been, with
the width of that interval as its doubt: "arrived by then" stays true whatever the clocks do within
their drift.
"""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

from companion.mavlink.clock.evidence import DriftProven, Interval, OffsetEvidence
from companion.values import Offer, RoundTrip, Standing

DRIFT_MAX: Final = 200e-6
"""Greatest drift between two nodes' clocks, a ratio: two ordinary crystals, disciplined or not."""
ANSWERS: Final = 3
"""Answers from which on what a node hears is used: the first, slow one would leave its doubt."""
DELAYS_KEPT: Final = 4096
DELAYS_WINDOW_NS: Final = 60_000_000_000  # time for which the delay of a report is remembered
NOTICED_OFFSET_NS: Final = 100_000_000
"""Difference of two nodes' clocks from which on it is told: with NTP there is none."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """By how much this node's timeline is ahead of another's: an interval, ns."""

    low_ns: int
    high_ns: int

    @property
    def width_ns(self) -> int:
        """The width of the interval."""
        return self.high_ns - self.low_ns


class NeighbourClock:
    """The clock of one other node."""

    def __init__(self) -> None:
        self._evidence = OffsetEvidence(DRIFT_MAX)
        self._newest_ns: int | None = None
        self._answers = 0

    def note_answer(self, sent_ns: int, received_ns: int, remote_ns: int) -> DriftProven | None:
        """Take in a reading of the other clock; returns what it contradicts, None where nothing."""
        self._newest_ns = remote_ns
        self._answers += 1
        return self._evidence.add(Interval(remote_ns, sent_ns - remote_ns, received_ns - remote_ns))

    @property
    def is_settled(self) -> bool:
        """Whether frames can be placed by it; a sender's clock keeps the doubt of the worst."""
        return self._answers >= ANSWERS

    def offset(self, remote_ns: int) -> ClockOffset | None:
        """What is known at a time of the other node; None before the first answer."""
        known = self._evidence.at(remote_ns)
        return (
            None
            if known is None
            else ClockOffset(math.floor(known.low_ns), math.ceil(known.high_ns))
        )

    def newest_offset(self) -> ClockOffset | None:
        """What was known at the newest answer; None before the first."""
        return None if self._newest_ns is None else self.offset(self._newest_ns)


@dataclass(slots=True, kw_only=True)
class Neighbour:
    """Another node, as it is known here."""

    clock: NeighbourClock  # its clock
    started_ns: int | None = None
    standing: Standing | None = None  # what it said last of itself; None before it did
    heard_ns: int = 0  # when there was word of it last
    offered_ns: int = 0
    offers: dict[str, Offer] | None = None  # its offers by UAV
    frames: int = 0  # frames that it told, used those that the pipeline had
    used: int = 0
    apart_told: bool = False
    _delays_ns: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=DELAYS_KEPT))

    def note_delay(self, now_ns: int, way_ns: int) -> None:
        """Note the most that a report from this node was on its way."""
        self._delays_ns.append((now_ns, way_ns))

    def delays_ns(self, now_ns: int) -> list[int]:
        """The most that each recent report was on its way."""
        oldest_ns = now_ns - DELAYS_WINDOW_NS
        return [way_ns for came_ns, way_ns in self._delays_ns if came_ns > oldest_ns]


def here(trip: RoundTrip, clock: NeighbourClock) -> RoundTrip | None:
    """A round trip of another node on this node's timeline, not shorter than it was.

    None while that node's clock is not known.
    """
    sent, received = clock.offset(trip.sent_ns), clock.offset(trip.t_ns)
    if sent is None or received is None:
        return None
    return RoundTrip(
        t_ns=trip.t_ns + received.high_ns,
        source=trip.source,
        sent_ns=trip.sent_ns + sent.low_ns,
        remote_ns=trip.remote_ns,
    )
