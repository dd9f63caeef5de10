"""Reception of frames by this node, and of frames shared by other nodes; its own have priority.

A shared report is used only if its vehicle is silent here. A node that sends wrong reports under a
vehicle's id then affects no vehicle that this node receives, except in gaps of its reception.
Shared reports of a vehicle that is received here are compared with its own reports
(``mavlink/trust/duplicate_ids.py``); those missed here are used once the vehicle falls silent.
"""

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Final

from companion.mavlink.trust.dedupe import content
from companion.mavlink.trust.duplicate_ids import NO_PLACE, DuplicateIds
from companion.mavlink.wire.decode import GPS_RAW_INT, HEARTBEAT
from companion.mavlink.wire.framing import MAGIC_V2, SHORTEST, examine
from companion.mavlink.wire.positions import OWN
from companion.pipeline.fleet.neighbours import OLDEST_NS, NeighbourClock
from companion.pipeline.fleet.trust import OWN_NODE
from companion.values import Frame, SharedFrame, Source

SHARED: Final = OWN | {HEARTBEAT, GPS_RAW_INT}
"""Messages that nodes share with each other: position, accuracy and type of a vehicle."""
KEPT_NS: Final = 10_000_000_000  # time for which contents of frames are remembered
SILENT_INTERVALS: Final = 2.5
"""Report intervals without a report after which a vehicle is silent at this node."""
SILENT_NS: Final = (200_000_000, 2_000_000_000)  # least and largest time for that
MISSED: Final = 64  # shared reports kept per vehicle that were not received here
TRIPS_NS: Final = 250_000_000  # least time between two round trips of a vehicle that are used
VEHICLES_MAX: Final = 4096
"""Limit on vehicles with a record; beyond it, shared reports are used without a check."""
FUTURE_NS: Final = 1_000_000
"""Tolerance for shared frames that seem received in the future, by the clock bounds."""


class RecentFrames:
    """Contents of frames, each kept for ``KEPT_NS`` after it was first noted."""

    def __init__(self) -> None:
        self._seen: OrderedDict[bytes, int] = OrderedDict()

    def note(self, now_ns: int, key: bytes) -> bool:
        """Note a frame's content. Returns whether the content is new."""
        while self._seen and next(iter(self._seen.values())) < now_ns - KEPT_NS:
            self._seen.popitem(last=False)
        if key in self._seen:
            return False
        self._seen[key] = now_ns
        return True

    def __contains__(self, key: bytes) -> bool:
        return key in self._seen


@dataclass(slots=True)
class _VehicleReception:
    """Reception of one vehicle: last report, usual interval, and shared reports missed here."""

    heard_ns: int
    interval_ns: float = 0.0
    missed: deque[Frame] = field(default_factory=lambda: deque(maxlen=MISSED))

    def is_silent(self, now_ns: int) -> bool:
        """Return whether the vehicle's last report is too old, if no frame is unread."""
        least_ns, most_ns = SILENT_NS
        wait_ns = min(max(SILENT_INTERVALS * self.interval_ns, least_ns), most_ns)
        return now_ns - self.heard_ns > wait_ns


