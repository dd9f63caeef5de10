"""Recovery of a recording truncated anywhere loses at most one flush."""

import contextlib
import random
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader
from support import HANG_S, line_of, read_metadata, rounds, started

from companion.cli.main import main
from companion.recording.reader import LogError, read_log, read_settings
from companion.recording.recover import (
    MAGIC,
    Recovered,
    holds_recording,
    recover,
    recover_leftovers,
)
from companion.recording.writer import Writer
from companion.values import Event, Frame, Reason, Rejection, Tick

Record = Callable[..., list[Event]]
FLUSH_EVERY = 25


@pytest.fixture
def recording(tmp_path: Path, record: Record) -> tuple[Path, list[Event], list[tuple[int, int]]]:
    """A finished recording, its events, and (size, events so far) at each flush."""
    flushed: list[tuple[int, int]] = []
    writer = Writer(
        where=tmp_path / "whole",
        settings_toml="[a]\n",
        versions={"companion": "1"},
        weights_hz=None,
        started_ns=0,
    )
    flushed.append((writer.size_bytes, 0))
    driven = record(writer, 400, FLUSH_EVERY, flushed)
    return writer.close({"digest": "d"}), driven, flushed


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def recovered_events(path: Path) -> list[Event]:
    try:
        return list(read_log(path))
    except LogError:  # nothing was flushed before the cut
        return []


def test_truncation_anywhere_loses_at_most_one_flush(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]]
) -> None:
    whole, driven, flushed = recording
    data = whole.read_bytes()
    rng = random.Random(11)
    cuts = [
        0,
        1,
        7,
        8,
        9,
        16,
        17,
        *(rng.randrange(len(data)) for _ in range(rounds(40, 120))),
        len(data) - 1,
    ]
    for number, cut in enumerate(cuts):
        torn = tmp_path / f"{number}.mcap.active"
        torn.write_bytes(data[:cut])
        result = recover(torn)
        assert result.path == tmp_path / f"{number}.mcap" and result.changed
        assert not torn.exists()
        kept = recovered_events(result.path)
        assert kept == driven[: len(kept)]
        safe = max((events for size, events in flushed if size <= cut), default=0)
        assert len(kept) >= safe
        assert sum(result.messages.get(t, 0) for t in ("/mavlink/frames", "/ticks")) == sum(
            isinstance(event, Frame | Tick) for event in kept
        )
        if cut >= flushed[0][0]:
            assert read_settings(result.path) == ("[a]\n", {})
            assert read_metadata(result.path)["versions"] == {"companion": "1"}
        with result.path.open("rb") as file:
            summary = make_reader(file, validate_crcs=True).get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == sum(result.messages.values())


def test_truncated_file_is_read_up_to_the_cut(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]]
) -> None:
    whole, driven, flushed = recording
    data = whole.read_bytes()
    for size, events in flushed[1:]:
        for more in (0, 5, 40):
            torn = tmp_path / "torn"
            torn.write_bytes(data[: size + more])
            assert list(read_log(torn)) == driven[:events]


def test_recovery_keeps_every_message_of_the_intact_part(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]]
) -> None:
    """Compare message for message, outputs included, byte for byte."""
    whole, _, flushed = recording
    cut = tmp_path / "cut.mcap"
    size = flushed[-1][0]
    cut.write_bytes(whole.read_bytes()[: size + 30])
    result = recover(cut)
    assert cut.exists() and result.path == tmp_path / "cut.recovered.mcap"
    assert result.lost_bytes == 30

    def contents(path: Path) -> list[tuple[str, int, int, bytes]]:
        with path.open("rb") as file:
            found = make_reader(file).iter_messages(log_time_order=False)
            return [(c.topic, m.sequence, m.log_time, m.data) for _, c, m in found]

    kept = contents(result.path)
    assert kept == contents(whole)[: len(kept)]
    assert result.messages == Counter(topic for topic, *_ in kept)
    assert result.last_ns == max(log_time for _, _, log_time, _ in kept)


def test_recovery_leaves_a_finished_recording_unchanged(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]]
) -> None:
    whole, driven, _ = recording
    before = whole.read_bytes()
    result = recover(whole)
    assert (result.path, result.changed, result.lost_bytes) == (whole, False, 0)
    assert whole.read_bytes() == before
    assert names(whole.parent) == [whole.name]
    # Killed between the last byte and the rename: only the name is missing.
    active = tmp_path / "done.mcap.active"
    active.write_bytes(before)
    assert recover(active).path.read_bytes() == before
    assert list(read_log(tmp_path / "done.mcap")) == driven


