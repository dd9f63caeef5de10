"""A stand-in node: a pipeline that has processed a flight, and a server in this process."""

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
from companion.values import Frame, Notice, Observation, Severity, Source, Tick
from companion.views.last_messages import LastMessages
from companion.views.lateness import Lateness
from companion.views.series import Series
from companion.views.served import FleetStatus
from companion.views.state import ObservationCounts, RecordingStatus, ReplayStatus

LOG = Path(__file__).parents[1] / "data" / "sitl_4circle_cut.tlog"
FLOWN_S = 6.0


class StandIn:
    """The node interface of the server, without links and clocks: only ``tick`` advances time."""

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
        self.counts = ObservationCounts(received=3, malformed=2, dropped=1)
        self.budget = 1_000_000
        self.observed: list[Observation | str] = []
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
        """Advance time and update the beams."""
        self._now_ns += round(after_s * 1e9)
        self.pipeline.step(Tick(self._now_ns))
        self._ticked.set()
        self._ticked.clear()

    def advance(self, after_s: float) -> None:
        """Advance time without an update."""
        self._now_ns += round(after_s * 1e9)

    def pretend_update(self, text: str) -> None:
        """Publish a notice and the newest beams once more, as after an update."""
        self.say(text)
        self.pipeline.updates += 1
        self._ticked.set()
        self._ticked.clear()

    def say(self, text: str) -> None:
        """Publish a notice to the operator."""
        self.notices.append(
            Notice(t_ns=self._now_ns, severity=Severity.INFO, subject="test", text=text)
        )

    def notify(self, notice: Notice) -> None:
        """Publish a notice of the server."""
        self.notices.append(notice)

    async def ticked(self) -> None:
        """Return after the next tick."""
        await self._ticked.wait()

    def now_ns(self) -> int:
        """Return the time of the last event."""
        return self._now_ns

    def uptime_s(self) -> float:
        """Return a fixed uptime."""
        return 12.5

    def links(self) -> list[LinkStatus]:
        """Return one link that receives one vehicle, and one that receives nothing."""
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
        """Return one output link that has sent something."""
        return [
            LinkStatus(url="cot:udp:127.0.0.1:6969", state="up", peers=1, sent=12, send_dropped=3)
        ]

    def recording(self) -> RecordingStatus:
        """Return the recording status set by the test."""
        return self.current

    def rates(self) -> dict[str, float | None]:
        """Return one known and one unknown rate."""
        return {"frames_hz": 70.0, "updates_hz": None}

    def unfit(self) -> list[str]:
        """Return no reason: the node is fit."""
        return []

    def message_rates(self) -> list[MessageRate]:
        """Return one requested message rate."""
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
        """Return the published notices."""
        return list(self.notices)

    def observations(self) -> ObservationCounts:
        """Return the counts that the test set."""
        return self.counts

    def may_observe(self) -> bool:
        """Return whether the budget that the test set is left."""
        self.budget -= 1
        return self.budget >= 0

    def observe(self, found: Observation | str) -> None:
        """Keep what was passed on."""
        self.observed.append(found)
        if isinstance(found, Observation):
            self.pipeline.step(found)

    def fleet_status(self) -> FleetStatus | None:
        """Return the fleet status set by the test."""
        return self.fleet

    def replay(self) -> ReplayStatus | None:
        """Return the replay status set by the test."""
        return self.replayed


def settings(**sections: dict[str, object]) -> Settings:
    """Return the log's settings plus those of the test; test clients use the host
    ``testserver``.
    """
    made = Settings().override(center={"source": "5:1"}, server={"hosts": ["testserver"]})
    return made.override(**sections)


@pytest.fixture
def make_node() -> Callable[..., StandIn]:
    """Return a node after some seconds of flight, or before it (``flown=False``), with settings."""

    def make(*, flown: bool = True, **sections: dict[str, object]) -> StandIn:
        return StandIn(settings(**sections), flown=flown)

    return make


@pytest.fixture(scope="module")
def shared_node() -> StandIn:
    """Return a node that no test modifies: it has beams and a codebook."""
    node = StandIn(settings(codebook={"kind": "dft"}))
    node.tick(0.0)
    return node


@pytest.fixture
def serving() -> Callable[..., contextlib.AbstractAsyncContextManager[str]]:
    """Serve a node on this event loop over a real socket; yields HOST:PORT."""

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
