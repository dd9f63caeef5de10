"""Link URLs: parsed and formatted consistently, with one-line errors."""

import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from companion.mavlink.links.urls import SCHEMES, LinkError, LinkUrl, parse_link
from companion.values import shown


@pytest.mark.parametrize(
    ("text", "scheme", "host", "port"),
    [
        ("udpin:0.0.0.0:14550", "udpin", "0.0.0.0", 14550),
        ("udpout:192.168.4.1:14550", "udpout", "192.168.4.1", 14550),
        ("tcp:localhost:5760", "tcp", "localhost", 5760),
        ("tcp:autopilot-2.lan.:5760", "tcp", "autopilot-2.lan.", 5760),
        ("tcp:my_drone:5760", "tcp", "my_drone", 5760),
        ("tcpin:127.0.0.1:5760", "tcpin", "127.0.0.1", 5760),
        ("udpin:[::]:14550", "udpin", "::", 14550),
        ("udpout:[2001:db8::1]:14550", "udpout", "2001:db8::1", 14550),
        ("tcp:[fe80::1%eth0]:5760", "tcp", "fe80::1%eth0", 5760),
        ("udpin:127.0.0.1:0", "udpin", "127.0.0.1", 0),
        ("tcpin:127.0.0.1:0", "tcpin", "127.0.0.1", 0),
        ("udpin:127.0.0.1:65535", "udpin", "127.0.0.1", 65535),
        ("sbs:radar.lan:30003", "sbs", "radar.lan", 30003),
        ("readsb:radar.lan:30005", "readsb", "radar.lan", 30005),
        ("readsb:http://radar.lan/data/aircraft.json", "readsb", "radar.lan", 80),
        ("rid:10.0.0.7:9000", "rid", "10.0.0.7", 9000),
        ("rid:udp:0.0.0.0:32001", "rid", "0.0.0.0", 32001),
        ("rid:udp:[::]:0", "rid", "::", 0),
        ("cot:udp:239.2.3.1:6969", "cot", "239.2.3.1", 6969),
        ("cot:tcp:tak.lan:8087", "cot", "tak.lan", 8087),
        ("readsb:https://[::1]:8443/a?b=c", "readsb", "::1", 8443),
        ("zenoh:mavlink_raw", "zenoh", "mavlink_raw", 0),
        ("zenoh:site/a/raw?connect=tcp/[::1]:7447&as=hub", "zenoh", "site/a/raw", 0),
        ("zenoh:k?listen=tls/0.0.0.0:7447#enable_mtls=true;a=/b?c", "zenoh", "k", 0),
        ("serial:/dev/ttyAMA0:921600", "serial", "/dev/ttyAMA0", 921600),
        ("serial:/dev/serial/by-path/a:0-b:57600", "serial", "/dev/serial/by-path/a:0-b", 57600),
        ("serial:/dev/tty µ 1:20000000", "serial", "/dev/tty µ 1", 20_000_000),
    ],
)
def test_link_url_round_trips(text: str, scheme: str, host: str, port: int) -> None:
    url = parse_link(text)
    assert (url.scheme, url.host, url.port) == (scheme, host, port)
    assert str(url) == text


