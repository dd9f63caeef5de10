"""pymavlink's generated dialect as the oracle, and recordings to compare with it."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import all as dialect

SHARED = Path(__file__).parents[2].parent / "shared" / "data"
CUT = Path(__file__).parents[1] / "data" / "sitl_4circle_cut.tlog"
_magics = re.compile(b"[\xfd\xfe]").finditer


@pytest.fixture(scope="session")
def cut_log() -> bytes:
    """Return 25 s of five flying vehicles, made by ``tests/data/make_cut.py``."""
    return CUT.read_bytes()


@pytest.fixture(scope="session")
def cut_frames(cut_log: bytes, scan: Callable[[bytes], list[bytes]]) -> list[bytes]:
    """Return the frames of the cut, without their stamps."""
    return scan(cut_log)


@pytest.fixture(scope="session")
def shared_log() -> Callable[[str], bytes]:
    """Return ``shared_log(name)``: a log of other programs; skips if it is missing."""

    def read(name: str) -> bytes:
        path = SHARED / name
        if not path.is_file():
            pytest.skip(f"the shared recording {path} is missing")
        return path.read_bytes()

    return read


@pytest.fixture(scope="session")
def scan() -> Callable[[bytes], list[bytes]]:
    """Return ``scan(data)``: the frames that pymavlink decodes, scanned from left to right.

    A frame is tried at every magic byte outside previous frames. pymavlink passes on unknown ids
    without checking them; those are left out.
    """
    mav = dialect.MAVLink(None)

    def size_at(data: bytes, at: int) -> int:
        v2 = data[at] == 0xFD
        head = data[at : at + (10 if v2 else 6)]
        if len(head) < (10 if v2 else 6) or (v2 and head[2] & ~1):
            return 0
        msgid = int.from_bytes(head[7:10], "little") if v2 else head[5]
        size = head[1] + (12 + 13 * head[2] if v2 else 8)
        if at + size > len(data) or msgid not in dialect.mavlink_map:
            return 0
        try:
            mav.decode(bytearray(data[at : at + size]))
        except dialect.MAVError:
            return 0
        return size

    def run(data: bytes) -> list[bytes]:
        found, free = [], 0
        for magic in _magics(data):
            at = magic.start()
            if at >= free and (size := size_at(data, at)):
                found.append(data[at : at + size])
                free = at + size
        return found

    return run
