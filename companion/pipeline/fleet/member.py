"""One node of a fleet: everything beyond its own pipeline, without network access.

Pure: time is an argument, messages come in by methods, and outgoing messages are returned. The
live node and the study of many nodes in virtual time use the same class.

Over 300 lines: all that a node receives or sends in a fleet meets here.
"""

from collections import deque
from collections.abc import Callable, Mapping
from typing import Final

from companion.mavlink.trust.dedupe import content
from companion.mavlink.wire.positions import OWN
from companion.pipeline.fleet.assignment import offer_values_db
from companion.pipeline.fleet.duties import Duties, Handover
from companion.pipeline.fleet.nearness import Place, near
from companion.pipeline.fleet.neighbours import (
    NOTICED_OFFSET_NS,
    Neighbour,
    NeighbourClock,
    here,
    uavs_in,
)
from companion.pipeline.fleet.reception import SHARED, Reception
from companion.pipeline.fleet.sharing import Sharing
from companion.pipeline.fleet.trust import Trust, UnconfirmedVehicle, Witness
from companion.settings.fleet import FleetSettings
from companion.values import (
    DUTY_MAX,
    Duty,
    Frame,
    Notice,
    Offer,
    RoundTrip,
    Severity,
    Shared,
    Standing,
    Vector,
)

NODES_MAX: Final = 256  # limit on other nodes; further ones are ignored
UAVS_MAX: Final = 50_000
"""Most UAVs in the newest messages of all other nodes; 20 that all receive 2000 need 42 000."""
UAVS_GUARANTEED: Final = 64  # UAVs in a message that are taken from any node
HANDOVERS_KEPT: Final = 500
OFFERS_KEPT_NS: Final = 10_000_000_000
"""Time for which a node's offers are valid."""
FORGET_NS: Final = 600_000_000_000
GONE_MAX: Final = 64  # limit on remembered nodes that left

ToLocal = Callable[[Place], Vector]


