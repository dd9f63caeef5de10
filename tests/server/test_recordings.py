"""Recordings over HTTP: listed, complete, by range, and while being written; no other files."""

import asyncio
import contextlib
import dataclasses
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from http_support import asked, connected, served
from starlette.testclient import TestClient
from support import HANG_S, run_async

from companion.server import recordings
from companion.server.app import create_app
from companion.server.byte_ranges import UnsatisfiableRangeError, span

FINISHED = "companion-20261120T130000Z.mcap"
CURRENT = "companion-20261120T140000Z.mcap.active"
BYTES = bytes(range(256)) * 4000


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return two recordings, one being written, and files that must not be served."""
    folder = tmp_path / "recordings"
    (folder / "below").mkdir(parents=True)
    (folder / FINISHED).write_bytes(BYTES)
    (folder / CURRENT).write_bytes(BYTES[:5000])
    (folder / "cut.mcap.active").write_bytes(b"cut")
    (folder / "settings.toml").write_text("secret")
    (folder / "below" / "deep.mcap").write_text("secret")
    (tmp_path / "outside.mcap").write_text("secret")
    (folder / "linked.mcap").symlink_to(tmp_path / "outside.mcap")
    (folder / ".hidden.mcap").write_text("secret")
    os.mkfifo(folder / "pipe.mcap")
    return folder


@pytest.fixture
def client(make_node: Any, folder: Path) -> Iterator[TestClient]:
    node = make_node(flown=False, recording={"directory": str(folder)})
    node.current = dataclasses.replace(node.current, state="recording", file=CURRENT, bytes=4096)
    with TestClient(create_app(node)) as client:
        yield client


def test_only_recordings_are_listed(client: TestClient) -> None:
    shown = client.get("/v1/recordings").json()["recordings"]
    assert shown == [
        {
            "name": FINISHED,
            "bytes": len(BYTES),
            "state": "finished",
            "started": "2026-11-20T13:00:00.000Z",
        },
        {
            "name": CURRENT,
            "bytes": 4096,
            "state": "recording",
            "started": "2026-11-20T14:00:00.000Z",
        },
        {"name": "cut.mcap.active", "bytes": 3, "state": "unfinished", "started": None},
    ]


def test_file_that_cannot_be_examined_has_no_size(folder: Path) -> None:
    """Here its folder was replaced by a file since it was read; or it may not be searched."""
    (entry,) = (entry for entry in os.scandir(folder) if entry.name == FINISHED)
    folder.rename(folder.with_name("moved"))
    folder.write_bytes(b"")
    shown = recordings._shown(entry, recordings.Current(None, 0))
    assert (shown["name"], shown["bytes"]) == (FINISHED, None)


WITHOUT_RIGHTS = """
import os, sys
from companion.server import recordings
where, name, folder = sys.argv[1:]
os.chmod(folder, 0o444)
entries = recordings.listed(where, recordings.Current(None, 0))
print([one["name"] for one in entries], recordings.version(where, name))
"""


@pytest.mark.parametrize("is_file", [False, True])
def test_folder_that_may_not_be_searched_has_no_versions(folder: Path, is_file: bool) -> None:
    """As a user without root's rights, in a service that runs."""
    where = str(folder / FINISHED) if is_file else str(folder)
    command = [sys.executable, "-c", WITHOUT_RIGHTS, where, FINISHED, str(folder)]
    if os.geteuid() == 0:
        rights = "-dac_override,-dac_read_search"
        command = ["setpriv", f"--bounding-set={rights}", *command]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    folder.chmod(0o755)
    assert done.stderr == ""
    assert done.stdout.endswith("None\n")


def test_time_in_a_name_may_be_none(make_node: Any, tmp_path: Path) -> None:
    (tmp_path / "companion-20261399T000000Z.mcap").write_bytes(b"")
    node = make_node(flown=False, recording={"directory": str(tmp_path)})
    with TestClient(create_app(node)) as client:
        (listed,) = client.get("/v1/recordings").json()["recordings"]
    assert listed["started"] is None


def test_recording_is_downloaded_completely(client: TestClient) -> None:
    answer = client.get(f"/v1/recordings/{FINISHED}")
    assert answer.content == BYTES
    assert answer.headers["content-length"] == str(len(BYTES))
    assert answer.headers["accept-ranges"] == "bytes"
    assert answer.headers["content-type"] == "application/x-mcap"


def test_active_recording_is_served_up_to_its_flushed_end(client: TestClient) -> None:
    assert client.get(f"/v1/recordings/{CURRENT}").content == BYTES[:4096]
    rest = client.get(f"/v1/recordings/{CURRENT}", headers={"range": "bytes=4000-"})
    assert rest.status_code == 206
    assert rest.content == BYTES[4000:4096]


