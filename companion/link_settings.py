"""The sections of the settings that say who is heard, who is tracked, and what is sent."""

import re
from typing import Annotated, Final, Self

from pydantic import (
    AfterValidator,
    Field,
    PositiveFloat,
    ValidationInfo,
    field_validator,
    model_validator,
)

from companion.mavlink.urls import parse_link
from companion.section import Section


def _link(text: str) -> str:
    parse_link(text)
    return text


LinkText = Annotated[str, AfterValidator(_link)]


class LinkSettings(Section):
    """Where MAVLink comes from: ``udpin:``, ``udpout:``, ``tcp:`` and ``tcpin:HOST:PORT``, and
    ``serial:DEVICE:BAUD``."""

    urls: tuple[LinkText, ...] = ()


class PresenceSettings(Section):
    """What the service sends; unless ``enabled``, nothing at all.

    It is then an onboard computer, component ``component_id``, of the system ``system_id``: that of
    the carrier unless said, and needed where the array stands on its own. It sends a heartbeat
    while it is fit to be used, and TIMESYNC requests. Where ``position_hz`` is given, UAVs whose
    GLOBAL_POSITION_INT is slower are asked for it at that rate, and where ``attitude_hz`` is, the
    carrier for its ATTITUDE.
    """

    enabled: bool = False
    system_id: Annotated[int, Field(ge=1, le=254)] | None = None
    component_id: Annotated[int, Field(ge=25, le=250)] = 191
    position_hz: Annotated[float, Field(ge=0.1, le=100)] | None = None
    attitude_hz: Annotated[float, Field(ge=0.1, le=100)] | None = None


class SigningSettings(Section):
    """MAVLink 2 signing. ``keys``: for a link, as it stands in ``links.urls``, the file of its key.

    Such a link takes nothing unsigned, unless it stands in ``allow_unsigned``, and what is sent
    over it is signed. ``timestamps`` is the file in which the newest timestamps are kept across
    restarts: what was heard once is not taken again.
    """

    keys: dict[LinkText, str] = Field(default_factory=dict)
    allow_unsigned: tuple[LinkText, ...] = ()
    timestamps: str = "signing-timestamps.json"

    @field_validator("allow_unsigned")
    @classmethod
    def _have_keys(cls, links: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        for url in links:
            if url not in info.data.get("keys", {}):
                raise ValueError(f"{url} has no key in signing.keys, and takes anything")
        return links


_UAV_PATTERN: Final = re.compile(r"(\d{1,3}|\*):(\d{1,3}|\*)|icao:([0-9A-F]{1,6}|[0-9A-F]{0,5}\*)")


def _uav_pattern(text: str) -> str:
    if not _UAV_PATTERN.fullmatch(text):
        raise ValueError(f"{text!r} is not SYSID:COMPID or icao:HEX; * stands for any")
    return text


UavPattern = Annotated[str, AfterValidator(_uav_pattern)]


class TrackSettings(Section):
    """Who is tracked, and ages of the newest report at which a track passes to the next state, s.

    ``allow`` names those who are (all, where it is empty), ``deny`` those who are not, whatever
    ``allow`` says: ``3:1``, ``3:*``, ``icao:4CA7B3``, ``icao:*``. The carrier always is. After
    ``dropped_s`` a UAV is forgotten. Of ``most`` at a time more are refused: memory and time for
    beams are bounded, whoever sends.

    ``window_s``: how late a report may come and still be used as if in order. A track is begun
    again from reports that were refused once ``reacquire_reports`` of them agree over
    ``reacquire_s``.
    """

    allow: tuple[UavPattern, ...] = ()
    deny: tuple[UavPattern, ...] = ()
    coasting_s: PositiveFloat = 2.0
    stale_s: PositiveFloat = 15.0
    lost_s: PositiveFloat = 60.0
    dropped_s: PositiveFloat = 600.0
    most: Annotated[int, Field(ge=1, le=100_000)] = 2000
    window_s: PositiveFloat = 5.0
    reacquire_reports: Annotated[int, Field(ge=2, le=60)] = 3
    reacquire_s: Annotated[float, Field(ge=0, le=60)] = 3.0

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        ages = (self.coasting_s, self.stale_s, self.lost_s, self.dropped_s)
        if list(ages) != sorted(ages):
            raise ValueError(
                "coasting_s <= stale_s <= lost_s <= dropped_s: a track passes its states in order"
            )
        return self
