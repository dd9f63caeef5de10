"""Configuration of a Zenoh session, and its conversion to Zenoh's own."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

from companion.mavlink.links.regular_file import open_regular
from companion.values import UserError

QUEUED: Final = 16
"""Batches of each priority that may wait for the network; the most that Zenoh allows.

With Zenoh's default of 2, and without waiting, only 2 of 5 express samples in a row arrive.
"""
MESSAGE_MAX: Final = 1 << 18
"""Longest sample, bytes; Zenoh's default is a gigabyte.

Each neighbour may begin one of each of eight priorities, reliable and not, and never end it.
"""
SESSIONS_MAX: Final = 64  # neighbours that are connected directly; Zenoh's default is 1000
LINKS_MAX: Final = 4  # links to one neighbour: two of each kind, where both connect to each other

Priority = Literal[
    "real_time",
    "interactive_high",
    "interactive_low",
    "data_high",
    "data",
    "data_low",
    "background",
]
Mode = Literal["peer", "client"]


@dataclass(frozen=True, slots=True, kw_only=True)
class BusTls:
    """Certificates for ``tls/`` and ``quic/`` endpoints, as PEM files.

    certificate  this node's own; None only if no server that it connects to asks for one
    """

    ca: Path  # certificate authority of the others
    certificate: Path | None = None
    private_key: Path | None = None  # its key
    mutual: bool = True  # whether clients must present a certificate too
    check_name: bool = True  # whether a certificate must match the host name


@dataclass(frozen=True, slots=True, kw_only=True)
class BusConfig:
    """How a session connects to others.

    mode            "peer" connects to every other peer directly, and no router forwards between two
                    peers; "client" communicates through one router
    listen          endpoints of this node, as in tcp/127.0.0.1:7447; empty: it only connects. A
                    client has none. An endpoint with ?rel=1 may have one with ?rel=0 beside it,
                    ``udp/`` or ``quic/`` (datagrams, by TLS), for unreliable samples
    access_control  a file with Zenoh's section ``access_control``; None: no restrictions
    attempt_s       timeout of a connection attempt: 3 round trips over TCP, 5 with TLS. More on a
                    slow link; an attempt that began during an outage delays its end
    """

    mode: Mode = "peer"
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    connect: tuple[str, ...] = ()  # endpoints of others or of routers
    tls: BusTls | None = None  # certificates; None: endpoints are not tls/
    access_control: Path | None = None
    scouting: bool = False  # whether others are discovered by multicast
    lease_s: float = 1.5  # silence after which a neighbour is disconnected
    keep_alive: int = 4  # keep-alives in one lease
    retry_s: float = 0.25  # time from one attempt to connect to the next
    attempt_s: float = 1.0


def sections(config: BusConfig) -> dict[str, str]:
    """Return Zenoh's configuration as JSON5, by path.

    Raises ``UserError`` if a file cannot be read.
    """
    retry_ms = round(config.retry_s * 1000)
    is_peer = config.mode == "peer"
    has_unreliable = any("rel=0" in one for one in (*config.listen, *config.connect))
    made: dict[str, Any] = {
        "mode": config.mode,
        "listen": {
            "endpoints": config.listen if is_peer else (),
            "timeout_ms": 0,
            "exit_on_failure": True,
        },
        "connect": {
            "endpoints": config.connect,
            "timeout_ms": -1 if is_peer else 0,
            "exit_on_failure": not is_peer,
            "retry": {
                "period_init_ms": retry_ms,
                "period_max_ms": retry_ms,
                "period_increase_factor": 1,
            },
        },
        "scouting/multicast/enabled": config.scouting,
        "scouting/delay": 0,  # open a session before its neighbours are found
        "transport/unicast/max_sessions": SESSIONS_MAX,
        "transport/unicast/max_links": LINKS_MAX if has_unreliable else 1,
        # Otherwise an attempt hangs with ever longer TCP retries after the network is back.
        "transport/unicast/open_timeout": round(config.attempt_s * 1000),
        "transport/unicast/accept_timeout": round(config.attempt_s * 1000),
        "transport/link/rx/max_message_size": MESSAGE_MAX,
        "transport/link/tx/lease": round(config.lease_s * 1000),
        "transport/link/tx/keep_alive": config.keep_alive,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
        "transport/link/tx/queue/size": dict.fromkeys(("control", *get_args(Priority)), QUEUED),
        "transport/shared_memory/enabled": False,
    }
    if config.tls is not None:
        made["transport/link/tls"] = _tls(config.tls)
    texts = {place: json.dumps(value) for place, value in made.items()}
    if config.access_control is not None:
        try:
            with open_regular(config.access_control) as file:
                texts["access_control"] = file.read().decode()
        except OSError as error:
            raise UserError(f"{config.access_control}: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise UserError(f"{config.access_control}: not UTF-8 text") from error
    return texts


def _tls(tls: BusTls) -> dict[str, Any]:
    certificate = None if tls.certificate is None else str(tls.certificate)
    private_key = None if tls.private_key is None else str(tls.private_key)
    return {
        "root_ca_certificate": str(tls.ca),
        "listen_certificate": certificate,
        "listen_private_key": private_key,
        "connect_certificate": certificate,
        "connect_private_key": private_key,
        "enable_mtls": tls.mutual,
        "verify_name_on_connect": tls.check_name,
    }
