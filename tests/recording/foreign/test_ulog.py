"""ULog: every value against pyulog; damage, nested topics and absurd counts."""

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from support import shared_log
from ulog_support import HEADER, Written, flight, message

from companion.recording.foreign import px4, ulog
from companion.recording.foreign.dataflash import Bytes
from companion.values import Reason


def as_bytes(data: bytes) -> Bytes:
    return np.frombuffer(data, dtype=np.uint8)


def test_ulog_values_equal_pyulog() -> None:
    pyulog = pytest.importorskip("pyulog")
    path = shared_log("px4_sample_small.ulg")
    theirs = pyulog.ULog(str(path))
    data = as_bytes(path.read_bytes())
    names = {topic.name for topic in theirs.data_list}
    walked = ulog.walk(data, names)
    assert walked.lost == 0
    assert len(walked.parameters) == len(theirs.initial_parameters)
    assert {topic.name for topic in walked.topics} >= names - {
        "position_setpoint_triplet",
        "telemetry_status",
    }  # they are nested
    compared = 0
    for topic in walked.topics:
        ours = ulog.UlogTable(data, topic)
        if not len(ours):
            continue
        expected = theirs.get_dataset(topic.name, topic.instance).data
        for column in expected:
            if "[" not in column and "." not in column:
                np.testing.assert_array_equal(ours.numbers(column), expected[column])
                compared += len(ours)
        if topic.name == "vehicle_attitude":
            quaternions = np.stack([expected[f"q[{n}]"] for n in range(4)], axis=1)
            np.testing.assert_array_equal(ours.numbers("q", 4), quaternions)
    assert compared > 80_000


def test_receiver_positions_replace_missing_estimates() -> None:
    pyulog = pytest.importorskip("pyulog")
    path = shared_log("px4_sample_small.ulg")
    theirs = pyulog.ULog(str(path)).get_dataset("vehicle_gps_position").data
    log = px4.read(as_bytes(path.read_bytes()))
    assert (log.sysid, log.compid, log.mav_type, log.autopilot) == (1, 1, 22, 12)
    assert log.positions is not None and log.fixes is not None and log.clock is not None
    np.testing.assert_array_equal(log.positions.lat_1e7, theirs["lat"])
    np.testing.assert_allclose(log.positions.alt_m, theirs["alt"] * 1e-3)
    np.testing.assert_allclose(log.fixes.accuracies[:, 0], theirs["eph"])
    speeds = np.hypot(*log.positions.velocity_ned_mps[:, :2].T)
    np.testing.assert_allclose(speeds, theirs["vel_m_s"], rtol=1e-6)
    apart = theirs["time_utc_usec"].astype(np.int64) - theirs["timestamp"].astype(np.int64)
    assert abs(log.clock.offset_us - int(np.median(apart))) < 100
    assert any("receiver" in note for note in log.notes)


def test_estimates_and_truth_match_the_written_values() -> None:
    log = px4.read(as_bytes(flight().data))
    assert (log.sysid, log.mav_type, log.lost, log.notes) == (7, 2, {}, ())
    assert log.positions is not None and log.truth is not None and log.attitudes is not None
    assert log.positions.velocity_ned_mps == pytest.approx(np.tile((12.0, 0, -1.0), (40, 1)))
    assert log.positions.heading_deg == pytest.approx(np.degrees(0.5), abs=1e-4)
    assert log.positions.lat_1e7[0] == 470_000_000
    assert log.truth.lon_1e7[0] == round((8.0 + 3.0 / 75_834.0) * 1e7)
    assert log.truth.velocity_ned_mps[5:-5, 0] == pytest.approx(12.0, abs=0.05)
    assert log.attitudes.euler_rad == pytest.approx(np.tile((0, 0, 0.5), (40, 1)), abs=1e-6)
    assert log.clock is not None and log.clock.offset_us == 1_700_000_000_000_000


def test_pyulog_reads_what_the_tests_write(tmp_path: Path) -> None:
    pyulog = pytest.importorskip("pyulog")
    (tmp_path / "made.ulg").write_bytes(flight().data)
    theirs = pyulog.ULog(str(tmp_path / "made.ulg"))
    assert len(theirs.get_dataset("vehicle_global_position").data["lat"]) == 40
    assert theirs.initial_parameters["MAV_SYS_ID"] == 7


@pytest.mark.parametrize("size", [1, 7, 300, 3000])
def test_ulog_damage_loses_only_the_damaged_messages(size: int) -> None:
    made = flight(seconds=40)
    at = len(made.data) // 3
    torn = made.data[:at] + b"\xff" * size + made.data[at + size :]
    whole, cut = (ulog.walk(as_bytes(data), px4._WANTED) for data in (made.data, torn))
    kept = sum(len(topic.at) for topic in cut.topics)
    assert whole.lost == 0 and cut.lost <= size + 200
    assert cut.lost or size < 300  # a changed byte inside a sample is undetectable
    assert kept >= sum(len(topic.at) for topic in whole.topics) - size // 20 - 2


