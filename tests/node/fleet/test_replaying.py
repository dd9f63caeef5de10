"""Recordings of several fleet nodes, replayed together."""

from pathlib import Path
from typing import Any

import pytest
from fleet_sky import FleetSky

from companion.mavlink.wire.framing import Splitter
from companion.node.fleet import replaying
from companion.pipeline.fold import Pipeline
from companion.recording.parts import Part
from companion.recording.reader import LogError, read_log
from companion.recording.writer import Writer
from companion.settings.model import Settings
from companion.values import Duty, Event, Frame, Tick

S = 1_000_000_000
START_NS = 1_800_000_000 * S


def events(shift_ns: int, duties: list[tuple[float, tuple[str, ...]]]) -> list[Event]:
    """Return six seconds of two vehicles on the node's own clock, with its duties."""
    sky = FleetSky(ports=[], uavs=2)
    found: list[Event] = []
    for step in range(60):
        now_ns = START_NS + shift_ns + step * S // 10
        for number in range(2):
            raw = sky.report(number, sky.begun_s + step / 10)
            frame = Splitter("udp").feed(now_ns, raw)[0]
            assert isinstance(frame, Frame)
            doubt_ns = 700_000 if number and shift_ns else 0
            found.append(frame._replace(doubt_ns=doubt_ns))
        found.append(Tick(now_ns + 1))
    found += [Duty(START_NS + round(at_s * S), uavs) for at_s, uavs in duties]
    return sorted(found, key=lambda event: event.t_ns)


def fleet_settings(node: str | None) -> Settings:
    return Settings().override(center={"source": "47.3977,8.5456,480"}, fleet={"node": node})


def record(path: Path, node: str | None, made: list[Event]) -> Path:
    """Write a node's recording, with its digest."""
    settings = fleet_settings(node)
    pipeline = Pipeline(settings)
    with Writer(
        where=path,
        settings_toml=settings.to_toml(),
        versions={},
        weights_hz=None,
        started_ns=START_NS,
    ) as writer:
        for event in made:
            pipeline.step(event)
            writer.event(event)
        writer.close({"digest": pipeline.digest.hexdigest()})
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("fleet")
    a = events(0, [(0.5, ("1:1", "2:1")), (3.05, ("1:1",))])
    b = events(5_000, [(0.5, ()), (3.0, ("2:1",)), (5.0, ("1:1", "2:1"))])
    return [record(folder / "a.mcap", "a", a), record(folder / "b.mcap", "b", b)]


def test_fleet_replay_matches_digests_and_lists_serving_nodes(recorded: list[Path]) -> None:
    found: dict[str, Any] = replaying.replay(recorded)
    assert [(node["node"], node["same"]) for node in found["nodes"]] == [("a", True), ("b", True)]
    assert found["uavs"] == 2
    assert found["handovers"] == 1  # 2:1 from a to b
    served = found["served"]
    assert served["none"] == 0
    assert served["once"] + served["twice"] == pytest.approx(1.0)
    assert 0.05 < served["twice"] < 0.2  # both nodes serve 1:1 in the last of 5.5 seconds


def test_duty_and_time_uncertainty_are_read_from_a_recording(recorded: list[Path]) -> None:
    read = list(read_log(recorded[1]))
    assert [event.serves for event in read if isinstance(event, Duty)] == [
        (), ("2:1",), ("1:1", "2:1"),
    ]  # fmt: skip
    doubts = {event.doubt_ns for event in read if isinstance(event, Frame)}
    assert doubts == {0, 700_000}


def test_recordings_that_are_not_one_fleet_are_rejected(
    recorded: list[Path], tmp_path: Path
) -> None:
    alone = record(tmp_path / "alone.mcap", None, events(0, []))
    with pytest.raises(LogError, match=r"no \[fleet\] node"):
        replaying.replay([recorded[0], alone])
    with pytest.raises(LogError, match="recordings of node a are not parts of one run"):
        replaying.replay([recorded[0], recorded[0]])


def test_parts_of_one_run_are_joined_in_any_order(recorded: list[Path], tmp_path: Path) -> None:
    made, settings = events(0, [(0.5, ("1:1", "2:1")), (3.05, ("1:1",))]), fleet_settings("a")
    pipeline, part = Pipeline(settings), Part.first()
    paths = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    for path, some in zip(paths, (made[:90], made[90:]), strict=True):
        with Writer(
            where=path,
            settings_toml=settings.to_toml(),
            versions={},
            weights_hz=None,
            started_ns=START_NS,
            part=part,
        ) as writer:
            for event in some:
                pipeline.step(event)
                writer.event(event)
            writer.close({"digest": pipeline.digest.hexdigest()})
        part = part.after(path.name)
    found = replaying.replay([paths[1], recorded[1], paths[0]])
    whole = replaying.replay(recorded)
    assert [node["same"] for node in found["nodes"]] == [True, True]
    assert found["nodes"][0]["logs"] == [str(path) for path in paths]
    assert found["served"] == whole["served"]


@pytest.mark.parametrize("text", ["fleet = 1", "fleet = [[[[" + "[" * 5000, "[fleet]\nnode = 3"])
def test_recorded_settings_without_fleet_are_rejected(
    text: str, recorded: list[Path], tmp_path: Path
) -> None:
    with Writer(
        where=tmp_path / "x.mcap",
        settings_toml=text,
        versions={},
        weights_hz=None,
        started_ns=START_NS,
    ) as writer:
        writer.close({})
    with pytest.raises(LogError, match=r"no \[fleet\] node"):
        replaying.replay([recorded[0], tmp_path / "x.mcap"])
