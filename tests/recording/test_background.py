"""The recorder's thread: it writes what it is handed, and its failures stay its own."""

from pathlib import Path

import numpy as np

from companion.recording.background import QUEUE_MAX, BackgroundRecorder
from companion.recording.reader import read_log, read_metadata
from companion.recording.writer import Writer
from companion.values import FloatArray, Frame, Source, Tick

RAW = b"\xfe\x00\x00\x01\x01\x00\x00\x00"


def nowhere(positions: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """No local frame is needed here."""
    north, east, down = np.asarray(positions).T
    return north, east, down


def recorder(folder: Path) -> BackgroundRecorder:
    """A recorder on a fresh file."""
    return BackgroundRecorder(Writer(folder, "", {}, None, 1_700_000_000_000_000_000), nowhere)


def test_what_is_put_is_in_the_file_in_order(tmp_path: Path) -> None:
    made = recorder(tmp_path)
    made.start()
    events = [Frame(n, "link", Source(1, 1), 0, RAW) if n % 3 else Tick(n) for n in range(1, 500)]
    for event in events:
        made.put(event, [])
    made.stop({"digest": "abc"})
    (path,) = tmp_path.glob("*.mcap")
    assert list(read_log(path)) == events
    assert read_metadata(path)["summary"] == {"digest": "abc"}
    assert made.dropped == 0
    assert made.failure is None


def test_a_disk_that_fails_ends_the_recording_alone(tmp_path: Path) -> None:
    made = recorder(tmp_path)
    made.writer.event = _disk_full  # type: ignore[method-assign]
    made.start()
    for n in range(100):
        made.put(Tick(n), [])
    made.stop({})
    assert made.failure is not None
    assert "No space left" in made.failure
    assert made.dropped > 0


def _disk_full(_event: object) -> None:
    raise OSError(28, "No space left on device")


def test_a_full_queue_drops_and_counts(tmp_path: Path) -> None:
    made = recorder(tmp_path)
    for n in range(QUEUE_MAX + 7):  # nobody takes them: the thread is not started yet
        made.put(Tick(n), [])
    assert made.dropped == 7
    made.start()
    made.stop({})
    assert made.writer.messages == QUEUE_MAX