def test_data_appended_after_a_crash_are_read() -> None:
    made = flight()
    end = len(made.data)
    torn = made.data[:-7]  # the last message was truncated, and more was appended after it
    late = message(
        "D", struct.pack("<Hddd", 0, 0, 0, 0)[:2] + struct.pack("<Qddf", 9_000_000, 47.5, 8, 500)
    )
    flags = message("B", bytes(8) + b"\x01" + bytes(7) + struct.pack("<3Q", end - 7, 0, 0))
    data = HEADER + flags + torn[len(HEADER) + 43 :] + late
    walked = ulog.walk(as_bytes(data), ("vehicle_global_position",))
    assert len(walked.topics[0].at) == 41


def test_unknown_incompatible_flags_are_rejected() -> None:
    data = HEADER + message("B", bytes(8) + b"\x02" + bytes(31)) + flight().data[59:]
    with pytest.raises(px4.UnknownFlagsError):
        px4.read(as_bytes(data))


@pytest.mark.parametrize(
    "fields",
    [
        "uint64_t timestamp;double[99999] lat;double lon;float alt;",
        "uint64_t timestamp;double[99999999999] lat;",
        "uint64_t timestamp;double[0] x;double lat;double lon;float alt;",
        "vehicle_global_position lat;",  # nested in itself
        "uint64_t timestamp;uint64_t timestamp;",
        "uint64_t timestamp;nothing lat;",
        "",
        ";;;",
    ],
)
def test_invalid_topics_are_rejected_and_counted(fields: str) -> None:
    made = Written()
    made.topic("vehicle_global_position", fields, "Qddf", [(1, 47.0, 8.0, 500.0)] * 3)
    log = px4.read(as_bytes(made.data))
    assert log.positions is None
    assert log.lost[Reason.MALFORMED] >= 1


def test_lone_message_inside_garbage_is_ignored() -> None:
    made = flight()
    false = message("D", struct.pack("<HQddf", 0, 5_000_000, 1.0, 2.0, 3.0))
    torn = made.data[:-1] + b"\xff" * 50 + false + b"\xff" * 50
    walked = ulog.walk(as_bytes(torn), ("vehicle_global_position",))
    assert len(walked.topics[0].at) == 40
    assert walked.lost >= 99 + len(false)  # one byte completes the truncated sample


def test_receiver_without_fix_yields_no_clock() -> None:
    assert px4.read(as_bytes(flight().data)).clock is not None
    assert px4.read(as_bytes(flight(fix_type=2).data)).clock is None


def test_descriptions_beyond_the_limit_are_rejected_and_counted() -> None:
    made = HEADER + message("B", bytes(40))
    topics = [message("F", b"t%d:" % n + b"char a;" * 9000) for n in range(300)]
    walked = ulog.walk(as_bytes(made + b"".join(topics)), ())
    assert 20 < walked.refused < 50  # beyond 16 MB


def test_parameters_beyond_the_limit_are_ignored() -> None:
    made = flight().data
    many = [message("P", b"\x09float %03x" % n + bytes(4)) for n in range(4096)]
    more = [message("P", b"\x0afloat %04x" % n + bytes(4)) for n in range(30_000)]
    walked = ulog.walk(as_bytes(made + b"".join(many + more)), ())
    assert len(walked.parameters) == 20_000 and walked.parameters["MAV_SYS_ID"] == 7


def test_few_instances_of_a_topic_are_indexed() -> None:
    made = Written()
    for _ in range(50):
        made.topic("vehicle_attitude", "uint64_t timestamp;", "Q", [(1,)] * 20)
    walked = ulog.walk(as_bytes(made.data), ("vehicle_attitude",))
    assert [len(topic.at) for topic in walked.topics] == [20] * 4
    assert walked.lost == 0


def test_only_columns_that_are_asked_for_are_copied() -> None:
    """Records may have 64 kB each: all of them are as large as the file."""
    made = Written()
    rows = [(float(n),) for n in range(200)]
    fields = "double timestamp;uint8_t[60000] x;"
    made.topic("vehicle_attitude", fields, "d60000x", rows)
    data = as_bytes(made.data)
    walked = ulog.walk(data, ("vehicle_attitude",))
    tracemalloc.start()
    try:
        found = ulog.table(data, walked, "vehicle_attitude").rows(np.arange(150))
        assert found.numbers("timestamp").tolist() == [*range(150)]
        assert np.isnan(found.numbers("x")).all()  # another width
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 200_000
    assert found.numbers("x", 60_000).shape == (150, 60_000)
