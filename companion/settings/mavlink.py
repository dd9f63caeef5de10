"""Settings of the links: what is received, which UAVs are tracked, and what is sent."""

import re
from typing import Annotated, Final, Literal, Self

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from companion.mavlink.links.urls import Scheme, parse_link
from companion.settings.section import FileName, Section
from companion.values import UAV_FORMS, UserError, shown


def _link(text: str) -> str:
    parse_link(text)
    return text


LinkText = Annotated[str, AfterValidator(_link)]


class LinkSettings(Section):
    """Links on which MAVLink, and reports of other receivers, are received.

    URLs are ``udpin:``, ``udpout:``, ``tcp:`` or ``tcpin:HOST:PORT``, ``serial:DEVICE:BAUD``,
    ``zenoh:KEY``, and those of other receivers: ``sbs:`` or ``readsb:HOST:PORT``,
    ``readsb:http://HOST/PATH``, ``rid:HOST:PORT``, ``rid:udp:HOST:PORT``, ``cot:udp:HOST:PORT``,
    ``cot:tcp:HOST:PORT``.

    ``routers`` are trusted peers: if peers contradict each other about the position of a vehicle,
    the position by ``routers`` is used. A peer is a link as in ``urls``, HOST, or HOST:PORT. Two
    peers that agree about a vehicle need no entry; with one, attitudes and TIMESYNC answers of
    both are used.
    """

    urls: tuple[LinkText, ...] = ()
    routers: Annotated[tuple[str, ...], Field(max_length=100)] = ()


class PresenceSettings(Section):
    """What the service sends over MAVLink: nothing unless ``enabled``.

        system_id     its system id; default: the carrier's; needed if the array is fixed
        component_id  its component id
        position_hz   rate requested of UAVs whose GLOBAL_POSITION_INT is slower; None: no request
        attitude_hz   rate of ATTITUDE requested of the carrier; None: no request
        verdicts      whether verdicts on links are sent to ground stations: a STATUSTEXT at each
                      change, and each second NAMED_VALUE_FLOAT with the spare gain of each link

    If enabled, the service acts as an onboard computer: it sends a heartbeat while it can compute
    beams, and TIMESYNC requests.
    """

    enabled: bool = False
    system_id: Annotated[int, Field(ge=1, le=254)] | None = None
    component_id: Annotated[int, Field(ge=25, le=250)] = 191
    position_hz: Annotated[float, Field(ge=0.1, le=100)] | None = None
    attitude_hz: Annotated[float, Field(ge=0.1, le=100)] | None = None
    verdicts: bool = False


class SigningSettings(Section):
    """Settings of MAVLink 2 message signing.

        keys            file of the key for each link, by URL as in ``links.urls``
        allow_unsigned  links with a key that also accept unsigned frames
        timestamps      file that keeps the newest timestamps across restarts, so that a frame
                        received before a restart is rejected after it

    Frames sent over a link with a key are signed.
    """

    keys: dict[LinkText, str] = Field(default_factory=dict)
    allow_unsigned: tuple[LinkText, ...] = ()
    timestamps: FileName = "signing-timestamps.json"

    @field_validator("allow_unsigned")
    @classmethod
    def _have_keys(cls, links: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        for url in links:
            if url not in info.data.get("keys", {}):
                raise UserError(
                    f"{url} has no key in signing.keys, so it accepts unsigned frames; remove it"
                )
        return links


_UAV_PATTERN: Final = re.compile(
    r"(\d{1,3}|\*):(\d{1,3}|\*)|icao:([0-9A-F]{1,6}|[0-9A-F]{0,5}\*)|(rid|cot):[A-Za-z0-9._*-]{1,64}"
)


_OUT: Final[tuple[Scheme, ...]] = ("udpout", "tcp", "tcpin", "serial", "zenoh", "cot")


def _uav_pattern(text: str) -> str:
    if not _UAV_PATTERN.fullmatch(text):
        raise UserError(f"{shown(text)} is not {UAV_FORMS}; * matches anything")
    return text


Age = Annotated[float, Field(gt=0, le=1e7)]
UavPattern = Annotated[str, AfterValidator(_uav_pattern)]


def _out_link(text: str) -> str:
    url = parse_link(text, _OUT)
    if url.port == 0:
        raise UserError(f"{shown(text)}: port 0 is invalid as a destination; give 1 to 65535")
    return text


class OutSettings(Section):
    """Settings of tracks sent to other programs on separate links: none unless ``urls`` are given.

    urls     ``udpout:``, ``tcp:``, ``tcpin:HOST:PORT``, ``serial:DEVICE:BAUD`` or ``zenoh:KEY`` get
             ``message`` of each vehicle that reports itself; ``cot:udp:HOST:PORT``
             (sends datagrams there, also to a group) and ``cot:tcp:HOST:PORT`` (connects) get
             Cursor on Target of every aircraft
    message  MAVLink message for positions
    rate_hz  rate for each aircraft
    stale_s  validity of a Cursor on Target event, seconds
    uavs     patterns of the UAVs to send; empty: all
    """

    urls: tuple[Annotated[str, AfterValidator(_out_link)], ...] = ()
    message: Literal["GLOBAL_POSITION_INT", "UTM_GLOBAL_POSITION"] = "GLOBAL_POSITION_INT"
    rate_hz: Annotated[float, Field(ge=0.1, le=50)] = 5.0
    stale_s: Annotated[float, Field(ge=1, le=600)] = 10.0
    uavs: tuple[UavPattern, ...] = ()


class TrackSettings(Section):
    """Settings of which UAVs are tracked, and of how a track ages.

        allow              UAVs to track; empty: all
        deny               UAVs not to track; overrides ``allow``
        coasting_s         age of the newest report at which a track is coasting, seconds; longer
                           for a link whose reports come less often
        stale_s            age at which it is stale, seconds
        lost_s             age at which it is lost, seconds
        dropped_s          age at which a UAV is forgotten, seconds
        most               largest number of tracked UAVs; reports of further ones are rejected, so
                           that memory and time stay bounded
        window_s           largest delay of a report that is still put in order, seconds
        reacquire_reports  number of rejected reports that must agree with each other before the
                           track is restarted from them
        reacquire_s        time over which they must agree, seconds

    Patterns are ``3:1``, ``3:*``, ``icao:4CA7B3``, ``icao:*``, ``rid:*`` or ``cot:*``. The carrier
    is always tracked.
    """

    allow: tuple[UavPattern, ...] = ()
    deny: tuple[UavPattern, ...] = ()
    coasting_s: Age = 2.0
    stale_s: Age = 15.0
    lost_s: Age = 60.0
    dropped_s: Age = 600.0
    most: Annotated[int, Field(ge=1, le=100_000)] = 1000
    window_s: Annotated[float, Field(gt=0, le=3600)] = 5.0
    reacquire_reports: Annotated[int, Field(ge=2, le=60)] = 3
    reacquire_s: Annotated[float, Field(ge=0, le=60)] = 1.0

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        ages = (self.coasting_s, self.stale_s, self.lost_s, self.dropped_s)
        if list(ages) != sorted(ages):
            raise UserError("ages out of order: need coasting_s <= stale_s <= lost_s <= dropped_s")
        return self