def test_recovery_overwrites_no_other_file(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]]
) -> None:
    whole, _, _ = recording
    (tmp_path / "x.mcap").write_bytes(b"mine")
    (tmp_path / "x.mcap.active").write_bytes(whole.read_bytes()[:-100])
    assert recover(tmp_path / "x.mcap.active").path == tmp_path / "x-1.mcap"
    assert (tmp_path / "x.mcap").read_bytes() == b"mine"


def test_failed_recovery_keeps_the_original(
    tmp_path: Path,
    recording: tuple[Path, list[Event], list[tuple[int, int]]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole, _, _ = recording
    torn = tmp_path / "x.mcap.active"
    torn.write_bytes(whole.read_bytes()[:-100])

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("companion.recording.recover.os.fsync", full)
    with pytest.raises(LogError, match=r"x\.mcap\.active: cannot be recovered: No space left"):
        recover(torn)
    assert torn.read_bytes() == whole.read_bytes()[:-100]
    assert names(tmp_path) == ["whole", "x.mcap.active"]


def test_damaged_chunk_is_lost_alone_and_reported(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]]
) -> None:
    whole, driven, flushed = recording
    broken = bytearray(whole.read_bytes())
    broken[flushed[5][0] + 200] ^= 0xFF  # in the chunk after the fifth flush
    path = tmp_path / "broken.mcap"
    path.write_bytes(broken)
    events = list(read_log(path))
    first, last = flushed[5][1], flushed[6][1]
    said = events[first]
    assert isinstance(said, Rejection) and said.reason is Reason.GARBAGE and said.count > 200
    assert events == [*driven[:first], said, *driven[last:]]
    result = recover(path)
    assert result.changed and result.lost_bytes == said.count
    assert list(read_log(result.path)) == [*driven[:first], *driven[last:]]


def test_damaged_first_chunk_is_lost_alone(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]]
) -> None:
    """The first chunk describes the channels, and so does the end of the file if present."""
    whole, driven, flushed = recording
    broken = bytearray(whole.read_bytes())
    broken[flushed[0][0] + 200] ^= 0xFF
    path = tmp_path / "broken.mcap"
    path.write_bytes(broken)
    said, *events = read_log(path)
    assert isinstance(said, Rejection) and said.reason is Reason.GARBAGE
    assert events == driven[flushed[1][1] :]
    assert said.t_ns == events[0].t_ns
    result = recover(path)
    assert result.lost_bytes == said.count
    assert list(read_log(result.path)) == events
    # Without both, the remaining data cannot be decoded, and this is reported.
    path.write_bytes(broken[:-1])
    with pytest.raises(LogError, match=r"no MAVLink frame in it: \d{3,} bytes are damaged"):
        read_log(path)
    path.with_name("broken.recovered.mcap").unlink()
    assert recover(path).lost_bytes > 2 * said.count


def test_damaged_last_chunk_is_reported(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]]
) -> None:
    """No event follows it."""
    whole, driven, flushed = recording
    broken = bytearray(whole.read_bytes())
    broken[flushed[-1][0] + 100] ^= 0xFF
    path = tmp_path / "broken.mcap"
    path.write_bytes(broken)
    *events, said = read_log(path)
    assert isinstance(said, Rejection) and said.reason is Reason.GARBAGE
    assert events == driven[: flushed[-1][1]]
    assert said.t_ns == events[-1].t_ns
    assert recover(path).lost_bytes == said.count


def test_recovery_reports_the_latest_time_of_all_messages(tmp_path: Path) -> None:
    with Writer(
        where=tmp_path / "x.mcap", settings_toml="", versions={}, weights_hz=None, started_ns=0
    ) as writer:
        for t_ns in (5, 9, 7):
            writer.event(Tick(t_ns))
        writer.flush()
    assert recover(writer.path).last_ns == 9


@pytest.mark.parametrize("seed", range(40))
def test_flipped_bits_lose_what_cannot_be_read(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]], seed: int
) -> None:
    broken = bytearray(recording[0].read_bytes())
    rng = random.Random(seed)
    for _ in range(5):
        broken[rng.randrange(8, len(broken))] ^= 1 << rng.randrange(8)
    path = tmp_path / "broken.mcap.active"
    path.write_bytes(broken)
    driven = set(map(repr, recording[1]))
    before = [e for e in recovered_events(path) if not isinstance(e, Rejection)]
    assert set(map(repr, before)) <= driven
    if before:
        after = [e for e in recovered_events(recover(path).path) if not isinstance(e, Rejection)]
        assert after == before
    else:
        with pytest.raises(LogError, match="no message can be recovered"):
            recover(path)
        assert path.read_bytes() == bytes(broken)


