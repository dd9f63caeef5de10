"""The GNU Radio example: samples through real flowgraphs, against numpy."""

import shutil
import socket
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from support import HANG_S, ROOT, line_of, started

from companion.values import Beam, BeamSet, ComplexArray, Method, Normalisation
from companion.views import records

PYTHON = shutil.which("python3", path="/usr/bin")
"""Debian's own, for which GNU Radio is built there."""
FOLDER = ROOT / "examples" / "gnuradio"
COUNT = 4000


@pytest.fixture(scope="module")
def python() -> str:
    """A Python interpreter with GNU Radio."""
    known = PYTHON and subprocess.run(
        [PYTHON, "-c", "import gnuradio.blocks"], capture_output=True, check=False, timeout=HANG_S
    )
    if not PYTHON or not known or known.returncode:
        pytest.skip("no GNU Radio on this machine")
    return PYTHON


def record(number: int, uavs: list[str], weights: ComplexArray) -> bytes:
    beams = tuple(
        Beam(
            uav=uav,
            azimuth_rad=0.0,
            elevation_rad=0.0,
            range_m=1.0,
            azimuth_rate_radps=None,
            elevation_rate_radps=None,
            range_rate_mps=None,
            pointing_bound_rad=None,
            gain_db=0.0,
            loss_db=0.0,
            group=0,
        )
        for uav in uavs
    )
    made = BeamSet(
        t_ns=0,
        valid_at_ns=0,
        beams=beams,
        weights=weights,
        method=Method.MATCHED,
        normalisation=Normalisation.STREAM,
        condition_number=1.0,
        left_out=(),
    )
    return next(records.encode(made, number))


def noise(rng: np.random.Generator, rows: int, columns: int) -> ComplexArray:
    parts = rng.normal(size=(2, rows, columns))
    made: ComplexArray = (parts[0] + 1j * parts[1]).astype(np.complex64)
    return made


@pytest.mark.full
@pytest.mark.parametrize("uavs", [["1:1", "icao:4CA7B3"], ["2:1"]])
def test_streams_use_the_newest_weights(python: str, tmp_path: Path, uavs: list[str]) -> None:
    """Weights change between sample blocks; damaged and foreign records have no effect."""
    rng, elements = np.random.default_rng(3), 8
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [python, FOLDER / "transmit.py", str(port), str(elements), *uavs]
    pipe = subprocess.PIPE
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as says,
        started(command, stdin=pipe, stdout=pipe, stderr=pipe) as process,
    ):
        says.connect(("127.0.0.1", port))
        while line_of(process, process.stderr) != b"open\n":
            pass
        assert process.stdin
        assert process.stdout

        def through(samples: ComplexArray) -> ComplexArray:
            """The samples of all elements, (M, n), from those of all UAVs, (N, n)."""
            process.stdin.write(samples.T.astype(np.complex64).tobytes())
            process.stdin.flush()
            found = process.stdout.read(8 * elements * samples.shape[1])
            return np.frombuffer(found, np.complex64).reshape(-1, elements).T

        silent = through(noise(rng, len(uavs), COUNT))
        assert not silent.any()  # no record yet
        for number in range(5):
            weights = noise(rng, elements, len(uavs) + 1)
            whole = record(number, ["9:9", *uavs], weights)
            says.send(whole)
            bad = bytearray(record(99, ["9:9", *uavs], 2 * weights))
            bad[-1] ^= 1
            for other in (bytes(bad), b"hello", whole[:-8], record(99, uavs, weights[:4, 1:])):
                says.send(other)
            samples = noise(rng, len(uavs), COUNT)
            got, wanted = through(samples), weights[:, 1:].astype(np.complex128) @ samples
            assert np.abs(got - wanted).max() < 1e-6 * np.abs(wanted).max()
        says.send(record(5, ["9:9"], noise(rng, elements, 1)))
        assert not through(noise(rng, len(uavs), COUNT)).any()  # no own UAV has a beam
        process.stdin.close()
        assert process.stdout.read() == b""
        assert process.wait(HANG_S) == 0


def test_invalid_and_late_records_are_ignored() -> None:
    """Also with a correct checksum. Only the block's own code runs: GNU Radio has a stand-in."""
    weights = noise(np.random.default_rng(1), 2, 1)
    at = records.HEADER.fields
    assert at is not None

    def changed(**values: int) -> bytes:
        bad = bytearray(record(12, ["1:1"], weights))
        for name, value in values.items():
            struct.pack_into("<I", bad, at[name][1], value)
        struct.pack_into("<I", bad, 16, zlib.crc32(bad[records.CHECKED_FROM :]))
        return bytes(bad)

    ignored = [
        changed(weights_at=1 << 30), changed(beams=1 << 31), changed(beam_bytes=1 << 31),
        record(12, ["1:1"], np.full((2, 1), np.nan + 0j)), record(9, ["1:1"], 2 * weights),
    ]  # fmt: skip
    sent = [record(10, ["1:1"], weights), *ignored, record(11, ["1:1"], 3 * weights)]
    done = subprocess.run(
        [sys.executable, "-c", TAKEN, str(FOLDER), *(one.hex() for one in sent)],
        capture_output=True,
        text=True,
        check=False,
        timeout=HANG_S,
    )
    first = float(weights[0, 0].real)
    assert [float(one) for one in done.stdout.split()] == pytest.approx(
        [first] * 6 + [3 * first]
    ), done.stderr


TAKEN = """
import sys, types
base = type("sync_block", (), {"__init__": lambda self, *_: None})
sys.modules["gnuradio"] = types.SimpleNamespace(gr=types.SimpleNamespace(sync_block=base))
sys.path.insert(0, sys.argv[1])
from uav_beams import Beams
block = Beams(["1:1"], 2, 0)
for one in sys.argv[2:]:
    block._take(bytes.fromhex(one))
    print(block._weights[0, 0].real)
"""


@pytest.mark.full
def test_outdated_weights_mute_the_output(python: str) -> None:
    """In GNU Radio's own process: a block without new records is muted, and resumes."""
    weights = noise(np.random.default_rng(1), 2, 1)
    first, second = (record(n, ["1:1"], weights).hex() for n in (1, 2))
    done = subprocess.run(
        [python, "-c", STALE, str(FOLDER), first, second],
        capture_output=True,
        text=True,
        check=False,
        timeout=HANG_S,
    )
    assert done.stdout.split() == ["True", "False", "True"], done.stderr


STALE = """
import sys, time
import numpy as np
sys.path.insert(0, sys.argv[1])
from uav_beams import Beams
block = Beams(["1:1"], 2, 0, stale_s=10.0)
def sends():
    out = [np.zeros(4, np.complex64) for _ in range(2)]
    block.work([np.ones(4, np.complex64)], out)
    return all(one.any() for one in out)
now = 100.0
time.monotonic = lambda: now
block._take(bytes.fromhex(sys.argv[2]))
print(sends())
now = 111.0
print(sends())
block._take(bytes.fromhex(sys.argv[3]))
print(sends())
"""
