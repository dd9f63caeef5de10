"""A flight received over Zenoh is tracked as over any other link."""

import subprocess
from typing import Any

import pytest
from support import BIN, free_port, started

pytest.importorskip("zenoh")


def test_flight_over_zenoh_is_tracked(start_node: Any) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    node = start_node(
        *("run", "--link", f"zenoh:mavlink_raw?connect={endpoint}", "--center", "5:1"),
        *("--listen", "127.0.0.1:0"),
    )
    hub = f"zenoh:mavlink_raw?as=hub&listen={endpoint}"
    with started([BIN / "sitl-replay", "fly", "paper", "--to", hub], stdout=subprocess.DEVNULL):
        node.wait_until(
            "/v1/uavs", lambda answer: sum(uav["target"] for uav in answer["uavs"]) == 4
        )
        (link,) = node.json("/v1/links")["links"]
        assert (link["state"], link["gaps"], link["lost"]) == ("up", 0, {})
    status, _, errors = node.stop()
    assert status == 0, errors
