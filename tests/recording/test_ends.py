"""Start and end time of a log, read from its two ends: equal to those of a full read, or
unknown."""

import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.recording.ends import span_ns
from companion.recording.reader import LogError, read_log
from companion.recording.writer import Writer
from companion.values import Event

START_US = 1_760_000_000_000_000


@pytest.fixture
def tlog(tmp_path: Path) -> Path:
    beats = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    path = tmp_path / "flight.tlog"
    with path.open("wb") as file:
        for second in range(2000):
            file.write(struct.pack(">Q", START_US + second * 1_000_000))
            file.write(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(beats))
    return path


@pytest.fixture
def recording(tmp_path: Path, record: Callable[..., list[Event]]) -> Path:
    writer = Writer(
        where=tmp_path / "whole",
        settings_toml="[a]\n",
        versions={"companion": "1"},
        weights_hz=None,
        started_ns=0,
    )
    record(writer, 400, 25, [])
    return writer.close({"digest": "d"})


def test_time_span_equals_that_of_a_full_read(tlog: Path, recording: Path) -> None:
    for path in (tlog, recording):
        times = [event.t_ns for event in read_log(path)]
        assert span_ns([path]) == (min(times), max(times))
    first = START_US * 1000
    assert span_ns([tlog]) == (first, first + 1999 * 1_000_000_000)
    both, parts = span_ns([tlog, recording]), (span_ns([tlog]), span_ns([recording]))
    assert parts[0] is not None
    assert parts[1] is not None
    assert both == (min(parts[0][0], parts[1][0]), max(parts[0][1], parts[1][1]))


@pytest.mark.parametrize("content", [b"", b"\x00", b"\xfd" * 8, bytes(9), b"\x89MCAP0\r\n"])
def test_small_file_has_unknown_time_span(tmp_path: Path, tlog: Path, content: bytes) -> None:
    small = tmp_path / "small"
    small.write_bytes(content)
    assert span_ns([small]) is None
    assert span_ns([tlog, small]) is None


def test_damaged_ends_give_the_full_read_span_or_unknown(
    tmp_path: Path, tlog: Path, recording: Path
) -> None:
    """Any byte of the ends changed or cut: the span is unknown or one that a full read may also
    give."""
    rng = random.Random(5)
    damaged = tmp_path / "damaged"
    for path in (tlog, recording):
        whole, sound = path.read_bytes(), span_ns([path])
        unknown = 0
        for _ in range(600):
            data = bytearray(whole)
            for _ in range(rng.randint(1, 3)):
                data[rng.choice([rng.randrange(64), -rng.randrange(1, 200)])] = rng.randrange(256)
            damaged.write_bytes(bytes(data[: len(data) - rng.choice([0, 0, rng.randrange(100)])]))
            found = span_ns([damaged])
            unknown += found is None
            if path == recording and found is not None:
                assert found == sound
        assert 0 < unknown < 600
    with pytest.raises(OSError, match="gone"):
        span_ns([tmp_path / "gone"])
    with pytest.raises((LogError, OSError)):
        list(read_log(tmp_path / "gone"))
