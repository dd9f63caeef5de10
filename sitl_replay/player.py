"""Sends a schedule or a log over links, in real time or as fast as it goes."""

import asyncio
import contextlib
import logging
import time
from collections import Counter
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.values import Frame
from sitl_replay.links import LinkError, Peer, Url, open_peer
from sitl_replay.recorder import TlogWriter
from sitl_replay.scenario import Scenario
from sitl_replay.vehicles import schedule

log = logging.getLogger(__name__)

MAX_STEP_NS = 5_000_000_000
# Frames sent without a pause when behind, or at full speed, before others get their turn.
BATCH = 32


@dataclass(slots=True)
class Tally:
    """What has been sent so far; kept up to date while it runs.

    ``frames`` and ``octets`` count each frame once, however many links it goes to. ``dropped``
    counts, over all links, frames that a slow peer did not take; ``clamped`` the time stamps of a
    log that step back or leap; ``rejected`` what else of a log was not usable, by reason;
    ``lost`` the links whose peer went away, with the reason.
    """

    frames: int = 0
    octets: int = 0
    dropped: int = 0
    clamped: int = 0
    duration_s: float = 0.0
    messages: Counter[int] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    lost: list[str] = field(default_factory=list)

    def count(self, raw: bytes) -> None:
        """Count one frame."""
        self.frames += 1
        self.octets += len(raw)
        self.messages[msgid(raw)] += 1


def msgid(raw: bytes) -> int:
    """The message id of a MAVLink 1 or 2 frame."""
    return int.from_bytes(raw[7:10], "little") if raw[0] == dialect.PROTOCOL_MARKER_V2 else raw[5]


def message_name(known: int) -> str:
    """The name of a message id; ``UNKNOWN_`` and the id where the dialect has none."""
    message = dialect.mavlink_map.get(known)
    return str(message.msgname) if message else f"UNKNOWN_{known}"


async def fly(
    scenario: Scenario,
    links: Sequence[str],
    duration_s: float | None = None,
    seed: int = 0,
    record: Path | None = None,
    *,
    tally: Tally | None = None,
) -> Tally:
    """Fly a scenario over ``links`` (``udpout:…``, ``tcp:…``), until ``duration_s`` or cancelled.

    ``record`` names a tlog that gets every frame with the time at which it was due. ``tally`` may
    be given to watch the count, or to have it after a cancellation.
    Errors: ``ValueError`` for a bad URL; ``LinkError`` for a link that cannot be opened, or when
    every peer is gone; ``OSError`` where the tlog cannot be written. Links and tlog are closed in
    any case.
    """
    tally = Tally() if tally is None else tally
    urls = [Url.parse(link) for link in links]
    with TlogWriter(record) if record else contextlib.nullcontext() as writer:
        async with _opened(urls, tally) as peers:
            epoch_ns = time.time_ns()

            def due() -> Iterator[tuple[float, bytes]]:
                for t_s, _, raw in schedule(scenario, seed, epoch_ns, duration_s):
                    yield t_s, raw
                    if writer is not None:  # asked for the next one: this one is sent
                        writer.write(epoch_ns + round(t_s * 1e9), raw)

            await _send_all(due(), peers, 1.0, tally)
    return tally


async def play(
    frames: Iterable[Frame],
    links: Sequence[str],
    speed: float | None = 1.0,
    *,
    tally: Tally | None = None,
) -> Tally:
    """Send the frames of a log over ``links``, paced by their stamps.

    ``speed`` multiplies the pace; None is as fast as the links take it (UDP takes anything, and
    a slow receiver loses what it cannot hold). Only ``t_ns`` and ``raw`` of a frame are used. A
    stamp that steps back counts as no step, one that leaps as 5 s (``Tally.clamped``).
    Errors: as ``fly``; and what iterating over ``frames`` raises.
    """
    tally = Tally() if tally is None else tally
    urls = [Url.parse(link) for link in links]
    async with _opened(urls, tally) as peers:
        await _send_all(on_timeline(frames, tally), peers, speed, tally)
    return tally


def on_timeline(frames: Iterable[Frame], tally: Tally) -> Iterator[tuple[float, bytes]]:
    """Seconds since the first frame, without steps back or beyond 5 s, and the raw frame."""
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
async def _opened(urls: Sequence[Url], tally: Tally) -> AsyncIterator[list[Peer]]:
    """The links, opened; closed at the end, with their dropped frames and the time counted."""
    loop = asyncio.get_running_loop()
    opened: list[Peer] = []
    start_s = loop.time()
    try:
        for url in urls:
            opened.append(await open_peer(url))
        start_s = loop.time()
        yield list(opened)
    finally:
        tally.duration_s = loop.time() - start_s
        tally.dropped += sum(peer.dropped for peer in opened)
        for peer in opened:
            await peer.close()


async def _send_all(
    items: Iterable[tuple[float, bytes]], peers: list[Peer], speed: float | None, tally: Tally
) -> None:
    # Against one start instant, not from frame to frame: nothing adds up to a drift.
    loop = asyncio.get_running_loop()
    start_s = loop.time()
    for t_s, raw in items:
        wait_s = 0.0 if speed is None else start_s + t_s / speed - loop.time()
        if wait_s > 0.0 or tally.frames % BATCH == 0:
            await asyncio.sleep(max(0.0, wait_s))
        for peer in peers:
            if speed is None:
                await peer.writable()
            peer.send(raw)
        tally.count(raw)
        if any(peer.lost for peer in peers):
            peers[:] = _still_there(peers, tally)


def _still_there(peers: list[Peer], tally: Tally) -> list[Peer]:
    """The peers that are left. ``LinkError`` when there is none."""
    gone = [f"{peer.url}: {peer.lost}" for peer in peers if peer.lost]
    tally.lost += gone
    if len(gone) == len(peers):
        raise LinkError("; ".join(gone))
    for text in gone:
        log.warning("%s; going on without it", text)
    return [peer for peer in peers if not peer.lost]
