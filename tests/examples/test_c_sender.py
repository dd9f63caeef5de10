"""Observations sent by the C header: built by gcc, decoded by the service's decoder."""

import math
import socket
import subprocess
import time
from pathlib import Path

import pytest
from c_programs import built
from support import HANG_S

from companion.values import Observation
from companion.views.observation_records import decode


@pytest.fixture(scope="module")
def sender(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("c"), "gcc", "-std=gnu99", "send_observation.c")


def sent(sender: Path, *arguments: str) -> Observation:
    """Return the observation in the datagram that the program sends."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(HANG_S)
        port = str(receiver.getsockname()[1])
        subprocess.run([sender, port, *arguments], check=True, timeout=HANG_S)
        return decode(receiver.recv(65_536), 1)


def test_c_program_sends_a_direction(sender: Path) -> None:
    before_ns = time.time_ns()
    got = sent(sender, "icao:4CA7B3", "direction", "12.5", "-3", "2")
    assert before_ns <= got.measured_ns <= time.time_ns()
    assert (got.uav, got.time_bound_ns, got.is_direction) == ("icao:4CA7B3", 1_000_000, True)
    angles = got.azimuth_rad, got.elevation_rad, got.bound_rad
    assert angles == pytest.approx([math.radians(12.5), math.radians(-3), math.radians(2)])


@pytest.mark.parametrize(
    ("word", "update"), [("codebook", None), ("5000000000", "wrong"), ("7", 7)]
)
def test_c_program_sends_powers(sender: Path, word: str, update: int | str | None) -> None:
    arguments = ("3:1", "powers", "1.5", word, "0", "-60.5", "65535", "-63")
    if update == "wrong":  # it is sent as given, and the service says what is wrong
        with pytest.raises(ValueError, match="update: is not within"):
            sent(sender, *arguments)
        return
    got = sent(sender, *arguments)
    assert (got.uav, got.update, got.power_bound_db) == ("3:1", update, 1.5)
    assert (got.beams, got.powers_db) == ((0, 65_535), (-60.5, -63.0))


def test_c_program_sends_the_largest_record(sender: Path) -> None:
    pairs = [text for beam in range(256) for text in (str(beam), f"{-beam / 2}")]
    got = sent(sender, "1:1", "powers", "0", "codebook", *pairs)
    assert got.beams == tuple(range(256))
    assert got.powers_db == tuple(-beam / 2 for beam in range(256))


@pytest.mark.parametrize(
    "arguments",
    [("3:1", "direction", "1"), (72 * "x", "direction", "1", "1", "1"),
     ("1:1", "powers", "0", "codebook", *("0", "1") * 257)],
    ids=["incomplete", "long name", "more powers than fit"],
)  # fmt: skip
def test_c_program_sends_nothing_incomplete(sender: Path, arguments: tuple[str, ...]) -> None:
    done = subprocess.run([sender, "9", *arguments], check=False, timeout=HANG_S, stderr=-1)
    assert done.returncode == 1
    assert done.stderr


def test_header_compiles_as_c99_and_cpp11(tmp_path: Path) -> None:
    source = tmp_path / "user.cpp"
    source.write_text(
        '#include "uav_observations.h"\n'
        'static_assert(sizeof(uavo_header) == 160 && sizeof(uavo_reading) == 16, "layout");\n'
        'int main() { uavo_record r; return uavo_begin(&r, "1:1", 0, 0) || '
        "uavo_add_power(&r, 1, 2) || !uavo_direction(&r, 0, 0, 1) || !uavo_powers(&r, 0, 1); }\n"
    )
    out = built(tmp_path, "g++", "-std=c++11", source)
    assert subprocess.run([out], check=False, timeout=HANG_S).returncode == 0
