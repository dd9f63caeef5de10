"""``WS /v1/stream`` over a real socket: the requested topics, always the newest."""

import asyncio
import base64
import gc
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import uvloop
from starlette.datastructures import QueryParams
from support import HANG_S, run_async
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed
from websockets.typing import Subprotocol

from companion.server import models, stream
from companion.server.stream import Wanted, wanted
from companion.server.topics import Topic
from companion.views import beam_state, guaranteed_gain, link_state, records, uav_state
from companion.views import state as state_view

LOOPS: list[Callable[[], asyncio.AbstractEventLoop] | None] = [None, uvloop.new_event_loop]
SOON_S = HANG_S


async def said(websocket: ClientConnection) -> Any:
    return json.loads(await asyncio.wait_for(websocket.recv(), SOON_S))


async def closed(address: str, **options: Any) -> tuple[int, str]:
    """Return the code and reason with which a stream is closed."""
    async with connect(address, **options) as websocket:
        with pytest.raises(ConnectionClosed) as raised:
            await asyncio.wait_for(websocket.recv(), SOON_S)
    assert raised.value.rcvd is not None
    return raised.value.rcvd.code, raised.value.rcvd.reason


@pytest.mark.parametrize("loop", LOOPS, ids=["asyncio", "uvloop"])
def test_stream_sends_state_at_once_and_at_every_update(
    make_node: Any, serving: Any, loop: Any
) -> None:
    async def check() -> None:
        node = make_node()
        async with serving(node) as at, connect(f"ws://{at}/v1/stream?rate_hz=100") as websocket:
            first = [await said(websocket) for _ in range(2)]
            assert [message["topic"] for message in first] == ["uavs", "beams"]
            for message in first:
                assert message.keys() >= {"valid_at", "topic"}
            models.model(uav_state.Uavs).model_validate(first[0])
            models.model(beam_state.Beams).model_validate(first[1])
            await asyncio.sleep(0.02)  # more than the requested period
            node.tick()
            second = [await said(websocket) for _ in range(2)]
            assert second[0]["valid_at"] > first[0]["valid_at"]
            assert len(second[1]["beams"]) == 4

    run_async(check(), loop)


def test_stream_sends_binary_records_of_each_update(make_node: Any, serving: Any) -> None:
    async def check() -> None:
        node = make_node(records={"guaranteed": True})
        node.tick()
        query = "topic=records&topic=uavs&rate_hz=100"
        async with (
            serving(node) as at,
            connect(f"ws://{at}/v1/stream?{query}") as websocket,
            connect(f"ws://{at}/v1/stream?{query}&uav=4:1&uav=2:1") as other,
        ):
            for _ in range(3):
                update, number = node.pipeline.last_update, node.pipeline.updates - 1
                sure = guaranteed_gain.gains_db(node.pipeline, node.equipment, update)
                (whole,) = records.encode(update.beams, number, sure)
                assert await asyncio.wait_for(websocket.recv(), SOON_S) == whole
                assert (await said(websocket))["topic"] == "uavs"
                some = await asyncio.wait_for(other.recv(), SOON_S)
                head = np.frombuffer(some, records.HEADER, 1)[0]
                assert (head["beams"], head["all_beams"], head["bytes"]) == (2, 2, len(some))
                kept = np.frombuffer(some, records.BEAM, 2, head["beams_at"])
                columns = [update.beams.uavs.index(uav.decode()) for uav in kept["uav"]]
                assert {update.beams.uavs[i] for i in columns} == {"2:1", "4:1"}
                assert kept["guaranteed_gain_db"].tolist() == [sure[i] for i in columns]
                weights = np.frombuffer(some, "<c8", offset=head["weights_at"]).reshape(2, -1)
                wanted = update.beams.weights[:, columns].T.astype(np.complex64)
                np.testing.assert_array_equal(weights, wanted)
                assert (await said(other))["topic"] == "uavs"
                await asyncio.sleep(0.02)  # more than the requested period
                node.tick()

    run_async(check())


