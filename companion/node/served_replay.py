"""A replay with the same page and API as a live run.                                     [shell]

The replayed pipeline is served, and "now" is the time of the log's newest event: each answer is
what the live service would have given then. No event is left out, however slow the machine is, so
the digest at the end is that of a replay without a page.

Over 300 lines: the server's whole view of a node, a method for each question.
"""

import asyncio
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final

import click

from companion.mavlink.links.lag import ArrivalLag
from companion.mavlink.links.peers import Peers
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.trust.dedupe import LINKS_MAX
from companion.mavlink.voice.rate_watch import MessageRate
from companion.node.replay import FLUSH_EVERY_S, Run, log_events, missing, vehicle_logs
from companion.node.serving import (
    NOTICES_KEPT,
    RateMeter,
    Server,
    address,
    pause,
    run_until_stopped,
)
from companion.pipeline import assembly
from companion.recording.writer import Writer
from companion.server import area_map
from companion.server.access import bind
from companion.settings.model import Settings
from companion.settings.origins import Origins
from companion.values import Event, Frame, Notice, Rejection, Update, printable
from companion.views.last_messages import LastMessages
from companion.views.lateness import Lateness
from companion.views.series import Series
from companion.views.state import RecordingStatus, ReplayStatus

SLICE_S: Final = 0.005
"""Time slice: the longest time that the replay holds the event loop."""
MEASURED_AT_ONCE: Final = 20_000
"""Events read at once while measuring the log; measuring can be stopped only in between."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayRequest:
    """What is to be replayed, and how.

    latency_s as in ``companion.node.replay.replay``
    area_map  the map under the plan view: of the user's own settings, not of a recording's
    """

    logs: Sequence[Path]  # the logs
    settings: Settings  # those of the pipeline
    speed: float | None  # as in companion.node.replay.replay
    record: Callable[[], Writer] | None  # makes the recording of the replay; None: there is none
    latency_s: float = 0.0
    origins: Origins = field(default_factory=dict)  # where the settings come from
    area_map: str | None = None


def serve(
    asked: ReplayRequest,
    listen: str,
    show: Callable[[dict[str, Any]], None],
    *,
    token: str | None = None,
    insecure: bool = False,
) -> None:
    """Replay and serve on ``listen`` (HOST:PORT) until SIGINT or SIGTERM.

    ``show`` gets the summary: see ``ServedReplay.run``. Raises ``LogError``, ``ConfigError``,
    ``ListenError`` or ``OSError`` for what cannot be used.
    """
    with bind(listen, token=token, insecure=insecure) as http:
        node = ServedReplay(asked, _say)
        _say(f"companion serves {address(http)} and replays {node.name}")
        run_until_stopped(partial(node.run, http, token, show))


def _say(text: str) -> None:
    click.echo(printable(text), err=True)


class ServedReplay:
    """A replay as the server sees it (``companion.views.state.Node``).

    ``say`` gets the messages that a live run would show to the operator. Raises ``LogError`` for a
    log, ``ConfigError`` for settings, ``OSError`` for a recording that cannot be used.
    """

    def __init__(self, asked: ReplayRequest, say: Callable[[str], None]) -> None:
        logs, settings = asked.logs, asked.settings
        self._area = area_map.find(asked.area_map)
        events = log_events(logs, settings, asked.latency_s)
        first = next(events)
        self._run = Run(settings, asked.record() if asked.record else None)
        self.pipeline = self._run.pipeline
        self.origins = asked.origins
        self.equipment = assembly.equipment(settings, self.pipeline.array)
        self.name = ", ".join(log.name for log in logs)
        self._missing = {"logs": vehicle_logs(logs), "missing": missing(logs)}
        self._measured = (islice(log_events(logs, settings, asked.latency_s), 1, None), first.t_ns)
        self._events = chain((first,), events)
        self._now_ns = first.t_ns
        self._speed = asked.speed
        self._say = say
        self._started_s = time.monotonic()
        self._finished = False
        self._of_s: float | None = None
        self._notices: deque[Notice] = deque(maxlen=NOTICES_KEPT)
        self._rates = RateMeter()
        self._links: dict[str, _ReplayedLink] = {}
        self.last_messages = LastMessages()
        self.lateness = Lateness()
        self.series = Series()
        self.arrival_lag = ArrivalLag()
        self._ticked = asyncio.Event()

    async def run(
        self,
        http: socket.socket,
        token: str | None,
        show: Callable[[dict[str, Any]], None],
        until: asyncio.Event,
    ) -> None:
        """Replay, and serve until ``until`` is set, also after the log has ended.

        ``show`` gets the summary (see ``companion.node.replay.replay``) when the log has ended, or
        the summary so far when ``until`` is set before that. Raises ``LogError`` for a log that
        turns out to be unusable, ``OSError`` where the recording cannot be written.
        """
        answering = asyncio.Event()
        server = Server(node=self, token=token, answering=answering, area=self._area)
        failed: Exception | None = None
        try:
            async with asyncio.TaskGroup() as group:
                serving = group.create_task(server.serve(sockets=[http]), name="http")
                await answering.wait()
                measuring = group.create_task(self._measure(), name="length")
                await self._replay(until)
                summary = await asyncio.to_thread(self._run.finish)
                show(summary | self._missing)
                await until.wait()
                measuring.cancel()
                server.should_exit = True
                await serving
        except* (ValueError, OSError) as group_of_one:
            failed = group_of_one.exceptions[0]
        if failed:
            raise failed

    async def _replay(self, until: asyncio.Event) -> None:
        """Step through every event at its time, until told to stop."""
        loop = asyncio.get_running_loop()
        began_s, first_ns = loop.time(), self._now_ns
        slice_s = flush_s = began_s
        for event in self._events:
            now_s = loop.time()
            if self._speed is not None:
                due_s = began_s + (event.t_ns - first_ns) * 1e-9 / self._speed
                if due_s > now_s:
                    await pause(until, due_s - now_s)
                    now_s = slice_s = loop.time()
                    self.lateness.observe(now_s - due_s)
            if now_s - slice_s > SLICE_S:
                await asyncio.sleep(0)
                slice_s = loop.time()
            if until.is_set():
                self._say(f"stopped after {self._run.at_s:.1f} s of {self.name}")
                return
            self._step(event)
            if self._run.writer and now_s - flush_s > FLUSH_EVERY_S:
                await asyncio.to_thread(self._run.writer.flush)
                flush_s = slice_s = loop.time()
        self._finished = True
        self._of_s = self._run.at_s

    def _step(self, event: Event) -> None:
        outputs = self._run.step(event)
        self._now_ns = max(self._now_ns, event.t_ns)  # a frame may be taken in after a later tick
        match event:
            case Frame():
                self.last_messages.add(event)
                link = self._links.get(event.link)
                if link is None and len(self._links) < LINKS_MAX:
                    link = self._links.setdefault(event.link, _ReplayedLink(event.link))
                if link is not None:
                    link.take(event)
            case Rejection() if event.source in self._links:
                self._links[event.source].take(event)
        for output in outputs:
            if isinstance(output, Notice):
                self._notices.append(output)
                self._say(output.text)
            elif isinstance(output, Update):
                self._updated(event.t_ns)

    def _updated(self, now_ns: int) -> None:
        self._rates.count(now_ns, self.pipeline.frames, self.pipeline.updates)
        self.series.add(self.pipeline)
        self._ticked.set()  # wakes those who wait now;
        self._ticked.clear()  # later ones wait for the next tick

    async def _measure(self) -> None:
        """Find the length of the log by reading it through, beside the replay."""
        events, first_ns = self._measured
        last_ns: int | None = first_ns
        while last_ns is not None:
            end_ns, last_ns = last_ns, await asyncio.to_thread(_last_ns, events)
        self._of_s = (end_ns - first_ns) * 1e-9

    # --- what the server looks at -----------------------------------------------------------

    def now_ns(self) -> int:
        """The latest time of an event so far."""
        return self._now_ns

    def uptime_s(self) -> float:
        """Seconds since the replay began, whatever its speed."""
        return time.monotonic() - self._started_s

    def links(self) -> list[LinkStatus]:
        """Links found in the log, with the counts that frames allow; "up" until the log ends."""
        for link in self._links.values():
            link.status.state = "down" if self._finished else "up"
        return [link.status for link in self._links.values()]

    def out_links(self) -> list[LinkStatus]:
        """A replay passes nothing on."""
        return []

    def recording(self) -> RecordingStatus:
        """State of the replay's recording."""
        writer = self._run.writer
        if writer is None:
            return RecordingStatus(state="off", file=None, bytes=0, messages=0, dropped=0)
        return RecordingStatus(
            state="recording",
            file=writer.path.name,
            bytes=writer.size_bytes,
            messages=writer.messages,
            dropped=0,
        )

    def rates(self) -> dict[str, float | None]:
        """Frames and updates per second of the log."""
        return self._rates.newest()

    def unfit(self) -> list[str]:
        """Why the live service would not have been fit to be used then; that the replay is over."""
        update = self.pipeline.last_update
        reasons = ["the replay has finished"] if self._finished else []
        if update is None:
            return [*reasons, "no beam update yet"]
        return [*reasons, update.unfit] if update.unfit else reasons

    def message_rates(self) -> list[MessageRate]:
        """Empty: a replay asks nobody for anything."""
        return []

    def events(self) -> list[Notice]:
        """The newest notices, the oldest of them first."""
        return list(self._notices)

    async def ticked(self) -> None:
        """Return after the next update of the log."""
        await self._ticked.wait()

    def fleet_status(self) -> None:
        """None: a recording has no more of a fleet than who was served."""

    def replay(self) -> ReplayStatus:
        """Progress of the replay."""
        return ReplayStatus(
            log=self.name,
            speed=self._speed,
            at_s=self._run.at_s,
            of_s=self._of_s,
            state="finished" if self._finished else "running",
        )


class _ReplayedLink:
    """Counts of one link, from its frames in the log, which does not tell its peers apart."""

    def __init__(self, url: str) -> None:
        self.status = LinkStatus(url=url)
        self._peers = Peers(self.status, lambda _peer: None)
        self._peer = self._peers.at(url)

    def take(self, item: Frame | Rejection) -> None:
        self._peers.count(self._peer, [item])
        if isinstance(item, Frame):
            self.status.bytes += len(item.raw)


def _last_ns(events: Iterator[Event]) -> int | None:
    """Time of the last of the next ``MEASURED_AT_ONCE`` events; None where there are none."""
    newest = deque(islice(events, MEASURED_AT_ONCE), maxlen=1)
    return newest[0].t_ns if newest else None