class Reception:
    """Reception of frames, and selection of the shared frames for the pipeline.

    ``early`` contains the names of nodes whose frames arrive before they can have been received;
    ``contradicted`` the vehicles about which a node contradicts what this node received before that
    node shared it, and ``disputed`` those about which it contradicts anything else; with its name,
    and that of the node that is believed. The reader clears them.
    ``behind_ns`` is the age of this node's newest frame when it was read: a vehicle whose reports
    are still queued here is not silent. Otherwise an overloaded node would also use all shared
    frames, and be more overloaded. ``unusable`` counts shared frames and round trips that
    are damaged, older than ``OLDEST_NS``, or more than this node can process.
    """

    def __init__(self) -> None:
        self.contradicted: list[tuple[str, str, str]] = []
        self.disputed: list[tuple[str, str, str]] = []
        self.early: list[str] = []
        self.behind_ns = 0
        self.unusable = 0
        self._heard = RecentFrames()
        self._shared = RecentFrames()
        self._vehicles: dict[Source, _VehicleReception] = {}
        self._duplicate_ids = DuplicateIds({OWN_NODE})
        self._trips_ns: dict[Source, int] = {}  # newest used, of vehicles whose reports are shared

    def take_received(self, frame: Frame) -> bytes:
        """Process a frame, of a message in ``SHARED``, received here. Returns its content."""
        key = content(frame.raw)
        if frame.msgid not in OWN:
            return key
        self._heard.note(frame.t_ns, key)
        self._trips_ns.pop(frame.source, None)
        self._duplicate_ids.rejects(OWN_NODE, frame)
        vehicle = self._vehicles.get(frame.source)
        if vehicle is None:
            if len(self._vehicles) < VEHICLES_MAX:
                self._vehicles[frame.source] = _VehicleReception(frame.t_ns)
            return key
        gap_ns = frame.t_ns - vehicle.heard_ns
        if gap_ns > 0:
            usual_ns = vehicle.interval_ns
            vehicle.interval_ns = gap_ns if not usual_ns else usual_ns + 0.2 * (gap_ns - usual_ns)
            vehicle.heard_ns = frame.t_ns
        return key

    def to_own_timeline(
        self, now_ns: int, node: str, clock: NeighbourClock, shared: SharedFrame
    ) -> Frame | None:
        """Return a shared frame with its arrival at the other node on this node's timeline.

        None if it is damaged, not in ``SHARED``, or cannot be placed.
        """
        raw = shared.raw
        ahead = clock.offset(shared.heard_ns)
        if ahead is None:
            return None
        if len(raw) < SHORTEST or examine(raw, 0, len(raw)) != len(raw):
            self.unusable += 1
            return None
        if raw[0] == MAGIC_V2:
            source, msgid = Source(raw[5], raw[6]), int.from_bytes(raw[7:10], "little")
        else:
            source, msgid = Source(raw[3], raw[4]), raw[5]
        if msgid not in SHARED:
            return None
        least_ns, most_ns = shared.heard_ns + ahead.low_ns, shared.heard_ns + ahead.high_ns
        if least_ns > now_ns + FUTURE_NS:
            self.early.append(node)
            return None
        if least_ns < now_ns - OLDEST_NS or most_ns < 0:
            self.unusable += 1
            return None
        t_ns = min(most_ns, max(now_ns, least_ns))
        return Frame(
            t_ns=t_ns,
            link=f"fleet:{node}",
            source=source,
            msgid=msgid,
            raw=raw,
            doubt_ns=max(1, t_ns - least_ns),  # 0 would be a frame of this node
        )

    def was_shared(self, key: bytes) -> bool:
        """Return whether another node recently shared a report with this content."""
        return key in self._shared

    def take_shared(self, now_ns: int, node: str, frame: Frame, key: bytes) -> list[Frame]:
        """Return frames for the pipeline after another node shared a frame; usually none."""
        if frame.msgid in OWN:
            return self._report(now_ns, node, frame, key)
        vehicle = self._vehicles.get(frame.source)
        return [frame] if vehicle is None or vehicle.is_silent(now_ns - self.behind_ns) else []

    def _report(self, now_ns: int, node: str, frame: Frame, key: bytes) -> list[Frame]:
        is_new = self._shared.note(now_ns, key)
        if key in self._heard or not is_new:
            return []
        contradicts = self._duplicate_ids.rejects(node, frame)
        if contradicts is NO_PLACE:
            self.unusable += 1
            return []
        if contradicts is not None:
            is_false = contradicts == (OWN_NODE, True)
            found = self.contradicted if is_false else self.disputed
            found.append((str(frame.source), node, contradicts.peer))
            return []
        vehicle = self._vehicles.get(frame.source)
        if vehicle is None:
            self._note_use(frame.source)
            return [frame]
        vehicle.missed.append(frame)
        if not vehicle.is_silent(now_ns - self.behind_ns):
            return []
        missed = [one for one in vehicle.missed if one.t_ns > vehicle.heard_ns]
        vehicle.missed.clear()
        if missed:
            self._note_use(frame.source)
        return missed

    def _note_use(self, source: Source) -> None:
        """Note that a shared report of a vehicle is used."""
        if source in self._trips_ns or len(self._trips_ns) < VEHICLES_MAX:
            self._trips_ns.setdefault(source, 0)

    def uses_trip(self, now_ns: int, source: Source) -> bool:
        """Return whether to use a shared round trip now; only if shared reports are used.

        Time is noted: the next one is used ``TRIPS_NS`` later.
        """
        newest_ns = self._trips_ns.get(source)
        if newest_ns is None or now_ns - newest_ns < TRIPS_NS:
            return False
        self._trips_ns[source] = now_ns
        return True

    def silent_s(self, uav: str, now_ns: int) -> float | None:
        """Return the age of a vehicle's last report received by this node; None: never received."""
        vehicle = self._vehicles.get(Source.parse(uav))
        return None if vehicle is None else (now_ns - vehicle.heard_ns) * 1e-9

    def forget(self, now_ns: int, after_ns: int) -> None:
        """Forget vehicles that this node has not received for a given time."""
        self._trips_ns.clear()  # a vehicle whose reports are still shared is noted again
        self._vehicles = {k: v for k, v in self._vehicles.items() if now_ns - v.heard_ns < after_ns}
