"""Links by their URLs.

udpout:HOST:PORT      one datagram a frame, to one peer
udpin:HOST:PORT       to everybody who has sent something here, as to a vehicle's own port
tcp:HOST:PORT         connect, once
tcpin:HOST:PORT       serve everybody who connects, from then on, as SITL does
serial:DEVICE:BAUD
"""

import asyncio
import socket
from typing import Final

from companion.mavlink.urls import LinkError, LinkUrl
from sitl_replay.endpoints import (
    Endpoint,
    Receive,
    TcpPeer,
    TcpServer,
    UdpPeer,
    UdpServer,
    ignore,
    reason,
)

RECEIVE_BUFFER_BYTES: Final = 4 << 20


async def open_endpoint(url: LinkUrl, receive: Receive = ignore) -> Endpoint:
    """Open a link. ``LinkError`` where that is not possible."""
    try:
        match url.scheme:
            case "udpout":
                return await _udp_peer(url, receive)
            case "udpin":
                return await _udp_server(url, receive)
            case "tcp":
                return await _tcp_peer(url, receive)
            case "tcpin":
                return await _tcp_server(url, receive)
            case "serial":
                from sitl_replay.serial_port import open_port

                return open_port(url, receive)
    except (OSError, UnicodeError) as error:
        raise LinkError(f"{url}: {reason(error)}") from error


async def _udp_peer(url: LinkUrl, receive: Receive) -> UdpPeer:
    opened = await _udp_socket(url)
    _, peer = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: UdpPeer(url, receive, opened), sock=opened
    )
    return peer


async def _udp_server(url: LinkUrl, receive: Receive) -> UdpServer:
    opened = await _udp_socket(url)
    chosen = LinkUrl(url.scheme, url.host, opened.getsockname()[1])
    _, peer = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: UdpServer(chosen, receive), sock=opened
    )
    return peer


async def _udp_socket(url: LinkUrl) -> socket.socket:
    """Connected or bound. By hand: it is then closed if that fails, on every event loop."""
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(url.host, url.port, type=socket.SOCK_DGRAM)
    family, kind, protocol, _, address = found[0]
    opened = socket.socket(family, kind, protocol)
    try:
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        if url.scheme == "udpin":
            opened.bind(address)
        else:
            opened.connect(address)
    except BaseException:
        opened.close()
        raise
    return opened


async def _tcp_peer(url: LinkUrl, receive: Receive) -> TcpPeer:
    loop = asyncio.get_running_loop()
    _, peer = await loop.create_connection(lambda: TcpPeer(url, receive), url.host, url.port)
    return peer


async def _tcp_server(url: LinkUrl, receive: Receive) -> TcpServer:
    loop = asyncio.get_running_loop()
    peer = TcpServer(url, receive)
    peer.server = await loop.create_server(peer.visitor, url.host, url.port)
    peer.url = LinkUrl(url.scheme, url.host, peer.server.sockets[0].getsockname()[1])
    return peer