def test_stream_sends_only_requested_uavs_and_topics(make_node: Any, serving: Any) -> None:
    async def check() -> None:
        node = make_node()
        node.tick()
        query = "uav=2:1&uav=3:1&topic=weights&topic=uavs&topic=beams&topic=status&topic=links"
        async with serving(node) as at, connect(f"ws://{at}/v1/stream?{query}") as websocket:
            weights, uavs, beams, status, links = [await said(websocket) for _ in range(5)]
        assert {one["id"] for one in uavs["uavs"]} == {"2:1", "3:1"}
        assert {one["uav"] for one in beams["beams"]} == {"2:1", "3:1"}
        models.model(state_view.Status).model_validate(status)
        models.model(link_state.Links).model_validate(links)
        models.model(beam_state.Weights).model_validate(weights)
        beam_set = node.pipeline.last_update.beams
        columns = [beam_set.uavs.index(uav) for uav in weights["uavs"]]
        assert {beam_set.uavs[i] for i in columns} == {"2:1", "3:1"}
        assert weights["re"] == beam_set.weights[:, columns].real.tolist()
        assert weights["im"] == beam_set.weights[:, columns].imag.tolist()

    run_async(check())


def test_events_are_sent_when_new(make_node: Any, serving: Any) -> None:
    async def check() -> None:
        node = make_node()
        query = "topic=events&topic=status&rate_hz=100"
        async with serving(node) as at, connect(f"ws://{at}/v1/stream?{query}") as websocket:
            events, status = await said(websocket), await said(websocket)
            assert (events["topic"], status["topic"]) == ("events", "status")
            await asyncio.sleep(0.02)
            node.tick()
            assert (await said(websocket))["topic"] == "status"
            node.say("something new")
            await asyncio.sleep(0.02)
            node.tick()
            assert (await said(websocket))["events"][-1]["text"] == "something new"

    run_async(check())


def test_event_between_two_updates_is_sent_to_every_client(make_node: Any, serving: Any) -> None:
    """The second client shares the update's messages with the first, but not its events."""

    async def check() -> None:
        node = make_node()
        node.say("before")
        query = "topic=events&rate_hz=100"
        async with serving(node) as at, connect(f"ws://{at}/v1/stream?{query}") as first:
            assert (await said(first))["events"][-1]["text"] == "before"
            node.say("something new")
            async with connect(f"ws://{at}/v1/stream?{query}") as second:
                assert (await said(second))["events"][-1]["text"] == "something new"
                await asyncio.sleep(0.02)  # more than the requested period
                node.tick()
                assert (await said(first))["events"][-1]["text"] == "something new"

    run_async(check())


def test_stream_respects_the_requested_rate(make_node: Any, serving: Any) -> None:
    async def check() -> None:
        node = make_node()
        query = "topic=uavs&rate_hz=5"
        loop = asyncio.get_running_loop()
        async with serving(node) as at, connect(f"ws://{at}/v1/stream?{query}") as websocket:
            await said(websocket)
            begun_s, count = loop.time(), 0
            while loop.time() < begun_s + 0.7:
                node.tick(0.01)
                await asyncio.sleep(0.005)
            websocket_messages = websocket.recv_messages.frames
            count = len(websocket_messages.queue)
        assert 2 <= count <= 4

    run_async(check())


def test_many_streams_share_a_rate(
    make_node: Any, serving: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "MESSAGES_PER_S", 10.0)  # for two topics of one client: 5 Hz

    async def check() -> None:
        node = make_node()
        query = "topic=status&topic=events&rate_hz=100"
        loop = asyncio.get_running_loop()
        async with serving(node) as at, connect(f"ws://{at}/v1/stream?{query}") as websocket:
            await said(websocket)
            begun_s = loop.time()
            while loop.time() < begun_s + 0.7:
                node.tick(0.01)
                await asyncio.sleep(0.005)
            topics = [json.loads(one.data)["topic"] for one in websocket.recv_messages.frames.queue]
        assert 2 <= topics.count("status") <= 4

    run_async(check())


