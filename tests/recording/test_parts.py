"""Parts of one run are ordered and missing parts reported; parts of different runs do not mix."""

import json
import subprocess
from itertools import permutations
from pathlib import Path

import pytest
from support import BIN, HANG_S

from companion.node.replay import log_events, replay, settings_for
from companion.node.replay import missing as missing_of
from companion.pipeline.fold import Pipeline
from companion.pipeline.ticks import with_ticks
from companion.recording.parts import UNFOLLOWED, Hole, Part, in_order, missing, read_recording_info
from companion.recording.reader import LogError, read_log
from companion.recording.recover import recover
from companion.recording.writer import Writer
from companion.settings.files import load
from companion.settings.model import Settings
from companion.values import Event, Tick

START_NS = 1_700_000_000_000_000_000


def write(
    path: Path,
    part: Part | None,
    events: list[Event],
    hole: Hole | None = None,
    *,
    is_continued: bool = False,
) -> Path:
    writer = Writer(
        where=path,
        settings_toml=Settings().to_toml(),
        versions={},
        weights_hz=None,
        started_ns=START_NS,
        part=part,
    )
    if hole is not None:
        writer.hole(hole)
    for event in events:
        writer.event(event)
    return writer.close({}, is_continued=is_continued)


@pytest.fixture
def run_of_three_parts(tmp_path: Path, short_log: Path) -> tuple[list[Path], list[Event], str]:
    """A flight in three parts whose names are not in order, with its events and digest."""
    settings = Settings()
    pipeline = Pipeline(settings)
    events = list(with_ticks(read_log(short_log), settings.beams.update_hz))
    for event in events:
        pipeline.step(event)
    part, logs = Part.first(), []
    third = len(events) // 3
    for name, piece in (("c", events[:third]), ("a", events[third : 2 * third]), ("b", [])):
        rest = piece or events[2 * third :]
        path = tmp_path / f"{name}.mcap"
        logs.append(write(path, part, rest, is_continued=name != "b"))
        part = part.after(f"{name}.mcap")
    return logs, events, pipeline.digest.hexdigest()


def test_shuffled_parts_replay_to_the_digest_of_the_run(
    run_of_three_parts: tuple[list[Path], list[Event], str],
) -> None:
    logs, events, digest = run_of_three_parts
    for shuffled in permutations(logs):
        assert list(log_events(shuffled, Settings())) == events
    summary = replay([logs[2], logs[0], logs[1]], Settings())
    assert summary["digest"] == digest
    assert summary["missing"] == []
    assert replay(logs[1:], Settings())["digest"] != digest


def test_part_that_was_cut_as_it_began_is_left_out(
    run_of_three_parts: tuple[list[Path], list[Event], str], tmp_path: Path
) -> None:
    """It has no event and no position in the run."""
    logs, events, digest = run_of_three_parts
    cut = write(tmp_path / "e.mcap", None, [])
    assert list(log_events([*logs, cut], Settings())) == events
    assert replay([cut, *logs], Settings())["digest"] == digest
    with pytest.raises(LogError, match="no MAVLink frame in it"):
        list(log_events([cut], Settings()))


def test_recovered_part_keeps_its_position_in_the_run(
    run_of_three_parts: tuple[list[Path], list[Event], str], tmp_path: Path
) -> None:
    logs, events, _ = run_of_three_parts
    cut = tmp_path / "d.mcap.active"
    cut.write_bytes(logs[1].read_bytes()[:-400])
    assert read_recording_info(recover(cut).path).part == read_recording_info(logs[1]).part
    assert list(log_events([logs[0], tmp_path / "d.mcap", logs[2]], Settings())) == events


def test_missing_parts_are_reported(
    run_of_three_parts: tuple[list[Path], list[Event], str],
) -> None:
    one, two, three = run_of_three_parts[0]
    assert missing_of([one, two, three]) == []
    assert missing_of([one, two]) == [f"{two}: {UNFOLLOWED}"]
    assert missing_of([one, three]) == [f"{three}: part 2 of the run is missing"]
    assert missing_of([three]) == [f"{three}: part 1 to 2 of the run is missing"]
    assert missing_of([three, two]) == [f"{two}: part 1 of the run is missing"]
    assert len(missing_of([two])) == 2


