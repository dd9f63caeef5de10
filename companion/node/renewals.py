"""Beams that reports renew between two updates: ``[beams] update = "report"``."""

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import Final

from companion.node.push import Push
from companion.pipeline.fold import Pipeline
from companion.values.budget import Budget

SHARE: Final = 0.5
"""Largest share of the time. Reports beyond it wait for the next update."""


class Renewals:
    """Renews the beam of each UAV that reports, and pushes it.

    Nothing is recorded, and no state changes: a renewed beam follows from the events so far. Where
    so many UAVs report that an update of all takes less time, that is made instead.
    """

    def __init__(
        self, *, pipeline: Pipeline, push: Push, period_s: float, now_ns: Callable[[], int]
    ) -> None:
        self._pipeline = pipeline
        self._push = push
        self._budget = Budget(per_s=SHARE, most=SHARE * period_s)
        self._now_ns = now_ns
        self._awaited = frozenset[str]()  # UAVs with a beam
        self._due = dict[str, None]()  # those that have reported, the newest last
        self._wake = asyncio.Event()
        self._are_many = asyncio.Event()  # set: an update takes less time than the due beams
        self._one_s = 0.0  # time that the last beam took
        self._update_s = 0.0  # time that the last update took

    def reported(self, uav: str) -> None:
        """Take note of an accepted report."""
        if uav in self._awaited:
            self._due.pop(uav, None)
            self._due[uav] = None
            self._wake.set()
            if len(self._due) * self._one_s > self._update_s:
                self._are_many.set()

    def update_begins(self) -> None:
        """Take note that an update begins, which takes in all reports so far."""
        self._due.clear()
        self._are_many.clear()

    def update_is_made(self, took_s: float) -> None:
        """Take note of a new update; reports since its beginning are taken in now."""
        update, self._update_s = self._pipeline.last_update, took_s
        self._awaited = frozenset(() if update is None else update.beams.uavs)
        if self._due:
            self._wake.set()

    async def wait_until(self, due_s: float) -> None:
        """Wait until the next update is due, or until it would take less than the due beams."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(due_s):
                await self._are_many.wait()

    async def run(self) -> None:
        """Renew beams until cancelled, the newest report first."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._due and self._pipeline.aiming is None:
                began_s = time.perf_counter()
                if not self._budget.spend(self._one_s, began_s):
                    break
                self._renew(self._due.popitem()[0])
                self._one_s = time.perf_counter() - began_s
                await asyncio.sleep(0)  # links and clients are served in between

    def _renew(self, uav: str) -> None:
        update, number = self._pipeline.last_update, self._pipeline.newest_number
        found = self._pipeline.renewed(uav, self._now_ns())
        if found is not None and update is not None and number is not None:
            self._push.renewed(found, number, len(update.beams.beams))
