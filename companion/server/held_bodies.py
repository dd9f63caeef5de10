"""Large answers and messages that clients have not taken yet: a limited number of bytes in all.

An answer about 2000 UAVs has megabytes, and each moment has another one. Clients that take each
of them slowly would keep all of them in memory.
"""

import asyncio
import contextlib
from collections import Counter
from collections.abc import Iterator
from typing import Final

BYTES_MAX: Final = 16 << 20  # bytes of all bodies being sent, each counted once; one larger is sent
SMALL_BYTES: Final = 1 << 16  # largest body that is not abandoned: that would free too little

Payload = bytes | str
"""Body of an answer, or message of a stream, whose characters are nearly all ASCII."""


class HeldBodies:
    """Bodies that are being sent. Beyond ``BYTES_MAX`` the oldest answers are abandoned."""

    def __init__(self) -> None:
        self.bytes = 0
        self._bodies: dict[asyncio.Task[object], Payload] = {}  # by the answer's task, oldest first
        self._answers = Counter[int]()  # of each body, by its identity

    @contextlib.contextmanager
    def hold(self, body: Payload) -> Iterator[None]:
        """Count a body while the current task sends it. The task is cancelled to abandon it."""
        task = asyncio.current_task()
        assert task is not None
        self._bodies[task] = body
        self._answers[id(body)] += 1
        if self._answers[id(body)] == 1:
            self.bytes += len(body)
        try:
            if self.bytes > BYTES_MAX:
                self._abandon_others(body)
            yield
        finally:
            self._release(task)

    def _abandon_others(self, body: Payload) -> None:
        others = [
            one
            for one, held in self._bodies.items()
            if held is not body and len(held) > SMALL_BYTES
        ]
        for oldest in others:
            if self.bytes <= BYTES_MAX:
                break
            self._release(oldest)
            oldest.cancel()

    def _release(self, task: asyncio.Task[object]) -> None:
        body = self._bodies.pop(task, None)
        if body is None:
            return
        self._answers[id(body)] -= 1
        if not self._answers[id(body)]:
            del self._answers[id(body)]
            self.bytes -= len(body)


HELD: Final = HeldBodies()
"""Those of this process."""
