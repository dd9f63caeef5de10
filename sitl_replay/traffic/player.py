"""Player: sends a schedule or a log over links, in real time or without waiting."""

import asyncio
import contextlib
import logging
import math
import time
from collections import Counter
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.mavlink.links.urls import MAVLINK, LinkError, LinkUrl, parse_link
from companion.values import Frame
from sitl_replay.faults.asked import Fault
from sitl_replay.faults.content import msgid_of
from sitl_replay.faults.traffic import Delivery, Network, Senders
from sitl_replay.flight.scenario import Scenario
from sitl_replay.flight.vehicles import schedule
from sitl_replay.receiver.model import Measured, measurements
from sitl_replay.traffic.links import TrafficLink, open_link
from sitl_replay.traffic.observations import ReceiverPlan, observe, open_outlet
from sitl_replay.traffic.recorder import TlogWriter

log = logging.getLogger(__name__)

MAX_STEP_NS = 5_000_000_000
# Frames sent in a row, when late or at full speed, before other tasks run.
BATCH = 32


@dataclass(slots=True, kw_only=True)
class Tally:
    """Counts of what has been sent so far, updated during the run.

    frames      frames, each counted once for all links, whether delivered or not
    octets      their bytes
    dropped     over all links: frames that a slow peer did not accept, or without a peer
    clamped     time stamps of a log that step back or jump
    duration_s  duration of the run
    messages    frames by message id
    rejected    unusable data of a log, by reason
    faults      over all links: frames affected by each requested fault
    lost        links that have ended, with the reason
    observed    measurements of a simulated receiver, sent and failed
    """

    frames: int = 0
    octets: int = 0
    dropped: int = 0
    clamped: int = 0
    duration_s: float = 0.0
    messages: Counter[int] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    lost: list[str] = field(default_factory=list)
    observed: Counter[str] = field(default_factory=Counter)

    def count(self, raw: bytes) -> None:
        """Count one sent frame."""
        self.frames += 1
        self.octets += len(raw)
        self.messages[msgid_of(raw)] += 1


def message_name(known: int) -> str:
    """Return the name of a message id; ``UNKNOWN_`` and the id if the dialect has none."""
    message = dialect.mavlink_map.get(known)
    return str(message.msgname) if message else f"UNKNOWN_{known}"


async def fly(
    scenario: Scenario,
    links: Sequence[str],
    duration_s: float | None = None,
    seed: int = 0,
    record: Path | None = None,
    *,
    faults: Sequence[Fault] = (),
    receiver: ReceiverPlan | None = None,
    tally: Tally | None = None,
) -> Tally:
    """Send a scenario over ``links`` (see module ``links``), until ``duration_s`` or cancelled.

        scenario    the scenario
        links       URLs of the links
        duration_s  duration; None: until cancelled
        seed        seed of the random numbers
        record      tlog of every frame at its scheduled time, with the faults of senders, but not
                    those of links
        faults      faults to inject
        receiver    receiver behind the carrier's array, whose measurements are sent as well
        tally       counts to update, so that they can be read meanwhile and after a cancellation

    Sending starts when every listening link has a peer. Links and tlog are always closed. Raises
    ``LinkError`` for an invalid URL, if a link cannot be opened, or when all links have ended;
    ``FaultError`` for faults that cannot be combined; ``UserError`` for an invalid receiver;
    ``OSError`` if the tlog cannot be written.
    """
    tally = Tally() if tally is None else tally
    senders = Senders(faults, seed, tally.faults)
    network = Network(faults=faults, links=len(links), seed=seed, touched=tally.faults)
    urls = [parse_link(link, MAVLINK) for link in links]
    with TlogWriter(record) if record else contextlib.nullcontext() as writer:
        async with _opened(urls, tally) as endpoints:
            epoch_ns = time.time_ns()

            def due() -> Iterator[tuple[float, bytes]]:
                for t_s, _, made in schedule(scenario, seed, epoch_ns, duration_s):
                    raw = senders.altered(t_s, made)
                    yield t_s, raw
                    if writer is not None:  # resumed for the next one, so this one is sent
                        writer.write(epoch_ns + round(t_s * 1e9), raw)

            sending = _Sending(endpoints=endpoints, network=network, speed=1.0, tally=tally)
            items = (
                ()
                if receiver is None
                else measurements(
                    scenario, receiver.model, seed, epoch_ns=epoch_ns, duration_s=duration_s
                )
            )
            async with _observing(receiver, items, sending.start_s, tally):
                await sending.send_all(due())
    return tally


