"""The whole service is suspended for a while, as by a debugger or a sleeping machine."""

import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from support import ROOT, end, read_metadata

from companion.node.replay import replay, settings_for

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "1:1")
STOPPED_S = 8.0
FRAMES_HZ = 400


@pytest.mark.full
def test_suspended_service_resumes_within_seconds(start_node: Any, tmp_path: Path) -> None:
    """Traffic continues meanwhile; messages that wait too long are discarded and counted."""
    node = start_node(*RUN, "--record", str(tmp_path))
    sender = [sys.executable, ROOT / "tests" / "load_sender.py"]
    command = [*map(str, sender), str(node.udp_port), "4", str(FRAMES_HZ), "600"]
    flight = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 3)
        before = node.json("/v1/links")["links"][0]
        node.process.send_signal(signal.SIGSTOP)
        time.sleep(STOPPED_S)  # suspended for this long
        node.process.send_signal(signal.SIGCONT)
        begun_s = time.monotonic()
        node.wait_until(
            "/v1/beams", lambda answer: len(answer["beams"]) == 3 and answer["age_s"] < 0.5
        )
        node.wait_until("/readyz", lambda answer: answer["ready"])
        took_s = time.monotonic() - begun_s
        tracks = node.json("/v1/uavs")["uavs"]
        least = FRAMES_HZ * (STOPPED_S - 4) + (before["overflowed"] or 0)
        node.wait_until("/v1/links", lambda answer: answer["links"][0]["overflowed"] > least)
    finally:
        end(flight)
    code, _, err = node.stop()
    assert code == 0, err
    assert took_s < 5.0
    assert all(track["age_s"] < 2.0 for track in tracks), "nothing old is served as if it were new"
    (log,) = tmp_path.iterdir()
    summary = replay([log], settings_for([log], None, None))
    assert summary["digest"] == read_metadata(log)["summary"]["digest"]
