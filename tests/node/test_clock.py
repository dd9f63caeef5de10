"""The node's clock: a timeline without steps, and UTC times that follow the wall clock."""

import asyncio
import csv
from pathlib import Path

import pytest
from support import run_async

from companion import __version__
from companion.node.clock import WALL_MAX_NS, NodeClock
from companion.node.export import export
from companion.node.moment import look
from companion.node.served_replay import ReplayRequest, ServedReplay
from companion.node.service import Service
from companion.pipeline.fold import Pipeline
from companion.pipeline.ticks import with_ticks
from companion.recording.reader import read_log
from companion.settings.model import Settings
from companion.values import ClockSet, Frame, Tick
from companion.views import state, uav_state

S = 1_000_000_000


class Machine:
    """A wall clock that can be set, and a boot time that cannot."""

    def __init__(self) -> None:
        self.set_ns = 0
        self.ns = 0

    def wall_ns(self) -> int:
        return 1_000 * S + self.ns + self.set_ns

    def since_boot_ns(self) -> int:
        return 5 * S + self.ns

    def clock(self) -> NodeClock:
        return NodeClock(self.wall_ns, self.since_boot_ns)


def test_timeline_continues_across_a_clock_set_with_one_notice() -> None:
    machine = Machine()
    clock = machine.clock()
    told = []
    for second in range(100):
        machine.ns = second * S
        machine.set_ns = 0 if second < 10 else 1_700_000_000 * S if second < 50 else -3600 * S
        assert clock.now_ns() == 1_000 * S + second * S  # a Pi without a battery begins in 1970
        told.append(clock.set_to_ns())
    assert [(at, offset) for at, offset in enumerate(told) if offset is not None] == [
        (10, 1_700_000_000 * S), (50, -3600 * S),
    ]  # fmt: skip


@pytest.mark.parametrize("at_start", [False, True])
def test_wall_clock_of_another_century_is_not_followed(at_start: bool) -> None:
    """A recording of such times could not be read back. Once the clock is right, it is followed."""
    machine = Machine()
    if at_start:
        machine.set_ns = 2 * WALL_MAX_NS
    clock = machine.clock()
    began_ns = clock.now_ns()
    assert began_ns == (WALL_MAX_NS if at_start else 1_000 * S)
    for second in range(1, 10):
        machine.ns, machine.set_ns = second * S, 2 * WALL_MAX_NS
        assert clock.now_ns() == began_ns + second * S
        assert clock.set_to_ns() is None
    machine.set_ns = 1_800_000_000 * S
    assert clock.set_to_ns() == machine.wall_ns() - clock.now_ns()


def test_suspended_machine_does_not_count_as_clock_set() -> None:
    """Both clocks count the suspended time, so everything received before is older by it."""
    machine = Machine()
    clock = machine.clock()
    before_ns = clock.now_ns()
    machine.ns += 3600 * S
    assert clock.now_ns() - before_ns == 3600 * S
    assert clock.set_to_ns() is None


def test_pause_between_clock_readings_is_not_a_step() -> None:
    machine = Machine()

    def slowly_ns() -> int:
        machine.ns += S
        return machine.since_boot_ns()

    clock = NodeClock(machine.wall_ns, slowly_ns)
    assert [clock.set_to_ns() for _ in range(5)] == [None] * 5


SETTINGS = Settings().override(center={"source": "5:1"}, links={"urls": ["udpin:127.0.0.1:0"]})
NTP_NS = 1_700_000_000 * S
FRAMES = 350
"""Frames of a log: the first second of four UAVs and the carrier."""


def flown(log: Path, machine: Machine, recordings: Path, said: list[str]) -> Service:
    """Return a service that replayed a log while its clock was set halfway."""
    settings = SETTINGS.override(recording={"directory": str(recordings)})
    node = Service(settings=settings, say=said.append, clock=machine.clock())
    assert node._recorder is not None
    node._recorder.start()
    events = [event for event in read_log(log) if isinstance(event, Frame)][:FRAMES]
    begins_ns = events[0].t_ns - node.now_ns()
    due_ns = node.now_ns()
    for number, frame in enumerate(events):
        machine.ns += max(0, frame.t_ns - begins_ns - node.now_ns())
        if number == len(events) // 2:
            machine.set_ns = NTP_NS
        node._step(frame._replace(t_ns=node.now_ns()))
        if node.now_ns() >= due_ns:
            node._follow_wall_clock()
            node._step(Tick(node.now_ns()))
            due_ns += S // 10
    node._traffic.close()
    for link in node._traffic.links:
        link._endpoint._socket.close()  # type: ignore[attr-defined]
    run_async(node._finish())
    return node


def test_utc_times_follow_a_clock_set_live_and_in_replay(short_log: Path, tmp_path: Path) -> None:
    machine, said = Machine(), list[str]()
    node = flown(short_log, machine, tmp_path / "recordings", said)
    told = [text for text in said if "clock" in text]
    assert told == [
        "this machine's clock was set forward by 1700000000.000 s; UTC times now follow it"
    ]
    shown = state.status(node, __version__)
    assert shown["time"].startswith("2023-11-14T22:")  # 1 700 000 000 s, and some of the first
    uavs = uav_state.uavs(node)["uavs"]
    assert uavs
    assert {one["valid_at"][:14] for one in uavs} == {"2023-11-14T22:"}
    assert {one["fix"]["at"][:14] for one in uavs} == {"2023-11-14T22:"}  # also for earlier times
    assert min(one["age_s"] for one in uavs) < 1  # the timeline has not moved

    (log,) = (tmp_path / "recordings").iterdir()
    assert sum(isinstance(event, ClockSet) for event in read_log(log)) == 1
    again = ServedReplay(
        ReplayRequest(logs=[log], settings=SETTINGS, speed=None, record=None), said.append
    )
    run_async(again._replay(asyncio.Event()))
    assert again.pipeline.digest.hexdigest() == node.pipeline.digest.hexdigest()
    assert uav_state.uavs(again)["uavs"][0]["fix"] == uavs[0]["fix"]
    assert said.count(told[0]) == 2

    tables = tmp_path / "tables"
    export([log], SETTINGS, tables, form="csv", progress=lambda *_: None)
    with (tables / "updates.csv").open() as file:
        assert {row["t_utc"][:14] for row in csv.DictReader(file)} == {"2023-11-14T22:"}
    pipeline, update = look([log], SETTINGS, shown["time"])
    apart_ns = pipeline.utc_ns(update.t_ns) - node.pipeline.utc_ns(node.now_ns())
    assert abs(apart_ns) < 2_000_000  # displayed times have milliseconds


def test_clock_set_does_not_change_estimates(short_log: Path) -> None:
    """The pipeline's timeline continues as with an untouched clock."""
    events = list(with_ticks(read_log(short_log), 10.0))[:FRAMES]
    middle = len(events) // 2
    alone, followed = Pipeline(SETTINGS), Pipeline(SETTINGS)
    for number, event in enumerate(events):
        if number == middle:
            followed.step(ClockSet(event.t_ns, NTP_NS))
        alone.step(event)
        followed.step(event)
    assert followed.digest.hexdigest() == alone.digest.hexdigest()
    assert (alone.utc_ns(0), followed.utc_ns(0)) == (0, NTP_NS)
