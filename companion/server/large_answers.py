"""Answers about many UAVs: read on the event loop in slices, computed and encoded in a work slot.

An answer about 2000 UAVs takes a sixth of a second. On the event loop it would delay links and beam
updates by as much, and eight clients would take all of its time. All who ask while an answer is
computed share the next one. About a few UAVs, the event loop answers at once: that is quicker than
a thread.
"""

import asyncio
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final, TypeVar

from companion.server.giving_way import NEVER, GivingWay
from companion.server.responses import encode, encode_with_items
from companion.server.shared_work import SharedWork
from companion.server.threads import in_thread
from companion.server.work_slots import WorkSlots
from companion.views import uav_state
from companion.views.as_json import Json, Utc, as_json, rfc3339, rounded
from companion.views.state import Node
from companion.views.uav_state import KnownUav, Overview

FEW_UAVS: Final = 12  # UAVs up to which the event loop answers at once, within 1 ms
FEW_ITEMS: Final = 100  # the same for smaller items: components, offers
SLICE: Final = 64  # UAVs read in one iteration of the event loop

T = TypeVar("T")
Make = Callable[[GivingWay], T]
"""Function that computes an answer on a thread, and gives way to the beams meanwhile."""


@dataclass(frozen=True)
class UavParts:
    """Answer of ``/v1/uavs`` in parts: the time, and each UAV as JSON by its id."""

    valid_at: str
    parts: dict[str, bytes]

    @cached_property
    def whole(self) -> bytes:
        """The answer as JSON."""
        return self.encode({}, frozenset())

    def encode(self, head: Json, only: frozenset[str]) -> bytes:
        """Return the answer as JSON after the values of ``head``; ``only`` some UAVs if given."""
        chosen = (part for uav, part in self.parts.items() if not only or uav in only)
        return encode_with_items({**head, "valid_at": self.valid_at, "uavs": []}, chosen)


class LargeAnswers:
    """Answers of one node whose size depends on what it has received, used on its event loop."""

    def __init__(self, node: Node, work_slots: WorkSlots) -> None:
        self._node = node
        self._work_slots = work_slots
        self._shared = SharedWork()

    async def made(
        self, what: Hashable, prepare: Callable[[], Make[T]], *, is_large: bool = True
    ) -> T:
        """Return what the function of ``prepare`` returns, which runs on a thread.

        ``prepare`` reads the node's state on the event loop. All who ask for ``what`` meanwhile
        share the answer. An answer that is not large is computed on the event loop, at once. Raises
        ``HTTPException`` 503 if the work slots are full, and what either function raises.
        """
        if not is_large:
            return prepare()(NEVER)

        async def work() -> T:
            async with self._work_slots.slot(is_long=True):
                return await in_thread(prepare(), self._way())

        return await self._shared.run(what, work)

    async def of_uavs(self, what: Hashable, prepare: Callable[[Overview], Make[T]]) -> T:
        """Return an answer about all UAVs, as ``made``; ``prepare`` gets an overview of them."""
        pipeline = self._node.pipeline
        if len(pipeline.tracker) <= FEW_UAVS:
            known = uav_state.known_uavs(pipeline, pipeline.tracker.uavs)
            return prepare(uav_state.overview(self._node, known, self._node.now_ns()))(NEVER)

        async def work() -> T:
            async with self._work_slots.slot(is_long=True):
                make = prepare(await self._overview())
                return await in_thread(make, self._way())

        return await self._shared.run(what, work)

    async def uavs(self, *, is_rounded: bool = False) -> UavParts:
        """Return the answer of ``/v1/uavs``, encoded; ``is_rounded`` as in ``rounded``."""
        utc_ns, show = self._node.pipeline.utc_ns, rounded if is_rounded else _as_is
        return await self.of_uavs(
            ("uavs", is_rounded), lambda overview: partial(_parts, overview, utc_ns, show=show)
        )

    def _way(self) -> GivingWay:
        return GivingWay(self._makes_beams, is_overloaded=self._work_slots.is_overloaded())

    def _makes_beams(self) -> bool:
        return self._node.pipeline.aiming is not None

    async def _overview(self) -> Overview:
        """Return an overview of all UAVs, read in slices. Its time is that of the last slice.

        It is read again if the local frame changes meanwhile: all positions are in another one.
        """
        pipeline = self._node.pipeline
        while True:
            local, names, known = pipeline.local, pipeline.tracker.uavs, list[KnownUav]()
            for start in range(0, len(names), SLICE):
                known += uav_state.known_uavs(pipeline, names[start : start + SLICE])
                await asyncio.sleep(0)
            if pipeline.local is local:
                return uav_state.overview(self._node, known, self._node.now_ns())


def _as_is(content: Json) -> Json:
    return content


def _parts(
    overview: Overview, utc_ns: Utc, way: GivingWay, show: Callable[[Json], Json] = _as_is
) -> UavParts:
    states = way.between(overview.states())
    parts = {one.id: encode(show(as_json(one, utc_ns))) for one in states}
    made = UavParts(rfc3339(utc_ns(overview.now_ns)), parts)
    assert made.whole  # joined here: that is megabytes
    return made
