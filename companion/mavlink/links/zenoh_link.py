"""Link with raw MAVLink frames over Zenoh.

    zenoh:KEY                        through the router on this machine, tcp/127.0.0.1:7447
    zenoh:KEY?connect=ENDPOINT       through another router, or to a listening peer
    zenoh:KEY?listen=ENDPOINT        as a peer that others connect to
    zenoh:KEY?as=hub&...             with both directions swapped

A link subscribes to ``KEY/out`` and publishes ``KEY/in``. The names are from the viewpoint of the
hub, which has the vehicles, as in bluerobotics/mavlink-server with its mavlink_raw/out and
mavlink_raw/in ("zenohraw" driver). A hub publishes ``KEY/out`` and subscribes to ``KEY/in``. A
sample is any number of whole frames.

Endpoints are Zenoh's own, with their options, such as the certificates in
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

ROUTER: Final = "tcp/127.0.0.1:7447"  # default endpoint of Zenoh's router
OPEN_S: Final = 5.0  # how long to wait for a router before the link is reported as down


class ZenohLink:
    """Link over its own Zenoh session; all other sessions under the same key are its one peer.

    It ends when its last neighbour disconnects, and is then opened again.
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
        """Check that Zenoh is installed and accepts the endpoints. Raises ``UserError`` if not."""
        check(self._config)

    def _take(self, _key: str, raw: bytes) -> bool:
        return self._upcalls.take(None, raw, None)

    async def serve(self) -> None:
        """Serve until there is no neighbour left; then raise ``OSError``."""
        bus = Bus(self._config, asyncio.get_running_loop())
        near: set[str] = set()

        def joined(who: str, is_joined: bool) -> None:
            near.add(who) if is_joined else near.discard(who)
            if not near and not self._config.listen:
                raise ConnectionError("Zenoh's router is gone")  # ends the bus, and so this

        try:
            async with asyncio.timeout(OPEN_S):
                await asyncio.to_thread(bus.open)
            bus.subscribe(self._heard_key, self._take)
            bus.neighbours(joined)
            self._bus = bus
            self._upcalls.up()
            await bus.run()
        except TimeoutError as error:
            raise OSError("Zenoh's router does not answer") from error
        except (UserError, RuntimeError) as error:  # an address or a thread is not available now
            raise OSError(str(error)) from error
        finally:
            self._bus = None
            try:
                await asyncio.to_thread(bus.close)
            except RuntimeError:  # the system allows no more threads
                bus.close()

    def peers(self) -> Collection[Hashable]:
        """Return the one peer, None, while there is a subscriber to this link's key."""
        bus = self._bus
        return (None,) if bus is not None and bus.is_wanted(self._said_key) else ()

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Publish a frame; drops at a congested link are not reported."""
        return self._bus is not None and self._bus.put(self._said_key, raw)

    def fullness(self, key: Hashable) -> float:
        """Return 0: Zenoh does not report its buffers."""
        return 0.0


def configuration(url: LinkUrl) -> BusConfig:
    """Return the configuration: peer if it listens, else client.

    No router forwards what peers publish.
    """
    options = [option.partition("=") for option in url.path.split("&")]
    listen = tuple(value for name, _, value in options if name == "listen")
    connect = tuple(value for name, _, value in options if name == "connect")
    if listen:
        return BusConfig(mode="peer", listen=listen, connect=connect)
    return BusConfig(mode="client", listen=(), connect=connect or (ROUTER,))
