"""Settings of recording, of serving and of the page."""

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from companion.settings.section import Section


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
    weights_hz: Literal["all"] | PositiveFloat = 10.0
    scene_hz: Annotated[float, Field(gt=0, le=100)] = 2.0
    rotate_mb: Annotated[float, Field(ge=0.1, le=1e6)] | None = None
    rotate_s: Annotated[float, Field(ge=1, le=1e7)] = 3600.0


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
