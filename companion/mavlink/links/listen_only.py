"""Receive-only endpoints, for formats other than MAVLink."""

from collections.abc import Collection, Hashable

from companion.mavlink.links.tcp import TcpOut
from companion.mavlink.links.udp import UdpIn


class TcpListen(TcpOut):
    """Receive-only link that connects to one peer."""

    def peers(self) -> Collection[Hashable]:
        """Return no peers: the link is receive-only."""
        return ()

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send nothing: the link is receive-only."""
        return False


class UdpListen(UdpIn):
    """Receive-only link that listens for datagrams."""

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send nothing: the link is receive-only."""
        return False
