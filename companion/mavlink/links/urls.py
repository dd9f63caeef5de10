"""Link addresses, in the usual form of MAVLink programs.

    udpin:HOST:PORT      listen for datagrams, from any number of peers
    udpout:HOST:PORT     send datagrams to one peer, and receive its answers
    tcp:HOST:PORT        connect
    tcpin:HOST:PORT      listen for connections
    serial:DEVICE:BAUD   a serial port, as in serial:/dev/ttyAMA0:921600
    sbs:HOST:PORT        connect to an ADS-B receiver with BaseStation lines; receive-only
    readsb:HOST:PORT     connect to an ADS-B receiver that speaks Beast; receive-only
    readsb:http://HOST/PATH/aircraft.json
                         poll such a receiver's web server once a second; https:// too
    rid:HOST:PORT        connect to a Remote ID receiver with JSON; receive-only
    rid:udp:HOST:PORT    listen for the datagrams of such receivers; receive-only
    cot:tcp:HOST:PORT    connect to a Cursor on Target server; receive-only
    cot:udp:HOST:PORT    listen for it, as in cot:udp:239.2.3.1:6969; receive-only
    zenoh:KEY            subscribe to KEY/out and publish KEY/in over Zenoh's router on this
                         machine; options follow a question mark, as in
                         zenoh:site/raw?connect=tcp/10.0.0.7:7447 (see ``zenoh_link``)

IPv6 hosts are written in brackets.
"""

import difflib
import ipaddress
import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final, Literal, cast, get_args

from companion.values import UserError
from companion.values.errors import shown

Scheme = Literal[
    "udpin", "udpout", "tcp", "tcpin", "serial", "zenoh", "sbs", "readsb", "rid", "cot"
]
SCHEMES: Final[tuple[Scheme, ...]] = get_args(Scheme)
TransportKind = Literal["", "tcp", "udp", "http", "https"]
"""Transport of a link whose scheme supports several; empty: the default of the scheme."""
MAVLINK: Final[tuple[Scheme, ...]] = ("udpin", "udpout", "tcp", "tcpin", "serial", "zenoh")
"""Schemes that carry MAVLink, in both directions."""
_FORMS: Final[dict[str, str]] = {
    "serial": "serial:DEVICE:BAUD",
    "zenoh": "zenoh:KEY",
    "readsb": "readsb:HOST:PORT, readsb:http://HOST/PATH",
    "rid": "rid:HOST:PORT, rid:udp:HOST:PORT",
    "cot": "cot:udp:HOST:PORT, cot:tcp:HOST:PORT",
}
_WAYS: Final = {"rid": ("udp:",), "cot": ("udp:", "tcp:")}
_USUAL_PORTS: Final = {"sbs": 30003, "readsb": 30005}
_HTTP_PORTS: Final = {"http": 80, "https": 443}
_BAUD_MAX: Final = 20_000_000
_AIRCRAFT_JSON: Final = "readsb:http://radar.lan/tar1090/data/aircraft.json"
_NUMBER: Final = re.compile(r"[0-9]{1,8}")
_PATH: Final = re.compile(r"/[A-Za-z0-9._~!$&'()*+,;=:@/?%-]{0,500}")
_KEY: Final = re.compile(r"[A-Za-z0-9_.~%+-]{1,100}(/[A-Za-z0-9_.~%+-]{1,100}){0,20}")
_OPTION: Final = re.compile(
    r"as=hub|(connect|listen)=(tcp|tls|udp|quic|ws)/[A-Za-z0-9_.:\[\]%-]+:[0-9]{1,5}([?#][^\s&]*)?"
)
_NAME: Final = re.compile(r"[A-Za-z0-9._-]+")