@pytest.mark.parametrize(
    "text",
    [
        "",
        "udpin",
        "udpin:",
        "udpin::14550",
        "udpin:127.0.0.1",
        "udpin:127.0.0.1:",
        "udpin:127.0.0.1:port",
        "udpin:127.0.0.1:-1",
        "udpin:127.0.0.1:65536",
        "udpin:127.0.0.1:" + "9" * 5000,
        "udpin:127.0.0.1:1e3",
        "udpin:127.0.0.1:١٤٥",
        "udpin:::1:14550",
        "udpin:[::1]",
        "udpin:[]:14550",
        "udpin:[127.0.0.1]:14550",
        "udpin:[a:b]:14550",
        "udpin:a b:14550",
        "udpin:a\nb:14550",
        "udpin:a..b:14550",
        "udpin:é:14550",
        "tcp:" + "a" * 64 + ":5760",
        "udpout:127.0.0.1:0",
        "tcp:127.0.0.1:0",
        "udp:127.0.0.1:14550",
        "http://127.0.0.1:80",
        "UDPIN:127.0.0.1:14550",
        "127.0.0.1:14550",
        "serial:/dev/ttyAMA0",
        "serial:/dev/ttyAMA0:0",
        "serial:/dev/ttyAMA0:20000001",
        "serial:/dev/ttyAMA0:fast",
        "serial:/dev/tty\0:57600",
        "serial:/dev/tty\n:57600",
        "serial::57600",
        "readsb:http://radar.lan",
        "readsb:http:radar.lan/a",
        "readsb:http://radar.lan/a b",
        "readsb:http://radar.lan/a\r\nHost: x",
        "readsb:http://radar.lan:0/a",
        "readsb:http://user:word@radar.lan/a",
        "readsb:ftp://radar.lan/a",
        "rid:tls:radar.lan:1",
        "rid:udp:radar.lan",
        "rid:radar.lan:0",
        "cot:tak.lan:8087",
        "cot:ssl:tak.lan:8089",
        "cot:tcp:tak.lan:0",
        "cot:",
        "zenoh:",
        "zenoh:site/*/raw",
        "zenoh:site//raw",
        "zenoh:/site",
        "zenoh:site?",
        "zenoh:site?as=router",
        "zenoh:site?connect=10.0.0.7:7447",
        "zenoh:site?connect=tcp/10.0.0.7:7447&",
        "zenoh:site?connect=tcp/10.0.0.7:7447 listen=tcp/10.0.0.7:7447",
    ],
)
def test_invalid_link_url_is_reported_in_one_line(text: str) -> None:
    with pytest.raises(LinkError) as caught:
        parse_link(text)
    message = str(caught.value)
    assert shown(text) in message and "\n" not in message


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("http://radar.lan/data/aircraft.json", "readsb:http://radar.lan/data/aircraft.json?"),
        ("beast:radar.lan:30005", "readsb:radar.lan:30005?"),
        ("readsb:radar.lan", "readsb:radar.lan:30005?"),
        ("sbs:radar.lan", "sbs:radar.lan:30003?"),
        ("reedsb:radar.lan:30005", "readsb:?"),
        ("cot:tak.lan:8087", "cot:udp:tak.lan:8087, which listens, or cot:tcp:tak.lan:8087?"),
        ("udp:14550", "udpin:0.0.0.0:14550, which listens?"),
        ("udpin:14550", "udpin:0.0.0.0:14550?"),
        ("tcp:5760", "tcp:HOST:5760?"),
        ("14550", "udpin:0.0.0.0:14550?"),
        ("cot:4242", "cot:udp:0.0.0.0:4242, which listens, or cot:tcp:HOST:4242?"),
        ("cot:udp:4242", "cot:udp:0.0.0.0:4242?"),
        ("cot:tcp:8087", "cot:tcp:HOST:8087?"),
    ],
)
def test_link_url_error_suggests_a_correction(text: str, meant: str) -> None:
    with pytest.raises(LinkError) as caught:
        parse_link(text)
    assert str(caught.value).endswith(f"did you mean {meant}")

    links = re.findall(r"[a-z]+:[^ ,?]+", meant.replace("HOST", "host"))
    assert links or meant == "readsb:?"
    for link in links:
        parse_link(link)


@pytest.mark.parametrize(
    ("text", "is_missing"),
    [
        ("serial:/dev/ttyS0", True),
        ("serial::57600", False),
        ("serial:/dev/ttyS0:" + "9" * 20, False),
    ],
)
def test_baud_rate_is_missing_only_where_there_is_none(text: str, is_missing: bool) -> None:
    with pytest.raises(LinkError) as caught:
        parse_link(text)
    assert ("a baud rate is missing" in str(caught.value)) is is_missing


def test_only_allowed_schemes_are_accepted() -> None:
    assert parse_link("tcp:127.0.0.1:1", ("tcp",)) == LinkUrl(
        scheme="tcp", host="127.0.0.1", port=1
    )
    with pytest.raises(LinkError, match=r"is not a link; give one of tcp:$"):
        parse_link("udpin:127.0.0.1:1", ("tcp",))
    with pytest.raises(LinkError, match=r"is not a link; give one of udpin:, serial:$"):
        parse_link("tcp:127.0.0.1:1", ("udpin", "serial"))


@given(st.sampled_from(SCHEMES), st.text(max_size=20), st.text("0123456789:.-", max_size=6))
@example("serial", "\x1e", "")
@example("udp", "\x85", "1")
def test_any_text_is_a_link_url_or_a_link_error(scheme: str, host: str, port: str) -> None:
    """A parsed URL is formatted so that it parses to the same value."""
    try:
        url = parse_link(f"{scheme}:{host}:{port}")
    except LinkError as error:
        assert len(str(error).splitlines()) == 1
    else:
        assert parse_link(str(url)) == url
