"""Recordings are read back in order by this program and by any MCAP reader."""

import fcntl
import gc
import os
import resource
import struct
import weakref
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import HealthCheck, given
from hypothesis import settings as run_with
from hypothesis import strategies as st
from mcap.reader import make_reader
from observed import OBSERVATIONS
from support import read_metadata

from companion.recording import writer
from companion.recording.reader import log_kind, read_log, read_settings
from companion.recording.recover import recover
from companion.recording.writer import Writer
from companion.values import Estimate, Event, Frame, Observation, Rejection, Source, Tick, Update

START_NS = 1_700_000_000_000_000_000
Record = Callable[..., list[Event]]


def open_writer(where: Path, weights_hz: float | None = None) -> Writer:
    return Writer(
        where=where,
        settings_toml="[beams]\nlead_s = 0.1\n",
        versions={"companion": "1"},
        weights_hz=weights_hz,
        started_ns=START_NS,
    )


def decode_all(path: Path) -> list[tuple[str, Any, Any]]:
    """(topic, MCAP message, decoded message) in file order, decoded by the file's own schemas
    only."""
    classes: dict[int, Any] = {}
    found = []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None and schema.encoding == channel.message_encoding == "protobuf"
            if schema.id not in classes:
                pool = DescriptorPool()
                for described in FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(described)
                classes[schema.id] = GetMessageClass(pool.FindMessageTypeByName(schema.name))
            found.append((channel.topic, message, classes[schema.id].FromString(message.data)))
    return found


def test_written_events_are_read_back_unchanged(tmp_path: Path, record: Record) -> None:
    """Links, equal times and backward steps are kept; outputs are not read as events."""
    writer = open_writer(tmp_path)
    driven = record(writer, 500, flush_every=37)
    path = writer.close({})
    assert log_kind(path) == "mcap"
    assert list(read_log(path)) == driven


