"""One Zenoh session: what is published, heard, asked and answered, and who is alive.       [shell]

Over 300 lines: the only file that knows Zenoh (https://zenoh.io, the extra ``[fleet]``). Its
callbacks come on threads of its own; what they bring is handed to the event loop. Only answers to
questions are given on Zenoh's thread, since a clock must not wait for a busy loop. Nothing here
waits for the network but ``open`` and ``close``, which belong on a thread.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from companion.mavlink.links.to_loop import ToLoop
from companion.mavlink.links.zenoh_config import BusConfig, Priority, sections
from companion.values import UserError
from companion.values.extras import needs

if TYPE_CHECKING:
    import zenoh

PUBLISHERS_MAX: Final = 1024
"""Keys declared, so that their names go over the wire once; beyond it, all are begun anew."""
NO_ROUTER: Final = "Unable to connect"
"""What Zenoh says when a client reaches none of its endpoints."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusStatus:
    """Counts, which only grow.

    sent     samples given to Zenoh. What it then drops at a congested link it does not tell: number
             what is published, and the other end sees the holes
    """

    sent: int
    refused: int  # samples that Zenoh did not take, or after close
    heard: int  # samples, answers and signs of life handed over
    dropped: int  # those for which there was no room while the loop was busy


def open_peer(config: BusConfig) -> "zenoh.Session":
    """The session of a peer, before there is a loop; blocks. Raises ``UserError`` as ``open``."""
    with needs("zenoh", "fleet", "Zenoh"):
        import zenoh
    try:
        return zenoh.open(_configured(config))
    except zenoh.ZError as error:
        raise UserError(f"Zenoh: {_error_text(error)}") from error


class Bus:
    """A Zenoh session. All methods but ``open`` and ``close`` are called on the loop.

    ``session`` is one that is open already (``open_peer``); None: ``open`` opens one.

    ``run`` raises what a callback raised: after that nothing more is handed over.
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
        self._declared: list[Any] = []  # what ends when nobody holds it any more

    def open(self) -> None:
        """Open the session; blocks. An absent neighbour is no error: it is tried again and again.

        A client has no session without its router, so this waits for it; ``close`` ends that.
        Raises ``UserError`` where the package is missing, an endpoint or a file is wrong, or an
        address cannot be had.
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
        """Wait until cancelled; raises what a callback raised."""
        await self._to_loop.run()

    def close(self) -> None:
        """End the session; blocks until others were told. Nothing is handed over afterwards."""
        self._to_loop.end()
        self._ended.set()
        if self._session is not None:
            _close(self._session)

    # --- publishing and asking ---------------------------------------------------------------

    def put(
        self,
        key: str,
        payload: bytes,
        *,
        express: bool = False,
        priority: Priority = "data",
        reliable: bool = True,
    ) -> bool:
        """Publish a sample; False if Zenoh did not take it.

        What a congested link has no room for is dropped, unseen. ``express`` sends it at once
        rather than with what follows, for single samples: of a burst only ``QUEUED`` find room.
        Not ``reliable``: over an endpoint ``?rel=0`` where there is one, with no wait for what was
        lost before.
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
        """Whether somebody listens to what ``put`` publishes under ``key``, with this priority."""
        import zenoh

        try:
            status: Any = self._publisher(key, priority, False, True).matching_status
            return bool(status.matching)  # its annotation says that it is a bool, and it is not
        except zenoh.ZError:
            return False

    def ask(
        self, key: str, payload: bytes, timeout_s: float, take: Callable[[bytes, int], None]
    ) -> None:
        """Ask who serves ``key``; ``take`` is called with each answer, if one comes in time.

        Its second argument is the monotonic time, ns, at which Zenoh's thread had the answer.
        """
        import zenoh

        def answered(reply: "zenoh.Reply") -> None:
            arrived_ns = time.monotonic_ns()
            if reply.ok is not None:
                answer = reply.ok.payload.to_bytes()
                self._to_loop.post(lambda: take(answer, arrived_ns))

        self._opened().get(
            key,
            zenoh.handlers.Callback(answered, indirect=False),
            payload=payload,
            timeout=timeout_s,
            # Else an answer is held back until nobody can give another.
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )

    # --- hearing and answering ---------------------------------------------------------------

    def subscribe(self, key_expr: str, take: Callable[[str, bytes], None]) -> Callable[[], None]:
        """Have ``take`` called with the key and the payload of every sample from others.

        Returns what ends that: samples that are on their way to the loop are still handed over.
        """
        import zenoh

        def heard(sample: "zenoh.Sample") -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                key, payload = str(sample.key_expr), sample.payload.to_bytes()
                self._to_loop.post(lambda: take(key, payload))

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
        """Have questions about ``key`` answered, at once, on Zenoh's own thread.

        ``answer`` is given the key that was asked for and the payload; None: no answer.
        """
        import zenoh

        def asked(query: "zenoh.Query") -> None:
            try:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                said = answer(str(query.key_expr), payload)
                if said is not None:
                    query.reply(key, said, express=True)
            except zenoh.ZError:  # who asked is gone, or this session
                return
            except Exception as fault:
                self._to_loop.post(partial(self._to_loop.fail, fault))

        self._declared.append(
            self._opened().declare_queryable(
                key, zenoh.handlers.Callback(asked, indirect=False), complete=True
            )
        )

    def alive(self, key: str) -> None:
        """Say that this node is there, until ``close`` or until others miss its signs of life."""
        self._declared.append(self._opened().liveliness().declare_token(key))

    def watch(self, key_expr: str, take: Callable[[str, bool], None]) -> None:
        """Have ``take`` called with each key that is alive, True, and when it is no more, False."""
        import zenoh

        def seen(sample: "zenoh.Sample") -> None:
            key, is_alive = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            self._to_loop.post(lambda: take(key, is_alive))

        callback = zenoh.handlers.Callback(seen, indirect=False)
        liveliness = self._opened().liveliness()
        self._declared.append(liveliness.declare_subscriber(key_expr, callback, history=True))

    def neighbours(self, take: Callable[[str, bool], None]) -> None:
        """Have ``take`` called with the id of each session that this one is, or no more, joined to.

        Those through a router are none.
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
        """The publisher for these, declared when it is first asked for."""
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
    """See that Zenoh is here and can read a configuration. Raises ``UserError`` where not."""
    with needs("zenoh", "fleet", "Zenoh"):
        import zenoh  # noqa: F401
    _configured(config)


def _close(session: "zenoh.Session") -> None:
    import zenoh

    # It may find that others do not listen; they then miss its signs of life.
    with contextlib.suppress(zenoh.ZError):
        session.close()  # type: ignore[no-untyped-call]


def _error_text(error: Exception) -> str:
    """What an error of Zenoh says, in one line without the places in its source."""
    return " ".join(str(error).split(" at ")[0].split())


def _configured(config: BusConfig) -> "zenoh.Config":
    import zenoh

    made = zenoh.Config()
    for place, text in sections(config).items():
        try:
            made.insert_json5(place, text)
        except zenoh.ZError as error:
            raise UserError(f"Zenoh's configuration, {place}: {_error_text(error)}") from error
    return made
