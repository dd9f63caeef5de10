"""Refuted assumptions, each with the setting that contains it.

Each is reported once. A limit that was raised decays, so that it may be refuted again: that is
reported again after a minute.
"""

import math
from typing import Final

from companion.mavlink.clock.estimates import ClockChange
from companion.pipeline.records import UavRecord, UavRecords
from companion.settings.tracking import ClockSettings
from companion.values import Estimate, Notice, Refuted, Severity

ATTITUDE_BOUND: Final = "center.attitude_bound_deg"
NOTICE_RATIO: Final = 1.25  # multiple of the value last reported above which a notice is repeated
_UNITS: Final = {
    "observer.speed_max_mps": "m/s",
    "observer.acceleration_max_mps2": "m/s²",
    "observer.position_noise_m": "m",
    "clocks.constant_delay_s": "s",
    "clocks.drift_max_ppm": "ppm",
    "center.turn_acceleration_max_degps2": "°/s²",
    ATTITUDE_BOUND: "°",
}
ARRAY: Final = "array"  # subject of what the array's own measurements refute
NOTICED_STEP_S: Final = 0.02
"""Least change of a clock or link for a notice: 0.4 m at 20 m/s, which the bound covers."""
WARNED_STEP_S: Final = 0.1  # change from which the notice is a warning
GATHERED_NS: Final = 5_000_000_000  # time over which changes are gathered in one notice
NOTICE_INTERVAL_NS: Final = 60_000_000_000  # least time between two equal notices
NAMED: Final = 6  # largest number of senders named in one notice


def notices(records: UavRecords, *refuted: Refuted | None) -> list[Refuted | Notice]:
    """Return refutations, each followed by a notice if it exceeds what was reported lately."""
    out: list[Refuted | Notice] = []
    for one in filter(None, refuted):
        out.append(one)
        record = records[one.uav]
        record.refuted += 1
        noticed_ns, proven = record.proven.get(one.setting, (0, 0.0))
        is_past = one.uav != ARRAY and one.t_ns - noticed_ns > NOTICE_INTERVAL_NS
        if one.proven > NOTICE_RATIO * proven or is_past:
            record.proven[one.setting] = one.t_ns, one.proven
            out.append(
                Notice(
                    t_ns=one.t_ns,
                    severity=Severity.WARNING,
                    subject=one.uav,
                    text=_refutation_text(one),
                )
            )
    return out


def attitude_bound_restored(records: UavRecords, t_ns: int, bound_rad: float) -> Notice:
    """Return the notice that the array confirms the bound on attitudes that it had refuted.

    A new refutation is announced again.
    """
    records[ARRAY].proven.pop(ATTITUDE_BOUND, None)
    text = (
        "the array sees UAVs again where the carrier's attitude puts them; an attitude error of up"
        f" to {math.degrees(bound_rad):.2g}° is assumed again"
    )
    return Notice(t_ns=t_ns, severity=Severity.INFO, subject=ARRAY, text=text)


def clock_changed(
    record: UavRecord, t_ns: int, sender: str, change: ClockChange, assumed: ClockSettings
) -> Refuted:
    """Return a change of a sender's clock or link as a refutation."""
    record.refuted += 1
    setting, limit = "clocks.drift_max_ppm", assumed.drift_max_ppm
    proven = raised_to = change.drift_ppm
    if change.was_late:
        setting, limit = "clocks.constant_delay_s", assumed.constant_delay_s
        proven, raised_to = limit - change.step_s, limit  # it held for the past
    return Refuted(
        t_ns=t_ns, uav=sender, setting=setting, limit=limit, proven=proven, raised_to=raised_to
    )


