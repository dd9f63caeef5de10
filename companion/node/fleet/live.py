"""The live node of a fleet: connects Zenoh with ``FleetMember`` and the pipeline.

docs/fleet.md describes the messages, their rates and their keys.

Over 300 lines: all messages meet here, between the pipeline and Zenoh's keys.
"""

import asyncio
import time
from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any, Final

from companion.mavlink.links.daemon_threads import close_within, in_daemon_thread
from companion.mavlink.links.descriptors import are_scarce
from companion.mavlink.links.to_loop import ToLoop
from companion.mavlink.links.zenoh_bus import Bus, open_peer
from companion.node.fleet import messages
from companion.node.fleet.answering import Unanswered
from companion.node.fleet.budgets import NodeBudgets
from companion.node.fleet.config import bus_config
from companion.node.fleet.listening import Listening
from companion.node.fleet.messages import FleetMessageError
from companion.node.fleet.traffic import Rate
from companion.pipeline.fleet.member import NODES_MAX, UAVS_MAX, FleetMember
from companion.pipeline.fleet.offers import Offers
from companion.pipeline.fleet.surroundings import Surroundings
from companion.pipeline.fold import Pipeline
from companion.recording import fields, schemas
from companion.settings.fleet import FleetSettings, is_node_name
from companion.values import Event, Frame, Notice, RoundTrip, Severity, Shared, UserError
from companion.views.served import FleetStatus

PREFIX: Final = "companion"
PRIORITY: Final = "data_high"
STANDING_S: Final = 0.2  # time between two standings
ASKED_S: Final = 0.5  # time between two requests for another node's clock
ANSWERED_S: Final = 3.0  # timeout of an answer
PATIENCE_S: Final = 6.0
"""Least time without answers from a present node after which the session is renewed."""
RETRY_S: Final = 2.0  # time between two attempts to reopen a session
AWAY_S: Final = 30.0
"""Time for which a node leaves the fleet when file descriptors are scarce.

Zenoh limits no connections that are not sessions yet, and closes them one at a time. The end of its
session closes all.
"""
PATIENCE_LEASES: Final = 4.0  # the same limit in leases
LOOK_S: Final = 0.3
"""Time between two batches of offers, not a multiple of the update interval."""
PIECE: Final = 16  # frames of a message that are processed in one piece
WAITING_MAX: Final = 1000
"""Frames of other nodes that wait; while more do, further messages are discarded and counted."""
DECIDED_NS: Final = 100_000_000
"""Least time between two decisions that another node's claim causes; each update decides too."""
OFFERED_S: Final = 1.0  # time between two messages of offers, and of tracks


