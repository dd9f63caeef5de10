"""Zenoh session: publications, subscriptions, queries and liveliness.

Over 300 lines: the only file that uses Zenoh (https://zenoh.io, the extra ``[fleet]``). Its
callbacks run on its own threads; their data are passed to the event loop. Only queries are answered
on Zenoh's thread, since a clock must not wait for a busy loop. Only ``open`` and ``close`` wait for
the network; call them on a thread.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import chain, repeat
from typing import TYPE_CHECKING, Any, Final

from companion.mavlink.links.to_loop import ToLoop
from companion.mavlink.links.zenoh_config import BusConfig, Priority, sections
from companion.values import UserError
from companion.values.extras import needs

if TYPE_CHECKING:
    import zenoh

ERROR_MAX: Final = 150  # largest number of characters of an error of Zenoh
PUBLISHERS_MAX: Final = 1024
"""Most keys declared to Zenoh, which shortens their names; beyond it, all are declared again."""
NO_ROUTER: Final = "Unable to connect"
"""Zenoh's message when a client reaches none of its endpoints."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusStatus:
    """Counters of a Zenoh session, which only increase.

    sent     samples given to Zenoh. It does not report drops at a congested link: number the
             samples, so that the receiver sees the gaps
    """

    sent: int
    refused: int  # samples that Zenoh did not accept, or after close
    heard: int  # samples, answers and liveliness changes handed over
    dropped: int  # those dropped because the queue to the loop was full


def open_peer(config: BusConfig) -> "zenoh.Session":
    """Open a peer's Zenoh session before the event loop runs; blocks.

    Raises ``UserError`` as ``Bus.open``.
    """
    with needs("zenoh", "fleet", "Zenoh"):
        import zenoh
    try:
        return zenoh.open(_configured(config))
    except zenoh.ZError as error:
        raise UserError(f"Zenoh: {_error_text(error)}") from error


