"""Nodes, UAVs and the network between the nodes, in virtual time.

The nodes are the real ones (``pipeline/fleet``) without their pipelines. Their offers are computed
from the positions of the UAVs, and their messages are encoded as in live operation, so that bytes
can be counted. Only a sample of the UAVs sends reports; the counts are scaled to all.
"""

import heapq
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any, Final

import numpy as np

from companion.mavlink.wire.positions import GLOBAL_POSITION_INT as REPORT
from companion.node.fleet import messages
from companion.pipeline.fleet.member import FleetMember
from companion.settings.fleet import FleetSettings
from companion.studies.fleet.sky import Sky, SkySimulation
from companion.values import FloatArray, Frame, Source

SECOND_NS: Final = 1_000_000_000
START_NS: Final = 1_800_000_000 * SECOND_NS
TICK_NS: Final = 100_000_000
STANDING_TICKS: Final = 2
OFFER_TICKS: Final = 10
ASK_TICKS: Final = 5
DEGREE_M: Final = 111_195.0
ENTRY_S: Final = 2.0  # time within reach before a UAV counts as served or unserved
STAGGER_NS: Final = 7_919_000  # time between the reports of consecutive UAVs
HEADER_BYTES: Final = 110
"""Ethernet, IP, TCP and Zenoh headers of a message, measured on loopback."""


@dataclass(slots=True, kw_only=True)
class FleetCounts:
    """Counts of a period, summed over ticks; UAVs count while within reach of some node.

    A UAV counts once it has been within reach for ``ENTRY_S``, the time allowed for a first
    assignment.

    served, twice, unserved   by one node, by several, by none
    handovers                 changes from one node to another
    sent                      bytes by kind of message, without headers
    samples                   messages by kind
    received                  bytes that reached a node, headers included
    cpu_s                     processor time of each node
    frames_cpu_s              part of ``cpu_s`` used for reports
    """

    served: int = 0
    twice: int = 0
    unserved: int = 0
    handovers: int = 0
    sent: Counter[str] = field(default_factory=Counter)
    samples: Counter[str] = field(default_factory=Counter)
    received: Counter[str] = field(default_factory=Counter)
    cpu_s: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    frames_cpu_s: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))


