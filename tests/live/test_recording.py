"""Recordings of the live service: killed, split into parts, removed folder, other readers."""

import json
import random
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from support import BIN, HANG_S, ROOT, Node, end, read_metadata

from companion.node.replay import replay, settings_for
from companion.recording.parts import read_recording_info
from companion.recording.reader import read_parts
from companion.recording.recover import Recovered, recover_leftovers
from companion.values import Frame

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "1:1")
SENDERS = 4
FRAMES_HZ = 400


def send(node: Node, seconds: float) -> "subprocess.Popen[str]":
    """Steady traffic from hovering vehicles."""
    sender = [sys.executable, ROOT / "tests" / "load_sender.py"]
    numbers = (node.udp_port, SENDERS, FRAMES_HZ, seconds)
    command = [*sender, *map(str, numbers)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def replayed(*logs: Path) -> dict[str, Any]:
    """The JSON output of ``companion replay`` for the given logs."""
    command = [BIN / "companion", "replay", *logs, "--no-record", "--json"]
    answer: dict[str, Any] = json.loads(
        subprocess.run(command, check=True, stdout=-1, timeout=HANG_S).stdout
    )
    return answer


def killed_while_recording(folder: Path, seconds: float) -> float:
    """Kill a service under traffic at some time; return the seconds of traffic lost before that."""
    node = Node(*RUN, "--record", str(folder))
    flight = send(node, seconds + 60)
    try:
        node.wait_until("/v1/status", lambda answer: answer["recording"]["messages"] > 0)
        begun_ns = time.time_ns()
        time.sleep(seconds)  # a random time
        killed_ns = time.time_ns()
        node.process.send_signal(signal.SIGKILL)
    finally:
        for process in (node.process, flight):
            end(process)
    (leftover,) = folder.iterdir()
    before = list(read_parts([leftover]))
    (found,) = recover_leftovers(folder)
    assert isinstance(found, Recovered)
    assert list(read_parts([found.path])) == before
    if before:  # killed more than a second after the start
        summary = replay([found.path], settings_for([found.path], None, None))
        assert summary["frames"] == sum(isinstance(event, Frame) for event in before) > 0
        assert summary["missing"] == []
    return (killed_ns - (before[-1].t_ns if before else begun_ns)) * 1e-9


def kills(folder: Path, count: int, at_once: int, longest_s: float) -> list[float]:
    """Kill many services at different times: a flush interval is one second, plus write time and
    delays of a busy machine."""
    rng = random.Random(6)
    moments = [rng.uniform(0.1, longest_s) for _ in range(count)]
    with ThreadPoolExecutor(at_once) as pool:
        runs = [
            pool.submit(killed_while_recording, folder / str(number), moment)
            for number, moment in enumerate(moments)
        ]
        lost_s = sorted(run.result() for run in runs)
    print(f"lost: median {lost_s[count // 2]:.2f} s, at most {lost_s[-1]:.2f} s")
    assert lost_s[count // 2] < 1.0
    assert lost_s[-1] < 1.5
    return lost_s


def test_killed_service_loses_at_most_a_second(tmp_path: Path) -> None:
    kills(tmp_path, 6, 3, 2.5)


@pytest.mark.soak
def test_service_killed_50_times_loses_at_most_a_second_each(tmp_path: Path, table: Any) -> None:
    lost_s = kills(tmp_path, 50, 2, 5.0)
    table.add("lost by 50 kills, median", lost_s[25], "s", "< 1 s")
    table.add("lost by 50 kills, most", lost_s[-1], "s", "< 1.5 s")


def test_parts_of_a_run_replay_to_its_digest(start_node: Any, tmp_path: Path) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text("[recording]\nrotate_s = 1.0\n")
    node = start_node(*RUN, "--config", str(settings), "--record", str(tmp_path / "kept"))
    flight = send(node, 4.5)
    flight.communicate(timeout=HANG_S)
    code, out, err = node.stop()
    assert code == 0, err
    logs = sorted(
        (tmp_path / "kept").iterdir(),
        key=lambda path: getattr(read_recording_info(path).part, "number", 0),
    )
    assert len(logs) >= 4
    assert all(log.suffix == ".mcap" for log in logs)
    summary = replayed(*reversed(logs))
    assert summary["digest"] == read_metadata(logs[-1])["summary"]["digest"]
    assert summary["missing"] == []
    assert logs[-1].name in out
    alone = replayed(logs[2])
    assert alone["missing"] == [f"{logs[2]}: part 1 to 2 of the run is missing"]
    assert alone["frames"] > 0 and alone["digest"] != summary["digest"]
    assert len(replayed(logs[0], logs[2])["missing"]) == 1


def test_removed_recording_folder_does_not_stop_the_beams(start_node: Any, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    node = start_node(*RUN, "--record", str(kept))
    with send(node, 20) as flight:
        node.wait_until("/v1/status", lambda answer: answer["recording"]["bytes"] > 20_000)
        shutil.rmtree(kept)
        kept.touch()  # nor can it be created again
        node.wait_until("/v1/status", lambda answer: answer["recording"]["state"] == "degraded")
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == SENDERS - 1)
        beams = node.json("/v1/beams")
        assert beams["age_s"] < 0.5
        assert json.loads(node.get("/readyz")[1])["ready"]
        kept.unlink()
        node.wait_until("/v1/status", lambda answer: answer["recording"]["state"] == "recording")
        flight.kill()
    code, _, err = node.stop()
    assert code == 0, err
    said = [line for line in err.splitlines() if "record" in line]
    assert len(said) == 2 and "nothing is recorded" in said[0] and "recording again" in said[1]
    (path,) = kept.iterdir()
    assert replayed(path)["missing"] == [f"{path}: part 1 of the run is missing"]
    log = [notice for notice in read_metadata(path) if notice == "summary"]
    assert log == ["summary"]
