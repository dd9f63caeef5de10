"""Binary records read by the C header: built by gcc, compared with numpy."""

import contextlib
import select
import socket
import struct
import subprocess
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from c_programs import built
from support import HANG_S, free_port, line_of, started

from companion.node.ring import LARGEST_RECORD, Ring
from companion.values import Beam, BeamSet, Method, Normalisation, UserError
from companion.views import records


@pytest.fixture(scope="module")
def printer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("c"), "gcc", "-std=gnu99", "print_record.c")


@pytest.fixture(scope="module")
def follower(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("cpp"), "g++", "-std=c++11", "follow_ring.cpp")


def beam_set(rng: np.random.Generator, elements: int, beams: int) -> BeamSet:
    """Beams with arbitrary values: the record format does not restrict them."""
    known = iter(rng.normal(size=8 * beams).tolist())
    made = tuple(
        Beam(
            uav=f"{i % 255 + 1}:{rng.integers(1, 255)}",
            azimuth_rad=next(known),
            elevation_rad=next(known),
            range_m=next(known),
            azimuth_rate_radps=next(known) if rng.random() < 0.5 else None,
            elevation_rate_radps=next(known),
            range_rate_mps=None,
            pointing_bound_rad=next(known) if rng.random() < 0.5 else None,
            gain_db=next(known),
            loss_db=0.0,
            group=int(rng.integers(0, 9)),
            widened=bool(rng.random() < 0.5),
        )
        for i in range(beams)
    )
    weights = rng.normal(size=(elements, beams)) + 1j * rng.normal(size=(elements, beams))
    t_ns = int(rng.integers(0, 2**62))
    kind = list(Normalisation)[rng.integers(0, 4)]
    return BeamSet(
        t_ns=t_ns,
        valid_at_ns=t_ns + 7,
        beams=made,
        weights=weights,
        method=Method.MATCHED,
        normalisation=kind,
        condition_number=1.0,
        left_out=(),
    )


def printed(printer: Path, parts: list[bytes]) -> list[list[str]]:
    """Lines of words printed by the C program for each record."""
    fed = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    done = subprocess.run([printer], input=fed, capture_output=True, check=True, timeout=HANG_S)
    return [line.split(" ") for line in done.stdout.decode().splitlines()]


def test_c_reader_reads_a_thousand_records_unchanged(printer: Path) -> None:
    rng = np.random.default_rng(7)
    sets = [beam_set(rng, int(rng.integers(1, 70)), int(rng.integers(0, 9))) for _ in range(1000)]
    sure = [[None if rng.random() < 0.3 else rng.normal() for _ in one.beams] for one in sets]
    made = [b"".join(records.encode(one, n, sure[n])) for n, one in enumerate(sets)]
    lines = iter(printed(printer, made))
    for n, one in enumerate(sets):
        elements, beams = one.weights.shape
        assert next(lines) == ["record", f"{n}", f"{one.valid_at_ns}", f"{elements}", f"{beams}"]
        for i, beam in enumerate(one.beams):
            uav, group, bound, least, *numbers = next(lines)
            assert (uav, int(group)) == (beam.uav, beam.group)
            for said, known in ((bound, beam.pointing_bound_rad), (least, sure[n][i])):
                assert np.isnan(float(said)) if known is None else float(said) == known
            read = np.array(numbers, dtype=np.float32).view(np.complex64)
            np.testing.assert_array_equal(read, one.weights[:, i].astype(np.complex64))
    assert next(lines, None) is None


def test_c_reader_prints_datagrams(printer: Path) -> None:
    rng = np.random.default_rng(5)
    body = b"".join(records.encode(beam_set(rng, 4, 2), 7, [None, None]))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        port = free_port(socket.SOCK_DGRAM)
        with started([printer, str(port)], stdout=subprocess.PIPE, text=True) as process:
            sender.connect(("127.0.0.1", port))
            ends_s = time.monotonic() + HANG_S
            while not select.select([process.stdout], [], [], 0.02)[0]:
                assert time.monotonic() < ends_s
                with contextlib.suppress(ConnectionRefusedError):  # it has not bound the port yet
                    sender.send(body)
            assert line_of(process, process.stdout).split()[:2] == ["record", "7"]


def test_damaged_record_is_rejected_at_every_byte(printer: Path) -> None:
    (whole,) = records.encode(beam_set(np.random.default_rng(1), 5, 2), 3)
    bad = [whole[:i] + bytes([whole[i] ^ 1 << i % 8]) + whole[i + 1 :] for i in range(len(whole))]
    cut = [whole[:i] for i in range(len(whole))]
    said = printed(printer, [*bad, *cut])
    assert len(said) == 2 * len(whole)
    assert {words[0] for words in said} == {"error"}
    assert printed(printer, [whole + b"more"])[0][0] == "record"


