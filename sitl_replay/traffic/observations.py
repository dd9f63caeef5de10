"""Sending of a simulated receiver's measurements to a service, over HTTP or UDP.

http://HOST:PORT  POST /v1/observations, with a bearer token
udp:HOST:PORT     one binary record in each datagram

A service that does not answer never delays the flight: measurements that it does not take are
counted, and the first failure is logged.
"""

import asyncio
import logging
import math
import socket
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Final, Protocol

from companion.client import Client, Measurement, ServiceError
from companion.mavlink.links.urls import MAVLINK, parse_link
from companion.values import Observation, UserError, shown
from companion.views.observation_records import encode
from sitl_replay.receiver.model import Measured, ReceiverModel

log = logging.getLogger(__name__)

BATCH_MAX: Final = 400  # most measurements in one request, as the service accepts
WAITING_MAX: Final = 4000  # most measurements that wait for an answer; the oldest are dropped
TIMEOUT_S: Final = 2.0  # of each request
CLOSING_S: Final = 3.0  # longest time for the measurements that wait at the end
SENT: Final = "sent"  # counted measurements: sent over UDP, or accepted over HTTP
FAILED: Final = "failed"  # not sent, or not accepted


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceiverPlan:
    """Simulated receiver and the service that takes its measurements.

    url    ``http://HOST:PORT`` or ``udp:HOST:PORT``
    token  bearer token for HTTP
    model  errors and timing of the receiver
    """

    url: str
    token: str | None = None
    model: ReceiverModel = field(default_factory=ReceiverModel)


class Outlet(Protocol):
    """Way to a service. ``counts`` has the measurements ``SENT`` and ``FAILED``."""

    counts: Counter[str]

    def send(self, observation: Observation) -> None:
        """Send one measurement, or keep it until the previous request is answered."""

    async def close(self) -> None:
        """Send what still waits, and release the socket."""


def check_url(url: str) -> None:
    """Raise ``UserError`` if the URL of a service is neither HTTP nor ``udp:HOST:PORT``."""
    if url.startswith("udp:"):
        parse_link(url.replace("udp:", "udpout:", 1), MAVLINK)
    elif url.startswith(("http://", "https://")):
        Client(url)
    else:
        known = "http://HOST:PORT or udp:HOST:PORT"
        raise UserError(f"{shown(url)} is not the address of a service; give {known}")


def open_outlet(plan: ReceiverPlan, counts: Counter[str]) -> Outlet:
    """Return the way to a plan's service; needs a running loop. Raises ``UserError``."""
    check_url(plan.url)
    return _Datagrams(plan.url, counts) if plan.url[:4] == "udp:" else _Requests(plan, counts)


async def observe(items: Iterable[Measured], outlet: Outlet, start_s: float) -> None:
    """Send each measurement at its time after ``start_s``, on the clock of the loop."""
    loop = asyncio.get_running_loop()
    for item in items:
        await asyncio.sleep(max(0.0, start_s + item.t_s - loop.time()))
        outlet.send(item.observation)


class _Datagrams:
    """Outlet over UDP."""

    def __init__(self, url: str, counts: Counter[str]) -> None:
        self.counts = counts
        link = parse_link(url.replace("udp:", "udpout:", 1), MAVLINK)
        try:
            found = socket.getaddrinfo(link.host, link.port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise UserError(f"{url}: {error.strerror or error}") from error
        family, kind, protocol, _, address = found[0]
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        self._socket.connect(address)
        self._url = url

    def send(self, observation: Observation) -> None:
        """Send a record. The error of an earlier datagram may come back with a later one."""
        try:
            self._socket.send(encode(observation))
        except OSError as error:
            _count_failure(self.counts, 1, f"{self._url}: {error.strerror or error}")
        else:
            self.counts[SENT] += 1

    async def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class _Requests:
    """Outlet over HTTP: one request at a time, in a thread, with all that waits."""

    def __init__(self, plan: ReceiverPlan, counts: Counter[str]) -> None:
        self.counts = counts
        self._client = Client(plan.url, plan.token, TIMEOUT_S)
        self._waiting: deque[Observation] = deque()
        self._more = asyncio.Event()
        self._is_closing = False
        self._task = asyncio.ensure_future(self._post())

    def send(self, observation: Observation) -> None:
        """Add a measurement to those of the next request."""
        self._waiting.append(observation)
        if len(self._waiting) > WAITING_MAX:
            self._waiting.popleft()
            self.counts[FAILED] += 1
        self._more.set()

    async def _post(self) -> None:
        while self._waiting or not self._is_closing:
            await self._more.wait()
            self._more.clear()
            while self._waiting:
                size = min(BATCH_MAX, len(self._waiting))
                batch = [as_measurement(self._waiting.popleft()) for _ in range(size)]
                try:
                    answer: dict[str, Any] = await asyncio.to_thread(self._client.observe, batch)
                except ServiceError as error:
                    _count_failure(self.counts, size, str(error))
                    continue
                self.counts[SENT] += answer["accepted"]
                if size > answer["accepted"]:
                    why = [one["title"] for one in answer["errors"][:1]] or ["too many"]
                    _count_failure(self.counts, size - answer["accepted"], why[0])

    async def close(self) -> None:
        """Send what still waits, for a limited time."""
        self._is_closing = True
        self._more.set()
        try:
            await asyncio.wait_for(self._task, CLOSING_S)
        except TimeoutError:
            _count_failure(self.counts, len(self._waiting), "the service is too slow")


def _count_failure(counts: Counter[str], size: int, why: str) -> None:
    if not counts[FAILED]:
        log.warning("observations: %s; continuing without an answer", why)
    counts[FAILED] += size


def as_measurement(observation: Observation) -> Measurement:
    """Return a direction as ``POST /v1/observations`` takes it; its time is Unix time."""
    assert observation.azimuth_rad is not None
    assert observation.elevation_rad is not None
    assert observation.bound_rad is not None
    seconds, rest_ns = divmod(observation.measured_ns, 1_000_000_000)
    return Measurement(
        uav=observation.uav,
        measured_at=f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest_ns:09d}Z",
        time_bound_s=observation.time_bound_ns * 1e-9,
        azimuth_deg=math.degrees(observation.azimuth_rad),
        elevation_deg=math.degrees(observation.elevation_rad),
        bound_deg=math.degrees(observation.bound_rad),
    )
