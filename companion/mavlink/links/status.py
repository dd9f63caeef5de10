"""Counters of a link, for the operator and for metrics.

Counters only increase. Frames rejected by signing are counted only in ``lost``: a sender that
cannot authenticate itself changes no other counter.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from companion.values import Source
from companion.values.described import Meaning

LinkState = Literal["up", "connecting", "down"]
Arrival = Literal["kernel", "read"]


@dataclass(slots=True, kw_only=True)
class ComponentStatus:
    """One component as received over one link; ``heard_ns`` is the time of its last frame."""

    frames: Annotated[int, Meaning("frames received")]
    gaps: Annotated[int, Meaning("least number of missing frames, by sequence number")]
    heard_ns: int
    mavlink: Annotated[int, Meaning("MAVLink version of its last frame")]


@dataclass(slots=True, kw_only=True)
class LinkStatus:
    """State and counters of one link.

    A listening link is up while it listens; a connecting link is "connecting" until its peer or
    device answers. A gap of n frames counts as n modulo 256 in ``gaps``; a sender that restarts can
    add one wrong gap (see ``peers``). ``late`` frames were counted in ``gaps`` before, or are
    copies. ``receive_buffer_bytes`` and ``overflowed`` are None for streams, and if the system does
    not report them. ``heard_ns`` is the time of the last frame.
    """

    url: Annotated[str, Meaning("address of the link", example="udpin:0.0.0.0:14550")]
    state: Annotated[LinkState, Meaning("up, trying to connect, or down")] = "down"
    frames: Annotated[int, Meaning("frames accepted")] = 0
    bytes: Annotated[int, Meaning("bytes received")] = 0
    peers: Annotated[int, Meaning("peers so far; each new connection counts")] = 0
    lost: Annotated[dict[str, int], Meaning("unusable frames, by reason; garbage in bytes")] = (
        field(default_factory=dict)
    )
    gaps: Annotated[int, Meaning("least number of missing frames, by sequence number")] = 0
    late: Annotated[int, Meaning("frames with an earlier sequence number: late or copies")] = 0
    repeats: Annotated[int, Meaning("frames with the previous frame's sequence number")] = 0
    sent: Annotated[int, Meaning("frames sent")] = 0
    send_dropped: Annotated[int, Meaning("frames that could not be sent")] = 0
    arrival: Annotated[
        Arrival, Meaning("source of arrival times: the kernel's time stamp, or the time of reading")
    ] = "read"
    misstamped: Annotated[
        int, Meaning("datagrams with an impossible kernel time stamp; the time of reading was used")
    ] = 0
    receive_buffer_bytes: Annotated[
        int | None, Meaning("receive buffer that the system granted (Linux doubles the request)")
    ] = None
    overflowed: Annotated[
        int | None, Meaning("datagrams dropped: receive buffer full, or too old to be used")
    ] = None
    heard_ns: int | None = None
    components: dict[Source, ComponentStatus] = field(default_factory=dict)

    @property
    def bad_crc(self) -> Annotated[int, Meaning("frames with a wrong checksum", label="Bad CRC")]:
        return self.lost.get("bad-crc", 0)