class World:
    """Simulated fleet in virtual time; ``cpu_s`` returns the processor time used."""

    def __init__(
        self, sky: Sky, settings: FleetSettings, cpu_s: Callable[[], float] = lambda: 0.0
    ) -> None:
        self.sky = sky
        self._cpu_s = cpu_s
        self.counted = FleetCounts()
        self.now_ns = START_NS
        self.dead: set[str] = set()
        self.parted: Callable[[str, str], bool] = lambda one, other: False
        self.handovers: list[tuple[int, str, str | None, str | None]] = []
        self._random = np.random.default_rng(sky.seed)
        self._flight = SkySimulation(sky, self._random)
        self._names = self._flight.names
        self.members = {
            name: FleetMember(
                name=name, settings=settings, elements=128, started_ns=START_NS + number
            )
            for number, name in enumerate(self._names)
        }
        self._clock_ns = self._random.integers(-3, 3, sky.nodes) * SECOND_NS
        self._since: dict[str, int] = {}
        self._flushing: dict[str, int] = {}
        self._queue: list[tuple[int, int, Callable[[], None]]] = []
        self._order = count()
        self._tick = 0
        for name in self._names:
            for other in self._names:
                if other != name:
                    self.members[name].node_joined(self._local_ns(name), other)

    # --- time -------------------------------------------------------------------------------

    def run(self, seconds: float, watch: Callable[[], None] = lambda: None) -> None:
        """Advance the world by ``seconds``; ``watch`` is called at every tick."""
        for _ in range(round(seconds * SECOND_NS / TICK_NS)):
            end_ns = self.now_ns + TICK_NS
            self._report(end_ns)
            while self._queue and self._queue[0][0] <= end_ns:
                self.now_ns, _, deliver = heapq.heappop(self._queue)
                deliver()
            self.now_ns = end_ns
            for number, name in enumerate(self._names):
                if name not in self.dead:
                    self._timed(name, partial(self._run_node, name, number))
            self._count()
            self._tick += 1
            watch()

    def kill(self, name: str, seen_s: float = 0.05) -> None:
        """End a node's process; the others notice its missing liveliness after ``seen_s``."""
        self.dead.add(name)
        at_ns = self.now_ns + round(seen_s * SECOND_NS)
        for other in self._names:
            if other not in self.dead:
                member = self.members[other]
                self._at(at_ns, partial(self._lose, member, name))

    def _lose(self, member: FleetMember, node: str) -> None:
        member.node_left(self._local_ns(member.name), node)

    def clock_ns(self, name: str) -> int:
        """Return the offset of a node's timeline from the world's."""
        return int(self._clock_ns[self._names.index(name)])

    def _local_ns(self, name: str) -> int:
        return self.now_ns + self.clock_ns(name)

    def _at(self, t_ns: int, what: Callable[[], Any]) -> None:
        heapq.heappush(self._queue, (t_ns, next(self._order), what))

    def _timed(self, name: str, what: Callable[[], None], *, of_frames: bool = False) -> None:
        began_s = self._cpu_s()
        what()
        spent_s = self._cpu_s() - began_s
        self.counted.cpu_s[name] += spent_s
        if of_frames:
            self.counted.frames_cpu_s[name] += spent_s

    # --- nodes ------------------------------------------------------------------------------

    def _run_node(self, name: str, number: int) -> None:
        member, now_ns = self.members[name], self._local_ns(name)
        tick = self._tick + number
        if tick % OFFER_TICKS == 0:
            member.set_offers(self._flight.offers(self._ranges_m()[number]))
            self._broadcast(name, "offers", messages.offers(member.offers))
        member.decide(now_ns)
        for one in member.handovers:
            self.handovers.append((self.now_ns, one.uav, one.before, one.after))
            self.counted.handovers += one.after == name and one.before is not None
        member.handovers.clear()
        if tick % STANDING_TICKS == 0:
            lat_deg, lon_deg = (self._flight.places_m[number] / DEGREE_M).tolist()
            said = member.own_standing(now_ns, (lat_deg, lon_deg, 0.0), self.sky.reach_m)
            self._broadcast(name, "standing", messages.standing(said))
        if tick % ASK_TICKS == 0:
            for other in sorted(member.near):
                self._query_clock(name, other)

    def _flush(self, name: str) -> None:
        if self._flushing.get(name) == self.now_ns and name not in self.dead:  # else postponed
            del self._flushing[name]
            self._publish_received(name)

    def _publish_received(self, name: str) -> None:
        sharing = self.members[name].sharing
        said = sharing.next_message(self._local_ns(name))
        if said is not None:
            self._broadcast(name, "heard", messages.shared(said))
        wait_ns = sharing.wait_ns(self._local_ns(name))
        if wait_ns is None or self.now_ns <= self._flushing.get(name, 0) <= self.now_ns + wait_ns:
            return
        self._flushing[name] = self.now_ns + wait_ns
        flush = partial(self._timed, name, partial(self._flush, name), of_frames=True)
        self._at(self.now_ns + wait_ns, flush)

    def _broadcast(self, name: str, what: str, payload: bytes) -> None:
        self.counted.sent[what] += len(payload)
        self.counted.samples[what] += 1
        for other in self._names:
            if other == name or other in self.dead:
                continue
            if what != "standing" and name not in self.members[other].near:
                continue
            if self._arrives(name, other):
                self.counted.received[what] += len(payload) + HEADER_BYTES
                self._at(self._arrival_ns(), partial(self._deliver, other, name, what, payload))

    def _arrives(self, name: str, other: str) -> bool:
        return not self.parted(name, other) and self._random.random() >= self.sky.loss

    def _arrival_ns(self) -> int:
        return self.now_ns + round(self.sky.delay_s * SECOND_NS * self._random.uniform(1.0, 1.5))

    def _deliver(self, name: str, node: str, what: str, payload: bytes) -> None:
        if name not in self.dead:
            taken = partial(self._handle_message, name, node, what, payload)
            self._timed(name, taken, of_frames=what == "heard")

    def _handle_message(self, name: str, node: str, what: str, payload: bytes) -> None:
        member, now_ns = self.members[name], self._local_ns(name)
        match what:
            case "heard":
                member.take_shared(now_ns, node, messages.to_shared(payload))
            case "standing":
                member.take_standing(now_ns, messages.to_standing(payload, node))
            case "offers":
                member.take_offers(now_ns, node, messages.to_offers(payload))

    def _query_clock(self, name: str, other: str) -> None:
        if other in self.dead or not (self._arrives(name, other) and self._arrives(other, name)):
            return
        sent_ns, there_ns = self.now_ns, self._arrival_ns()
        back_ns = 2 * there_ns - sent_ns
        own, theirs = self.clock_ns(name), self.clock_ns(other)
        member = self.members[name]
        reading = START_NS, sent_ns + own, back_ns + own, there_ns + theirs
        self._at(back_ns, lambda: member.read_clock(other, *reading))

    # --- UAVs -------------------------------------------------------------------------------

    def _ranges_m(self) -> FloatArray:
        return self._flight.ranges_m((self.now_ns - START_NS) / SECOND_NS)

    def _report(self, end_ns: int) -> None:
        period_ns = round(SECOND_NS / self.sky.report_hz)
        ranges_m = self._ranges_m()
        for i, uav in enumerate(self._flight.uavs[: self.sky.sampled]):
            hearers = np.flatnonzero(ranges_m[:, i] < self.sky.reach_m).tolist()
            at_ns = self.now_ns + i * STAGGER_NS % period_ns
            while at_ns < end_ns:
                raw = self._flight.report(uav, (at_ns - START_NS) // 1_000_000 + 60_000)
                for number in hearers:
                    self._at(at_ns, partial(self._deliver_frame, self._names[number], raw, uav))
                at_ns += period_ns

    def _deliver_frame(self, name: str, raw: bytes, uav: str) -> None:
        if name not in self.dead:
            frame = Frame(
                t_ns=self._local_ns(name),
                link="udp",
                source=Source.parse(uav),
                msgid=REPORT,
                raw=raw,
            )
            self._timed(name, partial(self._handle_frame, name, frame), of_frames=True)

    def _handle_frame(self, name: str, frame: Frame) -> None:
        self.members[name].frame_received(self._local_ns(name), frame)
        self._publish_received(name)

    # --- counting ---------------------------------------------------------------------------

    def served_by(self) -> dict[str, list[str]]:
        """Return the living nodes that serve each UAV now."""
        found: dict[str, list[str]] = {}
        for name, member in self.members.items():
            if name not in self.dead:
                for uav in member.duties.serves:
                    found.setdefault(uav, []).append(name)
        return found

    def servable(self) -> set[str]:
        """Return the UAVs within reach of at least one living node."""
        alive = [number for number, name in enumerate(self._names) if name not in self.dead]
        if not alive:
            return set()
        near = (self._ranges_m()[alive] < self.sky.reach_m).any(axis=0)
        return {self._flight.uavs[i] for i in np.flatnonzero(near).tolist()}

    def _count(self) -> None:
        by, near = self.served_by(), self.servable()
        self._since = {uav: self._since.get(uav, self.now_ns) for uav in near}
        for uav, since_ns in self._since.items():
            if self.now_ns - since_ns < ENTRY_S * SECOND_NS:
                continue
            nodes = len(by.get(uav, ()))
            self.counted.served += nodes == 1
            self.counted.twice += nodes > 1
            self.counted.unserved += nodes == 0
