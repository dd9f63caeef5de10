"""Beams as the API and ``companion weights`` show them: degrees, dB, null for unknown.

Everything is computed when it is asked for, from an update that no longer changes, and may
therefore run on any thread.
"""

import functools
from typing import Any, Final

import numpy as np

from companion.beams import line_of_sight
from companion.beams.aim import directions
from companion.beams.array.geometry import Array
from companion.beams.hardware import codebooks
from companion.beams.worth import link_budget, patterns
from companion.pipeline.assembly import Equipment
from companion.pipeline.fold import Pipeline
from companion.values import Beam, BeamSet, FloatArray, Update
from companion.views import guaranteed_gain
from companion.views.words import degrees, rfc3339

Json = dict[str, Any]

AHEAD_S: Final = 30.0
"""How far ahead the next beam of a codebook is looked for."""
MOST_SAMPLES: Final = 2000
"""Most samples of a direction over that time."""
FEWEST_SAMPLES: Final = 32
"""As many there are of each, however large the codebook."""
MOST_RESPONSES: Final = 2**28
"""Samples times beams of a codebook times elements, for all UAVs of one answer."""
FULL_SHARE: Final = 8
"""UAVs up to which each has all the work that a question may take."""


def beams(
    pipeline: Pipeline, equipment: Equipment, update: Update, age_s: float, lead_ms: float
) -> Json:
    """The answer of ``/v1/beams`` for one update."""
    beam_set, array = update.beams, pipeline.array
    boresight = None
    if update.carrier is not None:
        array_from_local = array.array_from_body @ update.carrier.body_from_local
        boresight = float(np.degrees(np.arctan2(array_from_local[0, 1], array_from_local[0, 0])))
    azimuth_width, elevation_width = _beamwidths_rad(array)
    return {
        "valid_at": rfc3339(pipeline.utc_ns(beam_set.valid_at_ns)),
        "age_s": age_s,
        "lead_ms": lead_ms,
        "beams": _entries(pipeline, equipment, update),
        "array": {
            "kind": array.kind,
            "elements": array.size,
            "frequency_hz": pipeline.settings.array.frequency_hz,
            "half_power_beamwidth_deg": degrees(azimuth_width),
            "half_power_beamwidth_elevation_deg": degrees(elevation_width),
            "boresight_bearing_deg": None if boresight is None else boresight % 360,
        },
        "method": str(beam_set.method),
        "policy": str(pipeline.precoder.policy),
        "normalisation": str(beam_set.normalisation),
        "condition_number": beam_set.condition_number,
        "regularised": beam_set.regularised,
        "groups": beam_set.groups,
        "codebook_beams": None if equipment.codebook is None else equipment.codebook.size,
        "unfit": update.unfit,
        "left_out": left_out(beam_set, update.unfit),
    }


@functools.lru_cache(maxsize=4)
def _beamwidths_rad(array: Array) -> tuple[float | None, float | None]:
    """Widths at half power of the beam along boresight, in azimuth and elevation.

    Cached by array.
    """
    return patterns.half_power_beamwidths_rad(array, np.array([1.0, 0.0, 0.0]))


def left_out(beam_set: BeamSet, unfit: str | None = None) -> list[Json]:
    """UAVs that have no beam, with the reason; ``unfit`` is the one that all of them share."""
    return [{"uav": out.uav, "reason": unfit or out.reason} for out in beam_set.left_out]


def pointing(pipeline: Pipeline, update: Update) -> list[Json]:
    """Where each beam points over the ground: bearing, angle above the horizon, and the place."""
    carrier, beam_set = update.carrier, update.beams
    if carrier is None or not beam_set.beams:
        return []
    tracked = {track.uav: track.position_ned_m for track in update.tracks}
    places = pipeline.geodetic(np.array([tracked[uav] for uav in beam_set.uavs]))
    ned = directions(beam_set) @ pipeline.array.array_from_body @ carrier.body_from_local
    bearings = np.degrees(np.arctan2(ned[:, 1], ned[:, 0])) % 360
    above = np.degrees(np.arcsin(np.clip(-ned[:, 2], -1.0, 1.0)))
    names = "uav", "bearing_deg", "above_horizon_deg", "lat_deg", "lon_deg", "alt_m"
    columns = bearings.tolist(), above.tolist(), *(one.tolist() for one in places)
    return [dict(zip(names, row, strict=True)) for row in zip(beam_set.uavs, *columns, strict=True)]