class ClockNotices:
    """Notices of changed clocks and links, gathered: ordinary clocks change by milliseconds."""

    def __init__(self) -> None:
        self._changes: dict[str, ClockChange] = {}  # the largest of each sender
        self._since_ns = 0
        self._noticed_ns: int | None = None

    def add(self, t_ns: int, sender: str, change: ClockChange) -> Notice | None:
        """Process a change. Returns a notice of a clock jump, or of late positions before it.

        Other changes are gathered.
        """
        if change.leapt or change.was_late:
            text = _clock_text(sender, change)
            return Notice(t_ns=t_ns, severity=Severity.WARNING, subject=sender, text=text)
        if abs(change.step_s) < NOTICED_STEP_S:
            return None
        if not self._changes:
            self._since_ns = t_ns
        before = self._changes.get(sender)
        if before is None or abs(change.step_s) > abs(before.step_s):
            self._changes[sender] = change
        return None

    def due(self, t_ns: int) -> Notice | None:
        """Return a notice of the gathered changes, if one is due."""
        if not self._changes or t_ns - self._since_ns < GATHERED_NS:
            return None
        if self._noticed_ns is not None and t_ns - self._noticed_ns < NOTICE_INTERVAL_NS:
            return None
        self._noticed_ns, changes, self._changes = t_ns, self._changes, {}
        largest_s = max(abs(change.step_s) for change in changes.values())
        severity = Severity.WARNING if largest_s >= WARNED_STEP_S else Severity.INFO
        (sender, change), *others = changes.items()
        if not others:
            text = _clock_text(sender, change)
            return Notice(t_ns=t_ns, severity=severity, subject=sender, text=text)
        names = ", ".join(list(changes)[:NAMED])
        rest = f" and {len(changes) - NAMED} more" if len(changes) > NAMED else ""
        text = (
            f"clocks or links of {names}{rest} changed by up to {largest_s * 1e3:.0f} ms; the"
            " bounds cover it"
        )
        return Notice(t_ns=t_ns, severity=severity, subject="clocks", text=text)


def _clock_text(sender: str, change: ClockChange) -> str:
    step = f"{change.step_s * 1e3:.0f} ms"
    if change.leapt:
        step = f"{abs(change.step_s):.1f} s"
        if change.step_s < 0:
            return f"{sender}: messages arrive {step} earlier than before; treated as a clock jump"
        return (
            f"{sender}: messages arrive {step} later than before; treated as a clock jump: if its"
            " link became slower, its positions are that much older than assumed; allow TIMESYNC"
        )
    if change.proven:
        return f"{sender}: clock changed by {step} more than clocks.drift_max_ppm allows"
    if change.was_late:
        return (
            f"{sender}: messages arrive {-change.step_s:.1f} s earlier than before: until now its"
            f" positions were {-change.step_s:.1f} s older than assumed, and its bounds too small;"
            " allow TIMESYNC, or set clocks.constant_delay_s"
        )
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
    if one.setting == "observer.velocity_noise_mps":
        return (
            f"{one.uav}: its positions contradict its velocities by {one.proven:.2g} m/s, beyond"
            f" {one.setting} ({one.limit:.2g}); {one.raised_to:.2g} m/s is assumed now"
        )
    if one.setting == ATTITUDE_BOUND and one.uav == ARRAY:
        return (
            f"the array sees UAVs at least {one.proven:.1f}° from where the carrier's attitude puts"
            f" them, beyond {one.setting} ({one.limit:.3g}°); up to {one.raised_to:.0f}° is assumed"
            " now: check the array's mount and the compass"
        )
    if one.setting == ATTITUDE_BOUND:
        return (
            f"{one.uav}: an attitude error of up to {one.raised_to:.0f}° is assumed now, not"
            f" {one.limit:.3g}° ({one.setting}): its estimator or compass has a problem, or a GNSS"
            " heading or second attitude contradicts it"
        )
    return (
        f"{one.uav}: {one.proven:.3g} {_UNITS[one.setting]} exceeds {one.setting}"
        f" ({one.limit:.3g}); {one.raised_to:.3g} is assumed now"
    )
