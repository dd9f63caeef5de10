"""Freed memory goes back to the system."""

import subprocess
import sys

import pytest
from support import HANG_S

CODE = """
import re
from pathlib import Path
from companion.node.memory import return_freed_memory

def resident_mb():
    return int(re.search(r"VmRSS:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1e3

{call}
first = b"x" * 1_000_000
del first  # glibc's own threshold grows with the first large block that is freed
before, large, small = resident_mb(), [], []
for number in range(100):
    large.append(bytes([number]) * 600_000)
    small.append(bytes([number]) * 2000)
del large
print(resident_mb() - before)
"""


def kept_mb(call: str) -> float:
    """What stays of 60 MB that were freed between small blocks."""
    command = [sys.executable, "-c", CODE.format(call=call)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANG_S, check=True)
    return float(done.stdout)


def test_large_blocks_between_small_ones_are_returned() -> None:
    if sys.platform != "linux" or kept_mb("") < 30:
        pytest.skip("this system's allocator returns them")
    assert kept_mb("return_freed_memory()") < 5
