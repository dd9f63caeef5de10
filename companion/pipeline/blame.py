"""Causes of weak links: the input that limits a beam, as text, and a remedy.

The guaranteed gain is the least gain within the pointing bound. The cause of a large bound is the
input that, if it were ideal, would reduce it most (``angle_parts``): the carrier's attitude or
position, the UAV's reports, a clock, or this machine.

Over 300 lines: each cause needs a few, and side by side no two have the same text.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Final

from companion.pipeline.angle_parts import AngleParts, ErrorSource, grown, largest
from companion.pipeline.receiver_difference import ReceiverDifference
from companion.pipeline.refusals import SIGNATURE_REASONS, UNPROVEN
from companion.tracking.carrier import AttitudeParts
from companion.values import (
    Beam,
    Blame,
    Carrier,
    Cause,
    LeftOut,
    Reason,
    Track,
    TrackState,
    kind_of,
)

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
CHECK_LINK: Final = "check its MAVLink link: power, range, antenna"
CHECK_SIGNING: Final = "check its signing key, and that its signing clock has not stepped back"
CHECK_CARRIER: Final = "read its rejections in the notices, and check its GNSS receiver and id"
CHECK_HEIGHT: Final = "check its barometer, and that both heights are above mean sea level"
CHECK_ESTIMATOR: Final = "check its GNSS receiver, and whether its estimator uses it"
CHECK_GNSS: Final = "check its GNSS receiver and antenna, and look for interference"
NAME_ROUTER: Final = "add the trusted peer to `[links] routers`"
CHECK_RECEIVER: Final = "check the receiver that relays it, and the link to that receiver"


@dataclass(frozen=True, slots=True, kw_only=True)
class CarrierEvidence:
    """Facts about the carrier in addition to its pose; a station has none.

    attitude        parts of the bound on its attitude
    attitude_age_s  age of its newest attitude; None without one
    clock_assumed   the constant part of its latency is only assumed
    refused         why its newest positions were rejected; None: they were used
    dead_reckoning_s  time for which its receiver has had no fix
    """

    attitude: AttitudeParts = field(default_factory=AttitudeParts)
    attitude_age_s: float | None = None
    clock_assumed: bool = False
    refused: Reason | None = None
    dead_reckoning_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkEvidence:
    """Facts about a UAV's link in addition to its track.

    clock_assumed  the constant part of its latency is only assumed
    refused        why its newest reports were rejected; None: they were used
    waited_s       time for which frames may have waited for this machine
    carrier        facts about the carrier
    is_contradicted  whether the array sees it elsewhere than it reports
    dead_reckoning_s  time for which its receiver has had no fix
    receiver_difference  difference of its position and its receiver's
    """

    clock_assumed: bool
    refused: Reason | None
    is_contradicted: bool = False
    dead_reckoning_s: float = 0.0
    receiver_difference: ReceiverDifference = field(default_factory=ReceiverDifference)
    waited_s: float = 0.0
    carrier: CarrierEvidence = field(default_factory=CarrierEvidence)


def of_machine(waited_s: float) -> Blame:
    """Return this machine as the cause: frames waited so long to be read."""
    return Blame(
        Cause.MACHINE,
        f"this machine is overloaded: frames wait up to {_duration(waited_s)}",
        "close other programs and pages, or lower `[beams] update_hz`",
    )


def of_past(why: Blame, seconds: float) -> Blame:
    """Return the cause of a link that is good again, but has not been for so long."""
    return replace(why, reason=f"good again, for less than {seconds:g} s; before: {why.reason}")


def of_left_out(
    out: LeftOut, track: Track | None, unfit: str | None, refused: Reason | None = None
) -> Blame:
    """Return why a UAV has no beam.

    track    the UAV's track; None if there are too many UAVs to predict them all
    unfit    why no UAV can have a beam; None if UAVs can
    refused  why the newest reports, of the carrier if it is unfit, were rejected; None if they were
        used, or if none arrives
    """
    if unfit is not None:
        remedy = (
            "check the carrier's power, link and position fix, and that `[center] source` is its id"
        )
        if refused is not None:
            unfit = f"{unfit}: its positions are rejected ({refused})"
            remedy = _refused_remedy(refused, CHECK_CARRIER)
        return Blame(Cause.CARRIER, unfit, remedy)
    match out.cause:
        case Cause.CROWDED:
            remedy = FLY_APART
        case Cause.SILENT if refused is not None:
            return _refused_cause(refused)
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
    beam: Beam,
    track: Track,
    needed_db: float,
    evidence: LinkEvidence,
    parts: AngleParts,
    *,
    carrier: Carrier,
    when_good: AngleParts | None = None,
    before: Blame | None = None,
) -> Blame:
    """Return why a beam may lack, or likely lacks, the gain that its link needs.

    parts      parts of its pointing bound
    when_good  those when the link was last good; None: it never was
    before     cause given so far, which stays if no part has grown since: beams follow their bounds
        with a delay, and a level rises only with a margin
    """
    if evidence.is_contradicted:
        return of_contradicted()
    silence = _silence(track, evidence)
    if silence is not None:
        return silence
    # A widened beam has less gain because of its bound, not because of other UAVs.
    if not beam.widened and (beam.gain_db < needed_db or beam.loss_db > CLOSE_UAVS_DB):
        return _short_of_gain(beam, needed_db)
    source = None if when_good is None else grown(parts, when_good)
    if source is None and when_good is not None and before is not None:
        return before
    match source or largest(parts):
        case ErrorSource.MACHINE:
            return of_machine(evidence.waited_s)
        case ErrorSource.CARRIER_POSITION:
            return _carrier_position_cause(carrier, evidence)
        case ErrorSource.AGE:
            return _age_cause(track)
        case ErrorSource.CLOCK:
            return _clock(track, evidence)
        case ErrorSource.POSITION:
            bound = f"its position is uncertain by {_rounded(track.bound_m)} m"
            if evidence.dead_reckoning_s:
                return Blame(
                    Cause.POSITION, _without_fix(bound, evidence.dead_reckoning_s), CHECK_GNSS
                )
            difference = evidence.receiver_difference
            off = difference.larger
            if off.covered_m > track.bound_m / 2:
                check = CHECK_HEIGHT if off is difference.height else CHECK_ESTIMATOR
                off_text = off.text(f"up to {off.covered_m:.0f}")
                return Blame(Cause.POSITION, f"{bound}: {off_text}", check)
            remedy = _remedy(
                track,
                "fly farther from the array, or fit a better GNSS receiver to the UAV",
                relayed="receive its own telemetry, if it sends any: a receiver's is less accurate",
            )
            return Blame(Cause.POSITION, f"at {beam.range_m:.0f} m, {bound}", remedy)
        case part:
            return _attitude_cause(part, carrier, evidence)


def of_contradicted() -> Blame:
    """Return why the link of a UAV that the array sees elsewhere than it reports is not good."""
    return Blame(
        Cause.CONTRADICTED,
        f"{Reason.CONTRADICTED_BY_ARRAY}: the array sees it elsewhere than it reports",
        "check it for GNSS spoofing, a forged sender or a wrong datum",
    )


def _attitude_cause(part: ErrorSource, carrier: Carrier, evidence: LinkEvidence) -> Blame:
    """Return why the carrier's attitude is uncertain, by the part of its bound."""
    known = f"{_rounded(math.degrees(carrier.attitude_bound_rad))}°"
    reason = f"the carrier's attitude is uncertain by {known}"
    match part:
        case ErrorSource.ATTITUDE:
            remedy = (
                "fit a dual-antenna GNSS or calibrate the compass, then lower"
                " `[center] attitude_bound_deg`"
            )
        case ErrorSource.ATTITUDE_AGE:
            age_s = (evidence.carrier.attitude_age_s or 0.0) - evidence.waited_s
            if age_s > SILENT_S:
                return _carrier_silence("attitude", age_s, evidence)
            hz = 10 if age_s > SPARSE_S else 50
            remedy = f"request its ATTITUDE at {hz} Hz: set `[presence] attitude_hz = {hz}`"
        case ErrorSource.ATTITUDE_CONFLICT:
            reason = f"attitudes of the carrier contradict each other by {known}"
            remedy = "check its gyroscopes, and that only one component sends its ATTITUDE"
        case _:
            better = TIMESYNC if evidence.carrier.clock_assumed else STEADIER_LINK
            remedy = f"improve the carrier's clock: {better}"
    return Blame(Cause.CARRIER, reason, remedy)


