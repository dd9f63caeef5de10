"""Refuted assumptions, each with the setting that contains it. Each is reported once."""

from typing import Final

from companion.mavlink.clock.estimates import ClockChange
from companion.pipeline.records import UavRecord, UavRecords
from companion.values import Estimate, Notice, Refuted, Severity

NOTICE_RATIO: Final = 1.25  # multiple of the value last reported above which a notice is repeated
_UNITS: Final = {
    "observer.speed_max_mps": "m/s",
    "observer.acceleration_max_mps2": "m/s²",
    "observer.position_noise_m": "m",
    "clocks.drift_max_ppm": "ppm",
    "center.turn_acceleration_max_degps2": "°/s²",
    "center.attitude_bound_deg": "°",
}
NOTICE_INTERVAL_NS: Final = (
    60_000_000_000  # least time between two notices of a change of a clock or link
)


def notices(records: UavRecords, *refuted: Refuted | None) -> list[Refuted | Notice]:
    """Return refutations, each followed by a notice if it exceeds what was reported before."""
    out: list[Refuted | Notice] = []
    for one in filter(None, refuted):
        out.append(one)
        record = records[one.uav]
        record.refuted += 1
        if one.proven > NOTICE_RATIO * record.proven.get(one.setting, 0.0):
            record.proven[one.setting] = one.proven
            out.append(
                Notice(
                    t_ns=one.t_ns,
                    severity=Severity.WARNING,
                    subject=one.uav,
                    text=_refutation_text(one),
                )
            )
    return out


def clock_changed(
    record: UavRecord, t_ns: int, sender: str, change: ClockChange, drift_max_ppm: float
) -> list[Refuted | Notice]:
    """Return a change of a sender's clock or link as a refutation and a notice."""
    drift = change.drift_ppm
    record.refuted += 1
    out: list[Refuted | Notice] = [
        Refuted(
            t_ns=t_ns,
            uav=sender,
            setting="clocks.drift_max_ppm",
            limit=drift_max_ppm,
            proven=drift,
            raised_to=drift,
        )
    ]
    notified_ns = record.clock_notice_ns
    if change.leapt or notified_ns is None or t_ns - notified_ns >= NOTICE_INTERVAL_NS:
        record.clock_notice_ns = t_ns
        out.append(
            Notice(
                t_ns=t_ns,
                severity=Severity.WARNING,
                subject=sender,
                text=_clock_text(sender, change),
            )
        )
    return out


def _clock_text(sender: str, change: ClockChange) -> str:
    step = f"{change.step_s * 1e3:.0f} ms"
    if change.leapt:
        way = "later" if change.step_s > 0 else "earlier"
        step = f"{abs(change.step_s):.1f} s {way}"
        return f"{sender}: messages arrive {step} than before; treated as a clock jump"
    if change.proven:
        return f"{sender}: clock changed by {step} more than clocks.drift_max_ppm allows"
    why = "clock stalled or link slowed down; the bound covers both"
    return f"{sender}: messages arrive {step} later than before: {why}"


def track_restarted(record: UavRecord, begun: Estimate) -> Refuted:
    """Return the refutation for a track that was restarted from rejected reports.

    The reports agree with each other, so the assumption that rejected them is wrong.
    """
    fix, jump_m = begun.fix, begun.innovation_m or 0.0
    record.refuted += 1
    limit_m = fix.noise.position_m
    name = "observer.position_noise_m"
    return Refuted(
        t_ns=fix.arrival_ns,
        uav=fix.uav,
        setting=name,
        limit=limit_m,
        proven=jump_m,
        raised_to=limit_m,
    )


def _refutation_text(one: Refuted) -> str:
    if one.setting == "observer.follow_accuracy":
        return (
            f"{one.uav}: receiver states an accuracy of {one.limit:.2g} m, but deviates by"
            f" {one.proven:.2g} m from its velocities ({one.setting});"
            f" {one.raised_to:.2g} m is assumed now"
        )
    if one.setting == "center.attitude_bound_deg":
        return (
            f"{one.uav}: an attitude error of up to {one.raised_to:.0f}° is assumed now, not"
            f" {one.limit:.3g}° ({one.setting}): its estimator reports a problem with its attitude"
            " or compass"
        )
    return (
        f"{one.uav}: {one.proven:.3g} {_UNITS[one.setting]} exceeds {one.setting}"
        f" ({one.limit:.3g}); {one.raised_to:.3g} is assumed now"
    )
