"""Beams as shown by the API and ``companion weights``: degrees, dB, null for unknown.

All values are computed on request from an immutable update, on any thread.
"""

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np

from companion.beams import line_of_sight
from companion.beams.aim import directions
from companion.beams.array.geometry import Array
from companion.beams.hardware import codebooks
from companion.beams.worth import link_budget, patterns
from companion.pipeline.assembly import Equipment
from companion.pipeline.fold import Pipeline
from companion.tracking.geodesy import Place
from companion.values import ArrayKind, Beam, BeamSet, FloatArray, LeftOut, Policy, Update
from companion.values.described import Inline, Meaning
from companion.views import guaranteed_gain
from companion.views.as_json import Json, as_json, degrees

HORIZON_S: Final = 30.0  # horizon of the search for the next beam of a codebook
RESPONSE_SAMPLES_MAX: Final = 2000  # largest number of sampled directions over that time
RESPONSE_SAMPLES_MIN: Final = 32  # smallest number, however large the codebook
RESPONSES_MAX: Final = 2**28
"""Limit on samples times codebook beams times elements, over all UAVs of one answer."""
FULL_WORK_UAVS: Final = 8  # number of UAVs up to which each gets the full work limit
NUMBER: Final = (
    "number of the update that these beams are of, from 0, as in records and for observations of "
    "powers; null: computed for this answer"
)
LEAD: Final = "requested lead: valid_at is this long after the request, or up to 10 ms more"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredBeam:
    """Beam of the codebook that serves a UAV, and the next one."""

    best: Annotated[int, Meaning("number of the codebook's beam that serves this UAV now")]
    gain_db: Annotated[
        float, Meaning("gain of the codebook's beam towards the predicted direction")
    ]
    next: Annotated[int | None, Meaning("number of the beam that will serve this UAV next")]
    next_in_s: Annotated[float | None, Meaning("time until the next beam")]
    candidates: Annotated[
        list[int], Meaning("numbers of all beams that can be the best one, wherever the UAV can be")
    ]
    ssb_candidates: Annotated[
        list[int], Meaning("the candidates in the order of a sweep, the strongest first")
    ]
    sweep_share: Annotated[float, Meaning("share of the codebook that such a sweep takes, 0 to 1")]


