"""Split ticks: beams are those of the tick, at any later time and on any thread."""

import threading
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from support import ROOT

from companion.node.replay import log_events
from companion.pipeline.digest import Digest
from companion.pipeline.fold import Pipeline
from companion.recording import schemas
from companion.recording.reader import read_log
from companion.recording.writer import Writer
from companion.settings.model import Settings
from companion.values import Event, Frame, Output, Tick, Tock, Update

SETTINGS = Settings().override(center={"source": "5:1"})
LATER = 7
"""Events that arrive while beams are computed."""


@pytest.fixture(scope="module")
def flown() -> list[Event]:
    """Return eight seconds of a flight."""
    events = []
    for event in log_events([ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"], SETTINGS):
        if events and event.t_ns > events[0].t_ns + 8_000_000_000:
            break
        events.append(event)
    return events


def in_two(events: Iterable[Event], later: int = LATER) -> Iterator[Event]:
    """Run the same flight with the beams of every tick finished so many events later."""
    due = -1
    for event in events:
        if isinstance(event, Tick):
            if due >= 0:
                yield Tock(event.t_ns)
            due = later
            yield replace(event, in_two=True)
        else:
            yield event
            due -= 1
        if due == 0:
            yield Tock(event.t_ns)
            due = -1


def same(one: Update, other: Update) -> bool:
    return one.beams.beams == other.beams.beams and digest(one) == digest(other)


def digest(update: Update) -> str:
    made = Digest()
    made.add(update)
    return made.hexdigest()


def updates(outputs: list[Output]) -> list[Update]:
    return [one for one in outputs if isinstance(one, Update)]


def test_beams_are_those_of_the_tick_despite_later_reports(flown: list[Event]) -> None:
    pipeline, expected = Pipeline(SETTINGS), list[Update]()
    differ = 0
    for event in in_two(flown):
        if isinstance(event, Tick):
            expected.append(pipeline.look(event.t_ns))
        outputs = updates(pipeline.step(event))
        assert len(outputs) == isinstance(event, Tock)
        for update in outputs:
            assert same(update, expected[-1])
            assert update is pipeline.last_update
            differ += not same(update, pipeline.look(update.t_ns))
    assert len(expected) - 1 <= pipeline.updates <= len(expected)
    assert pipeline.updates > 70
    assert differ > 30  # otherwise no relevant event came in between


def test_tick_and_tock_without_events_between_equal_one_tick(flown: list[Event]) -> None:
    whole, halves = Pipeline(SETTINGS), Pipeline(SETTINGS)
    for event in flown:
        said = whole.step(event)
        if isinstance(event, Tick):
            split = halves.step(Tick(event.t_ns, in_two=True)) + halves.step(Tock(event.t_ns))
            assert len(split) == len(said)
        else:
            halves.step(event)
    assert whole.digest.hexdigest() == halves.digest.hexdigest()


def test_beams_are_the_same_from_any_thread(flown: list[Event]) -> None:
    alone, helped, on = Pipeline(SETTINGS), Pipeline(SETTINGS), set[str]()
    for event in in_two(flown):
        alone.step(event)
        helped.step(event)
        if isinstance(event, Tick) and helped.aiming is not None:
            made = helped.aiming.made

            def make(made: object = made) -> None:
                assert callable(made)
                on.add(threading.current_thread().name)
                made()

            thread = threading.Thread(target=make, name="beams")
            thread.start()
            thread.join()
    assert on == {"beams"}
    assert alone.digest.hexdigest() == helped.digest.hexdigest()


def test_beams_are_recomputed_if_the_local_frame_changed(flown: list[Event]) -> None:
    """The tick's coordinates belong to no frame or to another one."""
    pipeline = Pipeline(SETTINGS)
    pipeline.step(Tick(flown[0].t_ns, in_two=True))
    for event in flown:
        if isinstance(event, Frame):
            pipeline.step(event)
    now_ns = flown[-1].t_ns
    expected = pipeline.look(now_ns)
    (update,) = updates(pipeline.step(Tock(now_ns)))
    assert same(update, expected)
    assert len(update.beams.beams) == 4


def test_tock_without_tick_is_ignored_and_last_tick_counts(flown: list[Event]) -> None:
    pipeline = Pipeline(SETTINGS)
    for event in flown:
        pipeline.step(event)
    now_ns, before = flown[-1].t_ns, pipeline.updates
    assert pipeline.step(Tock(now_ns)) == []
    pipeline.step(Tick(now_ns, in_two=True))
    pipeline.step(Tick(now_ns + 1000, in_two=True))
    (update,) = updates(pipeline.step(Tock(now_ns + 2000)))
    assert update.t_ns == now_ns + 1000
    assert pipeline.step(Tock(now_ns + 3000)) == []
    assert pipeline.updates == before + 1


def test_recording_replays_to_the_same_digest(tmp_path: Path, flown: list[Event]) -> None:
    events = list(in_two(flown))
    pipeline = Pipeline(SETTINGS)
    writer = Writer(
        where=tmp_path,
        settings_toml=SETTINGS.to_toml(),
        versions={},
        weights_hz=None,
        started_ns=events[0].t_ns,
    )
    for event in events:
        writer.event(event)
        for output in pipeline.step(event):
            writer.output(output, pipeline.geodetic)
    writer.close({})
    assert list(read_log(writer.path)) == events
    again = Pipeline(SETTINGS)
    for event in read_log(writer.path):
        again.step(event)
    assert again.digest.hexdigest() == pipeline.digest.hexdigest()


def test_older_reader_without_tocks_reads_ticks() -> None:
    """It meets one additional field, and a topic that it does not subscribe to."""
    data = schemas.encode("Tick", Tick(5, in_two=True))
    assert data.startswith(schemas.encode("Tick", Tick(5)))
    assert schemas.message_class("Tick").FromString(data).t_ns == 5
