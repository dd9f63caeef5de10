"""What reports refute, told once: which assumption was wrong, and by which setting it is held."""

from collections.abc import Iterable
from typing import Final

from companion.mavlink.clock.estimates import ClockChange
from companion.values import Estimate, Notice, Refuted, Severity

AGAIN: Final = 1.25
"""Multiple of what was told last above which it is told again."""
_UNITS: Final = {
    "observer.speed_max_mps": "m/s",
    "observer.acceleration_max_mps2": "m/s²",
    "observer.position_noise_m": "m",
    "clocks.drift_max_ppm": "ppm",
    "center.turn_acceleration_max_degps2": "°/s²",
    "center.attitude_bound_deg": "°",
}
SILENT_NS: Final = 60_000_000_000
"""Time for which a change of a clock or link is not told again."""


class Assumptions:
    """Counts refutations by UAV, and tells each once."""

    def __init__(self) -> None:
        self._told: dict[tuple[str, str], float] = {}
        self._told_ns: dict[str, int] = {}
        self._times: dict[str, int] = {}

    def told(self, refuted: Iterable[Refuted]) -> list[Refuted | Notice]:
        """The refutations, each followed by a notice if there is news in it."""
        out: list[Refuted | Notice] = []
        for one in refuted:
            out.append(one)
            self._times[one.uav] = self._times.get(one.uav, 0) + 1
            key = (one.uav, one.setting)
            if one.proven > AGAIN * self._told.get(key, 0.0):
                self._told[key] = one.proven
                out.append(
                    Notice(
                        t_ns=one.t_ns, severity=Severity.WARNING, subject=one.uav, text=_said(one)
                    )
                )
        return out

    def clock(
        self, t_ns: int, sender: str, change: ClockChange, drift_max_ppm: float
    ) -> list[Refuted | Notice]:
        """A change of a sender's clock, or of its link, as a refutation and a notice."""
        drift = change.drift_ppm
        self._times[sender] = self._times.get(sender, 0) + 1
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
        if change.leapt or t_ns - self._told_ns.get(sender, -SILENT_NS) >= SILENT_NS:
            self._told_ns[sender] = t_ns
            step = f"{change.step_s * 1e3:.0f} ms"
            if change.leapt:
                way = "later" if change.step_s > 0 else "earlier"
                why = "that is taken for a leap of its clock, as no link is known to be so slow"
                text = f"all of {sender} comes {abs(change.step_s):.1f} s {way} than before: {why}"
            elif change.proven:
                text = f"the clock of {sender} changed by {step} more than clocks.drift_max_ppm"
            else:
                why = "its clock stood still, or its link got slower; both are allowed for"
                text = f"all of {sender} comes {step} later than before: {why}"
            out.append(Notice(t_ns=t_ns, severity=Severity.WARNING, subject=sender, text=text))
        return out

    def jumped(self, begun: Estimate) -> list[Refuted]:
        """A track that was begun again from reports that were refused, as a refutation.

        They agree among themselves, so what they were refused by is wrong.
        """
        fix, jump_m = begun.fix, begun.innovation_m or 0.0
        self._times[fix.uav] = self._times.get(fix.uav, 0) + 1
        limit_m = fix.noise.position_m
        name = "observer.position_noise_m"
        return [
            Refuted(
                t_ns=fix.arrival_ns,
                uav=fix.uav,
                setting=name,
                limit=limit_m,
                proven=jump_m,
                raised_to=limit_m,
            )
        ]

    def times(self, uav: str) -> int:
        """How often assumptions about a UAV were refuted."""
        return self._times.get(uav, 0)

    def forget(self, uav: str) -> None:
        """Forget what was told of a UAV that is gone."""
        self._times.pop(uav, None)
        self._told_ns.pop(uav, None)
        for key in [key for key in self._told if key[0] == uav]:
            del self._told[key]


def _said(one: Refuted) -> str:
    if one.setting == "observer.follow_accuracy":
        return (
            f"the receiver of {one.uav} states {one.limit:.2g} m, but strays by {one.proven:.2g} m "
            f"from its velocities ({one.setting}): {one.raised_to:.2g} m is assumed now"
        )
    if one.setting == "center.attitude_bound_deg":
        return (
            f"the attitude of {one.uav} is taken to be off by up to {one.raised_to:.0f}°, not "
            f"{one.limit:.3g} ({one.setting}): its estimator doubts it or its compass"
        )
    return (
        f"{one.uav} does {one.proven:.3g} {_UNITS[one.setting]}, more than {one.setting}"
        f" ({one.limit:.3g}): {one.raised_to:.3g} is assumed now"
    )
