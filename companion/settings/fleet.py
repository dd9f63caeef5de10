"""Settings of a fleet: several nodes that share one sky over Zenoh."""

import re
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from companion.settings.section import Section
from companion.values import UserError

_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}")


def is_node_name(text: str) -> bool:
    """Whether a node may have this name."""
    return _NAME.fullmatch(text) is not None


def _name(text: str) -> str:
    if not is_node_name(text):
        raise UserError(f"{text!r}: letters, digits, dot, dash and underscore, at most 32")
    return text


class FleetSettings(Section):
    """The fleet that this node is part of; it needs the extra ``fleet``.

    node           this node's name, which no other node has; None: no fleet
    site           name of the fleet: nodes of other sites are not heard
    listen         Zenoh endpoints where other nodes reach this one, such as
                   tcp/192.0.2.1:7447; on this machine alone unless said otherwise
    connect        Zenoh endpoints of other nodes, or of a router
    mode           "peer" speaks with every other node directly, "client" through one router
    most           UAVs that this node serves at most; None: as many as it has elements
    lease_s        time for which a node's word holds: after it others serve its UAVs
    attempt_s      longest time of an attempt to connect: 3 round trips over TCP, 5 with TLS; longer
                   ones make a fleet whole again later
    hysteresis_db  least gain for which a UAV changes its node
    nulls          whether beams have nulls on UAVs that other nodes serve
    share_hz       how often what was heard is told, at most
    ca, certificate, key   TLS by both ends: PEM files of the authority, and of this node's
                   certificate and private key; endpoints are then tls/HOST:PORT
    access_control JSON5 file with Zenoh's section of that name: who may say and hear what
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
