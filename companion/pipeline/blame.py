"""Why a link is not good: what holds its beam back most, in words, and what to do about it.

The gain that is guaranteed is the least within the pointing bound, so what makes that bound large
is to blame: the carrier's attitude and position, or one part of the bound on the UAV's position.
"""

import math
from dataclasses import dataclass
from typing import Final

from companion.values import Beam, Blame, Carrier, Cause, LeftOut, Reason, Track, TrackState

CROWDED_DB: Final = 3.0
"""Loss against a beam for a UAV alone from which on the other UAVs are to blame."""
SPARSE_S: Final = 0.25  # interval between reports from which on asking for more of them helps
LATE_S: Final = 0.15  # latency from which on a faster link helps
SILENT_S: Final = 1.0
"""Age of the newest report from which on a UAV is silent, if that is several intervals too."""
SILENT_INTERVALS: Final = 3.0

TIMESYNC: Final = "allow TIMESYNC ([presence] enabled), over a link both ways"
STEADIER: Final = "use a MAVLink link of steadier delay"


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkEvidence:
    """What is known of a UAV beside its track."""

    clock_assumed: bool  # the constant part of its latency is only assumed
    refused: Reason | None  # why its newest reports were not used; None where they were
    attitude_bound_rad: float = 0.0  # what the carrier's attitudes may be off when they are made
    attitude_age_s: float = 0.0  # how old the newest of them is
    carrier_doubt_s: float = 0.0  # how far the carrier's clock may be off
    carrier_assumed: bool = False  # the constant part of its latency is only assumed


def of_left_out(out: LeftOut, track: Track | None, unfit: str | None) -> Blame:
    """Why a UAV has no beam. ``unfit`` is what keeps everybody from having one.

    ``track`` is None where there are too many for all to be looked at.
    """
    if unfit is not None:
        return Blame(
            Cause.CARRIER, unfit, "see what carries the array: is it powered, heard, with a fix?"
        )
    match out.cause:
        case Cause.CROWDED:
            remedy = 'fly them apart, or set [beams] policy = "group"'
        case Cause.SILENT if track is not None:
            return _silent(track)
        case Cause.MACHINE:
            remedy = "name it in [beams] priority, or raise [beams] most"
        case _:
            remedy = "turn the array or its carrier, or fly elsewhere"
    return Blame(out.cause, out.reason, remedy)


def of_unserved(track: Track, *, reached: bool, full: bool) -> Blame:
    """Why no node of the fleet serves a UAV.

    reached  some node's array has a gain towards it
    full     each of those serves as many as it may
    """
    if track.state in (TrackState.STALE, TrackState.LOST):
        return _silent(track)
    if not reached:
        remedy = "turn an array, or fly elsewhere"
        return Blame(Cause.COVERAGE, "no node of the fleet reaches it", remedy)
    if full:
        remedy = "raise [fleet] most, or add a node"
        return Blame(Cause.UNSERVED, "every node that reaches it is full", remedy)
    remedy = "one takes it within seconds; if not, see the fleet's nodes"
    return Blame(Cause.UNSERVED, "no node of the fleet serves it", remedy)


def of_beam(
    beam: Beam, track: Track, carrier: Carrier, needed_db: float, evidence: LinkEvidence
) -> Blame:
    """Why a beam surely does not have the gain that its link needs, or likely does not."""
    silence = _silence(track, evidence)
    if silence is not None:
        return silence
    # A beam that is broadened has less gain because of its bound, whoever else is there.
    if not beam.widened and (beam.gain_db < needed_db or beam.loss_db > CROWDED_DB):
        return _short_of_gain(beam, needed_db)
    seen_rad = math.asin(min(1.0, (track.bound_m + carrier.bound_m) / max(beam.range_m, 1e-9)))
    if carrier.attitude_bound_rad > seen_rad:
        return _turned(carrier, evidence)
    return _far_off(beam, track, carrier, evidence)


def _turned(carrier: Carrier, evidence: LinkEvidence) -> Blame:
    """Why the carrier's attitude may be far off: by itself, by its age, or by its clock."""
    if carrier.attitude_bound_rad < 1.5 * evidence.attitude_bound_rad:
        remedy = "give it a better compass, and say so ([center] attitude_bound_deg)"
    elif evidence.carrier_doubt_s <= evidence.attitude_age_s:
        remedy = "ask the carrier for ATTITUDE at 10 Hz or more ([presence] attitude_hz)"
    elif evidence.carrier_assumed:
        remedy = f"have its clock known: {TIMESYNC}"
    else:
        remedy = f"have its clock known: {STEADIER}"
    known = f"{math.degrees(carrier.attitude_bound_rad):.0f}°"
    return Blame(Cause.CARRIER, f"the carrier's attitude is only known to {known}", remedy)


