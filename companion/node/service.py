"""The live service: connects links, timer, recorder and HTTP with one pipeline.

Over 300 lines: it connects all parts of the running service.
"""

import asyncio
import socket
import time
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, Final

import companion
from companion.mavlink.links.daemon_threads import close_within, in_daemon_thread
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.voice.rate_watch import MessageRate
from companion.node.clock import NodeClock
from companion.node.drive import targets
from companion.node.drive.loop import Drive, SafeState
from companion.node.drive.running import run_in_thread
from companion.node.drive.sources import BeamRequest, LocalSource, stored_registers
from companion.node.fleet.live import LiveFleetNode
from companion.node.gateway import Gateway
from companion.node.observations import ObservationIntake
from companion.node.outlet import Outlet
from companion.node.push import Push
from companion.node.renewals import Renewals
from companion.node.serving import NOTICES_KEPT, RateMeter, Server, saved_at_end
from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.recording.background import STOP_MAX_S, BackgroundRecorder, Rotation
from companion.recording.folders import folder_of
from companion.recording.foxglove import LiveChannels
from companion.recording.parts import Part
from companion.recording.reader import LogError
from companion.recording.recover import holds_recording, recover_leftovers
from companion.recording.scene import Scene
from companion.recording.writer import Writer
from companion.server import area_map
from companion.settings.files import embedded
from companion.settings.model import Settings
from companion.settings.origins import Origins
from companion.values import (
    Blame,
    ClockSet,
    Estimate,
    Event,
    Frame,
    Notice,
    Observation,
    Output,
    Severity,
    Tick,
    Tock,
    UserError,
)
from companion.views.health import shown_verdicts
from companion.views.last_messages import LastMessages
from companion.views.lateness import Lateness
from companion.views.series import Series
from companion.views.served import FleetStatus
from companion.views.state import ObservationCounts, RecordingStatus, overload

THREAD_REST: Final = 0.5
"""Rest after an update, as a share of the processor time of its thread.

Meanwhile the event loop had the interpreter half of the time.
"""
HELD_UP_S: Final = 0.02  # lateness of a tick from which links are read before it
READ_FIRST_S: Final = 0.1  # longest time for that
READ_ROUNDS: Final = 3  # least number of iterations of the event loop for that
WAIT_NS: Final = 20_000_000  # wait for this machine that does not matter for beams


