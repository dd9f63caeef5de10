"""A day of a changing sky in virtual time: what was known of who is gone takes no memory."""

import gc
import re
from pathlib import Path
from typing import Any

import pytest
from changing_sky import S, day

from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Frame, Tick
from companion.views.last_messages import LastMessages
from companion.views.series import Series

GROWS_MB = 4.0
"""Most that the second half of a day, or of a shorter time, may add: 500 aircraft were there."""


def resident_mb() -> float:
    gc.collect()
    found = re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1000


def flown(hours: int) -> tuple[list[float], Pipeline]:
    """Memory at the end of each hour, MB, of all that a service keeps of its links."""
    settings = Settings().override(center={"source": "5:1"})
    pipeline, series, messages = Pipeline(settings), Series(), LastMessages()
    begins_ns, found = 1_790_000_000 * S, list[float]()
    for event in day(hours, begins_ns=begins_ns):
        if isinstance(event, Frame):
            messages.add(event)
        pipeline.step(event)
        if isinstance(event, Tick):
            series.add(pipeline)
            if (event.t_ns - begins_ns) // (3600 * S) > len(found):
                found.append(resident_mb())
    found.append(resident_mb())
    return found, pipeline


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_a_day_takes_no_more_memory_than_its_morning(table: Any) -> None:
    found, pipeline = flown(24)
    print("MB by the hour:", *(f"{mb:.1f}" for mb in found))
    grown_mb = found[-1] - found[11]
    table.add("memory after 24 h of a changing sky", found[-1], "MB", "flat")
    table.add("of that, since hour 12", grown_mb, "MB", f"< {GROWS_MB:g} MB")
    assert len(pipeline.senders._clocks) < 100
    assert grown_mb < GROWS_MB