def _short_of_gain(beam: Beam, needed_db: float) -> Blame:
    if beam.loss_db > CROWDED_DB:
        return Blame(
            Cause.CROWDED,
            f"other UAVs in its direction cost it {beam.loss_db:.0f} dB",
            'fly them apart, or set [beams] policy = "group"',
        )
    return Blame(
        Cause.RANGE,
        f"{beam.range_m:.0f} m away it needs {needed_db:.0f} dB, and the array gives"
        f" {beam.gain_db:.0f}",
        "fly nearer, or use more elements or more power",
    )


def _far_off(beam: Beam, track: Track, carrier: Carrier, evidence: LinkEvidence) -> Blame:
    """Why the position may be far off, as seen from the array."""
    aged_s = max(track.age_s, track.dt_s or 0.0)
    grown_m = _grown_m(track, aged_s)
    doubted_m = _grown_m(track, aged_s + track.clock_bound_s) - grown_m
    if track.velocity_ned_mps is not None:
        doubted_m += math.hypot(*track.velocity_ned_mps) * track.clock_bound_s
    parts = {
        Cause.RATE: grown_m,
        Cause.CLOCK: doubted_m,
        Cause.CARRIER: carrier.bound_m,
        Cause.POSITION: track.bound_m - grown_m - doubted_m,
    }
    match max(parts, key=lambda cause: parts[cause]):
        case Cause.RATE:
            return _aged(track)
        case Cause.CLOCK:
            return _clock(track, evidence)
        case Cause.CARRIER:
            reason = f"the carrier's own position is only known to {carrier.bound_m:.0f} m"
            return Blame(Cause.CARRIER, reason, "give the carrier a better GNSS receiver")
        case _:
            reason = f"{beam.range_m:.0f} m away, its position is only known to"
            return Blame(
                Cause.POSITION,
                f"{reason} {track.bound_m:.0f} m",
                "fly farther from the array, or give it a better GNSS receiver",
            )


def _grown_m(track: Track, seconds: float) -> float:
    """How far a UAV can come in so long from where its last report lets it be expected."""
    way_m = track.limits.speed_max_mps * seconds
    if track.velocity_ned_mps is None:
        return way_m
    return min(track.limits.acceleration_max_mps2 * seconds**2 / 2, way_m)


def _silence(track: Track, evidence: LinkEvidence) -> Blame | None:
    if evidence.refused is not None:
        return Blame(
            Cause.REFUSED, f"its reports are not used: {evidence.refused}", "see its rejections"
        )
    if track.age_s > max(SILENT_S, SILENT_INTERVALS * (track.dt_s or 0.0)):
        return _silent(track)
    return None


def _silent(track: Track) -> Blame:
    return Blame(Cause.SILENT, f"no report for {track.age_s:.1f} s", "see its MAVLink link")


def _aged(track: Track) -> Blame:
    """Why a prediction reaches far: reports are far apart, or late, or the UAV turns quickly."""
    if track.dt_s is not None and track.dt_s >= SPARSE_S:
        remedy = "ask for 10 Hz ([presence] position_hz)"
        return Blame(Cause.RATE, f"reports {track.dt_s:.1f} s apart", remedy)
    if track.latency_s is not None and track.latency_s >= LATE_S:
        return Blame(
            Cause.LATE, f"reports come {track.latency_s:.1f} s late", "use a faster MAVLink link"
        )
    return Blame(
        Cause.AGILE,
        f"it may accelerate by {track.limits.acceleration_max_mps2:.0f} m/s²",
        "ask for more reports, or tell what it can ([observer] acceleration_max_mps2)",
    )


def _clock(track: Track, evidence: LinkEvidence) -> Blame:
    doubt_s = track.clock_bound_s
    known = f"{doubt_s * 1e3:.0f} ms" if doubt_s < 1.0 else f"{doubt_s:.1f} s"
    if evidence.clock_assumed:
        return Blame(Cause.CLOCK, f"clock only assumed, to {known}", TIMESYNC)
    return Blame(Cause.CLOCK, f"its clock is only known to {known}", STEADIER)
