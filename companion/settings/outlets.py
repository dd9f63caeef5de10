"""Settings of recording, of serving, of records for machines, of a device and of the page."""

import ipaddress
import re
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from companion.settings.section import Section
from companion.values import UserError

_ADDRESS: Final = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([0-9.]+)):([0-9]{1,5})")


def host_and_port(text: str) -> tuple[str, int]:
    """The parts of IP:PORT, IPv6 in brackets. Raises ``UserError`` for anything else."""
    found = _ADDRESS.fullmatch(text)
    try:
        host = str(ipaddress.ip_address(found[1] or found[2])) if found else ""
    except ValueError:
        host = ""
    if not host or not found or not 1 <= int(found[3]) <= 65535:
        raise UserError(f"{text!r} is not IP:PORT, such as 127.0.0.1:9000 or [::1]:9000")
    return host, int(found[3])


def _addresses(texts: tuple[str, ...]) -> tuple[str, ...]:
    for text in texts:
        host_and_port(text)
    return texts


class RecordSettings(Section):
    """Where the weights of each update are pushed to machines, as records of one fixed layout.

    udp            addresses (IP:PORT) to which datagrams are sent
    shared_memory  file of a ring of records, such as /dev/shm/uav-beams
    guaranteed     whether records say the guaranteed gain, which takes milliseconds to compute; it
                   is NaN without
    """

    udp: Annotated[tuple[str, ...], Field(max_length=16), AfterValidator(_addresses)] = ()
    shared_memory: str | None = None
    guaranteed: bool = False


class RecordingSettings(Section):
    """Where, how often and in which portions recordings are written.

        directory   folder of the recordings; None: none are made
        weights_hz  greatest rate at which weights and tracks are written, or "all"
        scene_hz    greatest rate at which the scene is written
        rotate_mb   size at which a new file is begun, millions of bytes; None: no limit
        rotate_s    time after which a new file is begun, seconds

    The files of one run replay together to that run's digest.
    """

    directory: str | None = None
    weights_hz: Literal["all"] | Annotated[float, Field(ge=1e-3, le=1e6)] = 10.0
    scene_hz: Annotated[float, Field(gt=0, le=100)] = 2.0
    rotate_mb: Annotated[float, Field(ge=0.1, le=1e6)] | None = None
    rotate_s: Annotated[float, Field(ge=1, le=1e7)] = 3600.0


class DriveSettings(Section):
    """A device that the service drives itself.

    target    as ``companion drive`` has it, such as rotctld:HOST:PORT; None: nothing is driven
    uavs      whom to follow, in descending order; empty: by [beams] priority, then anybody
    aim       "first": the first of them that has a beam; "centre": a mount looks at the middle of
              all that have one
    on_stale  what the device does without beams, and at the end
    """

    target: str | None = None
    uavs: Annotated[tuple[str, ...], Field(max_length=1000)] = ()
    aim: Literal["first", "centre"] = "first"
    on_stale: Literal["hold", "boresight", "mute"] = "hold"


class PageSettings(Section):
    """What the page shows beside the state.

    ``map`` is a PMTiles file that lies under the plan view; None: range rings alone. It is served
    from here; nothing is loaded from elsewhere.
    """

    map: str | None = None


class ServerSettings(Section):
    """Where HTTP and the live Foxglove channels are served.

    ``listen`` is HOST:PORT. ``hosts`` are names by which clients may call this machine, beside its
    addresses, its own name and ``localhost``: those of a reverse proxy, say. ``foxglove`` is a port
    of this machine on which the channels of a recording are served live (None: nowhere, 0: any free
    port); it needs the extra ``live``.
    """

    listen: str = "127.0.0.1:8080"
    hosts: Annotated[tuple[str, ...], Field(max_length=100)] = ()
    foxglove: Annotated[int, Field(ge=0, le=65535)] | None = None