class FleetMember:
    """Logic of one node of a fleet: what it receives, decides and publishes.

    ``name`` is its name; ``elements`` is the size of its array. ``neighbours`` are the other nodes
    by name, ``offers`` this node's own, ``handovers`` the newest ones of this node, of
    ``handed_over`` in total. ``place`` and ``reach_m`` are the position of its array and its range,
    as last published. ``near`` are the other nodes whose reports and offers are used
    (``nearness.py``). ``gone`` are nodes that left, in order, with time and position, until they
    return or are forgotten.
    """

    def __init__(
        self, *, name: str, settings: FleetSettings, elements: int, started_ns: int
    ) -> None:
        self.name = name
        self.neighbours: dict[str, Neighbour] = {}
        self.gone: dict[str, tuple[int, Place | None]] = {}
        self.offers: dict[str, Offer] = {}
        self.handovers: deque[Handover] = deque(maxlen=HANDOVERS_KEPT)
        self.handed_over = 0
        self.reception = Reception()
        self.sharing = Sharing(name, round(1e9 / settings.share_hz))
        self.trust = Trust()
        self.most = settings.most or elements
        self.duties = Duties(
            name=name,
            most=self.most,
            lease_ns=round(settings.lease_s * 1e9),
            hysteresis_db=settings.hysteresis_db,
        )
        self.place: Place | None = None
        self.reach_m: float | None = None
        self.near: frozenset[str] = frozenset()
        self._nulls = settings.nulls
        self._duty: tuple[tuple[str, ...], tuple[str, ...]] | None = None
        self._looked_ns = started_ns

    # --- own input --------------------------------------------------------------------------

    def frame_received(self, now_ns: int, frame: Frame) -> None:
        """Process a frame received over one of this node's own links."""
        self.reception.behind_ns = max(now_ns - frame.t_ns, 0)
        if frame.msgid in SHARED:
            key = self.reception.take_received(frame)
            if self.neighbours:
                self.sharing.frame_received(now_ns, frame, key)

    def round_trip_measured(self, trip: RoundTrip) -> None:
        """Process a TIMESYNC round trip that this node measured."""
        if self.neighbours:
            self.sharing.round_trip_measured(trip)

    # --- input from other nodes -------------------------------------------------------------

    def node_joined(self, now_ns: int, node: str) -> None:
        """Note that another node is present."""
        self._neighbour(now_ns, node)

    def node_left(self, now_ns: int, node: str) -> list[Notice]:
        """Note that another node left: its process or its connection ended."""
        self.duties.gone(now_ns, node)
        known = self.neighbours.get(node)
        if known is None:
            return []
        self._drop(node)
        while len(self.gone) >= GONE_MAX:
            del self.gone[next(iter(self.gone))]
        self.gone[node] = now_ns, None if known.standing is None else known.standing.place
        text = f"node {node} disconnected"
        return [Notice(t_ns=now_ns, severity=Severity.WARNING, subject=f"node {node}", text=text)]

    def _drop(self, node: str) -> None:
        del self.neighbours[node]
        if not self.neighbours:
            self.sharing.clear()

    def read_clock(
        self, node: str, started_ns: int, sent_ns: int, received_ns: int, remote_ns: int
    ) -> list[Notice]:
        """Process a reading of another node's clock, between two times of this node's clock."""
        # an answer proves no life: Zenoh's threads give it even if the node hangs
        known = self.neighbours.get(node)
        if known is None:
            return []
        if known.started_ns != started_ns:  # a restarted node has another timeline
            known.started_ns, known.clock = started_ns, NeighbourClock()
        if known.clock.note_answer(sent_ns, received_ns, remote_ns) is not None:
            return self.trust.note_contradiction(received_ns, node, "has an inconsistent clock")
        ahead = known.clock.newest_offset()
        if known.apart_told or ahead is None:
            return []
        apart_ns = max(ahead.low_ns, -ahead.high_ns)
        if apart_ns < NOTICED_OFFSET_NS:
            return []
        known.apart_told = True
        way = "behind" if ahead.low_ns > 0 else "ahead of"
        text = (
            f"node {node}'s clock is {apart_ns * 1e-9:.3f} s {way} this one's; times are corrected"
        )
        return [
            Notice(t_ns=received_ns, severity=Severity.WARNING, subject=f"node {node}", text=text)
        ]

    def take_shared(
        self, now_ns: int, node: str, said: Shared
    ) -> tuple[list[Frame | RoundTrip], list[Notice]]:
        """Process frames from another node. Returns the events for the pipeline, and notices."""
        known = self._neighbour(now_ns, node)
        if known is None or not self.trust.is_trusted(node):
            return [], []
        ahead = known.clock.offset(said.told_ns)
        if ahead is None or not known.clock.is_settled:
            return [], []
        way_ns = max(now_ns - said.told_ns - ahead.low_ns, 0)
        events: list[Frame | RoundTrip] = []
        for one in said.frames:
            frame = self.reception.to_own_timeline(now_ns, node, known.clock, one)
            known.frames += 1
            if frame is None:
                continue
            key = content(frame.raw)
            if frame.msgid in OWN:
                if not self.reception.was_shared(key):  # a repeat has no meaningful delay
                    known.note_delay(now_ns, now_ns - frame.t_ns + frame.doubt_ns)
                self.sharing.note_shared(now_ns, node, frame.source, key, way_ns)
            events += self.reception.take_shared(now_ns, node, frame, key)
        for trip in said.trips:
            if not self.reception.uses_trip(now_ns, trip.source):
                continue
            placed = here(now_ns, trip, known.clock)
            if placed is None:
                self.reception.unusable += 1
            else:
                events.append(placed)
        known.used += len(events)
        return events, self._contradictions(now_ns)

    def _contradictions(self, now_ns: int) -> list[Notice]:
        notices = []
        for node in self.reception.early:
            notices += self.trust.note_contradiction(
                now_ns, node, "shares frames before they can have been received"
            )
        for uav, node, _ in self.reception.contradicted:
            notices += self.trust.note_false_report(now_ns, uav, node)
        for uav, node, believed in self.reception.contradicted + self.reception.disputed:
            notices += self.trust.note_dispute(now_ns, uav, node, believed)
        self.reception.early.clear()
        self.reception.contradicted.clear()
        self.reception.disputed.clear()
        return notices

    def take_standing(self, now_ns: int, said: Standing) -> bool:
        """Process the ``Standing`` of another node; return False if it exceeds ``UAVS_MAX``."""
        known = self._neighbour(now_ns, said.node)
        if known is None:
            return True
        if not self._has_room(known.standing_uavs, uavs_in(said)):
            return False
        known.standing = said
        self.duties.hear(now_ns, said)
        return True

    def take_offers(self, now_ns: int, node: str, offers: tuple[Offer, ...]) -> bool:
        """Process all offers of another node; return False if they exceed ``UAVS_MAX``."""
        known = self._neighbour(now_ns, node)
        if known is None:
            return True
        if not self._has_room(known.offered_uavs, len(offers)):
            return False
        known.take_offers(now_ns, offers)
        return True

    def _has_room(self, before: int, now: int) -> bool:
        """Return whether a message with so many UAVs may replace one."""
        if now <= max(before, UAVS_GUARANTEED):
            return True
        held = sum(one.standing_uavs + one.offered_uavs for one in self.neighbours.values())
        return held - before + now <= UAVS_MAX

    # --- decisions --------------------------------------------------------------------------

    def set_offers(self, offers: Mapping[str, Offer]) -> None:
        """Set this node's own offers, as published."""
        self.offers = dict(offers)

    def decide(self, now_ns: int) -> tuple[Duty | None, list[Notice]]:
        """Decide which UAVs this node serves. Returns its duty (None: unchanged) and notices."""
        notices = self.trust.readmit(now_ns)
        trusted = frozenset(node for node in self.neighbours if self.trust.is_trusted(node))
        offers = {self.name: offer_values_db(self.offers)}
        for node in trusted:
            known = self.neighbours[node]
            if known.offers is not None and now_ns - known.offered_ns < OFFERS_KEPT_NS:
                offers[node] = known.values_db
        changes = self.duties.decide(now_ns, offers, trusted)
        self.handovers += changes
        self.handed_over += len(changes)
        standing = self.duties.others(now_ns)
        elsewhere = {uav for n, said in standing.items() if n in trusted for uav, _ in said.serves}
        spares = tuple(sorted(elsewhere - self.duties.serves.keys())) if self._nulls else ()
        duty = tuple(sorted(self.duties.serves)), spares[:DUTY_MAX]
        if now_ns - self._looked_ns > FORGET_NS // 10:
            self._looked_ns = now_ns
            self._forget(now_ns)
        if duty == self._duty:
            return None, notices
        self._duty = duty
        return Duty(now_ns, *duty), notices

    def _forget(self, now_ns: int) -> None:
        """Forget vehicles and nodes without recent messages.

        A message in transit when its node left makes that node known again without a liveliness
        token.
        """
        self.reception.forget(now_ns, FORGET_NS)
        self.sharing.forget(now_ns, FORGET_NS)
        self.trust.forget(now_ns)
        before_ns = now_ns - FORGET_NS
        for node in [n for n, known in self.neighbours.items() if known.heard_ns < before_ns]:
            self._drop(node)
        for node in [n for n, (at_ns, _) in self.gone.items() if at_ns < before_ns]:
            del self.gone[node]

    def check_vehicles(
        self, now_ns: int, positions: Mapping[str, Vector], own: Witness, local: ToLocal
    ) -> list[Notice]:
        """Check vehicles that only one other node receives against all that should receive them.

        ``positions`` are those of all vehicles known here, ``own`` is what this node receives.
        """
        witnesses = {self.name: own}
        receiving_nodes = dict[str, list[str]]()
        received_by = dict[str, frozenset[str]]()
        for node, known in self.neighbours.items():
            said = known.standing
            if not self.trust.is_trusted(node) or known.offers is None or said is None:
                continue
            heard = frozenset(u for u, offer in known.offers.items() if offer.heard_s is not None)
            received_by[node] = heard
            for uav in heard:
                receiving_nodes.setdefault(uav, []).append(node)
            if said.place is not None and said.reach_m is not None:
                witnesses[node] = Witness(local(said.place), said.reach_m, heard)
        told = [
            UnconfirmedVehicle(uav, nodes[0], positions[uav])
            for uav, nodes in receiving_nodes.items()
            if len(nodes) == 1 and uav not in own.heard and uav in positions
        ]
        counts = {node: len(heard) for node, heard in received_by.items()}
        return self.trust.check_vehicles(now_ns, told, witnesses, counts)

    def own_standing(self, now_ns: int, place: Place | None, reach_m: float | None) -> Standing:
        """Return this node's ``Standing``, with its array's position and range; update ``near``."""
        self.place, self.reach_m = place, reach_m
        others = {node: known.standing for node, known in self.neighbours.items()}
        self.near = near(place, reach_m, others, self.near)
        for node in others.keys() - self.near:
            self.neighbours[node].drop_offers()
        return Standing(
            node=self.name,
            place=place,
            reach_m=reach_m,
            most=self.most,
            serves=tuple(self.duties.serves.items()),
            handing=tuple(self.duties.handing.items()),
        )

    def _neighbour(self, now_ns: int, node: str) -> Neighbour | None:
        """Return the record of a sending node; None for this node, and beyond ``NODES_MAX``."""
        if node == self.name:
            return None
        known = self.neighbours.get(node)
        if known is None:
            if len(self.neighbours) >= NODES_MAX:
                return None
            known = self.neighbours.setdefault(node, Neighbour(clock=NeighbourClock()))
            self.gone.pop(node, None)
        known.heard_ns = now_ns
        return known
