"""Compressed answers: as the client prefers, the same content, large ones off the event loop."""

import asyncio
import gzip
import threading
from typing import Any

import pytest
import zstandard
from starlette.testclient import TestClient
from support import run_async

from companion.server import compression
from companion.server.app import create_app
from companion.server.compression import AT_ONCE_BYTES, SharedCompression, preferred


@pytest.mark.parametrize(
    ("accepted", "expected"),
    [
        ("", None),
        ("br, deflate", None),
        ("gzip, deflate", "gzip"),
        ("gzip, deflate, br, zstd", "zstd"),
        ("zstd;q=0.5, gzip", "gzip"),
        ("zstd;q=0, *", "gzip"),
        ("gzip;q=0", None),
        ("gzip;q=x", None),
        ("GZIP", "gzip"),
    ],
)
def test_encoding_is_the_one_that_the_client_prefers(accepted: str, expected: str | None) -> None:
    assert preferred(accepted) == expected


def test_answer_has_the_same_content_in_every_encoding(make_node: Any) -> None:
    client = TestClient(create_app(make_node()))
    plain = client.get("/v1/labels", headers={"accept-encoding": "identity"})
    assert "content-encoding" not in plain.headers
    assert plain.headers["vary"] == "accept-encoding"
    for encoding in ("gzip", "zstd"):
        with client.stream("GET", "/v1/labels", headers={"accept-encoding": encoding}) as made:
            raw = b"".join(made.iter_raw())
        assert made.headers["content-encoding"] == encoding
        assert int(made.headers["content-length"]) == len(raw) < len(plain.content) / 2
        unpack = gzip.decompress if encoding == "gzip" else zstandard.decompress
        assert unpack(raw) == plain.content


def test_small_answer_is_sent_as_it_is(make_node: Any) -> None:
    client = TestClient(create_app(make_node()))
    made = client.get("/healthz", headers={"accept-encoding": "gzip"})
    assert "content-encoding" not in made.headers


def test_bodies_are_kept_up_to_a_number_of_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else 32 answers about two thousand UAVs take a gigabyte."""
    made = list[int]()

    def observed(body: bytes, _encoding: str) -> bytes:
        made.append(body[0])
        return body[:1]

    monkeypatch.setattr(compression, "compressed", observed)
    monkeypatch.setattr(compression, "KEPT_BYTES", 3 * AT_ONCE_BYTES)
    bodies = [bytes([number]) * (AT_ONCE_BYTES + 1) for number in range(3)]

    async def ask() -> None:
        shared = SharedCompression()
        for body in (*bodies, bodies[2], bodies[1], bodies[0], bodies[2], 9 * bodies[1]):
            assert await shared.of(body, "gzip") == body[:1]
        assert len(shared._made) == 1

    run_async(ask())
    assert made == [0, 1, 2, 0, 1]


def test_large_answer_is_compressed_once_and_off_the_event_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    threads = list[int]()

    def observed(body: bytes, encoding: str) -> bytes:
        threads.append(threading.get_ident())
        return encoding.encode() + body[:4]

    monkeypatch.setattr(compression, "compressed", observed)
    body = bytes(AT_ONCE_BYTES + 1)

    async def ask() -> list[bytes]:
        shared = SharedCompression()
        return await asyncio.gather(*(shared.of(body, "gzip") for _ in range(5)))

    assert run_async(ask()) == [b"gzip" + bytes(4)] * 5
    assert len(threads) == 1 and threads[0] != threading.get_ident()
