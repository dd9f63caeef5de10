"""Samples of the last minutes, for looking back: one per second of every UAV.

An open page collects its own samples; these are for a page that has just been opened.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np

from companion.pipeline.fold import Pipeline
from companion.tracking.geodesy import LocalFrame, Place
from companion.values import Beam, Blame, FloatArray, Track, Update, Verdict
from companion.values.described import Meaning, meaning, members
from companion.views.as_json import COORDINATE_DIGITS, DIGITS, Json, Utc, degrees, rfc3339
from companion.views.health import shown_verdicts

EVERY_NS: Final = 1_000_000_000  # least time between two samples
SAMPLES: Final = 300  # samples kept: five minutes
UAVS_MAX: Final = 120
"""Most UAVs of a sample, those with beams first, and of an answer, those with most samples first.

All samples together take 12 MB, and their answer 7 MB.
"""
Between = Callable[[Iterable[Any]], Iterable[Any]]
Column = list[float | None]
Words = list[str | None]


def _same(described: type, name: str) -> Meaning:
    """Return the meaning of a value that is sampled here."""
    return Meaning(meaning(described, name).text)


@dataclass(frozen=True, slots=True, kw_only=True)
class UavHistory:
    """Samples of one UAV, one per time in ``at``; null where a value was unknown."""

    pointing_bound_deg: Annotated[Column, _same(Beam, "pointing_bound_rad")]
    innovation_m: Annotated[Column, _same(Track, "innovation_m")]
    latency_s: Annotated[Column, _same(Track, "latency_s")]
    guaranteed_gain_db: Annotated[Column, _same(Verdict, "guaranteed_gain_db")]
    state: Annotated[Words, _same(Track, "state")]
    verdict: Annotated[Words, Meaning("whether the UAV's beam has the gain that the link needs")]
    age_s: Annotated[Column, _same(Track, "age_s")]
    horizontal_bound_m: Annotated[Column, _same(Track, "horizontal_bound_m")]
    azimuth_deg: Annotated[Column, _same(Beam, "azimuth_rad")]
    gain_db: Annotated[Column, _same(Beam, "gain_db")]
    lat_deg: Annotated[Column, _same(Place, "lat_deg")]
    lon_deg: Annotated[Column, _same(Place, "lon_deg")]
    alt_m: Annotated[Column, _same(Place, "alt_m")]


@dataclass(frozen=True, slots=True, kw_only=True)
class CarrierHistory:
    """Samples of the array's carrier; null where it was unknown."""

    lat_deg: Annotated[Column, _same(Place, "lat_deg")]
    lon_deg: Annotated[Column, _same(Place, "lon_deg")]
    alt_m: Annotated[Column, _same(Place, "alt_m")]
    heading_deg: Annotated[Column, Meaning("bearing of the nose from true north")]


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """Samples of the last minutes, one per second, oldest first."""

    valid_at_ns: Annotated[int, Meaning("the instant for which the values hold")]
    at: Annotated[list[str], Meaning("when each sample was taken")]
    carrier: Annotated[CarrierHistory, Meaning("the samples of the array's carrier")]
    uavs: Annotated[dict[str, UavHistory], Meaning("the samples of each UAV")]