def test_unfinished_files_are_recovered_and_failures_reported(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]]
) -> None:
    data = recording[0].read_bytes()
    folder = tmp_path / "leftovers"
    folder.mkdir()
    (folder / "a.mcap.active").write_bytes(data[:-10])
    (folder / "b.mcap.active").write_bytes(b"something else")
    (folder / "c.mcap").write_bytes(data)
    (folder / "d.mcap.active").touch()
    live = Writer(where=folder, settings_toml="", versions={}, weights_hz=None, started_ns=0)
    results = recover_leftovers(folder)
    assert [type(result) for result in results] == [Recovered, LogError, Recovered]
    assert live.path.exists()
    with pytest.raises(LogError, match="is being recorded"):
        recover(live.path)
    live.close({})
    assert names(folder) == [
        "a.mcap", "b.mcap.damaged", "c.mcap", "companion-19700101T000000Z.mcap", "d.mcap",
    ]  # fmt: skip


def test_recover_rejects_files_that_are_not_recordings(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.mcap").write_text("hello, this is no recording")
    for name, why in [
        ("missing.mcap", "no such file"),
        ("", "is a directory"),
        ("empty.mcap", "not an MCAP recording"),
        ("text.mcap", "not an MCAP recording"),
    ]:
        with pytest.raises(LogError, match=why):
            recover(tmp_path / name)
    assert names(tmp_path) == ["empty.mcap", "text.mcap"]


_RECORD_FOREVER = """
import itertools, sys
from pathlib import Path
from companion.recording.writer import Writer
from companion.values import Frame, Source
writer = Writer(
    where=Path(sys.argv[1]), settings_toml="[a]", versions={}, weights_hz=None, started_ns=0
)
for number in itertools.count():
    raw = bytes([0xFD, 9, 0, 0, number % 256, 1, 1, 0, 0, 0]) + number.to_bytes(11, "little")
    writer.event(Frame(number, "udp", Source(1, 1), 0, raw))
    if number % 1000 == 999:
        writer.flush()
        print(number + 1, flush=True)
"""


def test_killed_process_loses_no_flushed_event(tmp_path: Path) -> None:
    with started(
        [sys.executable, "-c", _RECORD_FOREVER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as process:
        for _ in range(20):
            flushed = int(line_of(process, process.stdout))
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read().split()
        assert process.wait(HANG_S) == -signal.SIGKILL
    flushed = int(rest[-1]) if rest else flushed
    [leftover] = tmp_path.iterdir()
    assert leftover.name.endswith(".mcap.active")
    read = list(read_log(leftover))
    [result] = recover_leftovers(tmp_path)
    assert isinstance(result, Recovered)
    events = list(read_log(result.path))
    assert events == read
    assert [event.t_ns for event in events] == list(range(len(events)))
    assert len(events) >= flushed
    assert result.messages == {"/mavlink/frames": len(events)}
    assert read_settings(result.path) == ("[a]", {})


def test_command_completes_all_files_that_can_be(
    tmp_path: Path, recording: tuple[Path, list[Event], list[tuple[int, int]]]
) -> None:
    data = recording[0].read_bytes()
    for name in ("one", "two"):
        (tmp_path / f"{name}.mcap.active").write_bytes(data[: len(data) // 2])
    (tmp_path / "no.mcap.active").write_bytes(b"no recording")
    names = ["one.mcap.active", "no.mcap.active", "missing", "two.mcap.active"]
    done = CliRunner().invoke(main, ["recover", *(str(tmp_path / name) for name in names)])
    assert done.exit_code == 1
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == [
        str(tmp_path / "one.mcap"),
        str(tmp_path / "two.mcap"),
    ]
    lines = done.stderr.splitlines()
    assert len(lines) == 2
    assert "no.mcap.active" in lines[0] and "missing" in lines[1]


def test_folder_is_no_recording(tmp_path: Path) -> None:
    assert not holds_recording(tmp_path)
    with contextlib.chdir(tmp_path):
        assert not holds_recording(Path())


def test_file_of_which_no_message_can_be_recovered_is_kept(tmp_path: Path) -> None:
    """Cut within its first chunk, which holds seconds of a replay's frames."""
    chunk = b"\x06" + (1 << 20).to_bytes(8, "little") + random.Random(3).randbytes(30_000)
    torn = tmp_path / "a.mcap.active"
    torn.write_bytes(MAGIC + chunk)
    with pytest.raises(LogError, match=r"a\.mcap\.active: no message can be recovered"):
        recover(torn)
    assert torn.read_bytes() == MAGIC + chunk
    (kept,) = recover_leftovers(tmp_path)
    assert str(kept).endswith("kept as a.mcap.damaged")
    assert names(tmp_path) == ["a.mcap.damaged"]
