"""What is fuzzed, and what must hold whatever the bytes are. ``run.py`` searches with coverage as
its guide; ``test_corpus.py`` runs what was found before.

Each target takes the bytes of one try, and raises where something does not hold.
"""

import asyncio
import functools
import math
import re
import struct
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from support import HANG_S

from companion.mavlink.wire.decode import DECODED
from companion.mavlink.wire.framing import Splitter
from companion.mavlink.wire.stamps import STAMPED
from companion.pipeline.fold import Pipeline
from companion.recording.container import MAGIC
from companion.recording.reader import LogError, read_log
from companion.recording.recover import Recovered, recover_leftovers
from companion.settings.model import Settings
from companion.values import Frame, Rejection, RoundTrip, Source, Tick, UserError

S = 1_000_000_000
TOKEN = re.compile(rb"[-!#$%&'*+.^_`|~0-9A-Za-z]+")
HEARD = sorted(DECODED.union(STAMPED))


def framing(data: bytes) -> None:
    """However the bytes are split, the same frames result, and every byte is accounted for."""
    step, data = 1 + (data[0] if data else 0), data[1:]
    whole, cut = Splitter("whole"), Splitter("cut")
    once = [*whole.feed(1, data), *whole.finish(1)]
    pieces = [data[at : at + step] for at in range(0, len(data), step)]
    again = [one for piece in pieces for one in cut.feed(1, piece)] + cut.finish(1)
    frames = [one.raw for one in once if isinstance(one, Frame)]
    assert frames == [one.raw for one in again if isinstance(one, Frame)]
    assert sum(map(len, frames)) <= len(data)
    for raw in frames:
        (alone,) = Splitter("alone").feed(1, raw)
        assert isinstance(alone, Frame)
        assert alone.raw == raw


def fold(data: bytes) -> None:
    """A pipeline accepts any frames in any time order, and its outputs are finite."""
    pipeline = _pipeline()
    for event in _events(data):
        for output in pipeline.step(event):
            if isinstance(output, Rejection):
                assert output.reason is not None
    update = pipeline.look(_now(data), 0.05)
    assert np.isfinite(update.beams.weights).all()
    for track in update.tracks:
        assert np.isfinite(track.position_ned_m).all()
        assert track.bound_m >= 0
        assert not math.isnan(track.bound_m)


def _pipeline() -> Pipeline:
    return Pipeline(Settings().override(center={"source": "5:1"}))


def _events(data: bytes) -> Iterator[Any]:
    """Each event: kind, sender, time since the previous one in ms, length, then the payload."""
    at, t_ns = 0, 1_800_000_000 * S
    while at + 5 <= len(data):
        kind, sender, ms, size = struct.unpack_from("<BBHB", data, at)
        payload = data[at + 5 : at + 5 + size]
        at, t_ns = at + 5 + size, t_ns + ms * 1_000_000
        source = Source(1 + sender % 6, 1)
        if kind >= 250:
            yield Tick(t_ns)
        elif kind >= 245 and len(payload) >= 16:
            sent_ms, there_ns = struct.unpack_from("<qq", payload)
            sent_ns = t_ns - abs(sent_ms) % 10_000 * 1_000_000
            yield RoundTrip(t_ns=t_ns, source=source, sent_ns=sent_ns, remote_ns=there_ns)
        else:
            msgid = HEARD[kind % len(HEARD)]
            head = bytes([0xFD, len(payload), 0, 0, 0, source.sysid, source.compid])
            raw = head + msgid.to_bytes(3, "little") + payload + b"\0\0"
            yield Frame(t_ns=t_ns, link="fuzz", source=source, msgid=msgid, raw=raw)


def _now(data: bytes) -> int:
    return max((event.t_ns for event in _events(data)), default=1_800_000_000 * S)


def recovery(data: bytes) -> None:
    """An unfinished file is processed once; its recovered part is read to its end."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "x.mcap.active").write_bytes(MAGIC + data)
        (told,) = recover_leftovers(folder)
        assert not list(folder.glob("*.active"))
        if isinstance(told, Recovered):
            for event in _read(told.path):
                assert event.t_ns >= 0
        else:
            assert "\n" not in str(told)
            kind = str(told).partition(": ")[2].split(":")[0]
            assert not kind.endswith("Error"), told  # unexpected errors


def _read(path: Path) -> Iterator[Any]:
    try:
        yield from read_log(path)
    except LogError as error:
        assert "\n" not in str(error)


def settings(data: bytes) -> None:
    """A text is valid settings, which round-trip, or a one-line error."""
    try:
        found = Settings.from_toml(data.decode("utf-8", "replace"), "fuzzed.toml")
    except UserError as error:
        assert "\n" not in str(error).strip(), error
        return
    assert Settings.from_toml(found.to_toml(), "again.toml") == found


def http(data: bytes) -> None:
    """Any request with any headers: no answer is an internal server error.

    Invalid HTTP never reaches this point: bytes that the server rejects are skipped.
    """
    line, *lines = data.split(b"\n")
    path, _, query = bytes(one for one in line if 0x21 <= one < 0x7F).partition(b"?")
    named = (bytes(x for x in one if x >= 0x20 and x != 0x7F).partition(b":") for one in lines)
    headers = [(name.lower(), value) for name, _, value in named if TOKEN.fullmatch(name)]
    status = _loop().run_until_complete(_answer(path, query, [(b"host", b"testserver"), *headers]))
    assert 200 <= status < 500, status


@functools.cache
def _loop() -> asyncio.AbstractEventLoop:
    return asyncio.new_event_loop()


@functools.cache
def _app() -> Any:
    from server.conftest import StandIn
    from server.conftest import settings as served

    from companion.server.app import create_app

    return create_app(StandIn(served(codebook={"kind": "dft"})))


async def _answer(path: bytes, query: bytes, headers: list[tuple[bytes, bytes]]) -> int:
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "GET",
        "scheme": "http", "path": unquote(path.decode()), "raw_path": path, "query_string": query,
        "root_path": "", "headers": headers, "client": ("127.0.0.1", 1), "state": {},
        "server": ("testserver", 80),
    }  # fmt: skip
    sent: list[int] = []
    body = iter([{"type": "http.request", "body": b"", "more_body": False}])

    async def receive() -> dict[str, Any]:
        for part in body:
            return part
        await asyncio.sleep(HANG_S)  # the client stays; this is cancelled
        raise AssertionError

    async def send(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            sent.append(message["status"])

    await asyncio.wait_for(_app()(scope, receive, send), HANG_S)
    (status,) = sent
    return status


TARGETS: dict[str, Callable[[bytes], None]] = {
    "framing": framing,
    "fold": fold,
    "recovery": recovery,
    "settings": settings,
    "http": http,
}
