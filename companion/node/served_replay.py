"""A replay with the page and API of a live run.

The replayed pipeline is served, and "now" is the time of the log's newest event: each answer is
that of the live service at that time. No event is skipped, however slow the machine, so the final
digest equals that of a replay without a page.

Over 300 lines: the server's whole view of a node, a method for each query.
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

from companion.mavlink.links.daemon_threads import in_daemon_thread
from companion.mavlink.links.lag import ArrivalLag
from companion.mavlink.links.peers import Peers
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.trust.dedupe import LINKS_MAX
from companion.mavlink.voice.rate_watch import MessageRate
from companion.node.printing import STDERR, STDOUT, Printer
from companion.node.replay import FLUSH_EVERY_S, Run, log_events, log_notes
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
from companion.values import Event, Frame, Notice, Observation, Rejection, Update
from companion.views.last_messages import LastMessages
from companion.views.lateness import Lateness
from companion.views.series import Series
from companion.views.state import RecordingStatus, ReplayStatus

SLICE_S: Final = 0.001
"""Longest time that the replay blocks the event loop."""
MEASURED_AT_ONCE: Final = 20_000
"""Events read between two checks for a stop, while the log's length is measured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayRequest:
    """Parameters of a replay with page and API.

    latency_s as in ``companion.node.replay.replay``
    area_map  the map under the plan view, from the user's own settings, not from a recording
    """

    logs: Sequence[Path]
    settings: Settings  # settings of the pipeline
    speed: float | None  # as in companion.node.replay.replay
    record: Callable[[], Writer] | None  # creates the recording of the replay; None: no recording
    latency_s: float = 0.0
    origins: Origins = field(default_factory=dict)  # origins of the settings
    area_map: str | None = None


def serve(
    asked: ReplayRequest,
    listen: str,
    summary_text: Callable[[dict[str, Any]], str],
    *,
    token: str | None = None,
    insecure: bool = False,
) -> None:
    """Replay and serve on ``listen`` (HOST:PORT) until a signal of ``ENDS``.

    ``summary_text`` returns what is printed on stdout of the summary (``ServedReplay.run``). Raises
    ``LogError``, ``ConfigError``, ``ListenError`` or ``OSError`` for unusable arguments.
    """

    def show(summary: dict[str, Any]) -> None:
        output = Printer(STDOUT)
        output.line(summary_text(summary))
        output.finish()
        output.require_output()

    with bind(listen, token=token, insecure=insecure) as http:
        printer = Printer(STDERR)
        try:
            node = ServedReplay(asked, printer.line)
            printer.line(f"companion serves {address(http)} and replays {node.name}")
            run_until_stopped(partial(node.run, http, token, show))
        finally:
            printer.finish()


class ServedReplay:
    """Replay with the interface of a node (``companion.views.state.Node``).

    ``say`` gets the notices of a live run. Raises ``LogError`` for an unusable log, ``ConfigError``
    for settings, ``OSError`` for a recording.
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
        self._missing = log_notes(logs)
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
        the summary so far if ``until`` is set before. Raises ``LogError`` for an unusable log,
        ``OSError`` if the recording cannot be written.
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
                summary = await in_daemon_thread(self._run.finish, at_once=True)
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
                await in_daemon_thread(self._run.writer.flush)
                flush_s = slice_s = loop.time()
        self._finished = True
        self._of_s = self._run.at_s

    def _step(self, event: Event) -> None:
        outputs = self._run.step(event)
        self._now_ns = max(self._now_ns, event.t_ns)  # a frame may be processed after a later tick
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
        self._ticked.set()  # wakes all current waiters;
        self._ticked.clear()  # later ones wait for the next tick

    async def _measure(self) -> None:
        events, first_ns = self._measured
        last_ns: int | None = first_ns
        while last_ns is not None:
            end_ns, last_ns = last_ns, await in_daemon_thread(partial(_last_ns, events))
        self._of_s = (end_ns - first_ns) * 1e-9

    # --- interface of the server ------------------------------------------------------------

    def now_ns(self) -> int:
        """Return the latest time of an event so far."""
        return self._now_ns

    def uptime_s(self) -> float:
        """Return the wall-clock seconds since the start of the replay."""
        return time.monotonic() - self._started_s

    def links(self) -> list[LinkStatus]:
        """Return the links in the log, with counts from its frames; "up" until the log ends."""
        for link in self._links.values():
            link.status.state = "down" if self._finished else "up"
        return [link.status for link in self._links.values()]

    def out_links(self) -> list[LinkStatus]:
        """Return nothing: a replay sends nothing to other programs."""
        return []

    def recording(self) -> RecordingStatus:
        """Return the state of the replay's recording."""
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
        """Return frames and updates per second of the log."""
        return self._rates.newest()

    def unfit(self) -> list[str]:
        """Return why the live service was not ready at that time, or that the replay has ended."""
        update = self.pipeline.last_update
        reasons = ["the replay has finished"] if self._finished else []
        if update is None:
            return [*reasons, "no beam update yet"]
        return [*reasons, update.unfit] if update.unfit else reasons

    def message_rates(self) -> list[MessageRate]:
        """Return nothing: a replay sends no requests."""
        return []

    def observations(self) -> None:
        """Return None: the observations of a replay are in its log."""

    def may_observe(self) -> bool:
        """Return False: a replay takes no observations."""
        return False

    def observe(self, found: Observation | str) -> None:
        """Do nothing: a replay takes no observations."""

    def notify(self, notice: Notice) -> None:
        """Publish a notice of the server, which is not part of the log."""
        self._notices.append(notice)

    def events(self) -> list[Notice]:
        """Return the newest notices, oldest first."""
        return list(self._notices)

    async def ticked(self) -> None:
        """Return after the next update of the log."""
        await self._ticked.wait()

    def fleet_status(self) -> None:
        """Return None: a recording contains of its fleet only the UAVs that its node served."""

    def replay(self) -> ReplayStatus:
        """Return the progress of the replay."""
        return ReplayStatus(
            log=self.name,
            speed=self._speed,
            at_s=self._run.at_s,
            of_s=self._of_s,
            state="finished" if self._finished else "running",
        )


class _ReplayedLink:
    """Counts of one link, from its frames in the log, which does not name the peers."""

    def __init__(self, url: str) -> None:
        self.status = LinkStatus(url=url)
        self._peers = Peers(status=self.status, on_evict=lambda _peer: None)
        self._peer = self._peers.at(url)

    def take(self, item: Frame | Rejection) -> None:
        self._peers.count(self._peer, [item])
        if isinstance(item, Frame):
            self.status.bytes += len(item.raw)


def _last_ns(events: Iterator[Event]) -> int | None:
    """Return the time of the last of the next ``MEASURED_AT_ONCE`` events; None without any."""
    newest = deque(islice(events, MEASURED_AT_ONCE), maxlen=1)
    return newest[0].t_ns if newest else None
