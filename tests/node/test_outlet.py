"""Tracks forwarded over an output link, as pymavlink receives them."""

import asyncio
import socket
import time
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import siege
from pymavlink.dialects.v20 import common
from support import HANG_S, ROOT, free_port, run_async

from companion.mavlink.links.transport import Link
from companion.mavlink.wire.decode import PREDICTION
from companion.mavlink.wire.encode import pack
from companion.mavlink.wire.framing import Splitter
from companion.mavlink.wire.positions import PASSED_ON
from companion.node import moment
from companion.node.outlet import SHARE, Outlet
from companion.settings.model import Settings
from companion.values import Frame, Reason, Rejection
from companion.views import passed_on


def test_each_forwarded_vehicle_has_its_own_sequence_numbers() -> None:
    settings = Settings().override(center={"source": "5:1"})
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    pipeline, update = moment.look([log], settings, "3")
    now_ns = (update.t_ns + 20_000_000 * n for n in count())
    numbers: list[int] = []

    async def test(heard: socket.socket) -> None:
        out = {"urls": [f"udpout:127.0.0.1:{heard.getsockname()[1]}"], "rate_hz": 50.0}
        outlet = Outlet(
            settings=settings.override(out=out),
            pipeline=pipeline,
            notify=lambda notice: None,
            now_ns=lambda: next(now_ns),
        )
        outlet.open()
        task, mav = asyncio.create_task(outlet.run()), common.MAVLink(None)
        while len(numbers) < 3:
            (message,) = mav.parse_buffer(await asyncio.to_thread(heard.recv, 2048))
            if message.get_srcSystem() == 1:
                assert message.get_type() == "GLOBAL_POSITION_INT"
                numbers.append(message.get_seq())
        task.cancel()

    with socket.socket(type=socket.SOCK_DGRAM) as heard:
        heard.bind(("127.0.0.1", 0))
        heard.settimeout(HANG_S)
        run_async(test(heard))
    assert numbers == [numbers[0] + n for n in range(3)]


def test_forwarded_position_is_no_report_of_its_vehicle() -> None:
    """Also in the log of a ground station, where it stands beside the vehicle's own."""
    settings = Settings().override(center={"source": "5:1"})
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    pipeline, update = moment.look([log], settings, "3")
    sent = passed_on.Positions(utm=False, every_s=0.1).outgoing(pipeline, list(update.tracks))
    raw = pack(sent[0], 7, compat_flags=PASSED_ON)
    (frame,) = Splitter("x").feed(update.t_ns + 1, raw)
    assert isinstance(frame, Frame)
    (rejected,) = [out for out in pipeline.step(frame) if isinstance(out, Rejection)]
    assert (rejected.reason, rejected.detail) == (Reason.DUPLICATE, PREDICTION)


def test_sending_takes_a_limited_share_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """1000 UAVs, sent to 60 clients, left no time for the carrier's attitudes: no beams."""
    settings = Settings().override(center={"source": "5:1"})
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    pipeline, update = moment.look([log], settings, "3")
    now_ns = (update.t_ns + 20_000_000 * n for n in count())
    sent = 0

    def slow(_link: Link, _raw: bytes) -> int:
        nonlocal sent
        sent += 1
        until_s = time.thread_time() + 0.003
        while time.thread_time() < until_s:
            pass
        return 1

    async def share() -> float:
        outlet = Outlet(
            settings=settings.override(
                out={"urls": [f"udpout:127.0.0.1:{free_port(socket.SOCK_DGRAM)}"], "rate_hz": 50.0}
            ),
            pipeline=pipeline,
            notify=lambda notice: None,
            now_ns=lambda: next(now_ns),
        )
        outlet.open()
        begun_s, used_s = time.monotonic(), time.thread_time()
        task = asyncio.create_task(outlet.run())
        async with asyncio.timeout(20):
            while sent < 100:
                await asyncio.sleep(0.01)
        task.cancel()
        return (time.thread_time() - used_s) / (time.monotonic() - begun_s)

    monkeypatch.setattr(Link, "send_raw", slow)
    assert run_async(share()) < 1.5 * SHARE


def test_silent_vehicle_does_not_live_on_by_its_forwarded_positions(
    tmp_path: Path, start_node: Any
) -> None:
    """A router forwards everything to all, so they come back over the service's own link."""
    port, config = free_port(socket.SOCK_DGRAM), tmp_path / "out.toml"
    config.write_text(f'[out]\nurls = ["udpout:127.0.0.1:{port}"]\nrate_hz = 10.0\n')
    run = ("run", "--config", str(config), "--link", f"udpin:127.0.0.1:{port}")
    node = start_node(*run, "--listen", "127.0.0.1:0", "--center", "5:1")
    with siege.flight(port):
        node.wait_until("/v1/uavs", lambda said: states(said) == {"live"} and len(said["uavs"]) > 3)
        node.wait_until("/v1/links", lambda said: said["out"][0]["sent"] > 100)
    node.wait_until("/v1/uavs", lambda said: "live" not in states(said), seconds=20)


def states(said: Any) -> set[str]:
    return {uav["state"] for uav in said["uavs"]}