def _entries(pipeline: Pipeline, equipment: Equipment, update: Update) -> list[Json]:
    beam_set, carrier = update.beams, update.carrier
    if carrier is None or not beam_set.beams:
        return []
    array, towards = pipeline.array, directions(beam_set)
    ranges_m = np.array([beam.range_m for beam in beam_set.beams])
    groups = np.array([beam.group for beam in beam_set.beams])
    power_w = equipment.budget.tx_power_w
    sent = link_budget.transmitted(beam_set.weights, power_w, groups, beam_set.normalisation)
    powers_w = np.einsum("mn,mn->n", sent, sent.conj()).real
    sinr_db = link_budget.predicted_sinr_db(
        array,
        towards,
        ranges_m=ranges_m,
        sent=sent,
        groups=groups,
        budget=equipment.budget,
        uav_antennas=equipment.uav_antennas,
    )
    pointed = pointing(pipeline, update)
    guaranteed, guaranteed_sinr = guaranteed_gain.of_beams(
        pipeline, equipment, update, towards, powers_w
    )
    powers_dbm = 10 * np.log10(np.maximum(powers_w, 1e-30)) + 30
    turns_db = 10 * np.log10(beam_set.groups)
    return [
        {
            "azimuth_deg": degrees(beam.azimuth_rad),
            "elevation_deg": degrees(beam.elevation_rad),
            "range_m": beam.range_m,
            **pointed[i],
            "azimuth_rate_dps": degrees(beam.azimuth_rate_radps),
            "elevation_rate_dps": degrees(beam.elevation_rate_radps),
            "range_rate_mps": beam.range_rate_mps,
            "gain_db": beam.gain_db,
            "guaranteed_gain_db": guaranteed[i],
            "power_dbm": float(powers_dbm[i]),
            "eirp_dbm": float(powers_dbm[i]) + beam.gain_db,
            "loss_db": beam.loss_db,
            "cost_db": beam.loss_db + turns_db,
            "group": beam.group,
            "widened": beam.widened,
            "pointing_bound_deg": degrees(beam.pointing_bound_rad),
            "pointing_p95_deg": degrees(beam.pointing_p95_rad),
            "guaranteed_sinr_db": guaranteed_sinr[i],
            "sinr_db": float(sinr_db[i]) if np.isfinite(sinr_db[i]) else None,
            "codebook": _codebook_entry(pipeline, equipment, update, beam, towards[i]),
        }
        for i, beam in enumerate(beam_set.beams)
    ]


def _codebook_entry(
    pipeline: Pipeline, equipment: Equipment, update: Update, beam: Beam, towards: FloatArray
) -> Json | None:
    """Which stored beam serves a UAV, which is next and when, and which must be swept."""
    codebook, array = equipment.codebook, pipeline.array
    if codebook is None:
        return None
    (best,), gains = codebooks.best(codebook, array, towards[np.newaxis])
    share = min(1.0, FULL_SHARE / len(update.beams.beams))
    swept = codebooks.candidates(codebook, array, towards, beam.pointing_bound_rad, share)
    following = _next_best(pipeline, equipment, update, beam)
    return {
        "best": int(best),
        "gain_db": float(10 * np.log10(np.maximum(gains[0], 1e-20))),
        "next": None if following is None else following.next_index,
        "next_in_s": None if following is None else following.after_s,
        "candidates": swept.tolist(),
        "ssb_candidates": codebooks.strongest_first(codebook, array, towards, swept).tolist(),
        "sweep_share": len(swept) / codebook.size,
    }


