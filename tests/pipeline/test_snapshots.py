"""Snapshots of UAVs: the same answers as at once, whatever is received afterwards."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from companion import Pipeline, Settings, read_log
from companion.values import Tick, Track

S = 1_000_000_000


def same(one: Track, other: Track) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in Track.__slots__)


def flown(log: Path, *, until_s: float) -> tuple[Pipeline, list[Any]]:
    """Return the state of a pipeline after some seconds, and the events that follow."""
    pipeline = Pipeline(Settings().override(center={"source": "5:1"}))
    events = list(read_log(log))
    first = next(
        number for number, event in enumerate(events) if event.t_ns > events[0].t_ns + until_s * S
    )
    for event in events[:first]:
        pipeline.step(event)
    return pipeline, events[first:]


def test_snapshot_does_not_change(cut_log: Path) -> None:
    pipeline, rest = flown(cut_log, until_s=4.0)
    now_ns = rest[0].t_ns
    uavs = pipeline.tracker.uavs
    snapshots = pipeline.snapshots(uavs)
    clocks = [one.timeline.clock for one in snapshots]
    before = [one.at(now_ns, now_ns + S // 10) for one in snapshots]
    estimates = [None if clock is None else clock.estimate() for clock in clocks]
    assert estimates == [pipeline.clock_estimate(uav) for uav in uavs]
    for event in rest[:2000]:
        pipeline.step(event)
    after = [one.at(now_ns, now_ns + S // 10) for one in snapshots]
    assert all(map(same, before, after))
    assert estimates == [None if clock is None else clock.estimate() for clock in clocks]
    moved = [one.at(now_ns, now_ns + S // 10) for one in pipeline.snapshots(uavs)]
    assert not all(map(same, before, moved))


def test_snapshot_is_that_of_the_newest_report(cut_log: Path) -> None:
    pipeline, rest = flown(cut_log, until_s=2.0)
    reports = dict[str, int]()
    for event in rest[:1000]:
        pipeline.step(event)
        for snapshot in pipeline.snapshots(pipeline.tracker.uavs):
            track = snapshot.track
            assert track.fix is pipeline.tracker.newest(track.fix.uav)
            assert track.reports >= reports.get(track.fix.uav, 0)
            reports[track.fix.uav] = track.reports
    assert max(reports.values()) > 10


def test_beams_do_not_depend_on_what_arrives_until_they_are_computed(cut_log: Path) -> None:
    pipeline, rest = flown(cut_log, until_s=4.0)
    now_ns = rest[0].t_ns
    make: Callable[[], Any] = pipeline.prepare_update(now_ns)
    before = make()
    for event in rest[:500]:
        if not isinstance(event, Tick):
            pipeline.step(event)
    after = make()
    assert all(map(same, before.tracks, after.tracks))
    assert np.array_equal(before.beams.weights, after.beams.weights)
