"""Order in which requests are started: a few in each iteration of the event loop.

Any number of connections can each have a request ready. Started all at once, they would delay the
links and the beam update by the sum of their times. A loop that never rests also starves the
threads that compute beams: each waits for the interpreter some hundred times.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Final

from companion.values.budget import Budget

AT_ONCE: Final = 4  # requests started in one iteration of the event loop
REQUESTS_PER_S: Final = 500.0  # requests of all connections, before those over a budget
REQUESTS_SAVED: Final = 1000.0
BESIDE_WORK_S: Final = 0.005
"""Time between two requests over a budget while a thread computes, seconds."""
STREAMS_PER_S: Final = 50.0  # WebSockets of all connections that are opened
STREAMS_SAVED: Final = 20.0
LOOK_AGAIN_S: Final = 0.001
"""Time between two checks whether the threads still compute, seconds."""

Start = Callable[[], None]
IsWanted = Callable[[], bool]


class RequestQueue:
    """Requests of all connections that are not started yet.

    Requests within the budget of their connection, and of all connections together, are started
    first; of these, requests that many programs repeat and that cost least, such as for health and
    beams. The others wait for threads that compute: ``is_busy`` says whether one does.
    """

    def __init__(self, is_busy: Callable[[], bool]) -> None:
        self._is_busy = is_busy
        self._budget = Budget(per_s=REQUESTS_PER_S, most=REQUESTS_SAVED)
        self._usual: deque[Start] = deque()
        self._prompt: deque[Start] = deque()
        self._late: deque[Start] = deque()
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

    def add(self, start: Start, *, within_budget: bool, is_usual: bool = False) -> None:
        """Start a request in an iteration to come. ``start`` must not raise."""
        if within_budget and self._budget.spend(1, asyncio.get_running_loop().time()):
            (self._usual if is_usual else self._prompt).append(start)
        else:
            self._late.append(start)
        self._schedule()

    def _start_some(self) -> None:
        self._wakes = None
        left = AT_ONCE
        for waiting in (self._usual, self._prompt):
            while left and waiting:
                waiting.popleft()()
                left -= 1
        while left and self._late and self._may_start_late():
            if self._is_busy():
                self._late_from_s = asyncio.get_running_loop().time() + BESIDE_WORK_S
            self._late.popleft()()
            left -= 1
        self._schedule()

    def _may_start_late(self) -> bool:
        return not self._is_busy() or asyncio.get_running_loop().time() >= self._late_from_s

    def _schedule(self) -> None:
        """Continue in the next iteration if a request may start, else look again soon."""
        loop = asyncio.get_running_loop()
        if self._usual or self._prompt or (self._late and self._may_start_late()):
            if self._wakes is not None:
                self._wakes.cancel()
            self._wakes = loop.call_soon(self._start_some)
        elif self._late and self._wakes is None:
            self._wakes = loop.call_later(LOOK_AGAIN_S, self._start_some)
