"""Endpoint and splitter of each link scheme."""

from collections.abc import Callable
from typing import Final

from companion.mavlink.links.endpoints import Endpoint, Upcalls
from companion.mavlink.links.http_poll import HttpPoll
from companion.mavlink.links.listen_only import TcpListen, UdpListen
from companion.mavlink.links.peers import Splits
from companion.mavlink.links.serial_port import SerialPort
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.links.tcp import TcpIn, TcpOut
from companion.mavlink.links.udp import UdpIn, UdpOut
from companion.mavlink.links.urls import LinkUrl
from companion.mavlink.links.zenoh_link import ZenohLink
from companion.mavlink.wire.aircraft_json import AircraftJson
from companion.mavlink.wire.beast import BeastSplitter
from companion.mavlink.wire.cot_link import CotSplitter
from companion.mavlink.wire.framing import Checker, SplitLimits, Splitter, search_budget
from companion.mavlink.wire.rid_json import RidJson
from companion.mavlink.wire.sbs import SbsSplitter

FRAMES_AT_ONCE: Final = 16  # frames processed before other work runs; one may take 0.3 ms


def splitter(url: LinkUrl) -> Callable[[str], Splits]:
    """Return the factory of a link's splitters; each peer has its own, and all share a cache."""
    match url.scheme:
        case "sbs":
            return SbsSplitter
        case "readsb":
            return AircraftJson if url.way else BeastSplitter
        case "rid":
            return RidJson
        case "cot":
            return CotSplitter
        case _:
            limits = SplitLimits(search=search_budget(), at_once=FRAMES_AT_ONCE)
            checker = Checker()
            return lambda link: Splitter.sharing(checker, link, limits)


def endpoint(url: LinkUrl, status: LinkStatus, upcalls: Upcalls) -> Endpoint:
    """Return the endpoint of a link's scheme, not yet open."""
    match url.scheme:
        case "udpin":
            return UdpIn(url, status, upcalls)
        case "udpout":
            return UdpOut(url, status, upcalls)
        case "tcp":
            return TcpOut(url, upcalls)
        case "tcpin":
            return TcpIn(url, upcalls)
        case "sbs" | "readsb":
            return HttpPoll(url, upcalls) if url.way else TcpListen(url, upcalls)
        case "rid" | "cot":
            return UdpListen(url, status, upcalls) if url.listens else TcpListen(url, upcalls)
        case "serial":
            return SerialPort(url, upcalls)
        case "zenoh":
            return ZenohLink(url, upcalls)
