"""Way in of the array's own measurements: UDP, and those that the HTTP server passes on.

Each valid observation is an event, in order of arrival. What is not used is counted, and reported
as rejections, which are events too: at most one for each reason and source in ``REPORT_EVERY_S``,
so that a flood of datagrams does not become a flood of events.
"""

import asyncio
from collections.abc import Callable, Hashable
from typing import Final

from companion.mavlink.links.endpoints import Upcalls, reason
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.links.udp import UdpIn
from companion.mavlink.links.urls import parse_link
from companion.settings.observations import ObservationSettings
from companion.values import Event, Notice, Observation, Reason, Rejection, Severity, UserError
from companion.values.budget import Budget
from companion.views.observation_records import ObservationRecordError, decode
from companion.views.state import ObservationCounts

OBSERVATIONS_PER_S: Final = 4000.0
"""Observations that are processed, over UDP and HTTP together; more are dropped unread."""
OBSERVATIONS_SAVED: Final = 1000.0  # observations beyond that at once, after a quiet time
REPORT_EVERY_S: Final = 0.2  # least time between two rejections of one reason and source
HTTP: Final = "observations http"  # source of rejections


class ObservationIntake:
    """Observations over UDP and HTTP.

    Call ``open`` for early errors, then ``run`` until cancelled.

        step           takes each event
        notify         takes messages for the operator
        now_ns         the node's timeline
        utc_offset_ns  UTC less the node's timeline

    ``counts`` are those since the start.
    """

    def __init__(
        self,
        *,
        settings: ObservationSettings,
        step: Callable[[Event], None],
        notify: Callable[[Notice], None],
        now_ns: Callable[[], int],
        utc_offset_ns: Callable[[], int],
    ) -> None:
        self.counts = ObservationCounts()
        self._settings = settings
        self._step = step
        self._notify = notify
        self._now_ns = now_ns
        self._utc_offset_ns = utc_offset_ns
        self._budget = Budget(per_s=OBSERVATIONS_PER_S, most=OBSERVATIONS_SAVED)
        self._unreported: dict[tuple[str, Reason], tuple[int, str]] = {}
        self._udp = f"observations udp:{settings.udp}"
        self._endpoint: UdpIn | None = None

    def open(self) -> None:
        """Bind the UDP socket. Raises ``UserError`` if the address is not available."""
        address = self._settings.udp
        if address is None:
            return
        if not self._settings.enabled:
            text = (
                f"observations to {address} are not received: set `[observations] enabled = true`"
            )
            self._notify(
                Notice(
                    t_ns=self._now_ns(),
                    severity=Severity.WARNING,
                    subject="observations",
                    text=text,
                )
            )
            return
        url = parse_link(f"udpin:{address}")
        upcalls = Upcalls(
            up=lambda: None,
            take=self._receive,
            stale=lambda _key, _raw: None,
            on_peer_gone=lambda _key: None,
            overflow=self._overflow,
        )
        self._endpoint = UdpIn(url, LinkStatus(url=str(url)), upcalls)
        try:
            self._endpoint.open()
        except OSError as error:
            raise UserError(f"observations.udp {address}: {reason(error)}") from error

    async def run(self) -> None:
        """Receive datagrams and report rejections, until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                if self._endpoint is not None:
                    group.create_task(self._endpoint.serve(), name="observations")
                while True:
                    await asyncio.sleep(REPORT_EVERY_S)
                    self._report()
        finally:
            self._report()

    def has_room(self, source: str = HTTP) -> bool:
        """Spend the budget of one observation; False, and counted, if none is left."""
        if self._budget.spend(1, self._now_ns() * 1e-9):
            return True
        self.counts.dropped += 1
        self._reject(source, Reason.TOO_FREQUENT, f"more than {OBSERVATIONS_PER_S:.0f} a second")
        return False

    def take(self, found: Observation | str, source: str = HTTP) -> None:
        """Process a valid observation that arrived now, or count one that is invalid, and why."""
        if isinstance(found, str):
            self.counts.malformed += 1
            self._reject(source, Reason.MALFORMED, found)
        else:
            self.counts.received += 1
            self._step(found)

    def _receive(self, _peer: Hashable, datagram: bytes, _age_ns: int | None) -> bool:
        if not self.has_room(self._udp):
            return False
        try:
            # The time of reading: events must stay in order, and the record has its own time.
            found: Observation | str = decode(datagram, self._now_ns(), self._utc_offset_ns())
        except ObservationRecordError as error:
            found = str(error)
        self.take(found, self._udp)
        return False

    def _overflow(self, count: int) -> None:
        self.counts.dropped += count
        self._reject(self._udp, Reason.SOCKET_OVERFLOW, "", count)

    def _reject(self, source: str, why: Reason, detail: str, count: int = 1) -> None:
        before, first = self._unreported.get((source, why), (0, detail))
        self._unreported[source, why] = before + count, first

    def _report(self) -> None:
        unreported, self._unreported = self._unreported, {}
        for (source, why), (count, detail) in unreported.items():
            t_ns = self._now_ns()
            self._step(Rejection(t_ns=t_ns, source=source, reason=why, count=count, detail=detail))
