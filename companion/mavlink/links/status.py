"""Counts of what a link has seen, for the operator and for metrics.

Counts only grow. Frames refused by signing are in ``lost`` and nowhere else: a sender that cannot
prove who it is changes no other number.
"""

from dataclasses import dataclass, field
from typing import Literal

from companion.values import Source

LinkState = Literal["up", "connecting", "down"]
Arrival = Literal["kernel", "read"]


@dataclass(slots=True, kw_only=True)
class ComponentStatus:
    """One component as heard over one link.

    frames    frames heard
    gaps      frames missing, as in ``LinkStatus``
    heard_ns  time of the last frame
    version   MAVLink version of the last frame
    """

    frames: int
    gaps: int
    heard_ns: int
    version: int


@dataclass(slots=True, kw_only=True)
class LinkStatus:
    """The state and the counts of one link.

        state         "up" (a listening link: it listens), "connecting" (the peer or the device is
                      away and is tried again and again) or "down" (not run)
        frames        frames accepted
        bytes         bytes received
        peers         peers met; a connection that is made again counts anew
        lost          rejections by reason; garbage in bytes
        gaps          frames missing by sequence number, per peer and sender. A hole of n frames
                      shows as n modulo 256, so this is a lower bound; a sender that starts again
                      can add one wrong hole (see ``peers``)
        late          frames that step back by less than half a round; each was counted in ``gaps``
                      before, or is a copy
        repeats       frames with the same number as the frame before
        sent          frames that a peer was sent
        send_dropped  frames that it did not take
        arrival       what tells when a frame arrived: "kernel", the system's stamp on its datagram;
                      or "read", the time at which it was read here
        misstamped    datagrams whose stamp could not be true, as when the wall clock was set: they
                      count as arrived when they were read
        overflowed    datagrams that the system dropped because its receive buffer was full, or that
                      had waited too long
        heard_ns      time of the last frame
        components    counts of each component

    ``receive_buffer_bytes`` is the buffer that the system granted (Linux includes its own
    bookkeeping and says twice what was asked for). It and ``overflowed`` are None for streams, and
    where the system does not say.
    """

    url: str
    state: LinkState = "down"
    frames: int = 0
    bytes: int = 0
    peers: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    gaps: int = 0
    late: int = 0
    repeats: int = 0
    sent: int = 0
    send_dropped: int = 0
    arrival: Arrival = "read"
    misstamped: int = 0
    receive_buffer_bytes: int | None = None
    overflowed: int | None = None
    heard_ns: int | None = None
    components: dict[Source, ComponentStatus] = field(default_factory=dict)
