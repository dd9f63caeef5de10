"""Samples for the charts: one per second of every UAV, over the last minutes.

An open page collects its own samples; these are for a page that has just been opened.
"""

from collections import deque
from dataclasses import dataclass
from typing import Annotated, Final

from companion.pipeline.fold import Pipeline
from companion.values.described import Meaning, members
from companion.views.as_json import Json, Utc, degrees, rfc3339

EVERY_NS: Final = 1_000_000_000  # least time between two samples
SAMPLES: Final = 300  # samples kept: five minutes
Column = list[float | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class UavHistory:
    """Samples of one UAV, one per time in ``at``; null where a value was unknown."""

    pointing_bound_deg: Annotated[
        Column, Meaning("largest angle between the predicted and the true direction")
    ]
    innovation_m: Annotated[Column, Meaning("distance from the prediction to the newest report")]
    latency_s: Annotated[Column, Meaning("age of the newest report at its arrival")]
    guaranteed_gain_db: Annotated[Column, Meaning("least array gain wherever the UAV can be")]


@dataclass(frozen=True, slots=True)
class History:
    """Samples of the last minutes, one per second, oldest first."""

    valid_at_ns: Annotated[int, Meaning("the instant for which the values hold")]
    at: Annotated[list[str], Meaning("when each sample was taken")]
    uavs: Annotated[dict[str, UavHistory], Meaning("the samples of each UAV")]


FIELDS: Final = tuple(member.name for member in members(UavHistory))
Sample = tuple[int, dict[str, tuple[float | None, ...]]]
"""Sample of an update: its time, ns, and the values of ``FIELDS`` for each UAV."""


class Series:
    """Samples for the charts. ``add`` is called after every tick."""

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=SAMPLES)

    def add(self, pipeline: Pipeline) -> None:
        """Sample the newest update if a sample is due."""
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
                None if found is None else found.guaranteed_gain_db,
            )
        self._samples.append((update.t_ns, sample))

    def samples(self) -> list[Sample]:
        """Return the samples so far, oldest first; they are immutable."""
        return list(self._samples)


def show(samples: list[Sample], now_ns: int, utc_ns: Utc) -> Json:
    """Return the answer of ``/v1/history``, in columns. Runs on any thread."""
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
