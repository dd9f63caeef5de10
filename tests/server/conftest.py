"""A node that stands still: a pipeline that has seen a flight, and a server in this process."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
import uvicorn

from companion.mavlink.links.lag import ArrivalLag
from companion.mavlink.links.status import ComponentStatus, LinkStatus
from companion.mavlink.voice.rate_watch import MessageRate, RateState
from companion.node.replay import log_events
from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.server.access import bind
from companion.server.app import create_app
from companion.settings.model import Settings
from companion.settings.origins import Origins
from companion.values import Frame, Notice, Severity, Source, Tick
from companion.views.last_messages import LastMessages
from companion.views.lateness import Lateness
from companion.views.series import Series
from companion.views.served import FleetStatus
from companion.views.state import RecordingStatus, ReplayStatus

LOG = Path(__file__).parents[1] / "data" / "sitl_4circle_cut.tlog"
FLOWN_S = 6.0


class StandIn:
    """What the server looks at, without links and clocks: time moves with ``tick`` alone."""

    def __init__(self, settings: Settings, *, flown: bool = True) -> None:
        self.pipeline = Pipeline(settings)
        self.origins: Origins = {}
        self.equipment = assembly.equipment(settings, self.pipeline.array)
        self.last_messages = LastMessages()
        self.lateness = Lateness()
        self.series = Series()
        self.arrival_lag = ArrivalLag()
        self.notices: list[Notice] = []
        self.current = RecordingStatus(state="off", file=None, bytes=0, messages=0, dropped=0)
        self.replayed: ReplayStatus | None = None
        self.fleet: FleetStatus | None = None
        self._ticked = asyncio.Event()
        self._now_ns = 1_800_000_000_000_000_000
        if flown:
            self._fly(settings)

    def _fly(self, settings: Settings) -> None:
        begun_ns = None
        for event in log_events([LOG], settings):
            begun_ns = begun_ns or event.t_ns
            if event.t_ns > begun_ns + FLOWN_S * 1e9:
                return
            self._now_ns = event.t_ns
            if isinstance(event, Frame):
                self.last_messages.add(event)
            outputs = self.pipeline.step(event)
            self.series.add(self.pipeline)
            self.notices += [output for output in outputs if isinstance(output, Notice)]

    def tick(self, after_s: float = 0.1) -> None:
        """Time passes, and the beams are updated."""
        self._now_ns += round(after_s * 1e9)
        self.pipeline.step(Tick(self._now_ns))
        self._ticked.set()
        self._ticked.clear()

    def say(self, text: str) -> None:
        """A notice to the operator."""
        self.notices.append(
            Notice(t_ns=self._now_ns, severity=Severity.INFO, subject="test", text=text)
        )

    async def ticked(self) -> None:
        """Return after the next tick."""
        await self._ticked.wait()

    def now_ns(self) -> int:
        """The time of the last event."""
        return self._now_ns

    def uptime_s(self) -> float:
        """Some time."""
        return 12.5

    def links(self) -> list[LinkStatus]:
        """One link that hears one vehicle, and one that hears nobody."""
        heard = {Source(1, 1): ComponentStatus(frames=7, gaps=1, heard_ns=self._now_ns, mavlink=2)}
        lost = {"garbage": 12}
        one = LinkStatus(
            url="udpin:127.0.0.1:14550",
            state="up",
            frames=7,
            bytes=210,
            peers=1,
            lost=lost,
            heard_ns=self._now_ns,
        )
        one.components = heard
        return [one, LinkStatus(url="serial:/dev/ttyS0:57600", state="connecting")]

    def out_links(self) -> list[LinkStatus]:
        """One that has said something."""
        return [
            LinkStatus(url="cot:udp:127.0.0.1:6969", state="up", peers=1, sent=12, send_dropped=3)
        ]

    def recording(self) -> RecordingStatus:
        """As the test says."""
        return self.current

    def rates(self) -> dict[str, float | None]:
        """One that is known and one that is not."""
        return {"frames_hz": 70.0, "updates_hz": None}

    def unfit(self) -> list[str]:
        """Nothing is wrong."""
        return []

    def message_rates(self) -> list[MessageRate]:
        """One that is asked for."""
        return [
            MessageRate(
                uav=Source(1, 1),
                msgid=33,
                wanted_hz=10.0,
                observed_hz=None,
                state=RateState.ASKED,
                asked=1,
                changed_by=None,
            )
        ]

    def events(self) -> list[Notice]:
        """What was said."""
        return list(self.notices)

    def fleet_status(self) -> FleetStatus | None:
        """As the test says."""
        return self.fleet

    def replay(self) -> ReplayStatus | None:
        """As the test says."""
        return self.replayed


def settings(**sections: dict[str, object]) -> Settings:
    """Those of the log, with what is asked for besides; test clients call it ``testserver``."""
    made = Settings().override(center={"source": "5:1"}, server={"hosts": ["testserver"]})
    return made.override(**sections)


@pytest.fixture
def make_node() -> Callable[..., StandIn]:
    """A node after some seconds of flight, or before (``flown=False``), with settings."""

    def make(*, flown: bool = True, **sections: dict[str, object]) -> StandIn:
        return StandIn(settings(**sections), flown=flown)

    return make


@pytest.fixture(scope="module")
def shared_node() -> StandIn:
    """One that no test changes: a beam has been made, and there is a codebook."""
    node = StandIn(settings(codebook={"kind": "dft"}))
    node.tick(0.0)
    return node


@pytest.fixture
def serving() -> Callable[..., contextlib.AbstractAsyncContextManager[str]]:
    """Serve a node on this event loop, over a real socket: gives HOST:PORT."""

    @contextlib.asynccontextmanager
    async def serve(node: StandIn, token: str | None = None) -> AsyncIterator[str]:
        with bind("127.0.0.1:0", token=token, insecure=False) as listening:
            server = uvicorn.Server(
                uvicorn.Config(
                    create_app(node, token),
                    log_level="error",
                    lifespan="off",
                    ws_max_size=1024,
                    ws_per_message_deflate=False,
                    timeout_graceful_shutdown=1,
                )
            )
            task = asyncio.create_task(server._serve(sockets=[listening]))
            while not server.started:
                assert not task.done()
                await asyncio.sleep(0.001)
            host, port = listening.getsockname()
            try:
                yield f"{host}:{port}"
            finally:
                server.should_exit = True
                await task

    return serve
