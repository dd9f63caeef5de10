"""Endpoints that only hear: what they would be sent is no MAVLink.                       [shell]"""

from collections.abc import Collection, Hashable

from companion.mavlink.links.tcp import TcpOut
from companion.mavlink.links.udp import UdpIn


class TcpListen(TcpOut):
    """A link that connects to one peer, and only hears it."""

    def peers(self) -> Collection[Hashable]:
        """Nobody can be sent anything."""
        return ()

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send nothing."""
        return False


class UdpListen(UdpIn):
    """A link that listens for datagrams, and only hears them."""

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send nothing."""
        return False