class LiveFleetNode:
    """Live operation of this node in a fleet. ``open`` blocks; ``run`` serves until cancelled.

        settings  [fleet], with a name
        pipeline  pipeline of this node
        step      takes events for the pipeline
        notify    takes messages for the operator
        now_ns    the node's timeline

    Raises ``ConfigError`` for inconsistent settings.
    """

    def __init__(
        self,
        *,
        settings: FleetSettings,
        pipeline: Pipeline,
        step: Callable[[Event], None],
        notify: Callable[[Notice], None],
        now_ns: Callable[[], int],
    ) -> None:
        assert settings.node is not None
        self.name = settings.node
        self.settings = settings
        self.damaged = 0
        self._sent = Rate()
        self._heard = Rate()
        self._pipeline = pipeline
        self._step = step
        self._notify = notify
        self._now_ns = now_ns
        self._started_ns = now_ns()
        self._config = bus_config(settings)
        self.member = FleetMember(
            name=self.name,
            settings=settings,
            elements=pipeline.array.size,
            started_ns=self._started_ns,
        )
        self._around = Surroundings(pipeline, self.member)
        self._offers = Offers(pipeline, self.member.reception.silent_s)
        self._session: Any = None  # session of a peer, opened before the loop runs
        self._bus: Bus | None = None  # set after all declarations
        self._flushing: asyncio.TimerHandle | None = None
        self._flush_ns = 0  # due time of the flush
        self._has_duplicate = False
        self._warned: set[str] = set()
        self._budgets = NodeBudgets()
        self._decided_ns = self._started_ns  # when a standing last caused a decision
        self._listening: Listening | None = None
        self._slices: ToLoop | None = None  # pieces of messages of frames
        self._waiting = 0  # frames and round trips in them
        patience_s = max(PATIENCE_S, PATIENCE_LEASES * settings.lease_s)
        self._unanswered = Unanswered(round(patience_s * 1e9))

    # --- life cycle -------------------------------------------------------------------------

    def open(self) -> None:
        """Open the session of a peer before the loop runs; blocks.

        Raises ``UserError`` if Zenoh or an endpoint is unavailable. A client's session needs its
        router, which is not waited for here.
        """
        if self.settings.mode == "peer":
            self._session = open_peer(self._config)

    async def run(self) -> None:
        """Run until cancelled; a client that cannot connect reports it, and serves alone."""
        has_taken_part = False
        while True:
            try:
                has_no_room = await self._take_part()
                has_taken_part = True
                if has_no_room:
                    text = "nearly all file descriptors are in use; this node leaves the fleet"
                    self._report(Severity.ERROR, "fleet", f"{text} for {AWAY_S:.0f} s")
                    await asyncio.sleep(AWAY_S)
            except UserError as error:
                self._report(Severity.ERROR, "fleet", f"no fleet: {error}")
                if not has_taken_part:
                    return
                await asyncio.sleep(RETRY_S)  # this node's former endpoints are free by then

    async def _take_part(self) -> bool:
        """Run in the fleet with one session, until it must be renewed (``answering.py``).

        Returns whether the session ended because file descriptors were scarce.
        """
        has_no_room = False
        bus = Bus(self._config, asyncio.get_running_loop(), self._session)
        slices = ToLoop(asyncio.get_running_loop())
        try:
            if self._session is None:
                await in_daemon_thread(bus.open)
            self._bus = bus
            self._slices, self._waiting = slices, 0
            self._declare(bus)
            async with asyncio.TaskGroup() as group:
                tasks = [
                    group.create_task(bus.run(), name="zenoh"),
                    group.create_task(slices.run(), name="frames"),
                    group.create_task(
                        self._repeat(STANDING_S, self._publish_standing), name="standing"
                    ),
                    group.create_task(self._repeat(ASKED_S, self._ask), name="clocks"),
                    group.create_task(self._repeat(OFFERED_S, self._publish_offers), name="offers"),
                    group.create_task(self._make_offers(), name="looks"),
                ]
                while not (has_no_room or self._is_link_one_way(self._now_ns())):
                    await asyncio.sleep(1.0)
                    has_no_room = are_scarce()
                for task in tasks:
                    task.cancel()
        finally:
            slices.end()
            self._bus = self._listening = self._session = self._slices = None
            self._unanswered.alive.clear()
            if self._flushing is not None:
                self._flushing.cancel()
                self._flushing = None
            await close_within(bus.close)
        return has_no_room

    def _is_link_one_way(self, now_ns: int) -> bool:
        """Return whether a present node does not answer; remove nodes that left."""
        heard_ns = {node: known.heard_ns for node, known in self.member.neighbours.items()}
        for node in self._unanswered.gone(now_ns, heard_ns):
            left = self.member.node_left(now_ns, node)
            if self._may_process_presence(now_ns):
                self._notify_all(left)
        unresponsive = self._unanswered.unresponsive(now_ns, heard_ns)
        if unresponsive:
            text = f"no answer from {', '.join(unresponsive)}; reconnecting to all nodes"
            self._report(Severity.WARNING, "fleet", text)
        return bool(unresponsive)

    async def _repeat(self, period_s: float, what: Callable[[int], None]) -> None:
        while True:
            what(self._now_ns())
            await asyncio.sleep(period_s)

    async def _make_offers(self) -> None:
        while True:
            make = self._offers.look(self._now_ns())
            if make is not None:
                self._offers.take(await in_daemon_thread(make))
            await asyncio.sleep(LOOK_S)

    def _declare(self, bus: Bus) -> None:
        base = f"{PREFIX}/{self.settings.site}"
        bus.serve(self._key("time"), self._time)
        bus.serve(self._key("schema"), lambda key, payload: schemas.schema("Shared").descriptor_set)
        bus.subscribe(f"{base}/*/standing", self._valid_only(self._stands))
        heard, offered = self._valid_only(self._shared), self._valid_only(self._offered)
        self._listening = Listening(bus=bus, base=base, heard=heard, offered=offered)
        bus.watch(f"{base}/*/alive", self._seen)
        bus.alive(self._key("alive"))

    def _time(self, key: str, payload: bytes) -> bytes:
        return messages.CLOCK.pack(self._started_ns, self._now_ns())

    # --- own input and decisions ------------------------------------------------------------

    def on_event(self, event: Event) -> None:
        """Process an event of this node's own links, before the pipeline does.

        Frames for which this node is the speaker are published at once, within the rate limit.
        """
        now_ns = self._now_ns()
        if isinstance(event, Frame):
            self.member.frame_received(now_ns, event)
        elif isinstance(event, RoundTrip):
            self.member.round_trip_measured(event)
        else:
            return
        if self.member.neighbours and self._bus is not None:
            self._publish_received(now_ns)

    def ticked(self, now_ns: int) -> None:
        """Decide which UAVs this node serves; called after every update of the pipeline."""
        duty, notices = self.member.decide(now_ns)
        if duty is not None:
            self._step(duty)
            # at once: until then two nodes serve a UAV that was handed over
            self._publish_standing(now_ns)
        self._notify_all(notices)

    def _publish_received(self, now_ns: int) -> None:
        said = self.member.sharing.next_message(now_ns)
        if said is not None:
            self._put("heard", messages.shared(said), express=True, reliable=False)
        wait_ns = self.member.sharing.wait_ns(now_ns)
        if wait_ns is None:
            return
        due_ns = now_ns + wait_ns
        if self._flushing is not None:
            if self._flush_ns <= due_ns:
                return
            self._flushing.cancel()
        loop, self._flush_ns = asyncio.get_running_loop(), due_ns
        self._flushing = loop.call_later(wait_ns * 1e-9, self._flush)

    def _flush(self) -> None:
        self._flushing = None
        self._publish_received(self._now_ns())

    # --- output -----------------------------------------------------------------------------

    def _key(self, what: str, node: str | None = None) -> str:
        """Return the key under which a node publishes; None stands for this node."""
        return f"{PREFIX}/{self.settings.site}/{node or self.name}/{what}"

    def _put(
        self, what: str, payload: bytes, *, express: bool = False, reliable: bool = True
    ) -> None:
        if self._bus is not None:
            self._sent.bytes += len(payload)
            self._bus.put(
                self._key(what), payload, express=express, priority=PRIORITY, reliable=reliable
            )

    def _publish_standing(self, now_ns: int) -> None:
        said = self.member.own_standing(now_ns, self._around.place(), self._around.reach_m(now_ns))
        self._put("standing", messages.standing(said))
        if self._listening is not None:
            self._listening.to(self.member.near)

    def _publish_offers(self, now_ns: int) -> None:
        """Publish this node's offers and the tracks that it serves, and check for phantoms."""
        offers = dict(islice(self._offers.made.items(), messages.OFFERS_MAX))
        self.member.set_offers(offers)
        self._put("offers", messages.offers(offers))
        update = self._pipeline.last_update
        if (
            update is not None
            and self._bus is not None
            and self._bus.is_wanted(self._key("tracks"), PRIORITY)
        ):
            said = schemas.message_class("Tracks")(
                track=[
                    schemas.message("Track", fields.RecordedTrack(one, update.t_ns))
                    for one in update.tracks
                ]
            )
            self._put("tracks", said.SerializeToString())
        self._notify_all(self._around.phantoms(now_ns))
        self._sent.look(now_ns)
        self._heard.look(now_ns)

    def _ask(self, now_ns: int) -> None:
        if self._bus is None:
            return
        for node in self.member.near:
            key = self._key("time", node)
            self._unanswered.asked(now_ns, node)
            self._bus.ask(key, b"", ANSWERED_S, self._clock_answer(node, self._now_ns()))

    def _clock_answer(self, node: str, sent_ns: int) -> Callable[[bytes, int], None]:
        """Return the callback for the answer to a clock request that is sent now."""

        def take(answer: bytes, arrived_ns: int) -> None:
            self._unanswered.answered(node)
            if len(answer) != messages.CLOCK.size:
                self.damaged += 1
                self._notify_malformed(node, "malformed clock answer")
                return
            started_ns, remote_ns = messages.CLOCK.unpack(answer)
            received_ns = self._now_ns() - (time.monotonic_ns() - arrived_ns)
            self._notify_all(
                self.member.read_clock(node, started_ns, sent_ns, received_ns, remote_ns)
            )

        return take

    # --- input from other nodes -------------------------------------------------------------

    def _node(self, key: str) -> str | None:
        """Return the node that a key names; None for an invalid name, which is counted."""
        node = key.split("/")[-2]
        if is_node_name(node):
            return node
        self.damaged += 1
        return None

    def _valid_only(self, take: Callable[[str, bytes], None]) -> Callable[[str, bytes], None]:
        """Return a callback that passes on valid samples of other nodes; others are counted as
        damaged."""

        def taken(key: str, payload: bytes) -> None:
            node = self._node(key)
            self._heard.bytes += len(payload)
            try:
                if node is not None:
                    self._budgets.spend(node, len(payload), self._now_ns() * 1e-9)
                    take(node, payload)
            except FleetMessageError as error:
                self.damaged += 1
                self._notify_malformed(str(node), str(error))

        return taken

    def _shared(self, node: str, payload: bytes) -> None:
        """Process a few items at once, and the others in slices, in the order of arrival."""
        said = messages.to_shared(payload)
        frames, trips = said.frames, said.trips
        if self._waiting > WAITING_MAX:
            self.member.reception.unusable += len(frames) + len(trips)
            return
        pieces = [
            Shared(said.told_ns, frames[at : at + PIECE], trips[at : at + PIECE])
            for at in range(0, max(len(frames), len(trips), 1), PIECE)
        ]
        if not self._waiting:
            self._take_piece(node, pieces.pop(0))
        if self._slices is not None:
            for piece in pieces:
                self._waiting += len(piece.frames) + len(piece.trips)
                self._slices.post(partial(self._take_waiting, node, piece))

    def _take_waiting(self, node: str, piece: Shared) -> None:
        self._waiting -= len(piece.frames) + len(piece.trips)
        self._take_piece(node, piece)

    def _take_piece(self, node: str, piece: Shared) -> None:
        now_ns, began_s = self._now_ns(), time.thread_time()
        if not self._budgets.has_time(node, now_ns * 1e-9):
            self.member.reception.unusable += len(piece.frames) + len(piece.trips)
            return
        events, notices = self.member.take_shared(now_ns, node, piece)
        for event in events:
            self._step(event)
        self._notify_all(notices)
        self._budgets.charge_time(node, time.thread_time() - began_s)

    def _stands(self, node: str, payload: bytes) -> None:
        said = messages.to_standing(payload, node)
        if node == self.name:
            self._notify_duplicate()
            return
        now_ns = self._now_ns()
        self._check_room(self.member.take_standing(now_ns, said))
        serves = self.member.duties.serves
        if (
            now_ns - self._decided_ns >= DECIDED_NS
            and self.member.trust.is_trusted(node)
            and any(uav in serves for uav, _ in said.serves)
        ):
            self._decided_ns = now_ns
            self.ticked(now_ns)  # one of both nodes must drop it

    def _offered(self, node: str, payload: bytes) -> None:
        offers = messages.to_offers(payload)
        self._check_room(self.member.take_offers(self._now_ns(), node, offers))

    @staticmethod
    def _check_room(has_room: bool) -> None:
        if not has_room:
            raise FleetMessageError(f"more than {UAVS_MAX} UAVs in the messages of all nodes")

    def _seen(self, key: str, is_alive: bool) -> None:
        node = self._node(key)
        if node is None or node == self.name:
            return
        if not self._may_process_presence(self._now_ns()):
            return
        if not is_alive:
            self._unanswered.alive.discard(node)
            self._notify_all(self.member.node_left(self._now_ns(), node))
            return
        is_new = node not in self.member.neighbours
        self.member.node_joined(self._now_ns(), node)
        if node not in self.member.neighbours:
            self._notify_once("fleet", f"more than {NODES_MAX} nodes; further ones are ignored")
            return
        self._unanswered.alive.add(node)
        if is_new:
            self._report(Severity.INFO, f"node {node}", f"node {node} connected")

    def _may_process_presence(self, now_ns: int) -> bool:
        """Use the budget for one node that comes or goes; report once that it is exhausted."""
        if self._budgets.spend_presence(now_ns * 1e-9):
            return True
        text = "nodes come and go too often; their messages show which are present"
        self._notify_once("presence", text)
        return False

    def _notify_malformed(self, node: str, why: str) -> None:
        """Report a node's first malformed message."""
        text = f"node {node}: message discarded: {why}; further ones are only counted"
        self._notify_once(f"node {node}", text)

    def _notify_once(self, subject: str, text: str) -> None:
        """Publish the first warning about a subject, for a bounded number of subjects."""
        if subject in self._warned or len(self._warned) > NODES_MAX:
            return
        self._warned.add(subject)
        self._report(Severity.WARNING, subject, text)

    def _notify_duplicate(self) -> None:
        if self._has_duplicate:
            return
        self._has_duplicate = True
        text = f"another node is also named {self.name}; set a unique `[fleet] node` on each"
        self._report(Severity.ERROR, "fleet", text)

    def _report(self, severity: Severity, subject: str, text: str) -> None:
        self._notify(Notice(t_ns=self._now_ns(), severity=severity, subject=subject, text=text))

    def _notify_all(self, notices: list[Notice]) -> None:
        for notice in notices:
            self._notify(notice)

    # --- state ------------------------------------------------------------------------------

    def status(self) -> FleetStatus:
        """Return this node's state in the fleet."""
        return FleetStatus(
            member=self.member,
            site=self.settings.site,
            sent_bps=self._sent.bps,
            heard_bps=self._heard.bps,
            damaged=self.damaged + self.member.reception.unusable,
        )
