"""Tracks sent to other programs at a steady rate, on separate links ([out]).

Data received over these links is ignored.
"""

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from companion.mavlink.links.status import LinkStatus
from companion.mavlink.links.transport import Link
from companion.mavlink.links.urls import parse_link
from companion.mavlink.trust.admission import admission
from companion.mavlink.wire.encode import pack
from companion.mavlink.wire.positions import PASSED_ON
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Notice, Source, Track
from companion.views import passed_on

AT_ONCE: Final = 4  # UAVs whose positions are sent in one iteration of the event loop
SHARE: Final = 0.2
"""Largest share of the time for sending; with many UAVs or clients, each UAV is sent less often."""


class Outlet:
    """Links of ``[out]``. Call ``open`` for early errors, then ``run`` until cancelled."""

    def __init__(
        self,
        *,
        settings: Settings,
        pipeline: Pipeline,
        notify: Callable[[Notice], None],
        now_ns: Callable[[], int],
    ) -> None:
        self._settings = settings.out
        self._pipeline = pipeline
        self._now_ns = now_ns
        self._admits = admission(settings.out.uavs, ())
        self._positions = passed_on.Positions(
            utm=settings.out.message == "UTM_GLOBAL_POSITION", every_s=1 / settings.out.rate_hz
        )
        self._sequences: dict[Source, int] = {}
        self._frames: list[Link] = []
        self._events: list[Link] = []
        self._named: list[str] = []
        for text in settings.out.urls:
            url = parse_link(text)
            says_cot = url.scheme == "cot"
            if says_cot:
                url = replace(url, scheme="udpout" if url.way == "udp" else "tcp", way="")
            link = Link(url=url, receive=lambda _: None, now_ns=now_ns, notify=notify)
            if says_cot:
                self._events.append(link)
                self._named.append(text)
            else:
                self._frames.append(link)

    def links(self) -> list[LinkStatus]:
        """Return the counts of each link of ``[out]``, under its name in the settings."""
        named = zip(self._events, self._named, strict=True)
        events = [replace(link.status, url=text) for link, text in named]
        return [*(link.status for link in self._frames), *events]

    def open(self) -> None:
        """Bind the addresses of links that listen. ``LinkError`` if an address is in use."""
        for link in (*self._frames, *self._events):
            link.open()

    async def run(self) -> None:
        """Serve the links and send positions, until cancelled."""
        async with asyncio.TaskGroup() as group:
            for link in (*self._frames, *self._events):
                group.create_task(link.run(), name=f"out {link.url}")
            if self._frames or self._events:
                group.create_task(self._send_loop(), name="out")

    async def _send_loop(self) -> None:
        """Send positions at the rate; times missed while the loop was blocked are skipped."""
        loop = asyncio.get_running_loop()
        period_s = 1 / self._settings.rate_hz
        due_s = loop.time()
        while True:
            await self._send_once()
            due_s = max(due_s + period_s, loop.time())
            await asyncio.sleep(due_s - loop.time())

    async def _send_once(self) -> None:
        """Send the positions of all UAVs, a few at a time, with rests in between by ``SHARE``."""
        uavs = [uav for uav in self._pipeline.tracker.uavs if self._admits(uav)]
        for start in range(0, len(uavs), AT_ONCE):
            begun_s, now_ns = time.thread_time(), self._now_ns()
            self._send(self._pipeline.tracks(now_ns, now_ns, uavs[start : start + AT_ONCE]))
            await asyncio.sleep((time.thread_time() - begun_s) * (1 / SHARE - 1))

    def _send(self, tracks: list[Track]) -> None:
        if self._frames:
            for message in self._positions.outgoing(self._pipeline, tracks):
                number = self._sequences.get(message.source, 0)
                self._sequences[message.source] = (number + 1) & 0xFF
                raw = pack(message, number, compat_flags=PASSED_ON)
                for link in self._frames:
                    link.send_raw(raw)
        if self._events:
            for text in passed_on.events(self._pipeline, tracks, self._settings.stale_s):
                for link in self._events:
                    link.send_raw(text)