def _next_best(
    pipeline: Pipeline, equipment: Equipment, update: Update, beam: Beam
) -> codebooks.NextBest | None:
    """The next stored beam, if the UAV flies on as it does; None where that is not known."""
    codebook, carrier, array = equipment.codebook, update.carrier, pipeline.array
    track = next((track for track in update.tracks if track.uav == beam.uav), None)
    if codebook is None or carrier is None or track is None:
        return None

    def directions_at(times_s: FloatArray) -> FloatArray:
        found = line_of_sight.directions_ahead(track, carrier, array, times_s)
        assert found is not None
        return found

    coarse_s = np.linspace(0.0, AHEAD_S, 121)
    path = line_of_sight.directions_ahead(track, carrier, array, coarse_s)
    if path is None:
        return None
    turned = np.linalg.norm(np.diff(path, axis=0), axis=1)
    fastest_radps = float(turned.max()) / coarse_s[1]
    step_s = codebooks.sampling_step_s(codebook, array, fastest_radps) or AHEAD_S
    answers = codebook.weights.size * len(update.beams.beams)
    samples = min(MOST_SAMPLES, max(FEWEST_SAMPLES, MOST_RESPONSES // answers))
    step_s = min(max(step_s, AHEAD_S / samples), AHEAD_S)
    return codebooks.next_best(codebook, array, directions_at, AHEAD_S, step_s)


def weights(pipeline: Pipeline, beam_set: BeamSet, lead_ms: float) -> Json:
    """The answer of ``/v1/beams/weights`` as JSON: M rows, columns in the order of ``uavs``."""
    return {
        "valid_at": rfc3339(pipeline.utc_ns(beam_set.valid_at_ns)),
        "lead_ms": lead_ms,
        "uavs": list(beam_set.uavs),
        "groups": [beam.group for beam in beam_set.beams],
        "method": str(beam_set.method),
        "normalisation": str(beam_set.normalisation),
        "condition_number": beam_set.condition_number,
        "re": beam_set.weights.real.tolist(),
        "im": beam_set.weights.imag.tolist(),
    }


def pattern(
    pipeline: Pipeline, update: Update, cut: str, *, points: int, only: str | None, lead_ms: float
) -> Json:
    """The answer of ``/v1/pattern``: the response of each beam (or one) along a cut through it."""
    array, beam_set = pipeline.array, update.beams
    towards = directions(beam_set)
    entries, angles = [], np.empty(0)
    for i, beam in enumerate(beam_set.beams):
        if only is not None and beam.uav != only:
            continue
        column = beam_set.weights[:, i]
        if cut == "azimuth":
            angles, response_db = patterns.azimuth_cut(array, column, beam.elevation_rad, points)
        else:
            angles, response_db = patterns.elevation_cut(array, column, beam.azimuth_rad, points)
        entries.append(
            _pattern_entry(pipeline, beam_set, i, cut=cut, response_db=response_db, towards=towards)
        )
    return {
        "valid_at": rfc3339(pipeline.utc_ns(beam_set.valid_at_ns)),
        "lead_ms": lead_ms,
        "cut": cut,
        "method": str(beam_set.method),
        "angles_deg": np.degrees(angles).tolist(),
        "patterns": entries,
    }


def _pattern_entry(
    pipeline: Pipeline,
    beam_set: BeamSet,
    i: int,
    *,
    cut: str,
    response_db: FloatArray,
    towards: FloatArray,
) -> Json:
    beam, column = beam_set.beams[i], beam_set.weights[:, i]
    lobe = patterns.lobe(pipeline.array, column, towards[i])
    across = lobe.azimuth if cut == "azimuth" else lobe.elevation
    others = [j for j, other in enumerate(beam_set.beams) if j != i and other.group == beam.group]
    depths = patterns.null_depths_db(pipeline.array, column, lobe.peak_db, towards[others])
    return {
        "uav": beam.uav,
        "at_deg": degrees(beam.elevation_rad if cut == "azimuth" else beam.azimuth_rad),
        "target_deg": degrees(beam.azimuth_rad if cut == "azimuth" else beam.elevation_rad),
        "response_db": response_db.tolist(),
        "peak_azimuth_deg": degrees(lobe.peak_azimuth_rad),
        "peak_elevation_deg": degrees(lobe.peak_elevation_rad),
        "peak_db": lobe.peak_db,
        "half_power_beamwidth_deg": degrees(across.half_power_width_rad),
        "side_lobe_db": across.side_lobe_db,
        "null_depths_db": {
            beam_set.beams[j].uav: float(depth) for j, depth in zip(others, depths, strict=True)
        },
    }