@run_with(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(observations=st.lists(OBSERVATIONS, max_size=5))
def test_any_observation_is_read_back_unchanged(
    tmp_path: Path, observations: list[Observation]
) -> None:
    writer, begins = open_writer(tmp_path), Tick(1)
    for event in (begins, *observations):
        writer.event(event)
    path = writer.close({})
    assert list(read_log(path)) == [begins, *observations]
    path.unlink()


@pytest.mark.parametrize(
    "end",
    [lambda one: one.close({}), Writer.salvage, Writer.abandon],
    ids=["close", "salvage", "abandon"],
)
def test_finished_writer_is_freed_without_garbage_collection(
    tmp_path: Path, record: Record, end: Callable[[Writer], object]
) -> None:
    """Regression: 1.5 MB per file stayed, as full garbage collections are rare in the service."""
    gc.disable()
    try:
        writer = open_writer(tmp_path)
        record(writer, 10)
        writer.flush()
        end(writer)
        left = weakref.ref(writer)
        del writer
        assert left() is None
    finally:
        gc.enable()


def test_file_has_its_name_settings_and_metadata(tmp_path: Path, record: Record) -> None:
    writer = open_writer(tmp_path / "new folder")
    assert writer.path.name == "companion-20231114T221320Z.mcap.active"
    assert writer.path.exists()
    record(writer, 10)
    path = writer.close({"digest": "d1"})
    assert path == writer.path == tmp_path / "new folder" / "companion-20231114T221320Z.mcap"
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    assert read_settings(path) == ("[beams]\nlead_s = 0.1\n", {})
    assert read_metadata(path) == {"versions": {"companion": "1"}, "summary": {"digest": "d1"}}
    assert writer.close({}) == path
    assert writer.size_bytes == path.stat().st_size


def test_writer_overwrites_no_file_in_a_folder(tmp_path: Path) -> None:
    first, second = open_writer(tmp_path), open_writer(tmp_path)
    second_path, first_path = second.close({}), first.close({})
    third = open_writer(tmp_path)
    stem = "companion-20231114T221320Z"
    assert third.path.name == f"{stem}-2.mcap.active"
    third_path = third.close({})
    assert [first_path.name, second_path.name, third_path.name] == [
        f"{stem}.mcap",
        f"{stem}-1.mcap",
        f"{stem}-2.mcap",
    ]


def test_explicitly_named_file_is_replaced_on_close(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    path.write_bytes(b"what was there before")
    writer = open_writer(path)
    assert path.read_bytes() == b"what was there before"
    with pytest.raises(BlockingIOError):
        open_writer(path)  # which does not truncate the first file
    writer.event(Tick(5))
    assert writer.close({}) == path
    assert list(read_log(path)) == [Tick(5)]


def test_flush_syncs_the_file_to_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A power failure cannot be tested; the sync requests to the system can."""
    writer = open_writer(tmp_path)
    synced: list[int] = []
    monkeypatch.setattr(
        "companion.recording.writer.os.fsync", lambda fd: synced.append(os.fstat(fd).st_size)
    )
    writer.event(Tick(5))
    writer.flush()
    assert synced == [writer.path.stat().st_size] == [writer.size_bytes]
    size = writer.close({}).stat().st_size
    assert synced[1] == size and len(synced) == 3  # the last sync is the folder's, for the new name


def test_writer_left_unclosed_keeps_the_active_name(tmp_path: Path, record: Record) -> None:
    with open_writer(tmp_path) as writer:
        driven = record(writer, 20)
        writer.flush()
    assert writer.path.name.endswith(".mcap.active")
    assert list(read_log(writer.path)) == driven


def test_every_channel_decodes_from_the_file_alone(tmp_path: Path, record: Record) -> None:
    writer = open_writer(tmp_path)
    driven = record(writer, 120)
    found = decode_all(writer.close({}))
    assert {topic: type(message).DESCRIPTOR.full_name for topic, _, message in found} == {
        "/mavlink/frames": "companion.Frame",
        "/ticks": "companion.Tick",
        "/rejections": "companion.Rejection",
        "/timesync": "companion.RoundTrip",
        "/observations": "companion.Observation",
        "/uav/1:1/fix": "foxglove.LocationFix",
        "/uav/1:1/predicted": "foxglove.LocationFix",
        "/uav/icao:4CA7B3/predicted": "foxglove.LocationFix",
        "/tracks": "companion.Track",
        "/beams/weights": "companion.Weights",
        "/log": "foxglove.Log",
    }
    counts = Counter(topic for topic, _, _ in found)
    assert counts["/mavlink/frames"] == sum(isinstance(event, Frame) for event in driven)
    by_pipeline = Counter(m.is_event for topic, _, m in found if topic == "/rejections")
    assert by_pipeline[True] == sum(isinstance(event, Rejection) for event in driven)
    assert by_pipeline[False] == len(driven) // 3  # and no topic above occurs twice
    assert [message.sequence for _, message, _ in found] == list(range(len(found)))
    frames = [(raw.log_time, message.t_ns) for topic, raw, message in found if "frames" in topic]
    assert frames == [(event.t_ns, event.t_ns) for event in driven if isinstance(event, Frame)]


def test_fix_and_prediction_have_positions_and_covariances(tmp_path: Path, record: Record) -> None:
    writer = open_writer(tmp_path)
    record(writer, 30)
    found = {topic: (raw, message) for topic, raw, message in decode_all(writer.close({}))}
    raw, fix = found["/uav/1:1/fix"]
    assert (raw.log_time, fix.latitude, fix.longitude) == (START_NS, 47.5, 8.5)
    assert fix.timestamp.ToNanoseconds() == START_NS - 100_000_000
    assert fix.altitude == 321.5
    raw, predicted = found["/uav/icao:4CA7B3/predicted"]
    assert (predicted.latitude, predicted.longitude) == pytest.approx((47.0001, 8.0002), abs=1e-12)
    assert predicted.altitude == 30.0
    assert predicted.timestamp.ToNanoseconds() == raw.log_time + 5
    covariance = np.array(predicted.position_covariance).reshape(3, 3)
    track = found["/tracks"][1]
    # Mean squares allowed by the bounds: half of the horizontal one on each axis of the plane.
    plane, height = track.horizontal_bound_m**2 / 2, track.vertical_bound_m**2
    assert covariance == pytest.approx(np.diag([plane, plane, height]))
    assert predicted.position_covariance_type == predicted.APPROXIMATED


def test_unknown_values_are_unset_not_zero(tmp_path: Path, record: Record) -> None:
    writer = open_writer(tmp_path)
    record(writer, 30)
    found = {topic: message for topic, _, message in decode_all(writer.close({}))}
    track = found["/tracks"]
    assert not track.HasField("latency_s") and not list(track.velocity_ned_mps)
    assert track.HasField("innovation_m") and track.innovation_m == 0.0
    assert list(track.unknown_input_mps) == [0.1, 0.2, 0.3]
    assert (track.state, track.reports, track.dt_s) == ("live", 7, 0.1)
    beams = found["/beams/weights"].beam
    assert not beams[0].HasField("pointing_bound_rad") and beams[1].pointing_bound_rad == 0.02
    assert not found["/rejections"].HasField("msgid")
    assert found["/log"].level == found["/log"].WARNING
    assert (found["/log"].name, found["/log"].message) == ("1:1", "1:1 is stale")


def test_weights_are_row_major_complex64(
    tmp_path: Path, record: Record, update: Callable[[int], Update]
) -> None:
    writer = open_writer(tmp_path)
    record(writer, 10)
    message = {topic: m for topic, _, m in decode_all(writer.close({}))}["/beams/weights"]
    numbers = struct.unpack("<16f", message.weights_complex64)
    expected = update(0).beams.weights
    assert (message.elements, list(message.uavs)) == (4, ["1:1", "icao:4CA7B3"])
    assert complex(numbers[2], numbers[3]) == expected[0, 1]
    assert complex(numbers[4], numbers[5]) == expected[1, 0]
    assert (message.method, message.condition_number) == ("zf", 1.5)
    assert message.normalisation == "stream"
    assert [(beam.loss_db, beam.group, beam.widened) for beam in message.beam] == [
        (0.1, 0, False),
        (0.6, 1, True),
    ]
    assert [(out.uav, out.reason) for out in message.left_out] == [("9:1", "behind the array")]


@pytest.mark.parametrize(
    ("weights_hz", "step_ms", "count", "kept"),
    [
        (None, 1, 50, 50),
        (10.0, 20, 500, 100),  # 10 s of updates at 50 Hz
        (10.0, 100, 100, 100),  # at exactly the given rate: none is lost to rounding
        (10.0, 1000, 20, 20),
        (30.0, 1, 1001, 31),
    ],
)
def test_weights_are_thinned_by_update_time(
    *,
    tmp_path: Path,
    update: Callable[[int], Update],
    geodetic: Any,
    weights_hz: float | None,
    step_ms: int,
    count: int,
    kept: int,
) -> None:
    writer = open_writer(tmp_path, weights_hz)
    for number in range(count):
        writer.output(update(START_NS + number * step_ms * 1_000_000), geodetic)
    counts = Counter(topic for topic, _, _ in decode_all(writer.close({})))
    assert counts["/beams/weights"] == kept
    assert counts["/tracks"] == 2 * kept


def test_backward_clock_step_does_not_suppress_weights(
    tmp_path: Path, update: Callable[[int], Update], geodetic: Any
) -> None:
    writer = open_writer(tmp_path, 10.0)
    for t_ns in (START_NS, START_NS - 3_600_000_000_000, START_NS - 3_599_000_000_000):
        writer.output(update(t_ns), geodetic)
    counts = Counter(topic for topic, _, _ in decode_all(writer.close({})))
    assert counts["/beams/weights"] == 3


def test_recording_of_a_replay_equals_the_original(tmp_path: Path, record: Record) -> None:
    """Replay of a replay: the second generation equals the first."""
    writer = open_writer(tmp_path)
    driven = record(writer, 50)
    again = open_writer(tmp_path / "again.mcap")
    for event in read_log(writer.close({})):
        again.event(event)
    assert list(read_log(again.close({}))) == driven


def test_chunk_size_is_limited(tmp_path: Path) -> None:
    writer = open_writer(tmp_path)
    noise = np.random.default_rng(1)
    frames = [
        Frame(
            t_ns=number,
            link="udp",
            source=Source(1, 1),
            msgid=0,
            raw=b"\xfd\xff\1" + noise.bytes(277),
        )
        for number in range(12_000)
    ]
    for frame in frames:
        writer.event(frame)
    path = writer.close({})
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) >= 3
    assert list(read_log(path)) == frames


@pytest.mark.benchmark
def test_six_minutes_of_traffic_are_written_within_four_seconds(
    tmp_path: Path, events: Callable[[int], list[Event]], estimate: Estimate, geodetic: Any,
    update: Callable[[int], Update],
) -> None:  # fmt: skip
    """117 000 frames, 17 000 fixes, 15 000 predictions; the limit is doubled for a busy machine."""
    driven = events(117_000)
    updates = [update(START_NS + number) for number in range(7_500)]
    writer = open_writer(tmp_path)
    began_s = perf_counter()
    for number, event in enumerate(driven):
        writer.event(event)
        if number % 7 == 0:
            writer.output(estimate, geodetic)
        if number % 18 == 0 and updates:
            writer.output(updates.pop(), geodetic)
    writer.close({})
    took_s = perf_counter() - began_s
    print(f"{writer.messages} messages in {took_s:.2f} s")
    assert took_s < 4.0


def test_salvaged_file_ends_at_the_last_flush(tmp_path: Path) -> None:
    """A chunk written to disk since the last flush is removed: it is written to the next file."""
    writer = open_writer(tmp_path)
    noise = np.random.default_rng(1)
    writer.event(Tick(5))
    writer.flush()
    for number in range(12_000):
        writer.event(
            Frame(t_ns=number, link="udp", source=Source(1, 1), msgid=0, raw=noise.bytes(280))
        )
    assert writer.path.stat().st_size > 2 << 20
    assert writer.salvage()
    assert list(read_log(writer.path)) == [Tick(5)]
    assert writer.path.stat().st_size == writer.size_bytes
    empty = open_writer(tmp_path / "empty")
    assert empty.salvage() and list(empty.path.parent.iterdir()) == []


def test_file_without_messages_is_removed_also_while_no_descriptor_is_free(tmp_path: Path) -> None:
    """It would count as a second part with its number: the run could not be replayed."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    empty, kept = open_writer(tmp_path / "empty"), open_writer(tmp_path / "kept")
    kept.event(Tick(5))
    kept.flush()
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
        assert empty.salvage() and not kept.salvage()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert not empty.path.exists() and list(read_log(kept.path)) == [Tick(5)]


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077])
def test_recordings_are_not_world_readable(tmp_path: Path, umask: int) -> None:
    """Recordings, recovered files and new folders are accessible to the owner and group only."""
    before = os.umask(umask)
    try:
        folder = tmp_path / "recordings"
        with Writer(
            where=folder, settings_toml="", versions={}, weights_hz=None, started_ns=0
        ) as writer:
            opened = writer.path.stat().st_mode & 0o777
            kept = writer.close({})
        (folder / "torn.mcap.active").write_bytes(kept.read_bytes()[:-20])
        recovered = recover(folder / "torn.mcap.active").path
    finally:
        os.umask(before)
    wanted = [0o750, 0o640, 0o640, 0o640]
    found = [folder.stat().st_mode & 0o777, opened]
    found += [file.stat().st_mode & 0o777 for file in (kept, recovered)]
    assert found == [mode & ~umask for mode in wanted]


def test_file_that_was_renamed_before_it_is_locked_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process finished it in between."""
    active, whole = tmp_path / "x.active", tmp_path / "x"
    active.write_bytes(b"finished")
    lock = fcntl.flock

    def late_lock(*args: Any) -> None:
        if not whole.exists():
            active.rename(whole)
        lock(*args)

    monkeypatch.setattr(writer.fcntl, "flock", late_lock)
    with writer.open_alone(active) as file:
        file.write(b"new")
    assert (whole.read_bytes(), active.read_bytes()) == (b"finished", b"new")


def test_pipe_in_place_of_a_file_is_an_error(tmp_path: Path) -> None:
    """Opening it would wait for a reader."""
    os.mkfifo(tmp_path / "x.active")
    with pytest.raises(OSError, match="is a pipe, not a file"):
        writer.open_alone(tmp_path / "x.active")