def _carrier_position_cause(carrier: Carrier, evidence: LinkEvidence) -> Blame:
    age_s = (carrier.age_s or 0.0) - evidence.waited_s
    if age_s > SILENT_S:
        return _carrier_silence("position", age_s, evidence)
    reason = f"the carrier's position is uncertain by {_rounded(carrier.bound_m)} m"
    if evidence.carrier.dead_reckoning_s:
        return Blame(
            Cause.CARRIER, _without_fix(reason, evidence.carrier.dead_reckoning_s), CHECK_GNSS
        )
    return Blame(Cause.CARRIER, reason, "fit a better GNSS receiver to the carrier")


def _carrier_silence(missing: str, age_s: float, evidence: LinkEvidence) -> Blame:
    """Return why no position or attitude of the carrier was used for so long."""
    refused = evidence.carrier.refused
    if refused is not None:
        reason = f"the carrier's positions are rejected: {refused}"
        return Blame(Cause.CARRIER, reason, _refused_remedy(refused, CHECK_CARRIER))
    reason = f"no {missing} from the carrier for {_duration(age_s)}"
    return Blame(Cause.CARRIER, reason, CHECK_LINK)


def _short_of_gain(beam: Beam, needed_db: float) -> Blame:
    if beam.loss_db > CLOSE_UAVS_DB:
        reason = f"other UAVs in its direction cost it {beam.loss_db:.0f} dB"
        return Blame(Cause.CROWDED, reason, FLY_APART)
    return Blame(
        Cause.RANGE,
        f"at {beam.range_m:.0f} m it needs {needed_db:.0f} dB, but the array gives"
        f" {beam.gain_db:.0f} dB",
        "fly closer, or use a larger array or more power (`[array]`, `[radio] tx_power_dbm`)",
    )


