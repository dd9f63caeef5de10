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

All samples together take 4 MB, and their answer 7 MB.
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
WORDS: Final = ("state", "verdict")
PLACE: Final = ("lat_deg", "lon_deg", "alt_m")
NUMBERS: Final = tuple(name for name in FIELDS if name not in (*WORDS, *PLACE))


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """State at one sample, in arrays: Python's numbers take four times the memory.

    numbers          (N, 8) of each UAV as in ``NUMBERS``; NaN: unknown
    words            for each of ``WORDS`` those of all UAVs
    positions_ned_m  (N + 1, 3) in the local frame, of the UAVs and then the carrier
    """

    local: LocalFrame | None
    heading_deg: float | None  # None: the carrier is unknown
    uavs: tuple[str, ...]
    numbers: FloatArray
    words: tuple[tuple[str | None, ...], ...]
    positions_ned_m: FloatArray


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
    tracks = update.tracks if most is None else _sampled(update.tracks, beams, most)
    judged = [verdicts.get(track.uav) for track in tracks]
    carrier = update.carrier
    here = np.zeros(3) if carrier is None else carrier.position_ned_m
    return Moment(
        local=pipeline.local,
        heading_deg=None if carrier is None else (degrees(carrier.yaw_rad) or 0.0) % 360,
        uavs=tuple(track.uav for track in tracks),
        numbers=np.array(
            [
                _numbers(track, beams.get(track.uav), found)
                for track, found in zip(tracks, judged, strict=True)
            ],
            dtype=float,
        ).reshape(-1, len(NUMBERS)),
        words=(
            tuple(str(track.state) for track in tracks),
            tuple(None if found is None else str(found.level) for found in judged),
        ),
        positions_ned_m=np.array([*(track.position_ned_m for track in tracks), here]),
    )


def _numbers(track: Track, beam: Beam | None, found: Verdict | None) -> tuple[float | None, ...]:
    """Return the values in the order of ``NUMBERS``."""
    return (
        None if beam is None else degrees(beam.pointing_bound_rad),
        track.innovation_m,
        track.latency_s,
        None if found is None else found.guaranteed_gain_db,
        track.age_s,
        track.horizontal_bound_m,
        None if beam is None else degrees(beam.azimuth_rad),
        None if beam is None else beam.gain_db,
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

    Columns of numbers are arrays, of which orjson encodes NaN as null. ``most`` limits the number
    of UAVs; None: all. ``between`` iterates with pauses for other work.
    """
    counts = Counter(uav for _, one in samples for uav in one.uavs)
    row = {uav: at for at, (uav, _) in enumerate(counts.most_common(most))}
    numbers = np.full((len(row), len(NUMBERS) + len(PLACE), len(samples)), np.nan)
    words: list[tuple[Words, ...]] = [tuple([None] * len(samples) for _ in WORDS) for _ in row]
    carrier = np.full((len(PLACE) + 1, len(samples)), np.nan)
    for at, (_, one) in enumerate(between(samples)):
        geodetic = _places(one)
        shown = [n for n, uav in enumerate(one.uavs) if uav in row]
        rows = [row[one.uavs[n]] for n in shown]
        numbers[rows, : len(NUMBERS), at] = one.numbers[shown]
        numbers[rows, len(NUMBERS) :, at] = geodetic[shown]
        for n, to in zip(shown, rows, strict=True):
            for said, known in zip(words[to], one.words, strict=True):
                said[at] = known[n]
        if one.heading_deg is not None:
            carrier[:, at] = *geodetic[-1], one.heading_deg
    if is_rounded:
        digits = (COORDINATE_DIGITS, COORDINATE_DIGITS, DIGITS)
        for at, kept in enumerate(digits):
            for column in (numbers[:, len(NUMBERS) + at], carrier[at]):
                column.round(kept, out=column)
        numbers[:, : len(NUMBERS)].round(DIGITS, out=numbers[:, : len(NUMBERS)])
    return {
        "valid_at": rfc3339(utc_ns(now_ns)),
        "at": [rfc3339(utc_ns(t_ns)) for t_ns, _ in samples],
        "carrier": dict(zip((*PLACE, "heading_deg"), carrier, strict=True)),
        "uavs": {uav: _columns(numbers[at], words[at]) for uav, at in row.items()},
    }


def _columns(numbers: FloatArray, words: tuple[Words, ...]) -> Json:
    """Return the samples of a UAV by name, in the order of ``UavHistory``."""
    columns = dict(zip((*NUMBERS, *PLACE, *WORDS), (*numbers, *words), strict=True))
    return {name: columns[name] for name in FIELDS}


def _places(one: Moment) -> FloatArray:
    """Return latitude, longitude and height (N + 1, 3) of a sample; NaN without a local frame."""
    if one.local is None:
        return np.full(one.positions_ned_m.shape, np.nan)
    return np.column_stack(one.local.geodetic(one.positions_ned_m))
