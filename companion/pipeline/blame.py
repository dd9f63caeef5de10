"""Causes of weak links: what limits a beam most, as text, and a remedy.

The guaranteed gain is the least gain within the pointing bound. A large bound is therefore the
cause: the carrier's attitude or position, or one part of the bound on the UAV's position.
"""

import math
from dataclasses import dataclass
from typing import Final

from companion.values import Beam, Blame, Carrier, Cause, LeftOut, Reason, Track, TrackState

CLOSE_UAVS_DB: Final = 3.0
"""Loss against a beam for one UAV alone above which the other UAVs are the cause, dB."""
SPARSE_S: Final = 0.25  # interval between reports from which on a higher rate helps
LATE_S: Final = 0.15  # latency from which on a faster link helps
SILENT_S: Final = 1.0
"""Least age of the newest report of a silent UAV, seconds, if it is also several intervals."""
SILENT_INTERVALS: Final = 3.0

TIMESYNC: Final = "allow TIMESYNC: set `[presence] enabled = true`, over a two-way link"
FLY_APART: Final = 'fly them apart, or set `[beams] policy = "group"`'
STEADIER_LINK: Final = "use a MAVLink link with a steadier delay"


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkEvidence:
    """Facts about a UAV's link in addition to its track."""

    clock_assumed: bool  # the constant part of its latency is only assumed
    refused: Reason | None  # why its newest reports were rejected; None: they were used
    attitude_bound_rad: float = 0.0  # bound on the error of the carrier's attitudes when measured
    attitude_age_s: float = 0.0  # age of the newest of them
    carrier_doubt_s: float = 0.0  # bound on the error of the carrier's clock
    carrier_assumed: bool = False  # the constant part of its latency is only assumed


def of_left_out(out: LeftOut, track: Track | None, unfit: str | None) -> Blame:
    """Return why a UAV has no beam. ``unfit`` is the reason why no UAV can have one.

    ``track`` is None if there are too many UAVs to predict them all.
    """
    if unfit is not None:
        return Blame(
            Cause.CARRIER,
            unfit,
            "check the carrier: powered, connected, with a position fix, and its id in"
            " `[center] source`",
        )
    match out.cause:
        case Cause.CROWDED:
            remedy = FLY_APART
        case Cause.SILENT if track is not None:
            return _silence_cause(track)
        case Cause.MACHINE:
            remedy = "add it to `[beams] priority`, or raise `[beams] most`"
        case _:
            remedy = "turn the array or its carrier, or fly elsewhere"
    return Blame(out.cause, out.reason, remedy)


def of_unserved(track: Track, *, reached: bool, full: bool) -> Blame:
    """Return why no node of the fleet serves a UAV.

    reached  some node's array has a gain towards it
    full     each of those serves as many UAVs as it may
    """
    if track.state in (TrackState.STALE, TrackState.LOST):
        return _silence_cause(track)
    if not reached:
        remedy = "turn an array, or fly elsewhere"
        return Blame(Cause.COVERAGE, "no node of the fleet reaches it", remedy)
    if full:
        remedy = "raise `[fleet] most`, or add a node"
        return Blame(Cause.UNSERVED, "every node that reaches it is full", remedy)
    remedy = "wait a few seconds for a node to take it; otherwise check the nodes of the fleet"
    return Blame(Cause.UNSERVED, "no node of the fleet serves it", remedy)


def of_beam(
    beam: Beam, track: Track, carrier: Carrier, needed_db: float, evidence: LinkEvidence
) -> Blame:
    """Return why a beam may lack, or likely lacks, the gain that its link needs."""
    silence = _silence(track, evidence)
    if silence is not None:
        return silence
    # A widened beam has less gain because of its bound, not because of other UAVs.
    if not beam.widened and (beam.gain_db < needed_db or beam.loss_db > CLOSE_UAVS_DB):
        return _short_of_gain(beam, needed_db)
    seen_rad = math.asin(min(1.0, (track.bound_m + carrier.bound_m) / max(beam.range_m, 1e-9)))
    if carrier.attitude_bound_rad > seen_rad:
        return _attitude_cause(carrier, evidence)
    return _bound_cause(beam, track, carrier, evidence)


def _attitude_cause(carrier: Carrier, evidence: LinkEvidence) -> Blame:
    """Return why the carrier's attitude is uncertain: its error, its age, or its clock."""
    if carrier.attitude_bound_rad < 1.5 * evidence.attitude_bound_rad:
        remedy = (
            "fit a dual-antenna GNSS or calibrate the compass, then lower"
            " `[center] attitude_bound_deg`"
        )
    elif evidence.carrier_doubt_s <= evidence.attitude_age_s:
        remedy = "request ATTITUDE from the carrier at 10 Hz: set `[presence] attitude_hz = 10`"
    elif evidence.carrier_assumed:
        remedy = f"improve the carrier's clock: {TIMESYNC}"
    else:
        remedy = f"improve the carrier's clock: {STEADIER_LINK}"
    known = f"{math.degrees(carrier.attitude_bound_rad):.0f}°"
    return Blame(Cause.CARRIER, f"the carrier's attitude is uncertain by {known}", remedy)


