"""What a Zenoh session is configured with, and how Zenoh reads it.                       [shell]"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

from companion.values import UserError

QUEUED: Final = 16
"""Batches of each priority that wait for the network, the most that Zenoh allows.

With its own 2, and without waiting for room, of 5 samples in a row sent express 2 arrive.
"""
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

    certificate  this node's own; None only for one that connects to who does not ask for it
    """

    ca: Path  # what signed the certificates of others
    certificate: Path | None = None
    private_key: Path | None = None  # its key
    mutual: bool = True  # whether who connects must show a certificate too
    check_name: bool = True  # whether a certificate must be that of the host that was connected to


@dataclass(frozen=True, slots=True, kw_only=True)
class BusConfig:
    """How a session reaches others.

    mode            "peer" speaks with every other peer directly, and no router passes on what two
                    peers say; "client" speaks through one router
    listen          endpoints of this node, as in tcp/127.0.0.1:7447; empty: it only connects. A
                    client has none. Beside one with ?rel=1 one with ?rel=0 may stand, ``udp/`` or
                    ``quic/`` (datagrams, by TLS), for what need not be reliable
    access_control  a file with Zenoh's section ``access_control``; None: who connects may do all
    attempt_s       longest time that an attempt takes: 3 round trips over TCP, 5 with TLS. More
                    on a slow link; what began in a parting delays its end
    """

    mode: Mode = "peer"
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    connect: tuple[str, ...] = ()  # endpoints of others or of routers
    tls: BusTls | None = None  # certificates; None: endpoints are not tls/
    access_control: Path | None = None
    scouting: bool = False  # whether others are looked for by multicast
    lease_s: float = 1.5  # silence after which a neighbour is given up
    keep_alive: int = 4  # signs of life in one lease
    retry_s: float = 0.25  # time from one attempt to connect to the next
    attempt_s: float = 1.0


def sections(config: BusConfig) -> dict[str, str]:
    """Places in Zenoh's configuration, and the JSON5 that stands there.

    Raises ``UserError`` where a file cannot be read.
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
        "scouting/delay": 0,  # a session is open before its neighbours are found
        "transport/unicast/max_links": LINKS_MAX if has_unreliable else 1,
        # Else an attempt to connect hangs on, ever more rarely heard, after the network is back.
        "transport/unicast/open_timeout": round(config.attempt_s * 1000),
        "transport/unicast/accept_timeout": round(config.attempt_s * 1000),
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
            texts["access_control"] = config.access_control.read_text("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"{config.access_control}: {error}") from error
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
