"""Settings of a fleet: several nodes that share their UAVs over Zenoh."""

import re
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from companion.settings.section import Section
from companion.values import UserError, shown

_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}")


def is_node_name(text: str) -> bool:
    """Return whether ``text`` is a valid node name."""
    return _NAME.fullmatch(text) is not None


def _name(text: str) -> str:
    if not is_node_name(text):
        allowed = "give at most 32 letters, digits, dots, dashes or underscores"
        raise UserError(f"{shown(text)} is invalid: {allowed}")
    return text


class FleetSettings(Section):
    """Settings of this node's fleet; a fleet needs the extra ``fleet``.

    node           name of this node, unique in the fleet; None: no fleet
    site           name of the fleet; nodes of other sites are ignored
    listen         Zenoh endpoints where other nodes reach this one, such as
                   tcp/192.0.2.1:7447; by default only on this machine
    connect        Zenoh endpoints of other nodes, or of a router
    mode           "peer" connects to every other node directly, "client" through one router
    most           largest number of UAVs that this node serves; None: its number of elements
    lease_s        validity of a node's last message: after it other nodes serve its UAVs
    attempt_s      timeout of a connection attempt: 3 round trips over TCP, 5 with TLS; a longer
                   timeout delays reconnection
    hysteresis_db  least gain for which a UAV is handed over to another node
    nulls          whether beams have nulls towards UAVs that other nodes serve
    share_hz       largest rate at which received frames are shared
    ca, certificate, key   mutual TLS: PEM files of the authority, and of this node's
                   certificate and private key; endpoints are then tls/HOST:PORT
    access_control JSON5 file with Zenoh's section of that name: who may publish and subscribe to
                   which keys
    """

    node: Annotated[str, AfterValidator(_name)] | None = None
    site: Annotated[str, AfterValidator(_name)] = "site"
    listen: Annotated[tuple[str, ...], Field(max_length=16)] = ("tcp/127.0.0.1:0",)
    connect: Annotated[tuple[str, ...], Field(max_length=64)] = ()
    mode: Literal["peer", "client"] = "peer"
    most: Annotated[int, Field(ge=1, le=10_000)] | None = None
    lease_s: Annotated[float, Field(ge=0.5, le=60)] = 1.5
    attempt_s: Annotated[float, Field(ge=0.1, le=60)] = 1.0
    hysteresis_db: Annotated[float, Field(ge=0, le=60)] = 3.0
    nulls: bool = False
    share_hz: Annotated[float, Field(ge=0.1, le=1000)] = 500.0
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None
    access_control: str | None = None