def test_missing_parts_of_several_runs_are_reported_in_any_order(tmp_path: Path) -> None:
    """Of one run the last part is missing, of the other the first two."""
    runs = []
    for name in "ab":
        part, logs = Part.first(), list[Path]()
        for number in (1, 2, 3):
            where = tmp_path / f"{name}{number}.mcap"
            logs.append(write(where, part, [Tick(number)], is_continued=number < 3))
            part = part.after(where.name)
        runs.append(logs)
    one, other = runs
    for logs in permutations([*one, *other]):
        assert missing_of(logs) == []
    for logs in permutations([*one[:2], other[2]]):
        assert set(missing_of(logs)) == {
            f"{one[1]}: {UNFOLLOWED}",
            f"{other[2]}: part 1 to 2 of the run is missing",
        }


def test_log_given_twice_is_rejected(tmp_path: Path, short_log: Path) -> None:
    (tmp_path / "link.tlog").symlink_to(short_log)
    for again in (short_log, short_log.parent / "." / short_log.name, tmp_path / "link.tlog"):
        with pytest.raises(LogError, match="is given twice"):
            log_events([short_log, again], Settings())


def test_gap_is_reported_with_its_time_and_event_count(tmp_path: Path) -> None:
    part = Part.first()
    path = write(tmp_path / "a.mcap", part, [Tick(7)], Hole(START_NS, 12, "no room"))
    assert read_recording_info(path).holes == (Hole(START_NS, 12, "no room"),)
    assert missing_of([path]) == [
        f"{path}: 12 events before 2023-11-14T22:13:20+00:00 are missing: no room"
    ]
    command = [BIN / "companion", "replay", path, "--no-record"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANG_S)
    assert "  missing: " in done.stdout and "12 events" in done.stdout
    assert (done.returncode, "no beam was computed" in done.stderr) == (1, True)


def test_duplicate_part_is_rejected(tmp_path: Path) -> None:
    part = Part.first()
    logs = [write(tmp_path / f"{name}.mcap", part, [Tick(7)]) for name in "ab"]
    other = write(tmp_path / "other.mcap", Part.first(), [Tick(8)])
    for given in (logs, [*logs, other]):
        with pytest.raises(LogError, match=r"a\.mcap and .*b\.mcap are both part 1 of one run"):
            log_events(given, Settings())


@pytest.mark.parametrize("alone", [False, True])
def test_parts_of_different_runs_are_merged_by_time(tmp_path: Path, alone: bool) -> None:
    one = write(tmp_path / "a.mcap", None if alone else Part.first(), [Tick(1), Tick(3)])
    other = write(tmp_path / "b.mcap", Part.first(), [Tick(2)])
    assert in_order({log: read_recording_info(log) for log in (one, other)}) is None
    assert list(log_events([one, other], Settings())) == []  # ticks are generated


def test_empty_part_belongs_to_its_run(tmp_path: Path) -> None:
    part = Part.first()
    one = write(tmp_path / "a.mcap", part, [Tick(1)])
    other = write(tmp_path / "b.mcap", part.after("a.mcap"), [])
    assert list(log_events([one, other], Settings())) == [Tick(1)]


def test_invalid_part_metadata_is_ignored() -> None:
    assert Part.from_metadata({"run": "a", "number": "x"}) is None
    assert Part.from_metadata({"number": "1"}) is None
    part = Part.first().after("x")
    assert Part.from_metadata(part.metadata()) == part
    assert missing({}) == []


def test_recording_holds_its_observer_gains(tmp_path: Path, short_log: Path) -> None:
    """The gains file named in the settings may have changed or be missing at replay."""
    from importlib import resources

    shipped = (resources.files("companion.tracking.design") / "kinematic_default.json").read_text()
    changed = json.loads(shipped)
    changed_text = json.dumps(changed)
    design, config = tmp_path / "design.json", tmp_path / "config.toml"
    design.write_text(changed_text)
    config.write_text(f"[observer]\ndesign = {json.dumps(str(design))}\n")
    settings = load(config)
    path = tmp_path / "a.mcap"
    digest = replay(
        [short_log],
        settings,
        lambda: Writer(
            where=path,
            settings_toml=settings.to_toml(),
            files=settings.files,
            versions={},
            weights_hz=None,
            started_ns=START_NS,
        ),
    )["digest"]
    design.write_text("another")
    held = settings_for([path], None, None)
    assert held.files == {"design.json": changed_text.encode()}
    assert replay([path], held)["digest"] == digest
    design.unlink()
    assert replay([path], settings_for([path], None, None))["digest"] == digest
