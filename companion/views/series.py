"""What the charts show of the last minutes: a sample of every UAV each second.

The page keeps its own minutes; these are for a page that has just been opened.
"""

from collections import deque
from collections.abc import Callable
from typing import Any, Final

from companion.pipeline.fold import Pipeline
from companion.values import UtcNs
from companion.views.words import degrees, rfc3339

Json = dict[str, Any]
EVERY_NS: Final = 1_000_000_000
"""Least time between two samples."""
SAMPLES: Final = 300
"""Samples kept: five minutes."""
FIELDS: Final = ("pointing_bound_deg", "innovation_m", "latency_s", "guaranteed_gain_db")
"""What is kept of each UAV."""


Sample = tuple[int, dict[str, tuple[float | None, ...]]]
"""The time of an update, ns, and what is kept of each UAV."""


class Series:
    """The samples. ``add`` is called after every tick."""

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=SAMPLES)

    def add(self, pipeline: Pipeline) -> None:
        """Take a sample of the newest update, if it is time."""
        update = pipeline.last_update
        if update is None or (self._samples and 0 <= update.t_ns - self._samples[-1][0] < EVERY_NS):
            return
        bounds = {beam.uav: beam.pointing_bound_rad for beam in update.beams.beams}
        verdicts = pipeline.health.verdicts
        sample = dict[str, tuple[float | None, ...]]()
        for track in update.tracks:
            found = verdicts.get(track.uav)
            sample[track.uav] = (
                degrees(bounds.get(track.uav)),
                track.innovation_m,
                track.latency_s,
                None if found is None else found.guaranteed_db,
            )
        self._samples.append((update.t_ns, sample))

    def samples(self) -> list[Sample]:
        """The samples so far, the oldest first; they no longer change."""
        return list(self._samples)


def show(samples: list[Sample], now_ns: int, utc_ns: Callable[[int], UtcNs]) -> Json:
    """The answer of ``/v1/history``: columns. May run on any thread."""
    uavs = dict.fromkeys(uav for _, sample in samples for uav in sample)
    nothing = (None,) * len(FIELDS)
    return {
        "valid_at": rfc3339(utc_ns(now_ns)),
        "at": [rfc3339(utc_ns(t_ns)) for t_ns, _ in samples],
        "uavs": {
            uav: {
                name: [sample.get(uav, nothing)[i] for _, sample in samples]
                for i, name in enumerate(FIELDS)
            }
            for uav in uavs
        },
    }