def test_identical_subscriptions_share_one_message(make_node: Any, serving: Any) -> None:
    """All receive the same bytes, although the clock has advanced."""

    async def check() -> None:
        node = make_node()
        made = 0
        message_rates = node.message_rates

        def counted() -> Any:
            nonlocal made
            made += 1
            return message_rates()

        node.message_rates = counted
        async with serving(node) as at:
            many = [await connect(f"ws://{at}/v1/stream?topic=links") for _ in range(10)]
            texts = {await asyncio.wait_for(one.recv(), SOON_S) for one in many}
            assert len(texts) == 1
            assert made == 1
            for one in many:
                await one.close()

    run_async(check())


@pytest.mark.parametrize(
    ("query", "said_of"),
    [
        ("rate_hz=0", "rate_hz"),
        ("rate_hz=nan", "rate_hz"),
        ("rate_hz=fast", "rate_hz"),
        ("uav=one", "uav"),
        ("uav=1:1&uav=%00", "uav"),
        ("uav=icao:xyz", "uav"),
        ("topic=weather", "topic"),
        ("rate=5", "'rate'"),
        ("uav=" + "%F0%9F%9A%81" * 90, "uav"),
    ],
)
def test_invalid_arguments_close_the_stream(
    shared_node: Any, serving: Any, query: str, said_of: str
) -> None:
    async def check() -> None:
        async with serving(shared_node) as at:
            code, reason = await closed(f"ws://{at}/v1/stream?{query}")
        assert code == stream.BAD_ARGUMENTS
        assert said_of in reason

    run_async(check())


def test_stream_arguments_are_parsed() -> None:
    assert wanted(QueryParams("")) == Wanted((Topic.UAVS, Topic.BEAMS), frozenset(), 10.0)
    asked = wanted(QueryParams("uav=1:1&uav=icao:4CA7B3&topic=beams&topic=beams&rate_hz=0.5"))
    assert asked == Wanted((Topic.BEAMS,), frozenset({"1:1", "icao:4CA7B3"}), 0.5)


@pytest.mark.parametrize("token", [None, "s3cret"])
@pytest.mark.parametrize("leaves", ["closes", "resets"])
def test_client_that_sends_and_leaves_at_once_causes_no_error(
    shared_node: Any, serving: Any, capfd: Any, leaves: str, token: str | None
) -> None:
    text, close = b"\x81\x81\0\0\0\0x", b"\x88\x82\0\0\0\0\x03\xe8"  # masked with zeros

    async def leave(at: str) -> None:
        websocket = await connect(
            f"ws://{at}/v1/stream", subprotocols=[Subprotocol("companion.v1")]
        )
        websocket.transport.write(text + (close if leaves == "closes" else b""))
        if leaves == "closes":
            await asyncio.wait_for(websocket.wait_closed(), SOON_S)
        else:
            websocket.transport.abort()

    async def check() -> None:
        async with serving(shared_node, token) as at:
            await asyncio.gather(*(leave(at) for _ in range(30)))
            async with asyncio.timeout(SOON_S):
                while any("run_asgi" in repr(task) for task in asyncio.all_tasks()):
                    await asyncio.sleep(0.01)

    run_async(check())
    assert "Traceback" not in capfd.readouterr().err


def test_foreign_origin_is_rejected(shared_node: Any, serving: Any) -> None:
    async def check() -> None:
        async with serving(shared_node) as at:
            address = f"ws://{at}/v1/stream"
            for origin in ("http://evil.example", "null", "http://[", f"http://{at}.example"):
                assert (await closed(address, origin=origin))[0] == stream.ELSEWHERE
            async with connect(address, origin=f"http://{at}") as websocket:
                assert (await said(websocket))["topic"] == "uavs"

    run_async(check())