@dataclass(frozen=True, slots=True)
class Pointing:
    """Direction of a beam over the ground."""

    bearing_deg: Annotated[float, Meaning("direction from true north, clockwise")]
    above_horizon_deg: Annotated[float, Meaning("angle of the direction above the horizon")]
    place: Annotated[Place, Inline()]


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamState:
    """One beam. Azimuth and elevation are in the array frame, the bearing is from true north."""

    beam: Annotated[Beam, Inline()]
    pointing: Annotated[Pointing, Inline()]
    guaranteed_gain_db: Annotated[
        float | None, Meaning("least array gain wherever the UAV can be; null: no guarantee")
    ]
    power_dbm: Annotated[float, Meaning("power of this beam in its time slot")]
    cost_db: Annotated[float, Meaning("`loss_db` plus 10 log10 of the number of time slots")]
    guaranteed_sinr_db: Annotated[
        float | None,
        Meaning("least SINR wherever the UAVs can be; null: no guarantee, or too many beams"),
    ]
    sinr_db: Annotated[float | None, Meaning("SINR at the predicted directions")]
    codebook: Annotated[StoredBeam | None, Meaning("beam of the device's codebook for this UAV")]

    @property
    def eirp_dbm(self) -> Annotated[float, Meaning("power plus gain in the predicted direction")]:
        return self.power_dbm + self.beam.gain_db


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayState:
    """Antenna array as the API shows it."""

    kind: Annotated[ArrayKind, Meaning("geometry of the array")]
    elements: Annotated[int, Meaning("number of elements")]
    frequency_hz: Annotated[float, Meaning("carrier frequency")]
    half_power_beamwidth_deg: Annotated[float | None, Meaning("width 3 dB below the peak")]
    half_power_beamwidth_elevation_deg: Annotated[
        float | None, Meaning("width 3 dB below the peak, in elevation")
    ]
    boresight_bearing_deg: Annotated[
        float | None, Meaning("bearing of boresight from true north, clockwise")
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Beams:
    """The beams that are applied at ``valid_at``."""

    made: Annotated[BeamSet, Inline()]
    update: Annotated[int | None, Meaning(NUMBER)]
    age_s: Annotated[float, Meaning("time since the beams were computed")]
    lead_ms: Annotated[float, Meaning(LEAD)]
    beams: Annotated[list[BeamState], Meaning("the beams, in the order of the weights' columns")]
    array: Annotated[ArrayState, Meaning("the antenna array")]
    policy: Annotated[
        Policy, Meaning("what happens if zero forcing would cost a UAV too much gain")
    ]
    codebook_beams: Annotated[int | None, Meaning("beams in the device's codebook")]
    unfit: Annotated[str | None, Meaning("why beams are impossible; null: they are possible")]
    left_out: Annotated[list[LeftOut], Meaning("UAVs without a beam, and why")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Weights:
    """Complex weights, M rows; columns in the order of ``uavs``."""

    made: Annotated[BeamSet, Inline(omit=("groups", "regularised"))]
    update: Annotated[int | None, Meaning(NUMBER)]
    lead_ms: Annotated[float, Meaning(LEAD)]
    uavs: Annotated[list[str], Meaning("the UAV of each column")]
    groups: Annotated[list[int], Meaning("the time slot of each column, from 0")]
    re: Annotated[
        list[list[float]],
        Meaning("real parts of the weights: one row per element, one column per UAV"),
    ]
    im: Annotated[
        list[list[float]],
        Meaning("imaginary parts of the weights: one row per element, one column per UAV"),
    ]


def beams(
    pipeline: Pipeline,
    equipment: Equipment,
    update: Update,
    *,
    age_s: float,
    lead_ms: float,
    number: int | None = None,
) -> Json:
    """Return the answer of ``/v1/beams`` for one update; ``number`` is None for a look."""
    beam_set, array, unfit = update.beams, pipeline.array, update.unfit
    boresight_deg = None
    if update.carrier is not None:
        array_from_local = array.array_from_body @ update.carrier.body_from_local
        boresight_deg = math.degrees(math.atan2(array_from_local[0, 1], array_from_local[0, 0]))
    azimuth_width, elevation_width = _beamwidths_rad(array)
    shown = Beams(
        made=beam_set,
        update=number,
        age_s=age_s,
        lead_ms=lead_ms,
        beams=list(_entries(pipeline, equipment, update)),
        array=ArrayState(
            kind=array.kind,
            elements=array.size,
            frequency_hz=pipeline.settings.array.frequency_hz,
            half_power_beamwidth_deg=degrees(azimuth_width),
            half_power_beamwidth_elevation_deg=degrees(elevation_width),
            boresight_bearing_deg=None if boresight_deg is None else boresight_deg % 360,
        ),
        policy=pipeline.precoder.policy,
        codebook_beams=None if equipment.codebook is None else equipment.codebook.size,
        unfit=unfit,
        left_out=[LeftOut(out.uav, out.cause, unfit or out.reason) for out in beam_set.left_out],
    )
    return as_json(shown, pipeline.utc_ns)


@functools.lru_cache(maxsize=4)
def _beamwidths_rad(array: Array) -> tuple[float | None, float | None]:
    """Return half-power widths of a boresight beam, azimuth and elevation; cached by array."""
    return patterns.half_power_beamwidths_rad(array, np.array([1.0, 0.0, 0.0]))


def pointing(pipeline: Pipeline, update: Update) -> list[Pointing]:
    """Return where each beam points over the ground; empty if the carrier's attitude is unknown."""
    carrier, beam_set = update.carrier, update.beams
    if carrier is None or not beam_set.beams:
        return []
    tracked = {track.uav: track.position_ned_m for track in update.tracks}
    places = pipeline.geodetic(np.array([tracked[uav] for uav in beam_set.uavs]))
    ned = directions(beam_set) @ pipeline.array.array_from_body @ carrier.body_from_local
    bearings = np.degrees(np.arctan2(ned[:, 1], ned[:, 0])) % 360
    above = np.degrees(np.arcsin(np.clip(-ned[:, 2], -1.0, 1.0)))
    rows = zip(bearings.tolist(), above.tolist(), *(one.tolist() for one in places), strict=True)
    return [Pointing(bearing, angle, Place(*place)) for bearing, angle, *place in rows]


def _entries(pipeline: Pipeline, equipment: Equipment, update: Update) -> Iterator[BeamState]:
    beam_set, towards, budget = update.beams, directions(update.beams), equipment.budget
    pointed = pointing(pipeline, update)
    if not pointed:
        return
    sent = link_budget.sent_weights(beam_set, budget)
    powers_w = np.einsum("mn,mn->n", sent, sent.conj()).real
    sinr_db = link_budget.sinr_of_beams_db(
        pipeline.array, beam_set, towards, budget, equipment.uav_antennas
    )
    gains_db, sinrs_db = guaranteed_gain.of_beams(pipeline, equipment, update, towards, powers_w)
    powers_dbm = 10 * np.log10(np.maximum(powers_w, 1e-30)) + 30
    for i, beam in enumerate(beam_set.beams):
        yield BeamState(
            beam=beam,
            pointing=pointed[i],
            guaranteed_gain_db=gains_db[i],
            power_dbm=float(powers_dbm[i]),
            cost_db=beam.loss_db + 10 * math.log10(beam_set.groups),
            guaranteed_sinr_db=sinrs_db[i],
            sinr_db=float(sinr_db[i]) if np.isfinite(sinr_db[i]) else None,
            codebook=_stored_beams(pipeline, equipment, update, beam, towards[i]),
        )


def _stored_beams(
    pipeline: Pipeline, equipment: Equipment, update: Update, beam: Beam, towards: FloatArray
) -> StoredBeam | None:
    """Return a UAV's best stored beam, the next one with its time, and those to sweep."""
    codebook, array = equipment.codebook, pipeline.array
    if codebook is None:
        return None
    (best,), gains = codebooks.best(codebook, array, towards[np.newaxis])
    share = min(1.0, FULL_WORK_UAVS / len(update.beams.beams))
    swept = codebooks.candidates(codebook, array, towards, beam.pointing_bound_rad, share)
    following = _next_best(pipeline, equipment, update, beam)
    return StoredBeam(
        best=int(best),
        gain_db=float(10 * np.log10(np.maximum(gains[0], 1e-20))),
        next=None if following is None else following.next_index,
        next_in_s=None if following is None else following.after_s,
        candidates=swept.tolist(),
        ssb_candidates=codebooks.strongest_first(codebook, array, towards, swept).tolist(),
        sweep_share=len(swept) / codebook.size,
    )


def _next_best(
    pipeline: Pipeline, equipment: Equipment, update: Update, beam: Beam
) -> codebooks.NextBest | None:
    """Return the next stored beam if the UAV keeps its motion; None if the motion is unknown."""
    codebook, carrier, array = equipment.codebook, update.carrier, pipeline.array
    track = next((track for track in update.tracks if track.uav == beam.uav), None)
    if codebook is None or carrier is None or track is None:
        return None

    def directions_at(times_s: FloatArray) -> FloatArray:
        found = line_of_sight.directions_ahead(track, carrier, array, times_s)
        assert found is not None
        return found

    coarse_s = np.linspace(0.0, HORIZON_S, 121)
    path = line_of_sight.directions_ahead(track, carrier, array, coarse_s)
    if path is None:
        return None
    turned = np.linalg.norm(np.diff(path, axis=0), axis=1)
    fastest_radps = float(turned.max()) / coarse_s[1]
    step_s = codebooks.sampling_step_s(codebook, array, fastest_radps) or HORIZON_S
    answers = codebook.weights.size * len(update.beams.beams)
    samples = min(RESPONSE_SAMPLES_MAX, max(RESPONSE_SAMPLES_MIN, RESPONSES_MAX // answers))
    step_s = min(max(step_s, HORIZON_S / samples), HORIZON_S)
    return codebooks.next_best(codebook, array, directions_at, HORIZON_S, step_s)


def weights(
    pipeline: Pipeline, beam_set: BeamSet, lead_ms: float, number: int | None = None
) -> Json:
    """Return the answer of ``/v1/beams/weights``: M rows, columns in the order of ``uavs``.

    ``number`` is that of the update; None for a look.
    """
    shown = Weights(
        made=beam_set,
        update=number,
        lead_ms=lead_ms,
        uavs=list(beam_set.uavs),
        groups=beam_set.slots.tolist(),
        re=beam_set.weights.real.tolist(),
        im=beam_set.weights.imag.tolist(),
    )
    return as_json(shown, pipeline.utc_ns)
