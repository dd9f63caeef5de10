"""The recorder thread writes what is queued, and its failures do not reach the service."""

import errno
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
import pytest
from support import BALLAST, HANG_S, ROOT, fill, read_metadata

from companion.node.replay import log_events, missing
from companion.recording import background
from companion.recording.background import BackgroundRecorder, Rotation
from companion.recording.folders import make_service_folder
from companion.recording.parts import UNFOLLOWED, Hole, Part, read_recording_info
from companion.recording.reader import read_log, utc_offset_ns
from companion.recording.writer import Writer
from companion.settings.model import Settings
from companion.values import (
    BeamSet,
    ClockSet,
    Event,
    FloatArray,
    Frame,
    Method,
    Normalisation,
    Notice,
    Output,
    Reason,
    Rejection,
    Severity,
    Source,
    Tick,
    Update,
    UserError,
)

RAW = b"\xfe\x00\x00\x01\x01\x00\x00\x00"
START_NS = 1_700_000_000_000_000_000


def nowhere(positions: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """No local frame is needed here."""
    north, east, down = np.asarray(positions).T
    return north, east, down


def recorder(folder: Path, rotation: Rotation | None = None, **more: int) -> BackgroundRecorder:
    """A recorder with new files."""

    def open_part(part: Part) -> Writer:
        return Writer(
            where=folder,
            settings_toml="",
            versions={},
            weights_hz=None,
            started_ns=START_NS,
            part=part,
        )

    return BackgroundRecorder(
        open_part=open_part,
        folder=folder,
        geodetic=nowhere,
        rotation=rotation or Rotation(),
        **more,
    )


def wait_until(good: Callable[[], bool], seconds: float = HANG_S) -> None:
    """Poll until the condition holds: the recorder runs in another thread."""
    end = time.monotonic() + seconds
    while not good():
        assert time.monotonic() < end
        time.sleep(0.01)


def on_disk(made: BackgroundRecorder) -> int:
    """Number of messages flushed to the newest file."""
    return made._writer.flushed


def waiting(made: BackgroundRecorder) -> int:
    """Number of queued items."""
    return made.queued


def wait_for_part(made: BackgroundRecorder, number: int) -> None:
    wait_until(lambda: made._part.number == number)


def ticks(first: int, last: int) -> list[Event]:
    return [Tick(START_NS + n) for n in range(first, last)]


def incompressible(first: int, last: int) -> list[Event]:
    """Events larger than the free part of the last page of a file on a full disk."""
    make = Random(first)
    return [
        Rejection(
            t_ns=START_NS + n, source="udp", reason=Reason.GARBAGE, detail=make.randbytes(200).hex()
        )
        for n in range(first, last)
    ]


def hand_over(made: BackgroundRecorder, events: list[Event]) -> list[Event]:
    for event in events:
        made.put(event, [])
    return events


def parts_of(folder: Path) -> list[Path]:
    found = [path for path in folder.iterdir() if ".mcap" in path.name]
    return sorted(found, key=lambda path: read_recording_info(path).part or Part("", 0, ""))


def test_first_events_are_flushed_immediately(tmp_path: Path) -> None:
    """The first events are on disk within a second; later ones may wait for the next flush."""
    made = recorder(tmp_path)
    made.start()
    begun_s = time.monotonic()
    hand_over(made, ticks(0, 5))
    wait_until(lambda: on_disk(made) >= 5)
    took_s = time.monotonic() - begun_s
    made.stop({})
    assert took_s < background.FLUSH_S


def test_queued_events_are_written_in_order(tmp_path: Path) -> None:
    made = recorder(tmp_path)
    made.start()
    events = [
        Frame(t_ns=n, link="link", source=Source(1, 1), msgid=0, raw=RAW) if n % 3 else Tick(n)
        for n in range(1, 500)
    ]
    hand_over(made, events)
    made.stop({"digest": "abc"})
    (path,) = tmp_path.glob("*.mcap")
    assert list(read_log(path)) == events
    assert read_metadata(path)["summary"] == {"digest": "abc"}
    assert (made.dropped, made.failure, made.news()) == (0, None, [])
    assert made.messages == len(events)
    assert missing([path]) == []


def test_freed_disk_space_leaves_no_gap(small_disk: Path) -> None:
    made = recorder(small_disk)
    made.start()
    events = hand_over(made, ticks(1, 100))
    wait_until(lambda: on_disk(made) == 99)
    fill(small_disk)
    events += hand_over(made, ticks(100, 5000))
    wait_until(lambda: made.failure is not None)
    assert made.degraded
    assert "No space left" in str(made.failure)
    events += hand_over(made, ticks(5000, 9000))
    (small_disk / BALLAST).unlink()
    wait_until(lambda: made.failure is None)
    events += hand_over(made, ticks(9000, 9100))
    made.stop({"digest": "d"})
    (severity, said), *_, (_, again) = made.news()  # a busy machine may report a slow disk
    assert severity is Severity.ERROR and "No space left" in said
    assert "recording again" in again
    assert made.dropped == 0 and not made.degraded
    first, second = parts_of(small_disk)
    assert first.name.endswith(".active")  # recovered at the next start of the service
    assert list(log_events([second, first], Settings())) == events
    assert missing([first, second]) == []
    assert missing([second]) == [f"{second}: part 1 of the run is missing"]
    assert read_metadata(second)["summary"] == {"digest": "d"}
    assert made.messages == len(events)


def test_full_disk_leaves_no_empty_file(small_disk: Path) -> None:
    """Regression: each retry left an empty file, which was recovered as a recording without
    frames."""
    fill(small_disk)
    with pytest.raises(OSError, match="No space left"):
        Writer(
            where=small_disk, settings_toml="", versions={}, weights_hz=None, started_ns=START_NS
        )
    assert [path.name for path in small_disk.iterdir()] == [BALLAST]


def test_disk_that_is_full_at_the_start_is_recorded_to_once_it_has_space(small_disk: Path) -> None:
    """A service that filled its disk is restarted: it has beams, and says that nothing is kept."""
    fill(small_disk)
    made = recorder(small_disk)
    assert made.degraded and made.file is None and made.messages == 0
    assert [(severity, "No space left" in text) for severity, text in made.news()] == [
        (Severity.ERROR, True)
    ]
    made.start()
    events = hand_over(made, ticks(1, 5000))
    (small_disk / BALLAST).unlink()
    wait_until(lambda: made.failure is None)
    made.stop({})
    (only,) = parts_of(small_disk)
    assert list(log_events([only], Settings())) == events
    assert missing([only]) == [] and made.dropped == 0


def test_disk_that_stays_full_from_the_start_does_not_delay_the_end(small_disk: Path) -> None:
    fill(small_disk)
    made = recorder(small_disk)
    made.start()
    hand_over(made, ticks(1, 100))
    made.stop({})
    assert made.dropped == 99
    assert [path.name for path in small_disk.iterdir()] == [BALLAST]


def test_read_only_disk_does_not_keep_a_service_from_its_start(small_disk: Path) -> None:
    remount = ["mount", "-o", "remount,ro", small_disk]
    subprocess.run(remount, check=True, timeout=HANG_S)
    for folder in (small_disk, small_disk / "not" / "there"):
        make_service_folder(folder)
        made = recorder(folder)
        assert "Read-only" in str(made.failure) and str(folder) in str(made.failure)
    with pytest.raises(UserError, match="is not a folder"):
        make_service_folder(Path(__file__))


def large_update(t_ns: int) -> Update:
    weights = np.zeros((512, 512), dtype=complex)  # 4 MB
    beams = BeamSet(
        t_ns=t_ns,
        valid_at_ns=t_ns,
        beams=(),
        weights=weights,
        method=Method.ZERO_FORCING,
        normalisation=Normalisation.STREAM,
        condition_number=None,
        left_out=(),
        exact=True,
    )
    return Update(t_ns=t_ns, carrier=None, unfit=None, tracks=(), beams=beams)


def test_updates_of_a_large_array_take_bounded_memory_while_the_disk_is_full(
    small_disk: Path,
) -> None:
    """All events are kept: a replay computes the weights again."""
    fill(small_disk)
    made = recorder(small_disk)
    made.start()
    events = ticks(1, 101)
    for event in events:
        made.put(event, [large_update(event.t_ns)])
    held = [item for item in made._queue if item.outputs]
    assert len(held) == background.UPDATES_MAX_BYTES // (4 << 20)
    assert made.queued == 100 and made.dropped == 0
    (small_disk / BALLAST).unlink()
    wait_until(lambda: made.failure is None and made.queued == 0)
    wait_until(lambda: made._freed_bytes == made._put_bytes)
    made.put(Tick(START_NS + 101), [large_update(START_NS + 101)])
    assert made._put_bytes - made._freed_bytes >= 4 << 20
    made.stop({})
    assert list(log_events(parts_of(small_disk), Settings())) == [*events, Tick(START_NS + 101)]


def test_end_waits_for_a_disk_as_long_as_it_takes_events(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(background, "STOP_MAX_S", 1.0)
    made, answers = recorder(tmp_path), threading.Event()
    write = made._writer.event

    def slowly(event: Event) -> None:
        write(event)
        answers.wait(HANG_S if event.t_ns == START_NS + 40 else 0.05)

    monkeypatch.setattr(made._writer, "event", slowly)
    made.start()
    hand_over(made, ticks(1, 60))
    made.stop({})
    assert made.messages >= 40
    assert [text for _, text in made.news()] == [
        f"{made._writer.path} is incomplete: the disk does not answer"
    ]
    answers.set()
    made._thread.join(HANG_S)


def test_disk_that_does_not_answer_is_announced_and_that_it_does_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(background, "STALLED_S", 0.2)
    made, answers = recorder(tmp_path), threading.Event()
    flush = made._writer.flush

    def waits() -> None:
        assert answers.wait(HANG_S)
        flush()

    monkeypatch.setattr(made._writer, "flush", waits)
    made.start()
    assert made.news() == [] and not made.degraded
    hand_over(made, ticks(1, 10))
    news = list[tuple[Severity, str]]()
    wait_until(lambda: bool(news.extend(made.news()) or news))
    assert made.degraded
    assert [severity for severity, _ in news] == [Severity.ERROR]
    assert "has not answered" in news[0][1]
    answers.set()
    wait_until(lambda: bool(news.extend(made.news()) or len(news) > 1))
    assert news[1:] == [(Severity.INFO, "the disk answers again")]
    assert not made.degraded
    made.stop({})


def test_time_for_which_the_process_was_stopped_is_none_of_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, answers = recorder(tmp_path), threading.Event()
    flush, monotonic, passed_s = made._writer.flush, time.monotonic, 0.0

    def waits() -> None:
        assert answers.wait(HANG_S)
        flush()

    monkeypatch.setattr(made._writer, "flush", waits)
    monkeypatch.setattr(time, "monotonic", lambda: monotonic() + passed_s)
    made.start()
    hand_over(made, ticks(1, 10))
    try:
        passed_s = 17.0
        assert made.news() == [] and not made.degraded
        news = list[tuple[Severity, str]]()
        for _ in range(6):
            passed_s += 1.0
            news += made.news()
        assert len(news) == 1 and "has not answered" in news[0][1]
    finally:
        answers.set()
        made.stop({})


def test_full_disk_retry_interval_does_not_grow(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: with a doubling retry interval, the queue kept twice the events of the outage."""
    monkeypatch.setattr(background, "RETRY_FIRST_S", 0.01)
    monkeypatch.setattr(background, "GATHER_S", 0.005)  # so that only retries wait this long
    made, waits_s = recorder(small_disk), list[float]()
    wait = made._stopping.wait

    def noted(seconds: float) -> bool:
        waits_s.append(seconds)
        return wait(seconds)

    monkeypatch.setattr(made._stopping, "wait", noted)
    made.start()
    events = hand_over(made, ticks(1, 100))
    wait_until(lambda: on_disk(made) == 99)
    fill(small_disk)
    events += hand_over(made, incompressible(100, 200))
    wait_until(lambda: waits_s.count(background.RETRY_FIRST_S) > 8)
    assert max(waits_s) == background.RETRY_FIRST_S
    (small_disk / BALLAST).unlink()
    wait_until(lambda: made.failure is None)
    made.stop({})
    assert list(log_events(parts_of(small_disk), Settings())) == events


def test_queued_events_that_fit_in_the_free_space_are_kept(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: all queued events had to fit at once and were rewritten by each retry."""
    monkeypatch.setattr(background, "RETRY_FIRST_S", 0.05)
    monkeypatch.setattr(background, "RETRY_MAX_S", 0.05)
    monkeypatch.setattr(background, "MIN_FREE_BYTES", 0)
    monkeypatch.setattr(background, "RESUME_BATCH", 100)
    made = recorder(small_disk)
    made.start()
    events = hand_over(made, ticks(1, 100))
    wait_until(lambda: on_disk(made) == 99)
    fill(small_disk)
    events += hand_over(made, ticks(100, 5000))
    wait_until(lambda: made.failure is not None)
    before, free = made._finished_messages + on_disk(made), 20_000
    os.truncate(small_disk / BALLAST, (small_disk / BALLAST).stat().st_size - free)
    wait_until(lambda: made._finished_messages + on_disk(made) > before + 99)
    (small_disk / BALLAST).unlink()
    wait_until(lambda: made.failure is None)
    made.stop({})
    assert made.dropped == 0
    assert list(log_events(parts_of(small_disk), Settings())) == events


def test_outage_longer_than_the_queue_is_recorded_as_a_gap(small_disk: Path) -> None:
    made = recorder(small_disk, queue_max=1000)
    made.start()
    head = hand_over(made, ticks(1, 100))
    wait_until(lambda: on_disk(made) == 99)
    fill(small_disk)
    hand_over(made, incompressible(100, 200))
    wait_until(lambda: made.failure is not None)
    hand_over(made, ticks(200, 5000))
    dropped = made.dropped
    assert dropped > 3000
    (small_disk / BALLAST).unlink()
    wait_until(lambda: made.failure is None)
    wait_until(lambda: waiting(made) == 0)
    tail = hand_over(made, ticks(5000, 5100))
    assert not made.degraded
    made.stop({})
    assert made.dropped == dropped
    logs = parts_of(small_disk)
    events = list(log_events(logs, Settings()))
    assert events[:99] == head and events[-100:] == tail
    assert len(events) + dropped == 5099
    hole = Hole(START_NS + 5000, dropped, "No space left on device")
    assert [hole] == [hole for log in logs for hole in read_recording_info(log).holes]
    assert len(missing(logs)) == 1 and f"{dropped} events" in missing(logs)[0]
    assert [severity for severity, _ in made.news()] == ["error", "info", "info"]


def test_full_disk_is_reported_once_and_does_not_delay_shutdown(small_disk: Path) -> None:
    made = recorder(small_disk)
    made.start()
    fill(small_disk)
    hand_over(made, ticks(1, 3000))
    wait_until(lambda: made.failure is not None)
    began_s = time.monotonic()
    made.stop({})
    assert time.monotonic() - began_s < 5
    kept = made._finished_messages + on_disk(made)  # written before all events were queued
    assert made.dropped == 2999 - kept
    (_, failed), (_, lost) = made.news()
    assert failed.startswith("nothing is recorded: ")
    assert lost == f"the last {made.dropped} events are not recorded: No space left on device"
    assert kept or [path.name for path in small_disk.iterdir()] == [BALLAST]


_LIMITED = """
import resource, sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from test_background import hand_over, on_disk, recorder, ticks, wait_until
made = recorder(Path(sys.argv[1]))
made.start()
hand_over(made, ticks(1, 100))
wait_until(lambda: on_disk(made) == 99)
size, hard = made.bytes + 50, resource.getrlimit(resource.RLIMIT_FSIZE)[1]
resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
hand_over(made, ticks(100, 5000))
wait_until(lambda: made.failure is not None)
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
wait_until(lambda: made.failure is None)
made.stop({})
print(made.dropped, [text for _, text in made.news()][0])
"""


@pytest.mark.full
def test_file_size_limit_continues_the_run_in_a_new_part(tmp_path: Path) -> None:
    """Without root: the system enforces a file size limit in the middle of a write."""
    done = subprocess.run(
        [sys.executable, "-c", _LIMITED, tmp_path, Path(__file__).parent, ROOT / "tests"],
        capture_output=True, text=True, check=True, timeout=HANG_S,
    )  # fmt: skip
    assert done.stdout.startswith("0 nothing is recorded: ")
    assert "File too large" in done.stdout
    logs = parts_of(tmp_path)
    assert len(logs) == 2
    assert list(log_events(logs, Settings())) == ticks(1, 5000)
    assert missing(logs) == []


_NEVER_WRITTEN = """
import resource, sys, threading
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from test_background import hand_over, recorder, ticks, wait_until
made = recorder(Path(sys.argv[1]))
made.start()
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
hand_over(made, ticks(1, 100))
wait_until(lambda: made.failure is not None)
made.stop({})
print(threading.active_count(), made.dropped)
"""


def test_end_does_not_wait_for_a_disk_on_which_files_are_opened_but_not_written(
    tmp_path: Path,
) -> None:
    """A quota: each new file can be opened, and none takes what waits."""
    done = subprocess.run(
        [sys.executable, "-c", _NEVER_WRITTEN, tmp_path, Path(__file__).parent, ROOT / "tests"],
        capture_output=True, text=True, check=True, timeout=HANG_S,
    )  # fmt: skip
    assert done.stdout == "1 99\n"


def test_removed_folder_is_recreated(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    made = recorder(folder)
    made.start()
    hand_over(made, ticks(1, 100))
    wait_until(lambda: on_disk(made) == 99)
    shutil.rmtree(folder)
    kept = hand_over(made, ticks(100, 200))
    wait_until(lambda: made.failure is not None)
    wait_until(lambda: made.failure is None)
    kept += hand_over(made, ticks(200, 300))
    made.stop({})
    (path,) = folder.iterdir()
    assert list(read_log(path)) == kept
    assert missing([path]) == [f"{path}: part 1 of the run is missing"]
    assert "the file was removed" in made.news()[0][1]


def test_truncated_file_is_announced_and_the_run_continues_in_another(tmp_path: Path) -> None:
    """What was recorded is lost, which nothing told; the rest is not."""
    made = recorder(tmp_path)
    made.start()
    hand_over(made, ticks(1, 100))
    wait_until(lambda: on_disk(made) == 99)
    (path,) = tmp_path.iterdir()
    os.truncate(path, 100)
    kept = hand_over(made, ticks(100, 200))
    wait_until(lambda: made.failure is not None)
    wait_until(lambda: made.failure is None)
    kept += hand_over(made, ticks(200, 300))
    made.stop({})
    assert "the file was truncated" in made.news()[0][1]
    assert path.stat().st_size == 100
    (rest,) = tmp_path.glob("*.mcap")
    assert list(read_log(rest)) == kept


def test_slow_disk_drops_events_and_reports_the_count(
    tmp_path: Path, update: Callable[[int], Update]
) -> None:
    """The thread blocks on an output that waits for a pipe, as a write waits for a slow disk."""
    reading, writing = os.pipe()
    waits = [True]

    def slow(positions: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        if waits:
            os.read(reading, 1)
        return nowhere(positions)

    def open_part(part: Part) -> Writer:
        return Writer(
            where=tmp_path,
            settings_toml="",
            versions={},
            weights_hz=None,
            started_ns=START_NS,
            part=part,
        )

    made = BackgroundRecorder(open_part=open_part, folder=tmp_path, geodetic=slow, queue_max=1000)
    made.start()
    made.put(Tick(START_NS), [update(START_NS)])
    wait_until(lambda: waiting(made) == 0)
    head = hand_over(made, ticks(1, 1001))
    began_s = time.monotonic()
    hand_over(made, ticks(1001, 1501))
    assert time.monotonic() - began_s < 1.0
    assert made.dropped == 500 and made.degraded and made.failure is None
    os.write(writing, b"x")
    waits.clear()
    wait_until(lambda: waiting(made) == 0)
    tail = hand_over(made, ticks(1501, 1511))
    assert not made.degraded
    made.stop({})
    os.close(reading)
    os.close(writing)
    (path,) = tmp_path.iterdir()
    assert list(read_log(path)) == [Tick(START_NS), *head, *tail]
    assert read_recording_info(path).holes == (Hole(START_NS + 1501, 500, "the disk was too slow"),)
    assert [text for _, text in made.news()] == [
        "some events are not recorded: the disk is too slow",
        "recording again: 500 events are missing",
    ]


def said(t_ns: int) -> list[Output]:
    return [
        Notice(
            t_ns=t_ns, severity=Severity.INFO, subject="1:1", text="something that came of no event"
        )
    ]


def test_queue_overflow_gap_counts_only_log_events(tmp_path: Path) -> None:
    """Notices without a log event are dropped too, but they are not missing from the log."""
    made = recorder(tmp_path, queue_max=2)
    hand_over(made, ticks(1, 5))
    for n in range(3):
        made.put(None, said(START_NS + n))
    assert made.dropped == 5
    made.start()
    wait_until(lambda: waiting(made) == 0)
    hand_over(made, ticks(5, 6))
    made.stop({})
    (path,) = tmp_path.iterdir()
    assert list(read_log(path)) == [*ticks(1, 3), *ticks(5, 6)]
    assert read_recording_info(path).holes == (Hole(START_NS + 5, 2, "the disk was too slow"),)


class _Broken(Writer):
    """A file on a disk that fails permanently: even truncation fails."""

    def flush(self) -> None:
        if self.messages:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        super().flush()

    def salvage(self) -> bool:
        self.abandon()
        return False


def test_write_failure_gap_counts_only_log_events(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.recording.background.RETRY_FIRST_S", 0.001)
    broken, sound = tmp_path / "broken", tmp_path / "sound"

    def open_part(part: Part) -> Writer:
        kind, folder = (Writer, sound) if broken.exists() else (_Broken, broken)
        return kind(
            where=folder,
            settings_toml="",
            versions={},
            weights_hz=None,
            started_ns=START_NS,
            part=part,
        )

    made = BackgroundRecorder(open_part=open_part, folder=tmp_path, geodetic=nowhere, queue_max=5)
    hand_over(made, ticks(1, 3))
    for n in range(3):
        made.put(None, said(START_NS + n))
    made.start()  # as many as fit in the queue: one write asks the disk for all of them
    wait_until(lambda: made.failure is None and sound.exists())
    hand_over(made, ticks(3, 4))
    made.stop({})
    assert made.dropped == 5
    (path,) = sound.iterdir()
    assert list(read_log(path)) == ticks(3, 4)
    (hole,) = read_recording_info(path).holes
    assert (hole.events, hole.why) == (2, os.strerror(errno.EIO))


def test_each_part_holds_its_utc_offset(tmp_path: Path) -> None:
    made = recorder(tmp_path, Rotation(1.0, None))
    made.start()
    clock_set = ClockSet(START_NS, -5)
    hand_over(made, [clock_set, *ticks(0, 10)])
    wait_for_part(made, 2)
    events = hand_over(made, ticks(10, 20))
    made.stop({})
    logs = parts_of(tmp_path)
    assert list(read_log(logs[1])) == [replace(clock_set, t_ns=events[0].t_ns), *events]
    assert utc_offset_ns(logs) == utc_offset_ns(logs[1:2]) == -5


def test_size_is_that_of_the_newest_part(tmp_path: Path) -> None:
    """It was that of the previous part until the next flush, a second later."""
    made = recorder(tmp_path, Rotation(1.0, None))
    made.start()
    hand_over(made, ticks(0, 2000))
    wait_for_part(made, 2)
    size = made.bytes
    made.stop({})
    assert 0 < size < parts_of(tmp_path)[0].stat().st_size / 2


def test_finished_part_is_served_whole_while_the_next_cannot_be_opened(tmp_path: Path) -> None:
    made = recorder(tmp_path, Rotation(1.0, None))
    open_part = made._open_part

    def full(part: Part) -> Writer:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    made._open_part = full
    made.start()
    hand_over(made, ticks(0, 2000))
    wait_until(lambda: made.failure is not None)
    (part,) = tmp_path.iterdir()
    assert made.file == part.name and made.bytes == part.stat().st_size
    made._open_part = open_part
    made.stop({})


def test_latest_utc_offset_counts_in_any_order_of_the_parts(tmp_path: Path) -> None:
    made = recorder(tmp_path, Rotation(1.0, None))
    made.start()
    hand_over(made, [ClockSet(START_NS, -5), *ticks(0, 10)])
    wait_for_part(made, 2)
    (first, *_) = later = ticks(10, 20)
    hand_over(made, [ClockSet(first.t_ns, -9), *later])
    made.stop({})
    logs = parts_of(tmp_path)
    assert utc_offset_ns(logs) == utc_offset_ns(logs[::-1]) == -9


@pytest.mark.parametrize("rotation", [Rotation(1e9, None), Rotation()])
def test_large_index_ends_a_part_unless_parts_have_no_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rotation: Rotation
) -> None:
    monkeypatch.setattr(background, "INDEX_MAX_BYTES", 1)
    made = recorder(tmp_path, rotation)
    made.start()
    hand_over(made, ticks(0, 10))
    if rotation != Rotation():
        wait_for_part(made, 2)
    else:
        wait_until(lambda: on_disk(made) >= 10)
    hand_over(made, ticks(10, 20))
    made.stop({})
    assert len(parts_of(tmp_path)) == (1 if rotation == Rotation() else 2)


@pytest.mark.parametrize("rotation", [Rotation(1e9, None), Rotation()])
def test_many_topics_end_any_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rotation: Rotation
) -> None:
    monkeypatch.setattr(background, "CHANNELS_MAX", 1)
    made = recorder(tmp_path, rotation)
    made.start()
    events = hand_over(made, ticks(0, 10))
    wait_for_part(made, 2)
    events += hand_over(made, ticks(10, 20))
    made.stop({})
    logs = parts_of(tmp_path)
    assert len(logs) >= 2 and list(log_events(logs, Settings())) == events


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_defect_that_ends_the_recording_is_announced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ValueError("a defect")

    made = recorder(tmp_path)
    monkeypatch.setattr(Writer, "event", broken)
    made.start()
    hand_over(made, ticks(0, 10))
    wait_until(lambda: not made._thread.is_alive())
    assert made.degraded and "a defect" in str(made.failure) and made.dropped == 10
    (first, last) = (text for _, text in made.news())
    assert first.startswith("nothing is recorded any more") and "last 10 events" in last
    assert last.endswith("a defect")  # not the disk
    hand_over(made, ticks(10, 20))
    assert (made.dropped, made.queued) == (20, 0)
    made.stop({})
    made._writer.salvage()


@pytest.mark.parametrize("rotation", [Rotation(1.0, None), Rotation(None, 0.5)])
def test_new_part_continues_where_the_previous_ends(tmp_path: Path, rotation: Rotation) -> None:
    made = recorder(tmp_path, rotation)
    made.start()
    events = []
    for number in range(3):
        events += hand_over(made, ticks(100 * number, 100 * (number + 1)))
        if number < 2:
            wait_for_part(made, number + 2)
    made.stop({"digest": "last"})
    logs = parts_of(tmp_path)
    assert len(logs) == 3 and all(log.suffix == ".mcap" for log in logs)
    stories = [read_recording_info(log).part for log in logs]
    assert [part and part.number for part in stories] == [1, 2, 3]
    assert [part and part.continues for part in stories] == ["", logs[0].name, logs[1].name]
    assert len({part and part.run for part in stories}) == 1
    assert list(log_events(logs[::-1], Settings())) == events
    assert list(read_log(logs[1])) == events[100:200]
    assert read_metadata(logs[2])["summary"] == {"digest": "last"}
    assert "summary" not in read_metadata(logs[0])
    assert missing([logs[0], logs[2]]) == [f"{logs[2]}: part 2 of the run is missing"]
    assert missing(logs) == []
    assert missing(logs[:2]) == [f"{logs[1]}: {UNFOLLOWED}"]
    assert made.messages == 300 and made.news() == []
    assert all(a < b for a, b in pairwise(event.t_ns for event in events))