@pytest.mark.parametrize(
    ("asked", "start", "stop"),
    [("0-0", 0, 1), ("100-199", 100, 200), ("1023990-", 1023990, 1024000), ("-7", -7, None)],
)
def test_byte_range_is_served(client: TestClient, asked: str, start: int, stop: int) -> None:
    answer = client.get(f"/v1/recordings/{FINISHED}", headers={"range": f"bytes={asked}"})
    assert answer.status_code == 206
    assert answer.content == BYTES[start:stop]
    first = start % len(BYTES)
    last = first + len(answer.content) - 1
    assert answer.headers["content-range"] == f"bytes {first}-{last}/{len(BYTES)}"


def test_byte_range_beyond_the_end_is_rejected(client: TestClient) -> None:
    answer = client.get(f"/v1/recordings/{FINISHED}", headers={"range": "bytes=1024000-"})
    assert answer.status_code == 416
    assert answer.headers["content-range"] == "bytes */1024000"
    assert answer.headers["content-type"] == "application/problem+json"


def test_range_of_an_earlier_version_is_answered_with_the_whole_file(client: TestClient) -> None:
    """A download that continues: nothing tells whether the file is still the same."""
    headers = {"range": "bytes=100-199", "if-range": '"7"'}
    answer = client.get(f"/v1/recordings/{FINISHED}", headers=headers)
    assert answer.status_code == 200
    assert answer.content == BYTES


@pytest.mark.parametrize("header", [None, "", "bytes=", "bytes=-", "bytes=5-2", "bytes=0-1,4-5"])
def test_invalid_byte_range_is_ignored(header: str | None) -> None:
    assert span(header, 10) is None


def test_byte_range_of_an_empty_file_is_rejected() -> None:
    with pytest.raises(UnsatisfiableRangeError):
        span("bytes=0-", 0)
    with pytest.raises(UnsatisfiableRangeError):
        span("bytes=-0", 10)


@pytest.mark.parametrize(
    "name",
    [
        "settings.toml",
        "linked.mcap",
        ".hidden.mcap",
        "pipe.mcap",
        "below",
        "below%2Fdeep.mcap",
        "below/deep.mcap",
        "..%2Foutside.mcap",
        "%2e%2e%2foutside.mcap",
        "..%5Coutside.mcap",
        "%2Fetc%2Fpasswd",
        FINISHED + "%00",
        FINISHED + "%0A",
        FINISHED.upper(),
        "none.mcap",
    ],
)
def test_files_other_than_recordings_are_not_served(client: TestClient, name: str) -> None:
    answer = client.get(f"/v1/recordings/{name}")
    assert answer.status_code == 404
    assert b"secret" not in answer.content


def test_no_recordings_are_listed_without_a_folder(make_node: Any, tmp_path: Path) -> None:
    for where in ({}, {"recording": {"directory": str(tmp_path / "missing")}}):
        with TestClient(create_app(make_node(flown=False, **where))) as client:
            assert client.get("/v1/recordings").json() == {"recordings": []}
            assert client.get(f"/v1/recordings/{FINISHED}").status_code == 404


def test_only_the_named_recording_file_is_listed(make_node: Any, folder: Path) -> None:
    node = make_node(flown=False, recording={"directory": str(folder / FINISHED)})
    with TestClient(create_app(node)) as client:
        (only,) = client.get("/v1/recordings").json()["recordings"]
    assert only["name"] == FINISHED


def test_recording_cut_short_while_it_is_read_ends_the_answer(
    make_node: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / FINISHED
    path.write_bytes(bytes(1 << 24))
    ask = f"GET /v1/recordings/{FINISHED} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()

    read = bytearray()

    async def cut() -> None:
        node = make_node(flown=False, recording={"directory": str(tmp_path)})
        async with served(node) as port:
            reader, writer = await connected(port)
            writer.write(ask)
            await reader.readuntil(b"\r\n\r\n")
            os.truncate(path, 1 << 20)
            with contextlib.suppress(ConnectionError):
                while piece := await reader.read(1 << 16):
                    read.extend(piece)

    run_async(cut())
    assert len(read) < 1 << 24
    assert capfd.readouterr().err == ""


def test_listings_are_shared_and_delay_no_other_answer(
    make_node: Any, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading a large folder takes long; all who ask meanwhile share the next reading."""
    may_end, calls = threading.Event(), list[str | None]()

    def slow(where: str | None, current: Any) -> list[Any]:
        calls.append(where)
        may_end.wait(HANG_S)
        return []

    monkeypatch.setattr(recordings, "listed", slow)
    listing, beams = (f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
                      for path in ("/v1/recordings", "/v1/pattern"))  # fmt: skip

    async def ask() -> None:
        node = make_node(recording={"directory": str(folder)})
        async with served(node) as port:
            clients = [await connected(port) for _ in range(30)]
            answers = [asyncio.create_task(asked(one, listing)) for one in clients]
            await asyncio.sleep(0)
            assert await asked(await connected(port), beams) == b"HTTP/1.1 200 OK\r\n"
            assert not any(one.done() for one in answers)
            may_end.set()
            assert set(await asyncio.gather(*answers)) == {b"HTTP/1.1 200 OK\r\n"}

    run_async(ask())
    assert len(calls) <= 3
