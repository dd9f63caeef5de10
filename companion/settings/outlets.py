"""Settings of recordings, HTTP, binary records, a driven device and the page."""

import ipaddress
import re
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from companion.settings.section import FileName, FolderName, Section, UavName
from companion.values import UserError, shown

_ADDRESS: Final = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([0-9.]+)):([0-9]{1,5})")


def host_and_port(text: str) -> tuple[str, int]:
    """Parse IP:PORT (IPv6 in brackets). Raises ``UserError`` for any other form."""
    found = _ADDRESS.fullmatch(text)
    try:
        host = str(ipaddress.ip_address(found[1] or found[2])) if found else ""
    except ValueError:
        host = ""
    if not host or not found or not 1 <= int(found[3]) <= 65535:
        raise UserError(f"{shown(text)} is not IP:PORT, such as 127.0.0.1:9000 or [::1]:9000")
    return host, int(found[3])


def _addresses(texts: tuple[str, ...]) -> tuple[str, ...]:
    for text in texts:
        host_and_port(text)
    return texts


class RecordSettings(Section):
    """Destinations of binary records with the weights of each update, in a fixed layout.

    udp            addresses (IP:PORT) to which datagrams are sent
    shared_memory  file of a ring buffer of records, such as /dev/shm/uav-beams
    guaranteed     whether records contain the guaranteed gain, which takes milliseconds to compute;
                   otherwise it is NaN
    """

    udp: Annotated[tuple[str, ...], Field(max_length=16), AfterValidator(_addresses)] = ()
    shared_memory: FileName | None = None
    guaranteed: bool = False


class RecordingSettings(Section):
    """Settings of recordings: directory, rates and file sizes.

        directory   folder of the recordings; None: no recording
        weights_hz  largest rate of recorded weights and tracks, or "all"
        scene_hz    largest rate of the recorded scene
        rotate_mb   size at which a new file begins, millions of bytes; None: no limit
        rotate_s    time after which a new file begins, seconds

    The files of one run replay together to the digest of that run.
    """

    directory: FolderName | None = None
    weights_hz: Literal["all"] | Annotated[float, Field(ge=1e-3, le=1e6)] = 10.0
    scene_hz: Annotated[float, Field(ge=1e-3, le=100)] = 2.0
    rotate_mb: Annotated[float, Field(ge=0.1, le=1e6)] | None = None
    rotate_s: Annotated[float, Field(ge=1, le=1e7)] = 3600.0


class DriveSettings(Section):
    """Settings of a device that the service drives itself.

    target    as for ``companion drive``, such as rotctld:HOST:PORT; None: no device
    uavs      UAVs to follow, highest priority first; empty: [beams] priority, then any UAV
    aim       "first": the first UAV with a beam; "centre": a mount points at the centre of all
              that have one
    on_stale  state of the device without beams, and after the end
    """

    target: str | None = None
    uavs: Annotated[tuple[UavName, ...], Field(max_length=1000)] = ()
    aim: Literal["first", "centre"] = "first"
    on_stale: Literal["hold", "boresight", "mute"] = "hold"


class PageSettings(Section):
    """Settings of the page's map.

    ``map`` is a PMTiles file for the background of the plan view; None: range rings only. This
    service serves the map; the page loads nothing from other servers.
    """

    map: str | None = None


class ServerSettings(Section):
    """Addresses of the HTTP server and of the live Foxglove channels.

    ``listen`` is HOST:PORT. ``hosts`` are further names by which clients may call this machine,
    such as that of a reverse proxy; its addresses, its own name and ``localhost`` are always
    allowed. ``foxglove`` is a port of this machine that serves the channels of a recording live
    (None: off, 0: any free port); it needs the extra ``live``.
    """

    listen: str = "127.0.0.1:8080"
    hosts: Annotated[tuple[str, ...], Field(max_length=100)] = ()
    foxglove: Annotated[int, Field(ge=0, le=65535)] | None = None
