"""What a link has seen so far: counts, for the operator and for metrics.

Counts only grow. Frames that were refused (signing) are in ``lost`` and nowhere else: who cannot
prove who he is moves no other number.
"""

from dataclasses import dataclass, field
from typing import Literal

from companion.values import Source

LinkState = Literal["up", "connecting", "down"]


@dataclass(slots=True)
class ComponentStatus:
    """One component as heard over one link. ``gaps`` as in ``LinkStatus``; ``version`` is the
    MAVLink version of its last frame."""

    frames: int
    gaps: int
    heard_ns: int
    version: int


@dataclass(slots=True)
class LinkStatus:
    """What a link has seen so far.

    ``state``: ``up`` (a listening link: it listens), ``connecting`` (the peer or the device is
    away; it is tried again and again) or ``down`` (not run). ``peers``: peers met, a connection
    that is made again counts anew. ``lost``: rejections by reason; garbage in bytes.

    ``gaps``: frames missing by the sender's sequence number, by peer and sender. The number has 8
    bits, so a hole of n frames shows as n modulo 256: it is a lower bound, and a sender that
    starts again can add one wrong hole (see ``peers``). ``late``: frames that step back by less
    than half a round; each was in ``gaps`` before, or is a copy. ``repeats``: the same number as
    the frame before.

    ``sent`` and ``send_dropped``: frames that a peer was sent, and those that it did not take.
    ``receive_buffer_bytes``: what the system granted (Linux counts its own bookkeeping in and says
    twice of what was asked for); ``overflowed``: datagrams that it dropped because that was full.
    Both None where there is no such thing (streams) or the system does not say.
    ``heard_ns``: time of the last frame.
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
    receive_buffer_bytes: int | None = None
    overflowed: int | None = None
    heard_ns: int | None = None
    components: dict[Source, ComponentStatus] = field(default_factory=dict)
