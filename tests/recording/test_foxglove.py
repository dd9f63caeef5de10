"""The live channels, received by a WebSocket client that knows only the protocol."""

import asyncio
import base64
import json
import socket
import struct
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from support import HANG_S, run_async
from websockets.asyncio.client import ClientConnection, connect

from companion.beams.array.geometry import uniform_linear
from companion.recording import foxglove
from companion.recording.foxglove import LiveChannels
from companion.recording.scene import Scene
from companion.values import Estimate, FloatArray, Tick, Update, UserError

pytest.importorskip("foxglove", reason="the extra [live] is not installed")

PROTOCOL = "foxglove.sdk.v1"
START_NS = 1_700_000_000_000_000_000
Geodetic = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]


async def advertised(viewer: ClientConnection, topics: set[str]) -> dict[str, Any]:
    """The channels by topic, once all given topics are announced."""
    found: dict[str, Any] = {}
    while not topics <= found.keys():
        said = json.loads(await asyncio.wait_for(viewer.recv(), HANG_S))
        if said["op"] == "advertise":
            found |= {channel["topic"]: channel for channel in said["channels"]}
    return found


def message_class(channel: dict[str, Any]) -> Any:
    """The message class described by a channel's schema."""

    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))


async def watch(port: int, topics: set[str], feed: Callable[[], None]) -> dict[str, Any]:
    """The first message on each topic, decoded by its own schema, and its log time."""
    async with connect(f"ws://127.0.0.1:{port}", subprotocols=[PROTOCOL]) as viewer:  # type: ignore[list-item]
        channels = await advertised(viewer, topics)
        wanted = dict(enumerate(sorted(topics)))
        asked = [{"id": n, "channelId": channels[topic]["id"]} for n, topic in wanted.items()]
        await viewer.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        found: dict[str, Any] = {}
        while found.keys() != topics:
            feed()
            try:
                said = await asyncio.wait_for(viewer.recv(), 0.1)
            except TimeoutError:
                continue
            if isinstance(said, bytes):
                kind, number, log_ns = struct.unpack_from("<BIQ", said)
                assert kind == 1
                message = message_class(channels[wanted[number]]).FromString(said[13:])
                found[wanted[number]] = (log_ns, message)
        return found


@pytest.mark.full
def test_viewer_receives_the_channels_of_a_recording(
    geodetic: Geodetic, update: Callable[[int], Update], estimate: Estimate
) -> None:
    live = LiveChannels(
        host="127.0.0.1",
        port=0,
        geodetic=geodetic,
        scene=Scene(
            uniform_linear(4, 1e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)), 2.0
        ),
    )
    live.start()
    now = iter(range(START_NS, START_NS + 10**12, 10**9))

    def feed() -> None:
        t_ns = next(now)
        live.put(Tick(t_ns), [estimate, update(t_ns)])

    feed()  # before any viewer connects: this announces the topics of the UAV
    topics = {"/ticks", "/scene", "/tracks", "/beams/weights", "/uav/1:1/fix", "/uav/1:1/predicted"}
    try:
        found = run_async(watch(live.port, topics, feed))
    finally:
        live.stop()
    log_ns, tick = found["/ticks"]
    assert log_ns == tick.t_ns >= START_NS
    assert found["/uav/1:1/fix"][1].latitude == 47.5
    assert found["/tracks"][1].uav in ("1:1", "icao:4CA7B3")
    assert [entity.id for entity in found["/scene"][1].entities] == ["uav 1:1", "uav icao:4CA7B3"]
    assert len(found["/beams/weights"][1].weights_complex64) == 4 * 2 * 8


def with_own_weights(update: Update) -> Update:
    """The same update with weights of its own, as each has in flight."""
    return replace(update, beams=replace(update.beams, weights=update.beams.weights.copy()))


def test_updates_that_wait_are_dropped_and_the_events_are_not(
    geodetic: Geodetic, update: Callable[[int], Update], estimate: Estimate
) -> None:
    live = LiveChannels(host="127.0.0.1", port=0, geodetic=geodetic, scene=None)
    updates = [with_own_weights(update(START_NS + n)) for n in range(9)]
    held = [weakref.ref(one.beams.weights) for one in updates]
    for one in updates:  # its thread does not run yet
        live.put(Tick(one.t_ns), [estimate, one])
    del updates, one
    assert live.dropped == 7
    kept = [weights for ref in held if (weights := ref()) is not None]
    assert len(kept) == 2
    released = [threading.Event() for _ in kept]
    for weights, event in zip(kept, released, strict=True):
        weakref.finalize(weights, event.set)
    del kept, weights
    try:
        live.start()
        assert all(event.wait(HANG_S) for event in released)
        live.put(Tick(START_NS + 10), [update(START_NS + 10)])
        assert live.dropped == 7
    finally:
        live.stop()


def test_encoding_rests_most_of_the_time(
    monkeypatch: pytest.MonkeyPatch, geodetic: Geodetic, update: Callable[[int], Update]
) -> None:
    live = LiveChannels(host="127.0.0.1", port=0, geodetic=geodetic, scene=None, rate_hz=None)
    rests, used_s = list[float](), count(0.0, 0.001)
    monkeypatch.setattr(time, "thread_time", lambda: next(used_s))
    monkeypatch.setattr(live._stopping, "wait", rests.append)
    try:
        for n in range(30):
            live._encoder.output(update(START_NS + n), geodetic)
    finally:
        live.stop()
    worked_s = next(used_s)
    assert len(rests) > 20
    assert worked_s <= 1.05 * foxglove.SHARE * (worked_s + sum(rests))


def test_port_in_use_is_reported(geodetic: Geodetic) -> None:
    live = LiveChannels(host="127.0.0.1", port=0, geodetic=geodetic, scene=None)
    with pytest.raises(UserError, match=rf"cannot listen on 127\.0\.0\.1:{live.port}"):
        LiveChannels(host="127.0.0.1", port=live.port, geodetic=geodetic, scene=None)
    live.stop()


def test_service_publishes_the_live_channels(start_node: Any) -> None:
    node = start_node(
        "run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "1:1",
        "--foxglove", "0",
    )  # fmt: skip
    line = node.errors().splitlines()[0]
    assert "ws://127.0.0.1:" in line
    found = run_async(watch(int(line.rsplit(":", 1)[1]), {"/ticks"}, lambda: None))
    assert found["/ticks"][1].t_ns > START_NS
    # The server waits for the handshake of a viewer that sends nothing; the end does not.
    with socket.create_connection(("127.0.0.1", int(line.rsplit(":", 1)[1])), HANG_S):
        assert node.stop()[0] == 0


_WITHOUT = """
import sys
sys.modules["foxglove"] = None
from companion.cli.main import main
main(["run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "1:1",
      "--foxglove", "0"])
"""


@pytest.mark.full
def test_missing_foxglove_extra_is_a_one_line_error() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _WITHOUT],
        capture_output=True,
        text=True,
        check=False,
        timeout=HANG_S,
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1 and "[live]" in done.stderr, done.stderr


def test_foxglove_is_not_imported_unless_enabled() -> None:
    code = "import sys, companion.node.service; print('foxglove' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=HANG_S
    )
    assert done.stdout == "False\n"