def _short_of_gain(beam: Beam, needed_db: float) -> Blame:
    if beam.loss_db > CLOSE_UAVS_DB:
        return Blame(
            Cause.CROWDED, f"other UAVs in its direction cost it {beam.loss_db:.0f} dB", FLY_APART
        )
    return Blame(
        Cause.RANGE,
        f"at {beam.range_m:.0f} m it needs {needed_db:.0f} dB, but the array gives"
        f" {beam.gain_db:.0f} dB",
        "fly closer, or use a larger array or more power (`[array]`, `[radio] tx_power_dbm`)",
    )


def _bound_cause(beam: Beam, track: Track, carrier: Carrier, evidence: LinkEvidence) -> Blame:
    """Return why the position is uncertain, as seen from the array."""
    aged_s = max(track.age_s, track.dt_s or 0.0)
    growth_m = _growth_m(track, aged_s)
    doubted_m = _growth_m(track, aged_s + track.clock_bound_s) - growth_m
    if track.velocity_ned_mps is not None:
        doubted_m += math.hypot(*track.velocity_ned_mps) * track.clock_bound_s
    parts = {
        Cause.RATE: growth_m,
        Cause.CLOCK: doubted_m,
        Cause.CARRIER: carrier.bound_m,
        Cause.POSITION: track.bound_m - growth_m - doubted_m,
    }
    match max(parts, key=lambda cause: parts[cause]):
        case Cause.RATE:
            return _age_cause(track)
        case Cause.CLOCK:
            return _clock(track, evidence)
        case Cause.CARRIER:
            reason = f"the carrier's position is uncertain by {carrier.bound_m:.0f} m"
            return Blame(Cause.CARRIER, reason, "fit a better GNSS receiver to the carrier")
        case _:
            reason = f"at {beam.range_m:.0f} m, its position is uncertain by"
            return Blame(
                Cause.POSITION,
                f"{reason} {track.bound_m:.0f} m",
                "fly farther from the array, or fit a better GNSS receiver to the UAV",
            )


def _growth_m(track: Track, seconds: float) -> float:
    """Return how far a UAV can deviate within a time from the prediction of its last report."""
    way_m = track.limits.speed_max_mps * seconds
    if track.velocity_ned_mps is None:
        return way_m
    return min(track.limits.acceleration_max_mps2 * seconds**2 / 2, way_m)


def _silence(track: Track, evidence: LinkEvidence) -> Blame | None:
    if evidence.refused is not None:
        return Blame(
            Cause.REFUSED,
            f"its reports are rejected: {evidence.refused}",
            "open the UAV's details and read its rejections",
        )
    if track.age_s > max(SILENT_S, SILENT_INTERVALS * (track.dt_s or 0.0)):
        return _silence_cause(track)
    return None


def _silence_cause(track: Track) -> Blame:
    remedy = "check its MAVLink link: power, range, antenna"
    return Blame(Cause.SILENT, f"no report for {track.age_s:.1f} s", remedy)


def _age_cause(track: Track) -> Blame:
    """Return why a prediction spans a long time: sparse reports, late reports, or an agile UAV."""
    if track.dt_s is not None and track.dt_s >= SPARSE_S:
        remedy = "request reports at 10 Hz: set `[presence] position_hz = 10`"
        return Blame(Cause.RATE, f"reports {track.dt_s:.1f} s apart", remedy)
    if track.latency_s is not None and track.latency_s >= LATE_S:
        return Blame(
            Cause.LATE, f"reports arrive {track.latency_s:.1f} s late", "use a faster MAVLink link"
        )
    return Blame(
        Cause.AGILE,
        f"it may accelerate by up to {track.limits.acceleration_max_mps2:.0f} m/s²",
        "raise `[presence] position_hz`, or lower `[observer] acceleration_max_mps2` to what the"
        " UAV can do",
    )


def _clock(track: Track, evidence: LinkEvidence) -> Blame:
    doubt_s = track.clock_bound_s
    known = f"{doubt_s * 1e3:.0f} ms" if doubt_s < 1.0 else f"{doubt_s:.1f} s"
    if evidence.clock_assumed:
        return Blame(Cause.CLOCK, f"its clock is unmeasured, uncertain by {known}", TIMESYNC)
    return Blame(Cause.CLOCK, f"its clock is uncertain by {known}", STEADIER_LINK)
