"""Hostile logs: reading any damaged file ends soon, with events or a one-line error."""

import random
import struct
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from support import HANG_S, ROOT, rounds
from ulog_support import flight

from companion.recording.reader import LogError, read_log
from companion.values import Frame, Rejection

CUT = (ROOT / "tests" / "data" / "sitl_planes_cut_1.bin").read_bytes()
TABLE = b"# sysid = 3\nunix_s,lat_deg,lon_deg,alt_m,vn_mps,ve_mps,vd_mps,roll_deg\n" + b"".join(
    b"%d.5,47.%07d,8.5,500.25,1,2,-3,4\n" % (1_795_000_000 + n, n * 100) for n in range(300)
)
FILES = {"bin": CUT, "ulg": flight(seconds=20).data, "csv": TABLE}
SLOWEST_S = 20.0
"""Far above what any takes here, even on a busy machine: it is for what never ends."""


def damaged(data: bytes, seed: int) -> bytes:
    """Return the file with a few random kinds of damage."""
    rng = random.Random(seed)
    out = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(out)) if out else 0
        size = rng.choice((1, 2, 8, 64, 700, 9000))
        match rng.randrange(8):
            case 0:
                out[at : at + size] = rng.randbytes(size)
            case 1:
                del out[at : at + size]
            case 2:
                out[at:at] = rng.randbytes(size)
            case 3:
                del out[at:]
            case 4:
                out[at:at] = out[at // 2 : at // 2 + size * 4]
            case 5:
                out[at : at + 8] = rng.choice(
                    (b"\xff" * 8, bytes(8), struct.pack("<d", float("nan")))
                )
            case 6:
                out[at : at + 4] = struct.pack("<f", rng.choice((1e38, -1e38, float("inf"))))
            case _:
                for _ in range(size):
                    out[rng.randrange(len(out)) if out else 0 : 0] = b""
                    if out:
                        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def read(path: Path) -> tuple[int, int]:
    """Count of frames and rejections, at monotonic times; (0, 0) for a rejected file."""
    frames = rejections = last_ns = 0
    try:
        for event in read_log(path):
            assert event.t_ns >= last_ns
            last_ns = event.t_ns
            frames += isinstance(event, Frame)
            rejections += isinstance(event, Rejection)
    except LogError as error:
        assert "\n" not in str(error) and str(path) in str(error)
    return frames, rejections


@pytest.mark.parametrize("kind", FILES)
def test_damaged_files_are_read_within_the_time_limit(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"x.{kind}"
    whole = FILES[kind]
    path.write_bytes(whole)
    sound, _ = read(path)
    used = 0
    tried = rounds(40, 120)
    for seed in range(tried):
        path.write_bytes(damaged(whole, seed))
        begin = time.monotonic()
        frames, _ = read(path)
        assert time.monotonic() - begin < SLOWEST_S, seed
        assert frames <= 4 * sound, seed
        used += frames > 0
    assert used > tried / 4  # most damaged files still yield frames


def described(number: int, length: int, name: bytes, letters: bytes, columns: bytes) -> bytes:
    """Description of a type of DataFlash message."""
    return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, length, name, letters, columns)


def many_heads() -> bytes:
    return CUT[:18_000] + b"\xa3\x95\x80" * rounds(50_000, 200_000)


def many_topics() -> bytes:
    made = flight(seconds=1).data
    one = b"A" + struct.pack("<BH", 0, 7) + b"vehicle_global_position"
    return made + (struct.pack("<H", len(one) - 1) + one) * 40_000


def deep_topics() -> bytes:
    head = flight(seconds=1).data[:59]
    lines = [f"t{n}:t{n + 1}[9] x;t{n + 1}[9] y;" for n in range(2000)]
    bodies = [line.encode() for line in lines] + [b"vehicle_global_position:t0 x;"]
    described = b"".join(struct.pack("<HB", len(body), ord("F")) + body for body in bodies)
    asked = struct.pack("<BH", 0, 0) + b"vehicle_global_position"
    return head + described + struct.pack("<HB", len(asked), ord("A")) + asked


def ulog(formats: list[bytes], asked: list[bytes]) -> bytes:
    """ULog with descriptions, and with subscriptions of topics."""
    bodies = [b"F" + each for each in formats]
    bodies += [b"A" + struct.pack("<BH", 0, n & 0xFFFF) + each for n, each in enumerate(asked)]
    return flight(seconds=1).data[:59] + b"".join(
        struct.pack("<H", len(body) - 1) + body for body in bodies
    )


def empty_arrays() -> bytes:
    """Types of no bytes, nested 8 deep and 7 times in each."""
    inner = [b"".join(b"t%d[0] x%d;" % (n + 1, k) for k in range(7)) for n in range(8)]
    formats = [b"t%d:uint8_t b;%b" % (n, each) for n, each in enumerate([*inner, b""])]
    return ulog(formats, [b"t0"])


def invalid_topics() -> bytes:
    """A topic that turns out to be invalid after 9000 fields, subscribed 1000 times."""
    return ulog([b"t:" + b"char a;" * 9000 + b"?"], [b"t"] * 1000)


def wide_topics() -> bytes:
    """A wanted topic of 5000 fields, subscribed 5000 times."""
    name = b"vehicle_global_position"
    return ulog([name + b":" + b"".join(b"char a%d;" % n for n in range(5000))], [name] * 5000)


def noise_behind() -> bytes:
    return flight(seconds=2).data + random.Random(1).randbytes(2_000_000)


def one_line() -> bytes:
    return TABLE + b"1," * 2_000_000


def quotes() -> bytes:
    return TABLE + b'"' * 1_000_000 + b"\n"


@pytest.mark.parametrize(
    "make",
    [
        many_heads,
        many_topics,
        deep_topics,
        empty_arrays,
        invalid_topics,
        wide_topics,
        noise_behind,
        one_line,
        quotes,
    ],
)
def test_absurd_files_are_read_in_bounded_time_and_memory(
    make: Callable[[], bytes], tmp_path: Path
) -> None:
    data = make()
    path = tmp_path / "absurd"
    path.write_bytes(data)
    tracemalloc.start()
    begin = time.monotonic()
    try:
        read(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert time.monotonic() - begin < SLOWEST_S
    assert peak < 60_000_000 + 8 * len(data)


def alternating(name: bytes, columns: bytes, layout: str, value: Callable[[int], int]) -> bytes:
    """DataFlash log of positions and messages of another kind: a time and a value."""
    head = described(1, 27, b"POS", b"QLLff", b"TimeUS,Lat,Lng,Alt,RelHomeAlt")
    made = struct.Struct(f"<Q{layout}")
    head += described(2, 3 + made.size, name, f"Q{layout}".encode(), columns)
    place = struct.pack("<iiff", 473977419, 85455938, 488.0, 10.0)
    return head + b"".join(
        b"\xa3\x95\1%b%b\xa3\x95\2%b"
        % ((n * 1_000_000).to_bytes(8, "little"), place, made.pack(n * 1_000_000, value(n)))
        for n in range(200_000)
    )


def armings() -> bytes:
    """As many changes of the arming state as heartbeats."""
    return alternating(b"ARM", b"TimeUS,ArmState", "B", lambda n: n & 1)


def cores() -> bytes:
    """Each sample is of another core of the estimator."""
    return alternating(b"XKF1", b"TimeUS,C", "I", lambda n: n)


@pytest.mark.parametrize("make", [armings, cores])
def test_reading_takes_time_linear_in_the_samples(
    make: Callable[[], bytes], tmp_path: Path
) -> None:
    path = tmp_path / "x.bin"
    path.write_bytes(make())
    begin = time.monotonic()
    first = next(read_log(path))
    assert isinstance(first, Frame)
    assert time.monotonic() - begin < SLOWEST_S


# --- huge sample counts ---------------------------------------------------------------------------

MOST_MB = 300
"""Memory in which any log is read, the program's own 70 MB and the file's pages included."""
MANY = 1_500_000
_READ = r"""
import re, sys
from pathlib import Path
from companion.recording.reader import read_log
frames = sum(1 for _ in read_log(sys.argv[1]))
peak_kb = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]
print(frames, int(peak_kb) // 1000)
"""


def many_lines() -> bytes:
    return b"t_s,lat_deg,lon_deg,alt_m\n" + b"".join(
        b"%d,47,8,1\n" % (n // 10) for n in range(MANY)
    )


def many_messages() -> bytes:
    head = described(65, 23, b"ATT", b"Qfff", b"TimeUS,Roll,Pitch,Yaw")
    head += described(66, 23, b"POS", b"QLLf", b"TimeUS,Lat,Lng,Alt")
    place = struct.pack("<iif", 473977419, 85455938, 488.0)
    turned = struct.pack("<fff", 1.0, 2.0, 3.0)
    return head + b"".join(
        b"\xa3\x95%c%b%b"
        % (65 + n % 2, (1000 + n * 20).to_bytes(8, "little"), (turned, place)[n % 2])
        for n in range(MANY)
    )


def many_samples() -> bytes:
    """Of the first topic that a flight describes."""
    body = struct.pack("<ddf", 47.0, 8.0, 500.0)
    return flight(seconds=10).data + b"".join(
        b"\x1e\x00D\x00\x00" + (20_000_000 + n * 100).to_bytes(8, "little") + body
        for n in range(MANY)
    )


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "made"), [("a.csv", many_lines), ("a.bin", many_messages), ("a.ulg", many_samples)]
)
def test_huge_sample_counts_are_read_in_bounded_memory(
    tmp_path: Path, name: str, made: Callable[[], bytes]
) -> None:
    """Every n-th sample is read: all of them would take 1.5 GB."""
    path = tmp_path / name
    path.write_bytes(made())
    command = [sys.executable, "-c", _READ, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANG_S)
    assert done.returncode == 0, done.stderr
    frames, peak_mb = map(int, done.stdout.split())
    assert frames > 90_000
    assert peak_mb < MOST_MB
