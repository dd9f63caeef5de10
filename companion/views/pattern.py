"""The array's response along a cut through each beam, as shown by the API."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from companion.beams.aim import directions
from companion.beams.worth import patterns
from companion.pipeline.fold import Pipeline
from companion.values import BeamSet, FloatArray, Method, Update
from companion.values.described import Meaning
from companion.views.as_json import Json, as_json, degrees
from companion.views.beam_state import LEAD

Cut = Literal["azimuth", "elevation"]


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamPattern:
    """Response of one beam along a cut."""

    uav: Annotated[str, Meaning("UAV of the beam", example="3:1")]
    at_deg: Annotated[float, Meaning("the other angle of the cut, which is constant")]
    target_deg: Annotated[float, Meaning("the UAV's own angle along the cut")]
    response_db: Annotated[
        list[float], Meaning("response at each angle, over an isotropic element")
    ]
    peak_azimuth_deg: Annotated[float, Meaning("azimuth of the peak")]
    peak_elevation_deg: Annotated[float, Meaning("elevation of the peak")]
    peak_db: Annotated[float, Meaning("response at the peak, over an isotropic element")]
    half_power_beamwidth_deg: Annotated[float | None, Meaning("width 3 dB below the peak")]
    side_lobe_db: Annotated[float | None, Meaning("largest side lobe below the peak")]
    null_depths_db: Annotated[
        dict[str, float], Meaning("response towards each other UAV, over an isotropic element")
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Pattern:
    """Response of the array in dB along a cut through each beam."""

    valid_at_ns: Annotated[int, Meaning("when the beams are applied")]
    lead_ms: Annotated[float, Meaning(LEAD)]
    cut: Annotated[Cut, Meaning("the angle that varies along the cut")]
    method: Annotated[Method, Meaning("how the weights were computed")]
    angles_deg: Annotated[list[float], Meaning("angles of the cut, in the order of response_db")]
    patterns: Annotated[list[BeamPattern], Meaning("one cut per beam")]


def pattern(
    pipeline: Pipeline, update: Update, cut: Cut, *, points: int, only: str | None, lead_ms: float
) -> Json:
    """Return the answer of ``/v1/pattern``: the response of all beams, or of one, along a cut."""
    array, beam_set = pipeline.array, update.beams
    entries, angles = [], np.empty(0)
    for i, beam in enumerate(beam_set.beams):
        if only is not None and beam.uav != only:
            continue
        column = beam_set.weights[:, i]
        if cut == "azimuth":
            angles, response_db = patterns.azimuth_cut(array, column, beam.elevation_rad, points)
        else:
            angles, response_db = patterns.elevation_cut(array, column, beam.azimuth_rad, points)
        entries.append(_pattern(pipeline, beam_set, i, cut, response_db))
    shown = Pattern(
        valid_at_ns=beam_set.valid_at_ns,
        lead_ms=lead_ms,
        cut=cut,
        method=beam_set.method,
        angles_deg=np.degrees(angles).tolist(),
        patterns=entries,
    )
    return as_json(shown, pipeline.utc_ns)


def _pattern(
    pipeline: Pipeline, beam_set: BeamSet, i: int, cut: Cut, response_db: FloatArray
) -> BeamPattern:
    beam, column, towards = beam_set.beams[i], beam_set.weights[:, i], directions(beam_set)
    lobe = patterns.lobe(pipeline.array, column, towards[i])
    across = lobe.azimuth if cut == "azimuth" else lobe.elevation
    others = [j for j, other in enumerate(beam_set.beams) if j != i and other.group == beam.group]
    depths = patterns.null_depths_db(pipeline.array, column, lobe.peak_db, towards[others])
    azimuth_deg, elevation_deg = np.degrees([beam.azimuth_rad, beam.elevation_rad]).tolist()
    is_azimuth = cut == "azimuth"
    return BeamPattern(
        uav=beam.uav,
        at_deg=elevation_deg if is_azimuth else azimuth_deg,
        target_deg=azimuth_deg if is_azimuth else elevation_deg,
        response_db=response_db.tolist(),
        peak_azimuth_deg=math.degrees(lobe.peak_azimuth_rad),
        peak_elevation_deg=math.degrees(lobe.peak_elevation_rad),
        peak_db=lobe.peak_db,
        half_power_beamwidth_deg=degrees(across.half_power_width_rad),
        side_lobe_db=across.side_lobe_db,
        null_depths_db={
            beam_set.beams[j].uav: float(depth) for j, depth in zip(others, depths, strict=True)
        },
    )