FIELDS: Final = tuple(member.name for member in members(UavHistory))
PLACE: Final = ("lat_deg", "lon_deg", "alt_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """State at one sample: values of each UAV as in ``FIELDS``, its place in the local frame."""

    local: LocalFrame | None
    heading_deg: float | None  # None: the carrier is unknown
    uavs: dict[str, tuple[Any, ...]]
    positions_ned_m: FloatArray  # (N + 1, 3): the UAVs, and then the carrier


Sample = tuple[int, Moment]
"""Sample of an update, and its time in nanoseconds."""


class Series:
    """Samples for looking back. ``add`` is called after every tick."""

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=SAMPLES)

    def add(self, pipeline: Pipeline, machine: Blame | None = None) -> None:
        """Sample the newest update if a sample is due; ``machine`` as for ``moment``."""
        update = pipeline.last_update
        if update is None or (self._samples and 0 <= update.t_ns - self._samples[-1][0] < EVERY_NS):
            return
        self._samples.append((update.t_ns, moment(pipeline, update, machine, UAVS_MAX)))

    @property
    def newest(self) -> Sample | None:
        """Newest sample; None before the first one."""
        return self._samples[-1] if self._samples else None

    def samples(self) -> list[Sample]:
        """Return the samples so far, oldest first; they are immutable."""
        return list(self._samples)


def moment(
    pipeline: Pipeline, update: Update, machine: Blame | None = None, most: int | None = None
) -> Moment:
    """Return a sample of an update; its places are converted by ``show``.

    ``machine`` is the cause of weak links by overload; None without overload. ``most`` limits the
    number of UAVs; None: all.
    """
    beams = {beam.uav: beam for beam in update.beams.beams}
    verdicts = shown_verdicts(pipeline.health, machine)
    uavs = dict[str, tuple[Any, ...]]()
    tracks = update.tracks if most is None else _sampled(update.tracks, beams, most)
    for track in tracks:
        found, beam = verdicts.get(track.uav), beams.get(track.uav)
        uavs[track.uav] = (
            None if beam is None else degrees(beam.pointing_bound_rad),
            track.innovation_m,
            track.latency_s,
            None if found is None else found.guaranteed_gain_db,
            str(track.state),
            None if found is None else str(found.level),
            track.age_s,
            track.horizontal_bound_m,
            None if beam is None else degrees(beam.azimuth_rad),
            None if beam is None else beam.gain_db,
        )
    carrier = update.carrier
    here = np.zeros(3) if carrier is None else carrier.position_ned_m
    return Moment(
        local=pipeline.local,
        heading_deg=None if carrier is None else (degrees(carrier.yaw_rad) or 0.0) % 360,
        uavs=uavs,
        positions_ned_m=np.array([*(track.position_ned_m for track in tracks), here]),
    )


def _sampled(tracks: Sequence[Track], beams: Mapping[str, Beam], most: int) -> Sequence[Track]:
    """Return the tracks that are sampled; those with beams take precedence."""
    if len(tracks) <= most:
        return tracks
    return sorted(tracks, key=lambda track: track.uav not in beams)[:most]


def show(
    samples: list[Sample],
    now_ns: int,
    utc_ns: Utc,
    *,
    is_rounded: bool = False,
    most: int | None = None,
    between: Between = iter,
) -> Json:
    """Return the answer of ``/v1/history``, in columns. Runs on any thread.

    ``most`` limits the number of UAVs; None: all. ``between`` iterates with pauses for other work.
    """
    shown = [_rows(one, is_rounded=is_rounded) for _, one in between(samples)]
    counts = Counter(uav for _, one in samples for uav in one.uavs)
    uavs = [uav for uav, _ in counts.most_common(most)]
    nothing = (None,) * len(FIELDS)
    return {
        "valid_at": rfc3339(utc_ns(now_ns)),
        "at": [rfc3339(utc_ns(t_ns)) for t_ns, _ in samples],
        "carrier": _columns((*PLACE, "heading_deg"), (rows[""] for rows in shown)),
        "uavs": {
            uav: _columns(FIELDS, (rows.get(uav, nothing) for rows in shown))
            for uav in between(uavs)
        },
    }


def _columns(names: tuple[str, ...], rows: Iterable[tuple[Any, ...]]) -> Json:
    columns = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in names]
    return dict(zip(names, columns, strict=True))


def _rows(one: Moment, *, is_rounded: bool) -> dict[str, tuple[Any, ...]]:
    """Return the values of each UAV in the order of ``FIELDS``, and of the carrier as ""."""
    places = [(None,) * len(PLACE)] * len(one.positions_ned_m)
    if one.local is not None:
        lat, lon, alt = one.local.geodetic(one.positions_ned_m)
        if is_rounded:
            lat, lon = lat.round(COORDINATE_DIGITS), lon.round(COORDINATE_DIGITS)
            alt = alt.round(DIGITS)
        places = list(zip(lat.tolist(), lon.tolist(), alt.tolist(), strict=True))
    rows = dict[str, tuple[Any, ...]]()
    for (uav, values), place in zip(one.uavs.items(), places[:-1], strict=True):
        kept = values
        if is_rounded:
            kept = tuple(round(v, DIGITS) if isinstance(v, float) else v for v in values)
        rows[uav] = (*kept, *place)
    is_known = one.heading_deg is not None
    rows[""] = (*(places[-1] if is_known else (None,) * len(PLACE)), one.heading_deg)
    return rows
