"""Settings of the links: who is heard, who is tracked, and what is sent."""

import re
from typing import Annotated, Final, Literal, Self

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from companion.mavlink.links.urls import Scheme, parse_link
from companion.settings.section import Section
from companion.values import UAV_FORMS, UserError


def _link(text: str) -> str:
    parse_link(text)
    return text


LinkText = Annotated[str, AfterValidator(_link)]


class LinkSettings(Section):
    """The links on which MAVLink, and what receivers of other kinds say, is received.

    URLs are ``udpin:``, ``udpout:``, ``tcp:`` or ``tcpin:HOST:PORT``, ``serial:DEVICE:BAUD``,
    ``zenoh:KEY``, and those of other receivers: ``sbs:`` or ``readsb:HOST:PORT``, ``readsb:http://HOST/PATH``,
    ``rid:HOST:PORT``, ``rid:udp:HOST:PORT``, ``cot:udp:HOST:PORT``, ``cot:tcp:HOST:PORT``.

    ``routers`` are peers that are believed where another one contradicts them in where a vehicle
    is: a link as in ``urls``, HOST, or HOST:PORT. Two peers that tell of one vehicle alike need no
    word here.
    """

    urls: tuple[LinkText, ...] = ()
    routers: Annotated[tuple[str, ...], Field(max_length=100)] = ()


class PresenceSettings(Section):
    """What the service sends over MAVLink: nothing at all unless ``enabled``.

        system_id     system id it sends as; the carrier's unless given, needed where the array is
                      fixed
        component_id  component id it sends as
        position_hz   rate asked of UAVs whose GLOBAL_POSITION_INT is slower; None: no request
        attitude_hz   rate of ATTITUDE asked of the carrier; None: no request

    Once enabled it presents itself as an onboard computer: it sends a heartbeat while it is fit to
    be used, and TIMESYNC requests.
    """

    enabled: bool = False
    system_id: Annotated[int, Field(ge=1, le=254)] | None = None
    component_id: Annotated[int, Field(ge=25, le=250)] = 191
    position_hz: Annotated[float, Field(ge=0.1, le=100)] | None = None
    attitude_hz: Annotated[float, Field(ge=0.1, le=100)] | None = None


class SigningSettings(Section):
    """MAVLink 2 signing.

        keys            a link's URL, as in ``links.urls``, to the file that holds its key
        allow_unsigned  links with a key that accept unsigned frames all the same
        timestamps      file that keeps the newest timestamps across restarts, so that a frame heard
                        before a restart is not accepted again after it

    What is sent over a link with a key is signed.
    """

    keys: dict[LinkText, str] = Field(default_factory=dict)
    allow_unsigned: tuple[LinkText, ...] = ()
    timestamps: str = "signing-timestamps.json"

    @field_validator("allow_unsigned")
    @classmethod
    def _have_keys(cls, links: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        for url in links:
            if url not in info.data.get("keys", {}):
                raise UserError(f"{url} has no key in signing.keys, and takes anything")
        return links


_UAV_PATTERN: Final = re.compile(
    r"(\d{1,3}|\*):(\d{1,3}|\*)|icao:([0-9A-F]{1,6}|[0-9A-F]{0,5}\*)|(rid|cot):[A-Za-z0-9._*-]{1,64}"
)


_OUT: Final[tuple[Scheme, ...]] = ("udpout", "tcp", "tcpin", "serial", "zenoh", "cot")


def _uav_pattern(text: str) -> str:
    if not _UAV_PATTERN.fullmatch(text):
        raise UserError(f"{text!r} is not {UAV_FORMS}; * stands for any")
    return text


Age = Annotated[float, Field(gt=0, le=1e7)]
UavPattern = Annotated[str, AfterValidator(_uav_pattern)]


def _out_link(text: str) -> str:
    url = parse_link(text, _OUT)
    if url.port == 0:
        raise UserError(f"{text!r}: nobody can be found at port 0")
    return text


class OutSettings(Section):
    """What is known goes on to others, on links of its own: nothing unless ``urls`` are given.

    urls     ``udpout:``, ``tcp:``, ``tcpin:HOST:PORT``, ``serial:DEVICE:BAUD`` or ``zenoh:KEY`` get
             ``message`` of each vehicle that reports itself; ``cot:udp:HOST:PORT``
             (sends datagrams there, also to a group) and ``cot:tcp:HOST:PORT`` (connects) get
             Cursor on Target of every aircraft
    message  as what positions are said
    rate_hz  how often each aircraft is said
    stale_s  how long an event of Cursor on Target says that it holds, seconds
    uavs     patterns of those that are said; everyone if empty
    """

    urls: tuple[Annotated[str, AfterValidator(_out_link)], ...] = ()
    message: Literal["GLOBAL_POSITION_INT", "UTM_GLOBAL_POSITION"] = "GLOBAL_POSITION_INT"
    rate_hz: Annotated[float, Field(ge=0.1, le=50)] = 5.0
    stale_s: Annotated[float, Field(ge=1, le=600)] = 10.0
    uavs: tuple[UavPattern, ...] = ()


class TrackSettings(Section):
    """Who is tracked, and how a track ages.

        allow              who is tracked; everyone if empty
        deny               who is not, whatever ``allow`` says
        coasting_s         age of the newest report at which a track is coasting, seconds; more over
                           a link whose own pace is slower
        stale_s            age at which it is stale, seconds
        lost_s             age at which it is lost, seconds
        dropped_s          age at which a UAV is forgotten, seconds
        most               UAVs tracked at a time; further ones are refused, so that memory and time
                           stay bounded whoever sends
        window_s           how late a report may come and still be put in order, seconds
        reacquire_reports  refused reports that must agree among themselves before the track is
                           begun again from them
        reacquire_s        time over which they must agree, seconds

    Patterns are ``3:1``, ``3:*``, ``icao:4CA7B3``, ``icao:*``, ``rid:*`` or ``cot:*``. The carrier
    is always followed.
    """

    allow: tuple[UavPattern, ...] = ()
    deny: tuple[UavPattern, ...] = ()
    coasting_s: Age = 2.0
    stale_s: Age = 15.0
    lost_s: Age = 60.0
    dropped_s: Age = 600.0
    most: Annotated[int, Field(ge=1, le=100_000)] = 2000
    window_s: Annotated[float, Field(gt=0, le=3600)] = 5.0
    reacquire_reports: Annotated[int, Field(ge=2, le=60)] = 3
    reacquire_s: Annotated[float, Field(ge=0, le=60)] = 1.0

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        ages = (self.coasting_s, self.stale_s, self.lost_s, self.dropped_s)
        if list(ages) != sorted(ages):
            raise UserError(
                "coasting_s <= stale_s <= lost_s <= dropped_s: a track passes its states in order"
            )
        return self
