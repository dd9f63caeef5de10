"""A service that gets too little of the processor: stopped for 0.6 s of each 0.9 s.

Within two seconds the page says so, no link is shown as good, and links that were good before name
this machine, not the compass or the radio.
"""

import json
import os
import signal
import threading
import time
import urllib.request
from collections import Counter
from typing import Any

from siege import besieged
from support import HANG_S, Node

STOPPED_S, PERIOD_S = 0.6, 0.9
STARVED_S = 12.0
WITHIN_S = 2.0


def starve(node: Node, until: threading.Event) -> None:
    """Stop and continue the service until told to end."""
    while not until.is_set():
        os.kill(node.process.pid, signal.SIGSTOP)
        time.sleep(STOPPED_S)
        os.kill(node.process.pid, signal.SIGCONT)
        until.wait(PERIOD_S - STOPPED_S)


def asked(node: Node, path: str) -> Any:
    with urllib.request.urlopen(node.url + path, timeout=HANG_S) as answer:
        return json.loads(answer.read())


def good(node: Node) -> set[str]:
    return {uav["id"] for uav in asked(node, "/v1/uavs")["uavs"] if uav["verdict"] == "good"}


def test_starved_service_blames_its_machine(start_node: Any, tmp_path: Any) -> None:
    (tmp_path / "settings.toml").write_text("[link]\nneeded_db = -20.0\n")
    with besieged(start_node, "--config", str(tmp_path / "settings.toml")) as node:
        node.wait_until("/v1/status", lambda answer: answer["health"]["good"] == 4)
        until = threading.Event()
        starver = threading.Thread(target=starve, args=(node, until), daemon=True)
        begun_s, seen, behind = time.monotonic(), Counter[Any](), Counter[bool]()
        starver.start()
        while (at_s := time.monotonic() - begun_s) < STARVED_S:
            health = asked(node, "/v1/status")["health"]
            for uav in asked(node, "/v1/uavs")["uavs"]:
                if at_s > WITHIN_S and uav["target"]:
                    seen[uav["verdict"], uav["health"]["cause"]] += 1
            if at_s > WITHIN_S:
                behind[health["behind"] is not None] += 1
        until.set()
        starver.join(HANG_S)
        assert behind.keys() == {True}
        assert sum(seen.values()) >= 40
        assert seen["weak", "machine"] >= 0.95 * sum(seen.values()), seen
        node.wait_until("/v1/status", lambda answer: answer["health"]["behind"] is None)
        node.wait_until("/v1/status", lambda answer: answer["health"]["good"] == 4)