async def play(
    frames: Iterable[Frame],
    links: Sequence[str],
    speed: float | None = 1.0,
    *,
    faults: Sequence[Fault] = (),
    seed: int = 0,
    tally: Tally | None = None,
) -> Tally:
    """Send the frames of a log over ``links``, paced by their stamps.

        frames  only ``t_ns`` and ``raw`` are used. A time stamp that steps back is played as 0 s,
                a jump of more than 5 s as 5 s (``Tally.clamped``)
        links   URLs of the links
        speed   speed factor, also of faults; None: as fast as the links accept frames (over UDP a
                slow receiver loses frames)
        faults  faults to inject
        seed    seed of the faults
        tally   as for ``fly``

    Sending starts when every listening link has a peer. Raises as ``fly`` does, and what iterating
    over ``frames`` raises.
    """
    tally = Tally() if tally is None else tally
    senders = Senders(faults, seed, tally.faults)
    network = Network(faults=faults, links=len(links), seed=seed, touched=tally.faults)
    urls = [parse_link(link, MAVLINK) for link in links]
    async with _opened(urls, tally) as endpoints:
        timed = on_timeline(frames, tally)
        sent = ((t_s, senders.altered(t_s, raw)) for t_s, raw in timed)
        await _Sending(endpoints=endpoints, network=network, speed=speed, tally=tally).send_all(
            sent
        )
    return tally


def on_timeline(frames: Iterable[Frame], tally: Tally) -> Iterator[tuple[float, bytes]]:
    """Yield seconds since the first frame, in steps of 0 to 5 s, and the raw frame."""
    elapsed_ns = 0
    before_ns: int | None = None
    for frame in frames:
        step_ns = 0 if before_ns is None else frame.t_ns - before_ns
        before_ns = frame.t_ns
        played_ns = min(max(step_ns, 0), MAX_STEP_NS)
        tally.clamped += played_ns != step_ns
        elapsed_ns += played_ns
        yield elapsed_ns / 1e9, frame.raw


@contextlib.asynccontextmanager
async def _opened(urls: Sequence[LinkUrl], tally: Tally) -> AsyncIterator[list[TrafficLink]]:
    loop = asyncio.get_running_loop()
    opened: list[TrafficLink] = []
    start_s = loop.time()
    try:
        for url in urls:
            opened.append(await open_link(url))
        for endpoint in opened:
            if not endpoint.peers():
                log.warning("%s: waiting for the first peer", endpoint.url)
        for endpoint in opened:
            await endpoint.first_peer()
        start_s = loop.time()
        yield opened
    finally:
        tally.duration_s = loop.time() - start_s
        tally.dropped += sum(endpoint.dropped for endpoint in opened)
        for endpoint in opened:
            await endpoint.close()


@contextlib.asynccontextmanager
async def _observing(
    plan: ReceiverPlan | None, items: Iterable[Measured], start_s: float, tally: Tally
) -> AsyncIterator[None]:
    """Send the measurements of a receiver, if there is one, during a flight and to their end."""
    if plan is None:
        yield
        return
    outlet = open_outlet(plan, tally.observed)
    task = asyncio.ensure_future(observe(items, outlet, start_s))
    try:
        yield
        await task
    finally:
        task.cancel()
        await outlet.close()


class _Sending:
    """Run over open links, timed from ``start_s``, so that errors do not accumulate."""

    def __init__(
        self, *, endpoints: list[TrafficLink], network: Network, speed: float | None, tally: Tally
    ) -> None:
        self._endpoints = endpoints
        self._open_links = list(endpoints)
        self._network = network
        self._speed = speed
        self._tally = tally
        self._loop = asyncio.get_running_loop()
        self.start_s = self._loop.time()
        self._steps = 0

    async def send_all(self, items: Iterable[tuple[float, bytes]]) -> None:
        """Send every frame at its time after the faults of its link, delayed ones at the end."""
        for t_s, raw in items:
            await self._send_held(t_s)
            await self._until(t_s)
            self._tally.count(raw)
            self._network.take(t_s, raw)
            for delivery in self._network.due(t_s):
                await self._send(delivery)
            self._remove_ended_links()
        await self._send_held(math.inf)

    async def _send_held(self, until_s: float) -> None:
        for delivery in self._network.due(until_s):
            await self._until(delivery.t_s)
            await self._send(delivery)
            self._remove_ended_links()

    async def _until(self, t_s: float) -> None:
        """Wait until a time; even without a wait, let other tasks run."""
        speed = self._speed
        wait_s = 0.0 if speed is None else self.start_s + t_s / speed - self._loop.time()
        if wait_s > 0.0 or self._steps % BATCH == 0:
            await asyncio.sleep(max(0.0, wait_s))
        self._steps += 1

    async def _send(self, delivery: Delivery) -> None:
        endpoint = self._endpoints[delivery.link]
        if self._speed is None:
            await endpoint.writable()
        endpoint.send(delivery.raw)

    def _remove_ended_links(self) -> None:
        """Continue with the remaining links. Raises ``LinkError`` if no link remains."""
        gone = [f"{one.url}: {one.lost}" for one in self._open_links if one.lost]
        if not gone:
            return
        self._tally.lost += gone
        self._open_links = [one for one in self._open_links if not one.lost]
        if not self._open_links:
            raise LinkError("; ".join(gone))
        for text in gone:
            log.warning("%s; continuing without this link", text)
