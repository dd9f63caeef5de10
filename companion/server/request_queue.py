"""Order in which requests are started: a few in each iteration of the event loop.

Any number of connections can each have a request ready. Started all at once, they would delay the
links and the beam update by the sum of their times. A loop that never rests also starves the
threads that compute beams: each waits for the interpreter some hundred times.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from enum import IntEnum
from itertools import count
from typing import Final

from companion.values.budget import Budget

AT_ONCE: Final = 4  # requests started in one iteration of the event loop
LONG_S: Final = 0.01
"""Time of an iteration after which the next one starts a single request, seconds."""
REQUESTS_PER_S: Final = 500.0  # requests of all connections, before those over a budget
REQUESTS_SAVED: Final = 1000.0
BESIDE_WORK_S: Final = 0.005
"""Time between two requests over a budget while a thread computes, seconds."""
STREAMS_PER_S: Final = 50.0  # WebSockets of all connections that are opened
STREAMS_SAVED: Final = 20.0
LOOK_AGAIN_S: Final = 0.001
"""Time between two checks whether the threads still compute, seconds."""


class Rank(IntEnum):
    """Order in which requests within their budgets are started."""

    HEALTH = 0  # costs least, and monitors judge the service by it
    BEAMS = 1  # of the moment: many programs repeat them, and the answer is made once
    OTHER = 2


Start = Callable[[], None]
IsWanted = Callable[[], bool]
Waiting = deque[tuple[int, Start]]
"""Requests that wait, each with its number in the order of arrival."""


class RequestQueue:
    """Requests of all connections that are not started yet.

    Up to ``REQUESTS_PER_S``, requests within the budget of their connection are started first, in
    the order of their ``Rank``. Beyond it all wait for threads that compute, and the oldest is
    started first: ``is_busy`` says whether a thread computes.
    """

    def __init__(self, is_busy: Callable[[], bool]) -> None:
        self._is_busy = is_busy
        self._budget = Budget(per_s=REQUESTS_PER_S, most=REQUESTS_SAVED)
        self._added = count()
        self._ready: dict[Rank, Waiting] = {rank: deque() for rank in Rank}
        self._late: Waiting = deque()  # over the budget of their connection
        self._began_s = 0.0  # time of the last iteration that started requests
        self._late_from_s = 0.0  # no request over a budget starts before this time
        self._wakes: asyncio.Handle | None = None
        self._streams: deque[tuple[Start, IsWanted]] = deque()
        self._streams_budget = Budget(per_s=STREAMS_PER_S, most=STREAMS_SAVED)
        self._opens: asyncio.Handle | None = None

    def add_stream(self, start: Start, is_wanted: IsWanted) -> None:
        """Open a WebSocket when the budget permits, unless its client has left by then."""
        self._streams.append((start, is_wanted))
        if self._opens is None:
            self._open_streams()

    def _open_streams(self) -> None:
        self._opens, loop = None, asyncio.get_running_loop()
        while self._streams:
            start, is_wanted = self._streams[0]
            if is_wanted() and not self._streams_budget.spend(1, loop.time()):
                self._opens = loop.call_later(1.0 / STREAMS_PER_S, self._open_streams)
                return
            self._streams.popleft()
            if is_wanted():
                start()

    def add(self, start: Start, *, within_budget: bool, rank: Rank = Rank.OTHER) -> None:
        """Start a request in an iteration to come. ``start`` must not raise."""
        waiting = self._ready[rank] if within_budget else self._late
        waiting.append((next(self._added), start))
        self._schedule()

    def _start_some(self) -> None:
        self._wakes = None
        now_s = asyncio.get_running_loop().time()
        left = AT_ONCE if now_s - self._began_s <= LONG_S else 1
        self._began_s = now_s
        while left and (start := self._next(now_s)) is not None:
            start()
            left -= 1
        self._schedule()

    def _next(self, now_s: float) -> Start | None:
        """Return the request that is due; None if all must wait."""
        waiting = [one for one in (*self._ready.values(), self._late) if one]
        if waiting and waiting[0] is not self._late and self._budget.spend(1, now_s):
            return waiting[0].popleft()[1]
        if not waiting or not self._may_start_late(now_s):
            return None
        if self._is_busy():
            self._late_from_s = now_s + BESIDE_WORK_S
        return min(waiting, key=lambda one: one[0][0]).popleft()[1]

    def _may_start_late(self, now_s: float) -> bool:
        return not self._is_busy() or now_s >= self._late_from_s

    def _schedule(self) -> None:
        """Continue in the next iteration if a request may start, else look again soon."""
        loop = asyncio.get_running_loop()
        is_ready, now_s = any(self._ready.values()), loop.time()
        is_late = is_ready or bool(self._late)
        if (is_ready and self._budget.has(1, now_s)) or (is_late and self._may_start_late(now_s)):
            if self._wakes is not None:
                self._wakes.cancel()
            self._wakes = loop.call_soon(self._start_some)
        elif is_late and self._wakes is None:
            self._wakes = loop.call_later(LOOK_AGAIN_S, self._start_some)