class LinkError(UserError):
    """Link that cannot be opened. The message is one line for the user and names the link."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkUrl:
    """Parsed link address; ``str`` gives it as the user wrote it.

    ``host`` is the device of a serial link, and ``port`` its baud rate; ``host`` is the key of a
    Zenoh link, whose ``port`` is 0. ``path`` is the path of an HTTP URL, or a Zenoh link's options.
    """

    scheme: Scheme
    host: str
    port: int
    way: TransportKind = ""
    path: str = ""

    def __str__(self) -> str:
        if self.scheme == "zenoh":
            return f"zenoh:{self.host}{self.path and '?'}{self.path}"
        host = f"[{self.host}]" if self.scheme != "serial" and ":" in self.host else self.host
        if self.way in _HTTP_PORTS:
            port = "" if self.port == _HTTP_PORTS[self.way] else f":{self.port}"
            return f"{self.scheme}:{self.way}://{host}{port}{self.path}"
        return f"{self.scheme}:{self.way and self.way + ':'}{host}:{self.port}"

    @property
    def listens(self) -> bool:
        """Whether the link listens at an address of this machine."""
        return self.scheme in ("udpin", "tcpin") or self.way == "udp"


def parse_link(text: str, schemes: Collection[Scheme] = SCHEMES) -> LinkUrl:
    """Parse a link of one of ``schemes``. Raises ``LinkError``, which names the fault.

    Port 0 is allowed if the link listens: the system then chooses one.
    """
    scheme, _, address = text.partition(":")
    if scheme == "zenoh" and scheme in schemes:
        return _zenoh(text, address)
    way: TransportKind = ""
    path = ""
    if scheme == "readsb" and address.startswith(("http:", "https:")):
        way, address, path = _http(text, address)
    elif address.startswith(_WAYS.get(scheme, ())):
        name, _, address = address.partition(":")
        way = cast(TransportKind, name)
    elif scheme == "cot":
        raise LinkError(f"{shown(text)} is not {_FORMS['cot']}{_suggestion(text)}")
    host, _, port = address.rpartition(":")
    if scheme not in schemes or not host or not _NUMBER.fullmatch(port):
        raise LinkError(f"{shown(text)} is not {_form(scheme, schemes)}{_suggestion(text)}")
    if scheme == "serial":
        return _serial(text, host, int(port))
    bracketed = host.startswith("[") and host.endswith("]")
    host = host[1:-1] if bracketed else host
    if (":" in host) is not bracketed:
        raise LinkError(
            f"{shown(text)}: put an IPv6 host, and no other, in brackets: udpin:[::]:14550"
        )
    if not (_is_ipv6(host) if bracketed else _may_be_a_name(host)):
        raise LinkError(f"{shown(text)}: {shown(host)} is not a valid host name or address")
    url = LinkUrl(scheme=cast(Scheme, scheme), host=host, port=int(port), way=way, path=path)
    if int(port) > 65535 or (int(port) == 0 and not url.listens):
        raise LinkError(f"{shown(text)}: {port} is not a port, 1 to 65535")
    return url


def _http(text: str, address: str) -> tuple[TransportKind, str, str]:
    way, slashes, rest = address.partition("://")
    host, slash, path = rest.partition("/")
    if not slashes or not _PATH.fullmatch(slash + path):
        raise LinkError(f"{shown(text)} is not readsb:http://HOST/PATH, as in {_AIRCRAFT_JSON}")
    if ":" not in host.rpartition("]")[2]:
        host = f"{host}:{_HTTP_PORTS[way]}"
    return cast(TransportKind, way), host, slash + path


def _zenoh(text: str, address: str) -> LinkUrl:
    key, mark, options = address.partition("?")
    if not _KEY.fullmatch(key):
        raise LinkError(
            f"{shown(text)} is not zenoh:KEY, a key without wildcards such as mavlink_raw"
        )
    if mark and not all(map(_OPTION.fullmatch, options.split("&"))):
        known = "connect=tcp/HOST:PORT, listen=tcp/HOST:PORT and as=hub"
        raise LinkError(f"{shown(text)}: unknown option; give {known}, joined by &")
    return LinkUrl(scheme="zenoh", host=key, port=0, way="", path=options)


def _serial(text: str, device: str, baud: int) -> LinkUrl:
    if not device.isprintable():
        raise LinkError(f"{shown(text)}: {shown(device)} is not a valid device name")
    if not 1 <= baud <= _BAUD_MAX:
        raise LinkError(f"{shown(text)}: {baud} is not a baud rate, 1 to {_BAUD_MAX}")
    return LinkUrl(scheme="serial", host=device, port=baud)


def _suggestion(text: str) -> str:
    """Return a suggested link for the end of a message; empty if none is similar."""
    scheme, _, address = text.partition(":")
    if not text.isprintable():
        return ""
    if scheme == "serial" and address and not address.rpartition(":")[2].isdecimal():
        return f"; a baud rate is missing, as in {text.rstrip(':')}:57600"
    if text.startswith(("/dev/", "COM")):
        return f"; did you mean serial:{text}:57600?"
    if scheme in _HTTP_PORTS and address.rpartition("/")[2] == "aircraft.json":
        return f"; did you mean readsb:{text}?"
    if scheme == "cot" and address:
        way, _, place = address.partition(":")
        if way in ("udp", "tcp"):
            return f"; did you mean cot:{way}:{_with_host(place, way == 'udp')}?"
        udp, tcp = _with_host(address, True), _with_host(address, False)
        return f"; did you mean cot:udp:{udp}, which listens, or cot:tcp:{tcp}?"
    if scheme in ("beast", "dump1090", "adsb"):
        return f"; did you mean readsb:{address or 'HOST:30005'}?"
    if scheme == "udp":
        place = _with_host(address or "14550", True)
        return f"; did you mean udpin:{place}, which listens?"
    if text.isdecimal():
        return f"; did you mean udpin:{_with_host(text, True)}?"
    near = difflib.get_close_matches(scheme, SCHEMES, 1, 0.5)
    if near and scheme not in SCHEMES:
        return f"; did you mean {near[0]}:?"
    if scheme in SCHEMES and address.isdecimal():
        return f"; did you mean {scheme}:{_with_host(address, scheme in ('udpin', 'tcpin'))}?"
    if scheme in SCHEMES and address and ":" not in address:
        return f"; did you mean {scheme}:{address}:{_USUAL_PORTS.get(scheme, 14550)}?"
    return ""


def _with_host(place: str, listens: bool) -> str:
    """Return a place with a host, if it is a port alone: all addresses for a link that listens."""
    if not place.isdecimal():
        return place
    return f"{'0.0.0.0' if listens else 'HOST'}:{place}"


def _form(scheme: str, schemes: Collection[Scheme]) -> str:
    """Return the form of a scheme's links; for an unknown scheme, the list of schemes."""
    if scheme in schemes:
        return _FORMS.get(scheme, f"{scheme}:HOST:PORT")
    return f"a link; give one of {', '.join(f'{one}:' for one in schemes)}"


def _is_ipv6(host: str) -> bool:
    try:
        ipaddress.IPv6Address(host)
    except ValueError:
        return False
    return True


def _may_be_a_name(host: str) -> bool:
    """Return whether the text can be a host name; an IPv4 address counts as one."""
    try:
        return _NAME.fullmatch(host) is not None and len(host.encode("idna")) > 0
    except UnicodeError:  # an empty or too long label
        return False
