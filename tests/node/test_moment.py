"""A log up to a given time, to the nanosecond."""

from itertools import pairwise
from pathlib import Path

import pytest

from companion.node.moment import MomentError, look
from companion.node.replay import log_events
from companion.settings.model import Settings
from companion.values import Frame

SETTINGS = Settings().override(center={"source": "5:1"})


def test_log_position_includes_events_up_to_that_time(cut_log: Path) -> None:
    events = list(log_events([cut_log], SETTINGS))
    begins_ns = events[0].t_ns
    times_ns = [a.t_ns for a, b in pairwise(events) if isinstance(a, Frame) and a.t_ns < b.t_ns]
    for t_ns in (times_ns[0], times_ns[100], events[-1].t_ns):
        at = f"{(t_ns - begins_ns) * 1e-9:.9f}"
        frames = sum(isinstance(event, Frame) and event.t_ns <= t_ns for event in events)
        pipeline, update = look([cut_log], SETTINGS, at)
        assert pipeline.frames == frames
        assert update.t_ns == t_ns


def test_time_after_the_last_event_is_rejected(cut_log: Path) -> None:
    with pytest.raises(MomentError, match="s long"):
        look([cut_log], SETTINGS, "3600")
