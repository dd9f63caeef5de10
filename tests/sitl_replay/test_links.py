"""Link URLs, and what a peer that does not read costs."""

import asyncio
import socket

import pytest

from sitl_replay.links import RECEIVING, Url, open_peer


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("udpout:127.0.0.1:14550", ("udpout", "127.0.0.1", 14550)),
        ("tcp:drone.example:5760", ("tcp", "drone.example", 5760)),
        ("udpout:[::1]:14550", ("udpout", "::1", 14550)),
    ],
)
def test_read_and_written_alike(text: str, expected: tuple[str, str, int]) -> None:
    url = Url.parse(text)
    assert url == expected
    assert str(url) == text


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "is not udpout:HOST:PORT or tcp:HOST:PORT"),
        ("udpin:127.0.0.1:14550", "is not udpout"),
        ("127.0.0.1:14550", "is not udpout"),
        ("udpout:14550", "is not udpout"),
        ("udpout::14550", "is not udpout"),
        ("udpout:::1:14550", "brackets"),
        ("udpout:[localhost]:14550", "brackets"),
        ("tcp:localhost:", "'' is not a port"),
        ("tcp:localhost:0", "'0' is not a port"),
        ("tcp:localhost:65536", "'65536' is not a port"),
        ("tcp:localhost:-1", "'-1' is not a port"),
        ("tcp:localhost:٣", "is not a port"),
    ],
)
def test_what_is_wrong_is_said(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        Url.parse(text)


def test_listening_has_schemes_of_its_own() -> None:
    assert Url.parse("udpin:0.0.0.0:14550", RECEIVING).port == 14550
    with pytest.raises(ValueError, match=r"udpin:HOST:PORT or tcp:HOST:PORT"):
        Url.parse("udpout:127.0.0.1:14550", RECEIVING)


def test_what_is_dropped_is_not_kept() -> None:
    async def scene(url: Url) -> None:
        peer = await open_peer(url)
        frame = bytes(1000)
        while peer.dropped < 1000:
            peer.send(frame)
        assert peer.transport.get_write_buffer_size() < 1 << 18  # type: ignore[attr-defined]
        await peer.close()

    with socket.create_server(("127.0.0.1", 0)) as deaf:
        asyncio.run(scene(Url("tcp", "127.0.0.1", deaf.getsockname()[1])))
