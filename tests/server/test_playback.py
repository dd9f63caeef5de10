"""Samples of a whole recording: read by a process of its own, one recording at a time."""

import asyncio
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient
from support import ROOT, run_async

from companion.node.recorded_history import lines
from companion.server import playback
from companion.server.app import create_app
from companion.server.recordings import Version, version
from companion.server.responses import encode

LOG = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with two readable recordings and a damaged one."""
    for name in ("one.mcap", "two.mcap"):
        shutil.copy(LOG, tmp_path / name)
    (tmp_path / "bad.mcap").write_bytes(b"no recording")
    return tmp_path


@pytest.fixture
def client(make_node: Any, folder: Path) -> Iterator[TestClient]:
    node = make_node(flown=False, recording={"directory": str(folder)})
    with TestClient(create_app(node)) as client:
        yield client


def whole(client: TestClient, name: str) -> Any:
    """Ask until the recording has been read; return the answer."""
    while (answer := client.get(f"/v1/recordings/{name}/history")).status_code == 202:
        assert set(answer.json()) == {"at_s", "of_s"}
    return answer


def test_samples_are_those_of_a_replay(client: TestClient, folder: Path) -> None:
    answer = whole(client, "one.mcap")
    assert answer.status_code == 200
    *progress, samples = lines(folder / "one.mcap")
    assert answer.json() == json.loads(encode(samples))
    assert len(samples["at"]) > 10 and samples["uavs"]["1:1"]["lat_deg"][-1] == pytest.approx(47, 1)
    assert all(set(one) == {"at_s", "of_s"} for one in progress)


def test_long_recording_is_sampled_more_rarely(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    *_, all_of_it = lines(folder / "one.mcap")
    monkeypatch.setattr("companion.node.recorded_history.UAV_SAMPLES_MAX", 60)
    *_, some = lines(folder / "one.mcap")
    assert 1 < len(some["at"]) * len(some["uavs"]) <= 64
    assert set(some["at"]) <= set(all_of_it["at"])


def test_one_recording_is_read_at_a_time(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(playback, "MODULE", "asyncio")  # reads its input, and never answers
    assert client.get("/v1/recordings/one.mcap/history").status_code == 202
    busy = client.get("/v1/recordings/two.mcap/history")
    assert busy.status_code == 409 and "another recording" in busy.json()["title"]
    monkeypatch.setattr(playback, "IDLE_S", 0.0)  # nobody asks for the first any more
    assert client.get("/v1/recordings/two.mcap/history").status_code in (202, 409)
    monkeypatch.undo()
    assert whole(client, "one.mcap").status_code == 200


def test_simultaneous_requests_for_many_recordings_start_one_process(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each process takes seconds of the machine's time."""
    started, start = list[Path](), playback._start

    def counted(path: Path) -> Any:
        started.append(path)
        return start(path)

    async def ask(player: playback.Playback, name: str) -> bool:
        try:
            await player.samples(file(name))
        except playback.BusyError:
            return False
        return True

    answers = list[bool]()

    def file(name: str) -> Version:
        found = version(str(folder), name)
        assert found is not None
        return found

    async def burst() -> None:
        player = playback.Playback()
        while not isinstance(await player.samples(file("one.mcap")), bytes):
            pass
        monkeypatch.setattr(playback, "_start", counted)
        names = ["two.mcap", "bad.mcap"] * 20
        answers.extend(await asyncio.gather(*(ask(player, name) for name in names)))

    run_async(burst())
    assert answers == [True, False] * 20
    assert started == [folder / "two.mcap"]


def test_recording_that_was_replaced_is_read_again(client: TestClient, folder: Path) -> None:
    before = whole(client, "one.mcap").json()
    other = folder / "other"
    with (folder / "one.mcap").open("rb") as file:
        other.write_bytes(file.read(os.fstat(file.fileno()).st_size // 2))
    other.rename(folder / "one.mcap")
    after = whole(client, "one.mcap").json()
    assert 0 < len(after["at"]) < len(before["at"])


def test_unreadable_and_unknown_recordings_are_refused(client: TestClient) -> None:
    bad = whole(client, "bad.mcap")
    assert bad.status_code == 409 and "cannot be read" in bad.json()["title"]
    assert client.get("/v1/recordings/none.mcap/history").status_code == 404


def test_recording_in_progress_is_refused(make_node: Any, folder: Path) -> None:
    import dataclasses

    node = make_node(flown=False, recording={"directory": str(folder)})
    node.current = dataclasses.replace(node.current, state="recording", file="one.mcap")
    with TestClient(create_app(node)) as client:
        answer = client.get("/v1/recordings/one.mcap/history")
    assert answer.status_code == 409 and "being written" in answer.json()["title"]
