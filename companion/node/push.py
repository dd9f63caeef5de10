"""Records of each update, pushed over UDP and shared memory.

No receiver is waited for, and nothing is queued: while a guaranteed gain is computed, only the
newest update is kept.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from companion.beams.aim import RenewedBeam
from companion.node.ring import LARGEST_RECORD, Ring
from companion.pipeline.assembly import Equipment
from companion.pipeline.fold import Pipeline
from companion.server.threads import Threads
from companion.settings.outlets import RecordSettings, host_and_port
from companion.values import Notice, Severity, Update, UserError
from companion.views import guaranteed_gain, records

LARGEST_DATAGRAM: Final = 65_000
"""Limit on the bytes of a datagram, below the limits of IPv4 and IPv6."""
RING_RETRY_NS: Final = 5_000_000_000  # time until a ring whose memory is full is tried again
RECOVERED_AFTER: Final = 50
"""Successful datagrams in a row before recovery is reported, as errors arrive late."""


class Push:
    """Outputs of ``[records]``. Call ``open`` for early errors, then ``run`` until cancelled."""

    def __init__(
        self,
        *,
        settings: RecordSettings,
        pipeline: Pipeline,
        equipment: Equipment,
        notify: Callable[[Notice], None],
        now_ns: Callable[[], int],
    ) -> None:
        self._settings = settings
        self._pipeline = pipeline
        self._equipment = equipment
        self._notify = notify
        self._now_ns = now_ns
        self._sockets: dict[str, socket.socket] = {}
        self._refused: dict[str, int] = {}  # datagrams since the last refusal
        self._ring: Ring | None = None
        self._ring_due_ns = 0  # when a ring whose memory is full is tried again; 0: it is not
        self._newest: tuple[Update, int] | None = None
        self._revised, self._revision = -1, 0  # the update whose beams were renewed, and how many
        self._fresh = asyncio.Event()
        self._threads = Threads(1, "guaranteed gains")

    def open(self) -> None:
        """Open all outputs. Raises ``UserError`` if one cannot be opened."""
        for text in self._settings.udp:
            host, port = host_and_port(text)
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            sock = self._sockets[text] = socket.socket(family, socket.SOCK_DGRAM)
            sock.setblocking(False)
            try:
                sock.connect((host, port))
            except OSError as error:
                raise UserError(f"records.udp {text}: {error.strerror}") from error
        self._open_ring()

    def _open_ring(self) -> None:
        """Open the ring, if one is requested; try again later if its memory is full."""
        path, now_ns = self._settings.shared_memory, self._now_ns()
        if path is None or now_ns < self._ring_due_ns:
            return
        try:
            self._ring = Ring(Path(path))
        except OSError as error:
            if not self._ring_due_ns:
                text = f"no records in shared memory: {path}: {error.strerror}; trying again"
                self._notify_state(Severity.ERROR, text)
            self._ring_due_ns = now_ns + RING_RETRY_NS
        except UserError:  # another file has the name now
            if not self._ring_due_ns:
                raise
            self._ring_due_ns = now_ns + RING_RETRY_NS
        else:
            if self._ring_due_ns:
                self._notify_state(Severity.INFO, f"records in shared memory again: {path}")

    def newest(self, update: Update, number: int) -> None:
        """Push this update, at once or as soon as its guaranteed gains are computed.

        Updates are numbered from 0.
        """
        if self._ring is None:
            self._open_ring()
        if not (self._sockets or self._ring):
            return
        if self._settings.guaranteed:
            self._newest = update, number
            self._fresh.set()
        else:
            self._send(update, number, None)

    @property
    def takes_renewed(self) -> bool:
        """Whether beams that reports renew are pushed: guaranteed gains would come too late."""
        settings = self._settings
        return bool(settings.udp or settings.shared_memory) and not settings.guaranteed

    def renewed(self, beam: RenewedBeam, number: int, all_beams: int) -> None:
        """Push one beam of an update that a report has renewed."""
        self._revision = self._revision + 1 if number == self._revised else 1
        self._revised = number
        in_utc = beam._replace(one=records.in_utc(self._pipeline, beam.one))
        record = records.encode_renewed(in_utc, number, all_beams, self._revision)
        if self._ring:
            self._ring.put(record)
        self._send_to_all(record)

    async def run(self) -> None:
        """Push updates with guaranteed gains until cancelled."""
        while True:
            await self._fresh.wait()
            self._fresh.clear()
            assert self._newest is not None
            update, number = self._newest
            work = partial(guaranteed_gain.gains_db, self._pipeline, self._equipment, update)
            try:
                computed = self._threads.submit(work)
            except RuntimeError:  # the system allows no thread now: beams without their gains
                self._send(update, number, None)
            else:
                sure = await asyncio.wrap_future(computed)
                self._send(update, number, sure)

    def _send(self, update: Update, number: int, sure: list[float | None] | None) -> None:
        beams = records.in_utc(self._pipeline, update.beams)
        encode = partial(records.encode, beams, number, sure)
        if self._ring:
            for record in encode(LARGEST_RECORD):
                self._ring.put(record)
        for record in encode(LARGEST_DATAGRAM) if self._sockets else ():
            self._send_to_all(record)

    def _send_to_all(self, record: bytes) -> None:
        for text, sock in self._sockets.items():
            self._say(text, sock, record)

    def _say(self, text: str, sock: socket.socket, record: bytes) -> None:
        try:
            sock.send(record)
        except OSError as error:  # no receiver, or a full queue: the next record is newer anyway
            if text not in self._refused:
                self._notify_state(Severity.WARNING, f"records to {text} fail: {error.strerror}")
            self._refused[text] = 0
        else:
            if text in self._refused:
                self._refused[text] += 1
                if self._refused[text] >= RECOVERED_AFTER:
                    del self._refused[text]
                    self._notify_state(Severity.INFO, f"records to {text} can be sent again")

    def _notify_state(self, severity: Severity, text: str) -> None:
        self._notify(Notice(t_ns=self._now_ns(), severity=severity, subject="records", text=text))

    def close(self) -> None:
        """Close all outputs of ``[records]``."""
        for sock in self._sockets.values():
            with contextlib.suppress(OSError):
                sock.close()
        if self._ring:
            self._ring.close()
