"""Other nodes, and their clocks on this node's timeline.

Each node has its own timeline. A request sent at s and answered at r, with the other clock's
reading x in between, proves that

    s - x  <=  this timeline less the other  <=  r - x

(docs/math.md 6). Frames received by the other node are placed at the latest possible time, with the
width of the interval as uncertainty: "arrived by then" stays true for any clock drift within the
limit.
"""

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Final

from companion.mavlink.clock.evidence import DriftProven, Interval, OffsetEvidence
from companion.pipeline.fleet.assignment import offer_values_db
from companion.values import Offer, RoundTrip, Standing

DRIFT_MAX: Final = 200e-6
"""Largest drift between two nodes' clocks, a ratio: two ordinary crystals, disciplined or not."""
ANSWERS: Final = 3
"""Clock answers after which a node's frames are used: a sender's clock keeps its largest doubt, and
the first answer is slow."""
OLDEST_NS: Final = 600_000_000_000
"""Largest age of what another node shares. Times before 1970 cannot be recorded at all, and frames
whose arrival is uncertain by an hour are read back as damage."""
DELAYS_KEPT: Final = 4096
DELAYS_WINDOW_NS: Final = 60_000_000_000  # time for which delays of reports are kept
NOTICED_OFFSET_NS: Final = 100_000_000
"""Clock offset between two nodes above which a notice is published; NTP keeps it smaller."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Clock offset, this node's timeline less another's: an interval, ns."""

    low_ns: int
    high_ns: int

    @property
    def width_ns(self) -> int:
        """Width of the clock offset's interval, ns."""
        return self.high_ns - self.low_ns


class NeighbourClock:
    """Clock of one other node, on this node's timeline."""

    def __init__(self) -> None:
        self._evidence = OffsetEvidence(DRIFT_MAX)
        self._newest_ns: int | None = None
        self._answers = 0

    def note_answer(self, sent_ns: int, received_ns: int, remote_ns: int) -> DriftProven | None:
        """Process a reading of the other clock; return the contradiction it proves, or None."""
        self._newest_ns = remote_ns
        self._answers += 1
        return self._evidence.add(Interval(remote_ns, sent_ns - remote_ns, received_ns - remote_ns))

    @property
    def is_settled(self) -> bool:
        """Whether the clock is known well enough to place frames in time."""
        return self._answers >= ANSWERS

    def offset(self, remote_ns: int) -> ClockOffset | None:
        """Return the clock offset at a time of the other node; None before the first answer."""
        known = self._evidence.at(remote_ns)
        return (
            None
            if known is None
            else ClockOffset(math.floor(known.low_ns), math.ceil(known.high_ns))
        )

    def newest_offset(self) -> ClockOffset | None:
        """Return the clock offset at the newest answer; None before the first answer."""
        return None if self._newest_ns is None else self.offset(self._newest_ns)


@dataclass(slots=True, kw_only=True)
class Neighbour:
    """State of another node of the fleet."""

    clock: NeighbourClock
    started_ns: int | None = None
    standing: Standing | None = None  # its newest standing; None before the first
    heard_ns: int = 0  # time of its newest message
    offered_ns: int = 0
    offers: dict[str, Offer] | None = None  # its offers by UAV
    values_db: dict[str, float] = field(default_factory=dict)  # of these offers, by UAV
    frames: int = 0  # frames that it shared
    used: int = 0  # those of them that the pipeline used
    apart_told: bool = False
    _delays_ns: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=DELAYS_KEPT))

    @property
    def standing_uavs(self) -> int:
        """Number of UAVs in its standing."""
        return 0 if self.standing is None else uavs_in(self.standing)

    @property
    def offered_uavs(self) -> int:
        """Number of UAVs in its offers."""
        return 0 if self.offers is None else len(self.offers)

    def take_offers(self, now_ns: int, offers: tuple[Offer, ...]) -> None:
        """Replace its offers."""
        self.offers = {offer.uav: offer for offer in offers}
        self.values_db = offer_values_db(self.offers)
        self.offered_ns = now_ns

    def drop_offers(self) -> None:
        """Forget its offers, which are no longer updated."""
        self.offers, self.values_db = None, {}

    def note_delay(self, now_ns: int, way_ns: int) -> None:
        """Note the largest possible delay of a report from the other node."""
        self._delays_ns.append((now_ns, way_ns))

    def delays_ns(self, now_ns: int) -> list[int]:
        """Return the largest possible delays of recent reports."""
        oldest_ns = now_ns - DELAYS_WINDOW_NS
        return [way_ns for came_ns, way_ns in self._delays_ns if came_ns > oldest_ns]


def uavs_in(said: Standing) -> int:
    """Return the number of UAVs in a node's standing; those handed over count twice."""
    return len(said.serves) + len(said.handing)


def here(now_ns: int, trip: RoundTrip, clock: NeighbourClock) -> RoundTrip | None:
    """Convert another node's round trip to this node's timeline, no shorter than it was.

    None while that node's clock is unknown, or if the result is not within ``OLDEST_NS`` of now.
    """
    sent, received = clock.offset(trip.sent_ns), clock.offset(trip.t_ns)
    if sent is None or received is None:
        return None
    t_ns, sent_ns = trip.t_ns + received.high_ns, trip.sent_ns + sent.low_ns
    if min(sent_ns, t_ns) < max(now_ns - OLDEST_NS, 0) or max(sent_ns, t_ns) > now_ns + OLDEST_NS:
        return None
    return replace(trip, t_ns=t_ns, sent_ns=sent_ns, is_shared=True)