class Service:
    """Running node, with the interface of the HTTP server.

    ``answering`` is set once HTTP is served. ``clock`` is this machine's unless a test provides
    another one. ``say`` gets one line for the operator per notice. Raises ``LinkError`` if a link
    cannot be opened, ``ConfigError`` for unusable settings, ``OSError`` if the recording cannot be
    opened, ``UserError`` if the live channels cannot be served.
    """

    def __init__(
        self,
        *,
        settings: Settings,
        say: Callable[[str], None],
        origins: Origins | None = None,
        clock: NodeClock | None = None,
    ) -> None:
        settings = embedded(settings)
        self.pipeline = Pipeline(settings)
        self.origins = origins or {}
        self.equipment = assembly.equipment(settings, self.pipeline.array)
        self.notices: deque[Notice] = deque(maxlen=NOTICES_KEPT)
        self.answering = asyncio.Event()
        self.last_messages = LastMessages()
        self.lateness = Lateness()
        self.series = Series()
        self._area = area_map.find(settings.page.map)
        self._ticked = asyncio.Event()
        self._is_behind = False
        self._aimer = ThreadPoolExecutor(1, "beams")
        self._settings = settings
        self._say = say
        self._timeline = clock or NodeClock()
        self._started_ns = self._timeline.now_ns()
        self._rates = RateMeter()
        self._defects: asyncio.Queue[Exception] = asyncio.Queue()
        self._recorder: BackgroundRecorder | None = None
        self._live = self._open_live()
        self._traffic = Gateway(
            settings=settings,
            step=self._process_own_event,
            notify=self.notify,
            now_ns=self._timeline.now_ns,
        )
        self.arrival_lag = self._traffic.lag
        self._outlet = Outlet(
            settings=settings,
            pipeline=self.pipeline,
            notify=self.notify,
            now_ns=self._timeline.now_ns,
        )
        now_ns = self._timeline.now_ns
        target = settings.drive.target
        stored = partial(stored_registers, self.pipeline.array, self.equipment)
        self._device = None if target is None else targets.device(target, self._say, stored)
        self.fleet = self._fleet_node(settings)
        self._push = Push(
            settings=settings.records,
            pipeline=self.pipeline,
            equipment=self.equipment,
            notify=self.notify,
            now_ns=now_ns,
        )
        self._renewals: Renewals | None = None
        if settings.beams.update == "report" and self._push.takes_renewed:
            self._renewals = Renewals(
                pipeline=self.pipeline,
                push=self._push,
                period_s=1 / settings.beams.update_hz,
                now_ns=now_ns,
            )
        self._intake = ObservationIntake(
            settings=settings.observations,
            step=self._step,
            notify=self.notify,
            now_ns=now_ns,
            utc_offset_ns=lambda: self.pipeline.utc_offset_ns,
        )
        self._traffic.open()
        self._intake.open()
        self._outlet.open()
        if self.fleet is not None:
            self.fleet.open()
        self._push.open()
        try:
            self._recorder = self._open_recorder()  # last: no recording if the start fails
        except (OSError, UserError):
            self._push.close()  # its ring would have no writer
            raise

    async def run(
        self,
        http: socket.socket,
        token: str | None,
        until: asyncio.Event,
        *others: Callable[[], Coroutine[Any, Any, None]],
    ) -> None:
        """Serve until ``until`` is set, then finish the recording.

        ``others`` return coroutines that run alongside, as for the demo; they are cancelled at
        the end.
        """
        server = Server(node=self, token=token, answering=self.answering, area=self._area)
        if self._recorder:
            self._recorder.start()
        if self._live:
            self._live.start()
        try:
            async with asyncio.TaskGroup() as group:
                tasks = [group.create_task(self._tick(), name="ticks")]
                tasks.append(group.create_task(self._traffic.run(), name="links"))
                tasks.append(group.create_task(self._intake.run(), name="observations"))
                tasks.append(group.create_task(self._outlet.run(), name="out"))
                tasks.append(group.create_task(self._push.run(), name="records"))
                if self._renewals is not None:
                    tasks.append(group.create_task(self._renewals.run(), name="renewals"))
                driving = group.create_task(self._run_drive(), name="drive")
                if self.fleet is not None:
                    tasks.append(group.create_task(self.fleet.run(), name="fleet"))
                tasks.append(group.create_task(self._recover_leftovers(), name="recovery"))
                tasks.append(group.create_task(self._end_on_defect(), name="defects"))
                tasks += [group.create_task(other(), name="beside") for other in others]
                serving = group.create_task(server.serve(sockets=[http]), name="http")
                await until.wait()
                server.should_exit = True
                driving.cancel()  # a device may take as long to its safe state as HTTP to its end
                if self._live:
                    group.create_task(close_within(self._live.stop))
                await serving
                for task in tasks:
                    task.cancel()
        finally:
            try:
                self._push.close()
                if not await saved_at_end(
                    self._traffic.close, "the signing timestamps", self._say, most_s=STOP_MAX_S
                ):
                    text = "the signing timestamps are not saved: the disk does not answer"
                    self._report(Severity.ERROR, "signing", text)
                self._aimer.shutdown()
            finally:  # a failure to save timestamps must not lose the recording
                await self._finish()

    async def _finish(self) -> None:
        if self._recorder:
            stop = partial(self._recorder.stop, self.pipeline.digest.both())
            await saved_at_end(stop, "the recording", self._say, most_s=None)
            self._notify_recorder_state(self._recorder)

    def _fleet_node(self, settings: Settings) -> LiveFleetNode | None:
        if settings.fleet.node is None:
            return None
        now_ns = self._timeline.now_ns
        return LiveFleetNode(
            settings=settings.fleet,
            pipeline=self.pipeline,
            step=self._step,
            notify=self.notify,
            now_ns=now_ns,
        )

    # --- input of the pipeline --------------------------------------------------------------

    def _process_own_event(self, event: Event) -> None:
        """Process an event of this node's own links."""
        if self.fleet is not None:
            self.fleet.on_event(event)  # first: other nodes wait for it
        self._step(event)

    def _step(self, event: Event) -> None:
        if isinstance(event, Frame):
            self.last_messages.add(event)
        try:
            outputs = self.pipeline.step(event)
        except Exception as error:
            self._defects.put_nowait(error)
            raise
        self._hand_over(event, outputs)
        for output in outputs:
            if isinstance(output, Notice):
                self._show(output)
            elif isinstance(output, Estimate) and self._renewals is not None:
                self._renewals.reported(output.fix.uav)

    def _follow_wall_clock(self) -> None:
        offset_ns = self._timeline.set_to_ns()
        if offset_ns is not None:
            self._step(ClockSet(self._timeline.now_ns(), offset_ns))

    async def _run_drive(self) -> None:
        """Drive the device of ``[drive]``; a user's error ends the drive, not the service."""
        if self._device is None:
            return
        loop, kept = asyncio.get_running_loop(), self._settings
        uavs = kept.drive.uavs or kept.beams.priority

        def say(text: str, severity: Severity) -> None:
            loop.call_soon_threadsafe(self._report, severity, "drive", text)

        try:
            centre = kept.drive.aim == "centre"
            wanted = BeamRequest(
                uavs=uavs, any_uav=not kept.drive.uavs, takes=self._device.takes, centre=centre
            )
            source = LocalSource(
                loop=loop,
                pipeline=self.pipeline,
                equipment=self.equipment,
                now_ns=self.now_ns,
                wanted=wanted,
            )
            safe = SafeState(kept.drive.on_stale)
            drive = Drive(
                source=source,
                device=self._device,
                update_hz=kept.beams.update_hz,
                safe=safe,
                now_ns=self.now_ns,
                say=say,
            )
            await run_in_thread(drive)
        except UserError as error:
            self._report(Severity.ERROR, "drive", f"driving of the device has ended: {error}")

    async def _end_on_defect(self) -> None:
        """Raise a defect of the pipeline, which ends the service.

        A link's callback would only log it, and beams must not be computed from an inconsistent
        state.
        """
        raise await self._defects.get()

    def _hand_over(self, event: Event | None, outputs: Sequence[Output]) -> None:
        if self._recorder:
            self._recorder.put(event, outputs)
        if self._live:
            self._live.put(event, outputs)

    def notify(self, notice: Notice) -> None:
        """Record and publish a notice to the operator."""
        self._hand_over(None, [notice])
        self._show(notice)

    def _report(self, severity: Severity, subject: str, text: str) -> None:
        self.notify(Notice(t_ns=self.now_ns(), severity=severity, subject=subject, text=text))

    def _notify_recorder_state(self, recorder: BackgroundRecorder) -> None:
        for severity, text in recorder.news():
            self._report(severity, "recording", text)

    def _notify_overload(self, machine: Blame | None) -> None:
        """Publish a notice when this machine becomes overloaded, and when it recovers."""
        if (machine is not None) is self._is_behind:
            return
        self._is_behind = machine is not None
        if machine is None:
            text, severity = "this machine is no longer overloaded", Severity.INFO
        else:
            text, severity = f"{machine.reason}; {machine.remedy}", Severity.WARNING
        self._report(severity, "machine", text)

    def _show(self, notice: Notice) -> None:
        self.notices.append(notice)
        self._say(notice.text)

    async def _tick(self) -> None:
        """Tick at the update rate; ticks missed while the loop was blocked are skipped.

        Beams are computed on a separate thread, so that events and requests are processed
        meanwhile. Each update is followed by a rest: with too many UAVs for the rate there are
        fewer updates, and no frame is lost.
        """
        loop = asyncio.get_running_loop()
        period_s = 1 / self._settings.beams.update_hz
        due_s = loop.time()
        while True:
            self._follow_wall_clock()
            rest_s = await self._update()
            began_s = loop.time()
            if self.fleet is not None:
                self.fleet.ticked(self.now_ns())
            if self.pipeline.last_update:
                self._push.newest(self.pipeline.last_update, self.pipeline.updates - 1)
            self._rates.count(self.now_ns(), self.pipeline.frames, self.pipeline.updates)
            if self._recorder:
                self._notify_recorder_state(self._recorder)
            machine = overload(self, self.now_ns())
            if self._traffic.has_component:
                verdicts = shown_verdicts(self.pipeline.health, machine)
                self._traffic.speak(not self.unfit(), self.pipeline.reporters(), verdicts)
            self._notify_overload(machine)
            self.series.add(self.pipeline, machine)
            self._ticked.set()  # wakes all current waiters;
            self._ticked.clear()  # later ones wait for the next tick
            ended_s = loop.time()
            rested_s = ended_s + rest_s + (ended_s - began_s)
            due_s = max(due_s + period_s, rested_s)
            if self._renewals is not None:
                await asyncio.sleep(rested_s - loop.time())
                await self._renewals.wait_until(due_s)
                due_s = min(due_s, loop.time())
            await asyncio.sleep(due_s - loop.time())
            late_s = loop.time() - due_s
            self.lateness.observe(late_s)
            if late_s > HELD_UP_S:
                self.arrival_lag.held_up(self.now_ns(), round(late_s * 1e9))
                await self._read_first()

    async def _read_first(self) -> None:
        """Let the links read what arrived while the event loop was held up.

        Beams are then aimed by reports that would otherwise wait until after the update.
        """
        loop = asyncio.get_running_loop()
        until_s = loop.time() + READ_FIRST_S
        for _ in range(READ_ROUNDS):  # in the first one, the loop only finds what is readable
            await asyncio.sleep(0)
        while self.arrival_lag.waiting_ns(self.now_ns()) > WAIT_NS and loop.time() < until_s:
            await asyncio.sleep(0)

    async def _update(self) -> float:
        """Predict the UAVs, and compute the beams on a thread; the first beams directly.

        The first request must already find an update. Returns how long updates must rest: as long
        as the event loop was held up, and ``THREAD_REST`` of the time of the thread.
        """
        loop, now_ns = asyncio.get_running_loop(), self._timeline.now_ns
        began_s = time.perf_counter()  # the loop's own time has steps of a millisecond
        waited_ns = self.arrival_lag.waiting_ns(now_ns())
        if self._renewals is not None:
            self._renewals.update_begins()
        self._step(
            Tick(
                now_ns(),
                in_two=self.pipeline.updates > 0,
                waited_ns=waited_ns if waited_ns > WAIT_NS else 0,
            )
        )
        held_s, thread_s = time.perf_counter() - began_s, 0.0
        if self.pipeline.aiming is not None:
            thread_s = await loop.run_in_executor(self._aimer, _took_s, self.pipeline.aiming.made)
            began_s = time.perf_counter()
            self._step(Tock(now_ns()))
            held_s += time.perf_counter() - began_s
        if self._renewals is not None:
            self._renewals.update_is_made(held_s + thread_s)
        return held_s + THREAD_REST * thread_s

    # --- interface of the server ------------------------------------------------------------

    def now_ns(self) -> int:
        """Return the present time on the node's timeline."""
        return self._timeline.now_ns()

    async def ticked(self) -> None:
        """Return after the next tick."""
        await self._ticked.wait()

    def uptime_s(self) -> float:
        """Return seconds since the service was created."""
        return (self.now_ns() - self._started_ns) * 1e-9

    def links(self) -> list[LinkStatus]:
        """Return the counts of each link."""
        return [link.status for link in self._traffic.links]

    def out_links(self) -> list[LinkStatus]:
        """Return the counts of each link of ``[out]``."""
        return self._outlet.links()

    def events(self) -> list[Notice]:
        """Return the newest notices, oldest first."""
        return list(self.notices)

    def message_rates(self) -> list[MessageRate]:
        """Return the requested message rates and their state."""
        return self._traffic.rates()

    def observations(self) -> ObservationCounts:
        """Return the counts of observations since the start."""
        return self._intake.counts

    def may_observe(self) -> bool:
        """Spend the budget of one observation; False if none is left."""
        return self._intake.has_room()

    def observe(self, found: Observation | str) -> None:
        """Process an observation, or count one that is invalid for the given reason."""
        self._intake.take(found)

    def rates(self) -> dict[str, float | None]:
        """Return frames and updates per second over the last seconds."""
        return self._rates.newest()

    def recording(self) -> RecordingStatus:
        """Return the state of the recording."""
        recorder = self._recorder
        if recorder is None:
            return RecordingStatus(state="off", file=None, bytes=0, messages=0, dropped=0)
        written_ns = recorder.written_ns
        return RecordingStatus(
            state="degraded" if recorder.degraded else "recording",
            file=recorder.file,
            bytes=recorder.bytes,
            messages=recorder.messages,
            dropped=recorder.dropped,
            queued=recorder.queued,
            lag_s=None if written_ns is None else (self.now_ns() - written_ns) * 1e-9,
        )

    def unfit(self) -> list[str]:
        """Return why the service is not ready; empty if it is."""
        update = self.pipeline.last_update
        states = [link.status.state for link in self._traffic.links]
        reasons = [] if "up" in states else ["no link is up"]
        machine = overload(self, self.now_ns())
        if machine is not None:  # late updates and old data are only symptoms of it
            return [*reasons, machine.reason]
        if update is None or self.updates_late():
            reasons.append("beam updates are late")
        elif update.unfit:
            reasons.append(update.unfit)
        return reasons

    def updates_late(self) -> bool:
        """Return whether the newest beam update is older than normal operation allows."""
        update = self.pipeline.last_update
        late_s = 1.0 + 5 / self._settings.beams.update_hz
        return update is None or (self.now_ns() - update.t_ns) * 1e-9 > late_s

    def replay(self) -> None:
        """Return None: this is a live run."""

    def fleet_status(self) -> FleetStatus | None:
        """Return this node's state in its fleet; None without a fleet."""
        return None if self.fleet is None else self.fleet.status()

    async def _recover_leftovers(self) -> None:
        directory = self._settings.recording.directory
        if directory is None:
            return
        for found in await in_daemon_thread(partial(recover_leftovers, folder_of(Path(directory)))):
            if isinstance(found, LogError):
                self._say(str(found))
            else:
                self._say(f"recovered {found.path} ({found.lost_bytes} bytes lost)")

    def _open_recorder(self) -> BackgroundRecorder | None:
        kept = self._settings.recording
        if kept.directory is None:
            return None
        size_bytes = None if kept.rotate_mb is None else kept.rotate_mb * 1e6
        rotation = Rotation(size_bytes, kept.rotate_s)
        return BackgroundRecorder(
            open_part=self._open_part,
            folder=folder_of(Path(kept.directory)),
            geodetic=self.pipeline.geodetic,
            rotation=rotation,
        )

    def _open_live(self) -> LiveChannels | None:
        """Open the live channels on this machine only, since their protocol has no token.

        None if not requested.
        """
        port = self._settings.server.foxglove
        if port is None:
            return None
        live = LiveChannels(
            host="127.0.0.1", port=port, geodetic=self.pipeline.geodetic, scene=self._scene()
        )
        self._say(f"live channels for Foxglove and Lichtblick on ws://127.0.0.1:{live.port}")
        return live

    def _scene(self) -> Scene:
        return Scene(self.pipeline.array, self._settings.recording.scene_hz)

    def _open_part(self, part: Part) -> Writer:
        kept = self._settings.recording
        where = Path(kept.directory or "")
        if part.number > 1 or holds_recording(where):
            where = folder_of(where)  # also if a file was requested
        return Writer(
            where=where,
            settings_toml=self._settings.to_toml(),
            files=self._settings.files,
            versions={"companion": companion.__version__},
            weights_hz=None if kept.weights_hz == "all" else kept.weights_hz,
            started_ns=self.pipeline.utc_ns(
                self._started_ns if part.number == 1 else self.now_ns()
            ),
            scene=self._scene(),
            part=part,
        )


def _took_s(work: Callable[[], object]) -> float:
    """Call a function on this thread; return the processor time that it used, seconds."""
    began_s = time.thread_time()
    work()
    return time.thread_time() - began_s


def require_center(settings: Settings) -> None:
    """Raise ``UserError`` unless the settings name the carrier of the array."""
    if settings.center.source is None:
        raise UserError(
            "center.source is not set; give --center SYSID:COMPID, LAT,LON,ALT[,HEADING] or home"
        )
