"""DataFlash: every value against pymavlink's DFReader; damage loses only damaged messages."""

import struct
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.DFReader import DFReader_binary
from support import ROOT, shared_log

from companion.recording.foreign import ardupilot, dataflash
from companion.recording.foreign.dataflash import table, walk
from companion.values import Reason

CUT = (ROOT / "tests" / "data" / "sitl_planes_cut_1.bin").read_bytes()
NAMES = ("ATT", "GPA", "GPS", "PARM", "POS", "SIM", "SIM2", "VER", "XKF1", "XKF4")


def as_bytes(data: bytes) -> dataflash.Bytes:
    return np.frombuffer(data, dtype=np.uint8)


def peers(path: Path, names: tuple[str, ...]) -> dict[str, list[Any]]:
    """The messages as read by pymavlink."""
    reader = DFReader_binary(str(path))
    found: dict[str, list[Any]] = {name: [] for name in names}
    while (message := reader.recv_match(type=list(names))) is not None:
        found[message.get_type()].append(message)
    reader.filehandle.close()
    return found


def require_equal(path: Path) -> Counter[str]:
    """Compare every number of every message and return the number of messages per type."""
    data = as_bytes(path.read_bytes())
    walked = walk(data, NAMES)
    theirs = peers(path, NAMES)
    for name in NAMES:
        ours = table(data, walked, name)
        assert len(ours) == len(theirs[name]), name
        for column in theirs[name][0].get_fieldnames():
            values = [getattr(message, column) for message in theirs[name]]
            if isinstance(values[0], int | float):
                found = ours.numbers(column)
                scale = 1e-7 if column in ("Lat", "Lng") else 1.0
                np.testing.assert_allclose(found * scale, values, rtol=1e-12, err_msg=column)
    return Counter({name: len(messages) for name, messages in theirs.items()})


def test_dataflash_values_equal_dfreader(aeroplane: Path) -> None:
    assert require_equal(aeroplane)["POS"] == 200


@pytest.mark.full
@pytest.mark.parametrize("vehicle", [1, 5])
def test_dataflash_values_of_a_whole_flight_equal_dfreader(vehicle: int) -> None:
    assert require_equal(shared_log(f"sitl_planes_circle_{vehicle}.bin"))["POS"] > 2000


def test_sysid_vehicle_type_and_autopilot_are_read(aeroplane: Path, carrier: Path) -> None:
    one, five = (ardupilot.read(as_bytes(path.read_bytes())) for path in (aeroplane, carrier))
    assert (one.sysid, one.mav_type, one.autopilot) == (1, 1, 3)
    assert (five.sysid, five.mav_type, five.autopilot) == (5, 2, 3)
    assert one.lost == five.lost == {}


def test_position_uses_velocity_of_the_primary_ekf_core(aeroplane: Path) -> None:
    log = ardupilot.read(as_bytes(CUT))
    theirs = peers(aeroplane, ("POS", "XKF1", "XKF4", "ATT"))
    primary = theirs["XKF4"][0].PI
    assert {each.PI for each in theirs["XKF4"]} == {primary}
    states = {each.TimeUS: each for each in theirs["XKF1"] if primary == each.C}
    yaws = {each.TimeUS: each.Yaw for each in theirs["ATT"]}
    assert log.positions is not None
    at = log.positions
    same = 0
    for row, pos in enumerate(theirs["POS"]):
        assert at.boot_us[row] == pos.TimeUS
        assert at.lat_1e7[row] * 1e-7 == pytest.approx(pos.Lat, abs=1e-12)
        assert at.alt_m[row] == pytest.approx(pos.Alt)
        if (state := states.get(pos.TimeUS)) is not None:
            expected = (state.VN, state.VE, state.VD)
            assert at.velocity_ned_mps[row] == pytest.approx(expected, abs=1e-6)
            assert at.heading_deg[row] % 360 == pytest.approx(yaws[pos.TimeUS], abs=1e-6)
            same += 1
    assert same > 190


def test_attitudes_hold_angles_and_matching_rates(aeroplane: Path) -> None:
    log = ardupilot.read(as_bytes(CUT))
    assert log.attitudes is not None
    theirs = peers(aeroplane, ("ATT",))["ATT"]
    for row, att in enumerate(theirs[: len(log.attitudes.boot_us)]):
        assert log.attitudes.boot_us[row] == att.TimeUS
        angles = np.radians([att.Roll, att.Pitch, att.Yaw])
        assert log.attitudes.euler_rad[row] == pytest.approx(angles, abs=1e-9)
    turned_rad = np.diff(np.unwrap(log.attitudes.euler_rad[:, 0]))
    apart_s = np.diff(log.attitudes.boot_us) * 1e-6
    rolled_rad = log.attitudes.rates_radps[:-1, 0] * apart_s
    assert np.corrcoef(turned_rad, rolled_rad)[0, 1] > 0.8


def test_accuracies_are_matched_to_their_fix(aeroplane: Path) -> None:
    log = ardupilot.read(as_bytes(CUT))
    assert log.fixes is not None
    theirs = peers(aeroplane, ("GPA",))["GPA"]
    assert log.fixes.accuracies[:, 0] == pytest.approx([each.HAcc for each in theirs])
    assert np.isnan(log.fixes.accuracies[:, 2]).all()  # 0 is not sent
    assert log.clock is not None and log.clock.fixes == 100
    week_ms = [(each.GWk, each.GMS) for each in peers(aeroplane, ("GPS",))["GPS"]]
    gps_s = 315_964_800 + week_ms[0][0] * 604_800 + week_ms[0][1] * 1e-3 - 18
    had_s = theirs[0].SMS * 1e-3
    assert log.clock.offset_us * 1e-6 == pytest.approx(gps_s - had_s, abs=2e-3)


