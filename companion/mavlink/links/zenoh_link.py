"""Raw MAVLink frames over Zenoh, for a link.                                              [shell]

    zenoh:KEY                        through the router on this machine, tcp/127.0.0.1:7447
    zenoh:KEY?connect=ENDPOINT       through another router, or to a peer that listens
    zenoh:KEY?listen=ENDPOINT        as a peer that others connect to
    zenoh:KEY?as=hub&...             the other way round

A link hears ``KEY/out`` and says ``KEY/in``: these are the names of who has the vehicles, as with
bluerobotics/mavlink-server, whose "zenohraw" driver has mavlink_raw/out and mavlink_raw/in. A hub
has vehicles: it says ``KEY/out`` and hears ``KEY/in``. A sample is any number of whole frames.

Endpoints are Zenoh's own; what they need more stands in them, as the certificates in
``tls/HOST:7447#root_ca_certificate_file=/etc/companion/ca.pem``.
"""

import asyncio
from collections.abc import Collection, Hashable
from typing import Final

from companion.mavlink.links.endpoints import Upcalls
from companion.mavlink.links.urls import LinkUrl
from companion.mavlink.links.zenoh_bus import Bus, check
from companion.mavlink.links.zenoh_config import BusConfig
from companion.values import UserError

ROUTER: Final = "tcp/127.0.0.1:7447"  # where Zenoh's router listens unless told otherwise
OPEN_S: Final = 5.0  # how long a router is waited for before it is said to be away


class ZenohLink:
    """A link over a Zenoh session of its own, with whoever uses the same key as its one peer.

    It ends when the last neighbour goes that it connected to, and is then opened anew.
    """

    def __init__(self, url: LinkUrl, upcalls: Upcalls) -> None:
        self._config = configuration(url)
        is_hub = "as=hub" in url.path.split("&")
        self._heard_key, self._said_key = (
            f"{url.host}/{way}" for way in (("in", "out") if is_hub else ("out", "in"))
        )
        self._upcalls = upcalls
        self._bus: Bus | None = None

    def open(self) -> None:
        """Do nothing but look whether Zenoh is here and can read the endpoints.

        Raises ``UserError`` where not.
        """
        check(self._config)

    async def serve(self) -> None:
        """Hear and say until there is no neighbour left; raises ``OSError`` then."""
        bus = Bus(self._config, asyncio.get_running_loop())
        near: set[str] = set()

        def joined(who: str, is_joined: bool) -> None:
            near.add(who) if is_joined else near.discard(who)
            if not near and not self._config.listen:
                raise ConnectionError("Zenoh's router is gone")  # ends the bus, and so this

        try:
            async with asyncio.timeout(OPEN_S):
                await asyncio.to_thread(bus.open)
            bus.subscribe(self._heard_key, lambda _, raw: self._upcalls.take(None, raw, None))
            bus.neighbours(joined)
            self._bus = bus
            self._upcalls.up()
            await bus.run()
        except TimeoutError as error:
            raise OSError("Zenoh's router does not answer") from error
        except UserError as error:  # an address that cannot be had now
            raise OSError(str(error)) from error
        finally:
            self._bus = None
            await asyncio.to_thread(bus.close)

    def peers(self) -> Collection[Hashable]:
        """The one peer, None, while somebody listens to what is said here."""
        bus = self._bus
        return (None,) if bus is not None and bus.is_wanted(self._said_key) else ()

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Publish a frame; what a congested link drops is not known."""
        return self._bus is not None and self._bus.put(self._said_key, raw)

    def fullness(self, key: Hashable) -> float:
        """0: Zenoh does not tell."""
        return 0.0


def configuration(url: LinkUrl) -> BusConfig:
    """A peer where it listens; else a client, since no router passes on what peers say."""
    options = [option.partition("=") for option in url.path.split("&")]
    listen = tuple(value for name, _, value in options if name == "listen")
    connect = tuple(value for name, _, value in options if name == "connect")
    if listen:
        return BusConfig(mode="peer", listen=listen, connect=connect)
    return BusConfig(mode="client", listen=(), connect=connect or (ROUTER,))
