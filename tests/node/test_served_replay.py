"""``companion replay --serve``: page and API over a replay, as users run it."""

import asyncio
import json
import re
import signal
import socket
import subprocess
import time
from asyncio import Event
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from link_support import frame
from support import BIN, HANG_S, Node, end, line_of, read_metadata, run_async

from companion.node.replay import replay
from companion.node.served_replay import ReplayRequest, ServedReplay
from companion.recording.reader import read_log
from companion.recording.writer import Writer
from companion.settings.model import Settings
from companion.values import Frame, Source, Tick

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")


class Replaying(Node):
    """A ``companion replay --serve`` process and its address, read from stderr."""

    def __init__(self, *arguments: str | Path) -> None:
        self.process = subprocess.Popen(
            [BIN / "companion", "replay", *arguments, "--serve", "--listen", "127.0.0.1:0"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        line = line_of(self.process, self.process.stderr)
        found = re.search(r"serves (http://\S+) and replays (\S+)", line)
        if found is None:
            end(self.process)
            pytest.fail(f"did not start: {line!r}")
        self.url, self.log = found[1], found[2]

    def stop(self, number: signal.Signals = signal.SIGTERM) -> tuple[int, str, str]:
        """Return exit status, stdout and stderr after a signal."""
        self.process.send_signal(number)
        out, err = self.process.communicate(timeout=HANG_S)
        return self.process.returncode, out, err


@pytest.fixture
def start_replay() -> Iterator[Any]:
    """Start replays, and stop those that a test leaves running."""
    started: list[Replaying] = []

    def start(*arguments: str | Path) -> Replaying:
        started.append(Replaying(*arguments))
        return started[-1]

    yield start
    for node in started:
        end(node.process)


@pytest.fixture
def unserved(cut_log: Path) -> dict[str, Any]:
    """Return the summary of a replay that is not served."""
    return replay([cut_log], Settings().override(center={"source": "5:1"}))


@pytest.mark.full
def test_replay_is_served_during_and_after_the_run(
    start_replay: Any, cut_log: Path, unserved: dict[str, Any], tmp_path: Path
) -> None:
    out = tmp_path / "served.mcap"
    node = start_replay(cut_log, "--center", "5:1", "--speed", "10", "--out", out, "--json")
    assert node.log == cut_log.name
    began_s, seen = time.monotonic(), []
    while not seen or seen[-1]["replay"]["state"] == "running":
        seen.append(node.json("/v1/status"))
        ahead_s = seen[-1]["replay"]["at_s"] - 10 * (time.monotonic() - began_s)
        assert ahead_s < 0.5  # it announces its address before it starts
        assert time.monotonic() - began_s < 30
    at_s = [answer["replay"]["at_s"] for answer in seen]
    assert at_s == sorted(at_s)
    assert len({round(at) for at in at_s}) > 12  # in small steps
    last = seen[-1]
    assert last["replay"] == {
        "log": cut_log.name,
        "speed": 10.0,
        "at_s": pytest.approx(unserved["duration_s"]),
        "of_s": pytest.approx(unserved["duration_s"]),
        "state": "finished",
    }
    assert any(answer["replay"]["of_s"] for answer in seen[:-1])  # known before the end
    assert last["digest"] == unserved["digest"]
    newest_ns = max(event.t_ns for event in read_log(cut_log))
    assert datetime.fromisoformat(last["time"]).timestamp() == pytest.approx(
        newest_ns * 1e-9, abs=0.002
    )
    assert last["recording"]["state"] == "recording"
    assert [link["url"] for link in last["links"]] == [cut_log.name]
    assert last["links"][0]["frames"] == unserved["frames"]
    assert json.loads(node.get("/readyz")[1])["reasons"] == ["the replay has finished"]
    uavs = {uav["id"]: uav for uav in node.json("/v1/uavs")["uavs"]}
    assert {uav: entry["reports"] for uav, entry in uavs.items()} == unserved["reports"]
    assert len(node.json("/v1/beams")["beams"]) == 4
    assert any("live" in event["text"] for event in node.json("/v1/events")["events"])

    returncode, stdout, err = node.stop(signal.SIGINT)
    assert returncode == 0, err
    assert "stopped" not in err
    summary = json.loads(stdout)
    volatile = {"wall_s", "recording"}
    assert {k: v for k, v in summary.items() if k not in volatile} == {
        k: v for k, v in unserved.items() if k not in volatile
    }
    assert summary["recording"] == str(out)
    assert read_metadata(out)["summary"]["digest"] == unserved["digest"]


@pytest.mark.full
def test_stopped_replay_prints_a_summary(start_replay: Any, cut_log: Path, tmp_path: Path) -> None:
    out = tmp_path / "part.mcap"
    node = start_replay(cut_log, "--center", "5:1", "--out", out, "--json")
    status = node.wait_until("/v1/status", lambda answer: answer["replay"]["at_s"] > 0.5)
    assert status["replay"]["speed"] == 1.0  # the default
    assert node.json("/readyz")["ready"]
    returncode, stdout, err = node.stop(signal.SIGTERM)
    assert returncode == 0, err
    summary = json.loads(stdout)
    assert 0.5 < summary["duration_s"] < 20
    assert f"stopped after {summary['duration_s']:.1f} s of {cut_log.name}" in err
    again = replay([out], Settings.from_toml("", "").override(center={"source": "5:1"}))
    assert again["digest"] == summary["digest"]


@pytest.mark.full
def test_full_speed_replay_runs_on_plain_asyncio(cut_log: Path, unserved: dict[str, Any]) -> None:
    said: list[str] = []
    shown: list[dict[str, Any]] = []

    async def serve() -> ServedReplay:
        settings = Settings().override(center={"source": "5:1"})
        node = ServedReplay(
            ReplayRequest(logs=[cut_log], settings=settings, speed=None, record=None), said.append
        )
        until = asyncio.Event()

        def show(summary: dict[str, Any]) -> None:
            shown.append(summary)
            until.set()

        with socket.create_server(("127.0.0.1", 0)) as http:
            await asyncio.wait_for(node.run(http, None, show, until), HANG_S)
        return node

    node = run_async(serve())
    assert shown[0]["digest"] == unserved["digest"]
    assert node.replay().speed is None
    assert node.replay().state == "finished"
    assert node.recording().state == "off"
    assert "5:1 is live" in said


def test_current_time_does_not_go_back_for_a_queued_frame(tmp_path: Path) -> None:
    """The frame is processed after a later tick, with its true arrival time."""
    settings, begun_ns = Settings().override(center={"source": "5:1"}), 1_760_000_000 * 10**9
    late = Frame(
        t_ns=begun_ns + 500_000_000, link="udp", source=Source(1, 1), msgid=33, raw=frame(1)
    )
    with Writer(
        where=tmp_path / "log.mcap",
        settings_toml=settings.to_toml(),
        versions={},
        weights_hz=None,
        started_ns=begun_ns,
    ) as writer:
        for event in (Tick(begun_ns), Tick(begun_ns + 10**9), late):
            writer.event(event)
        log = writer.close({})

    async def served() -> tuple[int, float]:
        node, until = (
            ServedReplay(
                ReplayRequest(logs=[log], settings=settings, speed=None, record=None),
                lambda _: None,
            ),
            Event(),
        )
        with socket.create_server(("127.0.0.1", 0)) as http:
            await node.run(http, None, lambda _: until.set(), until)
        return node.now_ns(), node.replay().at_s

    assert run_async(served()) == (begun_ns + 10**9, 1.0)
    assert replay([log], settings)["duration_s"] == 1.0


@pytest.mark.full
def test_live_service_has_no_replay_status(start_node: Any) -> None:
    assert start_node(*RUN).json("/v1/status")["replay"] is None


@pytest.mark.full
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--listen", "127.0.0.1:0"), "need --serve"),
        (("--serve", "--listen", "0.0.0.0:0"), "--insecure"),
        (("--serve", "--speed", "0"), "'0' is neither max nor a number of at least 0.001"),
    ],
)
def test_command_error_is_one_line_and_leaves_no_files(
    arguments: tuple[str, ...], says: str, cut_log: Path, tmp_path: Path
) -> None:
    done = subprocess.run(
        [BIN / "companion", "replay", cut_log, "--center", "5:1", *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert done.returncode != 0
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert says in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.full
def test_recorded_listen_address_is_not_used(tmp_path: Path, cut_log: Path) -> None:
    """A recording holds the settings of its run, whose port may now be in use."""
    recorded = tmp_path / "x.mcap"
    settings = tmp_path / "settings.toml"
    settings.write_text('[server]\nlisten = "192.0.2.1:1"\n[center]\nsource = "5:1"\n')
    command = ["replay", cut_log, "--config", settings, "--out", recorded]
    subprocess.run([BIN / "companion", *command], check=True, capture_output=True, timeout=HANG_S)
    with socket.socket() as taken:  # the default port is in use, by others or by this test
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            taken.bind(("127.0.0.1", 8080))
            taken.listen()
        except OSError:
            pass
        done = subprocess.run(
            [BIN / "companion", "replay", recorded, "--serve", "--no-record"],
            capture_output=True,
            text=True,
            timeout=HANG_S,
            check=False,
        )
    assert "127.0.0.1:8080: Address already in use" in done.stderr