# --- damage -------------------------------------------------------------------------------------


def messages(data: bytes) -> int:
    walked = walk(as_bytes(data), [each.name for each in walk(as_bytes(CUT), ()).formats.values()])
    return sum(len(at) for at in walked.at.values())


def test_gap_in_dataflash_loses_only_the_removed_messages() -> None:
    whole = messages(CUT)
    data = as_bytes(CUT)
    pos = next(iter(walk(data, ("POS",)).at.values()))
    cut_from = int(pos[50]) + 9  # in the middle of a message
    found = walk(as_bytes(CUT[:cut_from] + CUT[cut_from + 40_000 :]), ("POS",))
    kept = next(iter(found.at.values()))
    assert pos[50] not in kept and set(pos[:50]) <= set(kept)
    assert 0 < found.lost < 200
    assert messages(CUT[:cut_from]) + messages(CUT[cut_from + 40_000 :]) <= whole


@pytest.mark.parametrize("tail", [b"", b"\xa3", b"\xa3\x95", b"\xa3\x95\x80", bytes(300)])
def test_trailing_bytes_lose_at_most_the_last_message(tail: bytes) -> None:
    found = walk(as_bytes(CUT + tail), NAMES)
    whole = walk(as_bytes(CUT), NAMES)
    short = sum(map(len, whole.at.values())) - sum(map(len, found.at.values()))
    assert short == (1 if tail and tail[:2] != b"\xa3\x95" else short)
    assert 0 <= short <= 1
    assert found.lost <= len(tail) + 256


def test_false_header_inside_a_message_is_ignored() -> None:
    data = bytearray(CUT)
    sim = next(iter(walk(as_bytes(CUT), ("SIM",)).at.values()))
    number = data[sim[10] + 2]
    data[sim[10] + 20 : sim[10] + 23] = bytes((0xA3, 0x95, number))
    found = walk(as_bytes(bytes(data)), ("SIM",))
    assert found.at[number].tolist() == sim.tolist()
    assert found.lost == 0


def test_block_size_does_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = walk(as_bytes(CUT), NAMES)
    for block in (1000, 4097, 65_536):
        monkeypatch.setattr(dataflash, "_BLOCK", block)
        found = walk(as_bytes(CUT), NAMES)
        assert found.lost == whole.lost == 0
        assert {k: v.tolist() for k, v in found.at.items()} == {
            k: v.tolist() for k, v in whole.at.items()
        }


def fmt(number: int, length: int, name: bytes, letters: bytes, columns: bytes) -> bytes:
    body = struct.pack("<BB4s16s64s", number, length, name, letters, columns)
    return b"\xa3\x95\x80" + body


def test_inconsistent_format_message_is_rejected_and_counted() -> None:
    head = fmt(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    wrong = [
        fmt(200, 12, b"POS", b"QLL", b"TimeUS,Lat,Lng"),  # longer than its format
        fmt(201, 19, b"POS", b"QLL", b"TimeUS,Lat"),
        fmt(202, 19, b"POS", b"Q?L", b"TimeUS,Lat,Lng"),
        fmt(203, 19, b"POS", b"QLL", b"TimeUS,Lat,Lat"),
        fmt(204, 0, b"POS", b"", b""),
    ]
    found = walk(as_bytes(head + b"".join(wrong)), ("POS",))
    assert found.refused == len(wrong)
    assert set(found.formats) == {128}


def test_invalid_timestamps_are_discarded_and_counted() -> None:
    data = bytearray(CUT)
    pos = next(iter(walk(as_bytes(CUT), ("POS",)).at.values()))
    for row, stamp_us in ((20, 0), (40, 2**63 + 5), (60, 10**15)):
        data[pos[row] + 3 : pos[row] + 11] = stamp_us.to_bytes(8, "little")
    log = ardupilot.read(as_bytes(bytes(data)))
    assert log.positions is not None
    assert len(log.positions.boot_us) == 197
    assert log.lost == {Reason.BAD_STAMP: 3}
    assert np.ptp(log.positions.boot_us) < 21e6


DESCRIBED = CUT.rfind(b"\xa3\x95\x80") + 89
"""Where the descriptions end, without which messages are none."""


@given(st.binary(max_size=400), st.integers(DESCRIBED, len(CUT)))
def test_inserted_garbage_loses_at_most_adjacent_messages(garbage: bytes, at: int) -> None:
    found = walk(as_bytes(CUT[:at] + garbage + CUT[at:]), NAMES)
    lost = len(CUT) + len(garbage)
    whole = messages(CUT)
    assert messages(CUT[:at] + garbage + CUT[at:]) >= whole - 2 - len(garbage) // 3
    assert 0 <= found.lost <= lost


def test_first_of_several_types_with_one_name_counts() -> None:
    head = b"\xa3\x95\x80"
    types = range(200, 240)
    made = b"".join(
        head + struct.pack("<BB4s16s64s", n, 11, b"POS", b"Q", b"TimeUS") for n in types
    )
    made += b"".join(b"\xa3\x95%c" % n + n.to_bytes(8, "little") for n in [*types] * 30)
    walked = walk(as_bytes(made), ("POS",))
    assert {number: len(at) for number, at in walked.at.items()} == {200: 30}
    assert walked.lost == 0
    assert table(as_bytes(made), walked, "POS").numbers("TimeUS").tolist() == [200.0] * 30