class Bus:
    """Zenoh session. All methods but ``open`` and ``close`` are called on the event loop.

    ``session`` is one that is already open (``open_peer``); None: ``open`` opens one.

    ``run`` raises the exception of a callback: after that nothing more is handed over.
    """

    def __init__(
        self,
        config: BusConfig,
        loop: asyncio.AbstractEventLoop,
        session: "zenoh.Session | None" = None,
    ) -> None:
        self._config = config
        self._sent = 0
        self._refused = 0
        self._to_loop = ToLoop(loop)
        self._ended = threading.Event()
        self._session = session
        self._publishers: dict[tuple[str, Priority, bool, bool], zenoh.Publisher] = {}
        self._declared: list[Any] = []  # declarations, which end when unreferenced

    def open(self) -> None:
        """Open the session; blocks. An absent neighbour is no error: it is retried.

        A client has no session without its router, so this waits for it; ``close`` ends that.
        Raises ``UserError`` if the package is missing, an endpoint or a file is invalid, or an
        address is not available.
        """
        with needs("zenoh", "fleet", "Zenoh"):
            import zenoh
        config = _configured(self._config)
        while not self._ended.is_set():
            try:
                self._session = zenoh.open(config)
                break
            except zenoh.ZError as error:
                if self._config.mode != "client" or NO_ROUTER not in str(error):
                    raise UserError(f"Zenoh: {_error_text(error)}") from error
            self._ended.wait(self._config.retry_s)
        if self._ended.is_set() and self._session is not None:  # closed meanwhile
            _close(self._session)

    @property
    def status(self) -> BusStatus:
        queue = self._to_loop
        return BusStatus(
            sent=self._sent, refused=self._refused, heard=queue.handed_over, dropped=queue.dropped
        )

    async def run(self) -> None:
        """Wait until cancelled; raise the exception of a callback."""
        await self._to_loop.run()

    def close(self) -> None:
        """Close the session; blocks until the others are notified, then delivers nothing more."""
        self._to_loop.end()
        self._ended.set()
        if self._session is not None:
            _close(self._session)

    # --- publications and queries ------------------------------------------------------------

    def put(
        self,
        key: str,
        payload: bytes,
        *,
        express: bool = False,
        priority: Priority = "data",
        reliable: bool = True,
    ) -> bool:
        """Publish a sample; False if Zenoh did not accept it.

        A congested link drops samples silently. ``express`` sends a sample at once, without
        batching; for single samples only, since at most ``QUEUED`` of a burst fit the queue. A
        sample that is not ``reliable`` goes over an endpoint with ``?rel=0`` if there is one,
        without waiting for lost samples.
        """
        import zenoh

        try:
            self._publisher(key, priority, express, reliable).put(payload)
        except zenoh.ZError:
            self._refused += 1
            return False
        self._sent += 1
        return True

    def is_wanted(self, key: str, priority: Priority = "data") -> bool:
        """Return whether there is a subscriber to ``put`` under ``key`` with this priority."""
        import zenoh

        try:
            status: Any = self._publisher(key, priority, False, True).matching_status
            return bool(status.matching)  # despite its annotation, it is not a bool
        except zenoh.ZError:
            return False

    def ask(
        self, key: str, payload: bytes, timeout_s: float, take: Callable[[bytes, int], None]
    ) -> None:
        """Query ``key``; ``take`` is called with each answer that arrives within the timeout.

        Its second argument is the monotonic time, ns, at which Zenoh's thread received the answer.
        """
        import zenoh

        def answered(reply: "zenoh.Reply") -> None:
            arrived_ns = time.monotonic_ns()
            if reply.ok is not None:
                answer = reply.ok.payload.to_bytes()
                self._to_loop.post(lambda: take(answer, arrived_ns), len(answer))

        self._opened().get(
            key,
            zenoh.handlers.Callback(answered, indirect=False),
            payload=payload,
            timeout=timeout_s,
            # Otherwise Zenoh holds answers back until all are in.
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )

    # --- subscriptions and answers -----------------------------------------------------------

    def subscribe(self, key_expr: str, take: Callable[[str, bytes], object]) -> Callable[[], None]:
        """Call ``take`` with the key and the payload of every sample from others.

        While it returns True, there is more to do, and it is called again without a payload.
        Returns the function that ends the subscription: samples already queued are still handed
        over.
        """
        import zenoh

        def heard(sample: "zenoh.Sample") -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                key, payload = str(sample.key_expr), sample.payload.to_bytes()
                pieces = chain((payload,), repeat(b""))
                self._to_loop.post(lambda: take(key, next(pieces)), len(payload))

        subscriber = self._opened().declare_subscriber(
            key_expr,
            zenoh.handlers.Callback(heard, indirect=False),
            allowed_origin=zenoh.Locality.REMOTE,
        )
        self._declared.append(subscriber)

        def end() -> None:
            if subscriber in self._declared:
                self._declared.remove(subscriber)
            with contextlib.suppress(zenoh.ZError):  # the session has ended
                subscriber.undeclare()  # type: ignore[no-untyped-call]

        return end

    def serve(self, key: str, answer: Callable[[str, bytes], bytes | None]) -> None:
        """Answer queries for ``key`` at once, on Zenoh's own thread.

        ``answer`` is called with the queried key and the payload; None: no answer.
        """
        import zenoh

        def asked(query: "zenoh.Query") -> None:
            try:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                said = answer(str(query.key_expr), payload)
                if said is not None:
                    query.reply(key, said, express=True)
            except zenoh.ZError:  # the querier or this session is gone
                return
            except Exception as fault:
                self._to_loop.post(partial(self._to_loop.fail, fault))

        self._declared.append(
            self._opened().declare_queryable(
                key, zenoh.handlers.Callback(asked, indirect=False), complete=True
            )
        )

    def alive(self, key: str) -> None:
        """Declare a liveliness token, until ``close`` or until others miss its keep-alives."""
        self._declared.append(self._opened().liveliness().declare_token(key))

    def watch(self, key_expr: str, take: Callable[[str, bool], None]) -> None:
        """Call ``take`` with each live key and True; with the key and False once it is not."""
        import zenoh

        def seen(sample: "zenoh.Sample") -> None:
            key, is_alive = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            self._to_loop.post(lambda: take(key, is_alive))

        callback = zenoh.handlers.Callback(seen, indirect=False)
        liveliness = self._opened().liveliness()
        self._declared.append(liveliness.declare_subscriber(key_expr, callback, history=True))

    def neighbours(self, take: Callable[[str, bool], None]) -> None:
        """Call ``take`` with each directly connected session's id and True; False on disconnection.

        Sessions behind a router are excluded.
        """
        import zenoh

        def seen(event: "zenoh.TransportEvent") -> None:
            who, is_joined = str(event.transport.zid), event.kind == zenoh.SampleKind.PUT
            self._to_loop.post(lambda: take(who, is_joined))

        callback = zenoh.handlers.Callback(seen, indirect=False)
        info = self._opened().info
        self._declared.append(info.declare_transport_events_listener(callback, history=True))

    # --- the session ------------------------------------------------------------------------

    def _opened(self) -> "zenoh.Session":
        assert self._session is not None, "open comes first"
        return self._session

    def _publisher(
        self, key: str, priority: Priority, express: bool, reliable: bool
    ) -> "zenoh.Publisher":
        import zenoh

        publisher = self._publishers.get((key, priority, express, reliable))
        if publisher is not None:
            return publisher
        if len(self._publishers) >= PUBLISHERS_MAX:
            self._publishers.clear()
        publisher = self._opened().declare_publisher(
            key,
            priority=getattr(zenoh.Priority, priority.upper()),
            congestion_control=zenoh.CongestionControl.DROP,
            express=express,
            reliability=getattr(zenoh.Reliability, "RELIABLE" if reliable else "BEST_EFFORT"),
            allowed_destination=zenoh.Locality.REMOTE,
        )
        self._publishers[key, priority, express, reliable] = publisher
        return publisher


def check(config: BusConfig) -> None:
    """Check that Zenoh is installed and accepts a configuration. Raises ``UserError`` if not."""
    with needs("zenoh", "fleet", "Zenoh"):
        import zenoh  # noqa: F401
    _configured(config)


def _close(session: "zenoh.Session") -> None:
    import zenoh

    # Notification may fail; others then miss the keep-alives.
    with contextlib.suppress(zenoh.ZError):
        session.close()  # type: ignore[no-untyped-call]


def _error_text(error: Exception) -> str:
    """Return an error of Zenoh in one line, without source locations, and cut if it is long."""
    text = " ".join(str(error).split(" at ")[0].replace("\\n", " ").split())
    return text if len(text) <= ERROR_MAX else f"{text[:ERROR_MAX]}…"


def _configured(config: BusConfig) -> "zenoh.Config":
    import zenoh

    made = zenoh.Config()
    for place, text in sections(config).items():
        try:
            made.insert_json5(place, text)
        except zenoh.ZError as error:
            raise UserError(f"Zenoh's configuration, {place}: {_error_text(error)}") from error
    return made
