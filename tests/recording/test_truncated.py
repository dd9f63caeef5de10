"""Logs that end early, of every kind: a line, a field of ``--json``, and everything before used."""

import json
import struct
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion.cli.main import main
from companion.recording.recover import recover
from companion.recording.truncated import truncated
from sitl_replay.cli import main as sitl

DATA = Path(__file__).parents[1] / "data"
CSV = "unix_s,lat_deg,lon_deg,alt_m\n" + "".join(
    f"{1_795_000_000 + n / 10:.1f},47.{n:04d},8.5,500\n" for n in range(300)
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """One complete log of each kind, made from one flight."""
    cut_log = DATA / "sitl_4circle_cut.tlog"
    folder = tmp_path_factory.mktemp("whole")
    recording = folder / "flight.mcap"
    words = ["replay", str(cut_log), "--center", "5:1", "--out", str(recording)]
    assert CliRunner().invoke(main, words).exit_code == 0
    tlog = cut_log.read_bytes()
    datagrams = [tlog[at : at + 1000] for at in range(0, 100_000, 1000)]
    return {
        "flight.mcap": recording.read_bytes(),
        "flight.tlog": tlog,
        "net.pcap": pcap(datagrams),
        "net.pcapng": pcapng(datagrams),
        "table.csv": CSV.encode(),
        "flight.bin": (DATA / "sitl_planes_cut_5.bin").read_bytes(),
    }


def udp(payload: bytes) -> bytes:
    head = struct.pack(">BBHHHBBHII", 0x45, 0, 28 + len(payload), 0, 0, 64, 17, 0, 1, 2)
    return head + struct.pack(">HHHH", 14555, 14550, 8 + len(payload), 0) + payload


def pcap(payloads: list[bytes]) -> bytes:
    made = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101)
    for second, payload in enumerate(payloads):
        packet = udp(payload)
        made += struct.pack("<4I", 1_795_000_000 + second, 0, len(packet), len(packet)) + packet
    return made


def pcapng(payloads: list[bytes]) -> bytes:
    made = struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
    made += struct.pack("<IIHHII", 1, 20, 101, 0, 65535, 20)
    for payload in payloads:
        packet = udp(payload)
        padded = packet + bytes(-len(packet) % 4)
        size = 32 + len(padded)
        made += struct.pack("<7I", 6, size, 0, 0, 0, len(packet), len(packet)) + padded
        made += struct.pack("<I", size)
    return made


KINDS = ["flight.mcap", "flight.tlog", "net.pcap", "net.pcapng", "table.csv", "flight.bin"]


@pytest.mark.parametrize("name", KINDS)
def test_cut_log_is_recognised_at_any_byte(
    name: str, whole: dict[str, bytes], tmp_path: Path
) -> None:
    data = whole[name]
    path = tmp_path / name
    end = len(data) - (data.endswith(b"\n"))
    missed = []
    for cut in range(end - 40, end):
        path.write_bytes(data[:cut])
        if not truncated([path]):
            missed.append(cut)
    assert len(missed) <= 1  # a tlog or a capture may end between two records
    path.write_bytes(data)
    assert truncated([path]) == [] or name == "flight.bin"  # that one was cut itself


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("command", ["replay", "export", "sitl-replay"])
def test_cut_log_is_reported_once(
    name: str, command: str, whole: dict[str, bytes], tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(whole[name][: len(whole[name]) * 2 // 3 + 1])
    if command == "sitl-replay":
        words = ["play", str(path), "--to", "udpout:127.0.0.1:9", "--speed", "max"]
        done = CliRunner().invoke(sitl, words)
    else:
        out = ["--no-record"] if command == "replay" else ["--out", str(tmp_path / "tables")]
        done = CliRunner().invoke(main, [command, str(path), *out, "--json"])
        (found,) = json.loads(done.stdout)["truncated"]
        assert found["log"] == name
        assert found["incomplete_bytes"] > 0
    lines = [line for line in done.stderr.splitlines() if "log is truncated" in line]
    assert len(lines) == 1
    assert lines[0].startswith(f"{path}: ")


def test_recording_that_was_never_closed_is_reported(
    whole: dict[str, bytes], tmp_path: Path
) -> None:
    """Cut between two records, as after a power failure."""
    data, at = whole["flight.mcap"], 8
    ends = []
    while at + 9 < len(data):
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        ends.append(at)
    path = tmp_path / "flight.mcap"
    path.write_bytes(data[: ends[len(ends) // 2]])
    (found,) = truncated([path])
    assert found.incomplete_bytes == 0
    assert found.notice().endswith("log is truncated: the file was never closed;"
                                   " everything before is used")  # fmt: skip


def test_recordings_joined_in_one_file_are_reported(
    whole: dict[str, bytes], tmp_path: Path
) -> None:
    """As by ``cat part1 part2``: readers of MCAP end at the first end."""
    path, data = tmp_path / "joined.mcap", whole["flight.mcap"]
    path.write_bytes(data + data)
    (found,) = truncated([path])
    assert (found.incomplete_bytes, found.bytes_after_end) == (0, len(data))
    assert "separate files" in found.notice()
    again = recover(path)
    assert again.lost_bytes == len(data) and again.changed
    assert truncated([again.path]) == []