def test_record_whose_name_has_no_end_is_rejected(printer: Path) -> None:
    """Its checksum is correct; a program that prints the name would read beyond it."""
    (whole,) = records.encode(beam_set(np.random.default_rng(1), 5, 2), 3)
    at = int(np.frombuffer(whole, records.HEADER, 1)[0]["beams_at"])
    bad = bytearray(whole)
    bad[at : at + records.ID_BYTES] = b"A" * records.ID_BYTES
    bad[16:20] = struct.pack("<I", zlib.crc32(bad[records.CHECKED_FROM :]))
    assert printed(printer, [bytes(bad)])[0][0] == "error"


def test_large_record_is_split_into_complete_parts() -> None:
    one = beam_set(np.random.default_rng(2), 64, 50)
    parts = list(records.encode(one, 4, None, 9000))
    assert len(parts) > 3
    seen, columns = 0, []
    for part in parts:
        head = np.frombuffer(part, records.HEADER, 1)[0]
        assert (head["bytes"], head["all_beams"], head["sequence"]) == (len(part), 50, 4)
        assert head["bytes"] <= 9000
        assert head["first_beam"] == seen
        columns.append(np.frombuffer(part, "<c8", offset=head["weights_at"]).reshape(-1, 64))
        seen += head["beams"]
    np.testing.assert_array_equal(np.concatenate(columns).T, one.weights.astype(np.complex64))
    with pytest.raises(ValueError, match="does not fit"):
        list(records.encode(one, 4, None, 700))


def test_record_layout_has_c_sizes_and_alignment() -> None:
    assert records.HEADER.itemsize == 96
    assert records.BEAM.itemsize == 144
    assert all(offset % min(kind.itemsize, 8) == 0 for kind, offset in layout(records.HEADER))
    assert all(offset % min(kind.itemsize, 8) == 0 for kind, offset in layout(records.BEAM))


def layout(kind: np.dtype[Any]) -> list[tuple[np.dtype[Any], int]]:
    assert kind.fields is not None
    return [(part[0], part[1]) for part in kind.fields.values()]


def follow(follower: Path, ring: Path, write: Any) -> tuple[int, int]:
    """Received and lost records of those that ``write`` puts."""
    with started([follower, ring], stdout=subprocess.PIPE, text=True) as process:
        assert line_of(process, process.stdout) == "open\n"
        write()
        said = process.communicate(timeout=HANG_S)[0].split()
    assert process.returncode == 0
    return int(said[0]), int(said[2])


def test_thousand_updates_per_second_arrive_without_loss(follower: Path, tmp_path: Path) -> None:
    ring = Ring(tmp_path / "ring")
    (record,) = records.encode(beam_set(np.random.default_rng(3), 64, 4), 0)

    def write() -> None:
        due = time.monotonic()
        for _ in range(2000):
            ring.put(record)
            due += 0.001
            time.sleep(max(0.0, due - time.monotonic()))
        ring.close()

    assert follow(follower, tmp_path / "ring", write) == (2000, 0)
    assert not (tmp_path / "ring").exists()


def test_overrun_reader_counts_losses_and_reads_no_torn_record(
    follower: Path, tmp_path: Path
) -> None:
    """At full speed: overwritten records are counted, and received ones are complete."""
    ring, rng = Ring(tmp_path / "ring"), np.random.default_rng(4)
    made = [next(iter(records.encode(beam_set(rng, 60, n), n))) for n in range(1, 9)]
    assert all(len(record) <= LARGEST_RECORD for record in made)

    def write() -> None:
        for n in range(100_000):
            ring.put(made[n % 8])
        ring.close()

    came, lost = follow(follower, tmp_path / "ring", write)
    assert came + lost == 100_000
    assert came > 256


def test_file_that_is_not_a_ring_is_not_overwritten(tmp_path: Path) -> None:
    mine = tmp_path / "thesis.txt"
    mine.write_text("years of work")
    with pytest.raises(UserError, match="is not a ring of records"):
        Ring(mine)
    assert mine.read_text() == "years of work"
    with pytest.raises(UserError, match="No such file"):
        Ring(tmp_path / "nowhere" / "ring")
    ring = Ring(tmp_path / "ring")
    assert [path.name for path in tmp_path.iterdir() if path != mine] == ["ring"]
    ring.close()
