"""Requests to all autopilots for message rates; ``rate_watch`` handles one message of one UAV."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from companion.mavlink.voice.rate_watch import MessageRate, ObservedRate, RateState, Request, Watch
from companion.mavlink.wire.decode import ATTITUDE
from companion.mavlink.wire.encode import Outgoing
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.values import Notice, Source

_NS: Final = 1_000_000_000
SILENCE_NS: Final = 5 * _NS  # silence after which a UAV gets no requests
FORGET_NS: Final = 30 * _NS  # silence after which a UAV is forgotten
REQUESTS_PER_S: Final = 5  # most requests sent in any second


@dataclass(slots=True)
class _Uav:
    heard_ns: int
    watches: dict[int, Watch]


class MessageRates:
    """Monitored messages of all UAVs, with the requests for their rates.

    ``source`` requests ``position_hz`` of every UAV and ``attitude_hz`` of the carrier; None: any
    rate is accepted. ``notices`` collects messages to the operator; the reader empties it.
    """

    def __init__(
        self,
        *,
        source: Source,
        carrier: Source | None,
        position_hz: float | None,
        attitude_hz: float | None,
    ) -> None:
        self.notices: list[Notice] = []
        self._source = source
        self._carrier = carrier
        self._always: frozenset[Source] = frozenset(() if carrier is None else (carrier,))
        self._wanted_hz = {GLOBAL_POSITION_INT: position_hz, ATTITUDE: attitude_hz}
        self._wanted = self._always
        self._uavs: dict[Source, _Uav] = {}
        self._others: deque[Request] = deque(maxlen=256)
        self._sent: deque[int] = deque(maxlen=REQUESTS_PER_S)

    def message_received(self, t_ns: int, source: Source) -> None:
        """Record that a message of this sender arrived, of any kind."""
        uav = self._uavs.get(source)
        if uav is not None:
            uav.heard_ns = t_ns
        elif source in self._wanted:
            self._uavs[source] = _Uav(t_ns, self._watches(t_ns, source))

    def stamped(self, t_ns: int, source: Source, msgid: int, boot_ms: int) -> None:
        """Record a position or an attitude with its sender's stamp."""
        self.message_received(t_ns, source)
        uav = self._uavs.get(source)
        watch = uav.watches.get(msgid) if uav is not None else None
        if watch is not None:
            watch.observed.add(t_ns, boot_ms)

    def requested(self, request: Request) -> None:
        """Record that another component requested a message rate."""
        self._others.append(request)

    def acknowledged(self, t_ns: int, source: Source, result: int) -> None:
        """Process a COMMAND_ACK of SET_MESSAGE_INTERVAL to this service or to all."""
        uav = self._uavs.get(source)
        asked = [w for w in uav.watches.values() if w.state is RateState.ASKED] if uav else []
        if asked:
            max(asked, key=lambda watch: watch.asked_ns).acknowledged(t_ns, result)

    def due(self, now_ns: int, uavs: Iterable[Source]) -> list[tuple[Outgoing, Source]]:
        """Return the due requests with their targets; ``uavs`` are those whose positions count.

        At most ``REQUESTS_PER_S`` in any second; the one that has waited longest comes first.
        """
        self._wanted = self._always.union(uavs)
        for source in [s for s, u in self._uavs.items() if now_ns - u.heard_ns > FORGET_NS]:
            del self._uavs[source]
        ready = []
        for uav in self._watched():
            for watch in uav.watches.values():
                self.notices += watch.review(now_ns, uav.heard_ns, self._others)
                if watch.ready(now_ns) and now_ns - uav.heard_ns < SILENCE_NS:
                    ready.append(watch)
        out = []
        for watch in sorted(ready, key=lambda watch: watch.next_ns):
            if len(self._sent) == REQUESTS_PER_S and now_ns - self._sent[0] < _NS:
                break
            if any(w.awaits_ack(now_ns) for w in self._uavs[watch.uav].watches.values()):
                continue
            out.append((watch.ask(now_ns, self._source), watch.uav))
            self._sent.append(now_ns)
        return out

    def state(self) -> list[MessageRate]:
        """Return the state of every monitored message, in the UAVs' order of first appearance."""
        return [w.view(uav.heard_ns) for uav in self._watched() for w in uav.watches.values()]

    def _watched(self) -> list[_Uav]:
        return [uav for source, uav in self._uavs.items() if source in self._wanted]

    def _watches(self, now_ns: int, source: Source) -> dict[int, Watch]:
        return {
            msgid: Watch(
                uav=source, msgid=msgid, wanted_hz=wanted_hz, observed=ObservedRate(now_ns)
            )
            for msgid, wanted_hz in self._wanted_hz.items()
            if wanted_hz is not None and (msgid != ATTITUDE or source == self._carrier)
        }