TOKEN = "s3cret/ü"
AS_SUBPROTOCOL = "bearer." + base64.urlsafe_b64encode(TOKEN.encode()).decode().rstrip("=")


def test_token_is_required(shared_node: Any, serving: Any) -> None:
    async def check() -> None:
        async with serving(shared_node, TOKEN) as at:
            address = f"ws://{at}/v1/stream"
            wrong: list[dict[str, Any]] = [
                {},
                {"additional_headers": {"authorization": "Bearer wrong"}},
                {"subprotocols": [Subprotocol("companion.v1")]},
                {"subprotocols": [Subprotocol("companion.v1"), Subprotocol("bearer.d3Jvbmc")]},
                {"subprotocols": [Subprotocol("companion.v1"), Subprotocol("bearer.d")]},
                {"subprotocols": [Subprotocol("companion.v1"), Subprotocol("bearer.")]},
            ]
            for options in wrong:
                assert (await closed(address, **options))[0] == 4401
            assert (await closed(f"{address}?token=s3cret"))[0] == 4401
            assert (await closed(f"ws://{at}/elsewhere"))[0] == 4401
            given = [Subprotocol("companion.v1"), Subprotocol(AS_SUBPROTOCOL)]
            async with connect(address, subprotocols=given) as websocket:
                assert websocket.subprotocol == "companion.v1"
                assert (await said(websocket))["topic"] == "uavs"

    run_async(check())


def test_token_in_the_header_is_accepted(shared_node: Any, serving: Any) -> None:
    async def check() -> None:
        async with serving(shared_node, "s3cret") as at:
            headers = {"authorization": "Bearer s3cret"}
            async with connect(f"ws://{at}/v1/stream", additional_headers=headers) as websocket:
                assert (await said(websocket))["topic"] == "uavs"

    run_async(check())


def test_closed_stream_leaves_no_state(make_node: Any, serving: Any) -> None:
    async def check() -> None:
        node = make_node()
        async with serving(node) as at:
            for _ in range(3):
                async with connect(f"ws://{at}/v1/stream") as websocket:
                    await said(websocket)
            async with connect(f"ws://{at}/v1/stream") as websocket:
                await said(websocket)
                websocket.transport.abort()
            tasks = {"_send", "receive"}

            def left() -> int:
                names = [task.get_coro().__qualname__ for task in asyncio.all_tasks()]
                return sum(name.rsplit(".", 1)[-1] in tasks for name in names)

            async with asyncio.timeout(SOON_S):
                while left():
                    node.tick()
                    await asyncio.sleep(0.01)
        gc.collect()

    run_async(check())


def test_slow_client_skips_messages_without_delaying_others(make_node: Any, serving: Any) -> None:
    """The reader receives every update; the other one receives messages in transit and then the
    newest."""

    async def check() -> None:
        node = make_node()
        query = "topic=weights&topic=beams&rate_hz=100"
        async with serving(node) as at:
            address = f"ws://{at}/v1/stream?{query}"
            slow = await connect(address, max_queue=1, close_timeout=1)
            reader = await connect(address)
            heard = 0
            for _ in range(150):
                while json.loads(await asyncio.wait_for(reader.recv(), SOON_S))["topic"] != "beams":
                    pass
                heard += 1
                await asyncio.sleep(0.01)
                node.tick()
            newest = json.loads(await asyncio.wait_for(reader.recv(), SOON_S))["valid_at"]
            assert heard == 150
            valid_at = []
            while valid_at[-1:] != [newest]:
                message = json.loads(await asyncio.wait_for(slow.recv(), SOON_S))
                valid_at.append(message["valid_at"])
            await slow.close()
            await reader.close()
        assert valid_at == sorted(valid_at)
        assert len(valid_at) < 250  # of 302: the kernel's buffers hold a few

    run_async(check())