def _silence(track: Track, evidence: LinkEvidence) -> Blame | None:
    refused, is_silent = evidence.refused, _is_silent(track, evidence.waited_s)
    if refused is not None and (is_silent or refused not in UNPROVEN):
        return _refused_cause(refused)
    return _silence_cause(track) if is_silent else None


def of_coasting(track: Track, evidence: LinkEvidence) -> Blame:
    """Return why the link of a coasting UAV is not good, although its gain is enough."""
    return _silence(track, evidence) or _silence_cause(track)


def _is_silent(track: Track, waited_s: float) -> bool:
    """Return whether no report has arrived for longer than its interval and latency explain."""
    unheard_s = track.age_s - (track.latency_s or 0.0) - waited_s
    return unheard_s > max(SILENT_S, SILENT_INTERVALS * (track.dt_s or 0.0))


def _refused_cause(refused: Reason) -> Blame:
    if refused is Reason.NEWCOMER:
        return Blame(
            Cause.MACHINE,
            "this machine is overloaded, and drops its reports",
            "name it in `[tracks] allow`, or stop the sender that floods the links",
        )
    remedy = _refused_remedy(refused, "open the UAV's details and read its rejections")
    return Blame(Cause.REFUSED, f"its reports are rejected: {refused}", remedy)


def _refused_remedy(refused: Reason, otherwise: str) -> str:
    if refused in SIGNATURE_REASONS:
        return CHECK_SIGNING
    if refused is Reason.NO_FIX:
        return CHECK_GNSS
    return NAME_ROUTER if refused is Reason.STRANGER else otherwise


def _silence_cause(track: Track) -> Blame:
    reason = f"no report for {_duration(track.age_s)}"
    return Blame(Cause.SILENT, reason, _remedy(track, CHECK_LINK))


def _remedy(track: Track, own: str, *, relayed: str = CHECK_RECEIVER) -> str:
    """Return the remedy for a UAV that reports itself, or for one that a receiver relays."""
    return own if kind_of(track.uav).reports_itself else relayed


def _age_cause(track: Track) -> Blame:
    """Return why a prediction spans a long time: sparse reports, late reports, or an agile UAV."""
    late_s = track.latency_s or 0.0
    if track.dt_s is not None and track.dt_s >= max(SPARSE_S, late_s):
        own = "request reports at 10 Hz: set `[presence] position_hz = 10`"
        remedy = _remedy(track, own)
        return Blame(Cause.RATE, f"reports {_duration(track.dt_s)} apart", remedy)
    if late_s >= LATE_S:
        return _late(track, late_s)
    lower = "lower `[observer] acceleration_max_mps2` to what the UAV can do"
    return Blame(
        Cause.AGILE,
        f"it may accelerate by up to {track.limits.acceleration_max_mps2:.0f} m/s²",
        _remedy(track, f"raise `[presence] position_hz`, or {lower}", relayed=lower),
    )


def _late(track: Track, late_s: float) -> Blame:
    reason = f"reports arrive {_duration(late_s)} late"
    return Blame(Cause.LATE, reason, _remedy(track, "use a faster MAVLink link"))


def _clock(track: Track, evidence: LinkEvidence) -> Blame:
    doubt_s, late_s = track.clock_bound_s, track.latency_s or 0.0
    if not evidence.clock_assumed and late_s >= max(LATE_S, doubt_s / 2):
        return _late(track, late_s)  # the link's delay is what makes the clock uncertain
    known = f"uncertain by {_duration(doubt_s)}"
    if evidence.clock_assumed:
        return Blame(Cause.CLOCK, f"its clock is unmeasured, {known}", _remedy(track, TIMESYNC))
    return Blame(Cause.CLOCK, f"its clock is {known}", _remedy(track, STEADIER_LINK))


def _without_fix(reason: str, seconds: float) -> str:
    return f"{reason}, after {_duration(seconds)} without a GNSS fix"


def _duration(seconds: float) -> str:
    return f"{seconds * 1e3:.0f} ms" if seconds < 1.0 else f"{seconds:.1f} s"


def _rounded(value: float) -> str:
    """Return a number without decimals; a small one with two digits, never as 0."""
    return f"{value:.0f}" if value >= 2.0 else f"{value:.2g}"
