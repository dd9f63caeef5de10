"""Summary of a replay, as ``companion replay --json`` prints it."""

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from companion.pipeline.fold import Pipeline
from companion.values import Estimate, Event, Update, kind_of


@dataclass(slots=True, kw_only=True)
class Tally:
    """Figures collected during a replay, for its summary."""

    reports: Counter[str] = field(default_factory=Counter)
    dt_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    latency_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    innovation_m: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    reacquired: Counter[str] = field(default_factory=Counter)
    refuted: Counter[str] = field(default_factory=Counter)
    updates: int = 0
    regularised: int = 0
    condition_number_max: float | None = None
    first_ns: int | None = None
    last_ns: int = 0

    def event(self, event: Event) -> None:
        """Extend the time span of the replay by an event."""
        t_ns = event.t_ns
        if self.first_ns is None:
            self.first_ns = t_ns
        # A frame may be processed after a later tick.
        self.last_ns = t_ns if t_ns > self.last_ns else self.last_ns

    def estimate(self, estimate: Estimate) -> None:
        """Count an accepted report."""
        fix = estimate.fix
        self.reports[fix.uav] += 1
        self.reacquired[fix.uav] += estimate.reacquired
        self.latency_s[fix.uav].append((fix.arrival_ns - fix.t_ns) * 1e-9)
        if estimate.dt_s is not None and estimate.innovation_m is not None:
            self.dt_s[fix.uav].append(estimate.dt_s)
            self.innovation_m[fix.uav].append(estimate.innovation_m)

    def update(self, update: Update) -> None:
        """Count a beam update; those without beams do not count."""
        condition = update.beams.condition_number
        if condition is None:
            return
        self.updates += 1
        self.regularised += update.beams.regularised
        self.condition_number_max = max(condition, self.condition_number_max or 0.0)


def summary(pipeline: Pipeline, tally: Tally) -> dict[str, Any]:
    """Return the figures of a replay; ``unaimed`` says why no beam was computed."""
    now_ns = tally.last_ns
    tracks = {track.uav: track for track in pipeline.tracks(now_ns, now_ns)}
    carrier = str(pipeline.center.place)
    heard = [uav for uav in dict.fromkeys([*tally.reports, *tracks]) if uav != carrier]
    return {
        "frames": pipeline.frames,
        "rejected": {
            str(reason): count for reason, count in sorted(pipeline.refusals.total.items())
        },
        "reports": {uav: tally.reports[uav] for uav in heard},
        "uavs": {
            uav: {
                "reports": tally.reports[uav],
                "dt_median_s": _percentile(tally.dt_s[uav], 50),
                "dt_max_s": _percentile(tally.dt_s[uav], 100),
                "latency_p50_s": _percentile(tally.latency_s[uav], 50),
                "latency_p95_s": _percentile(tally.latency_s[uav], 95),
                "innovation_rms_m": _rms(tally.innovation_m[uav]),
                "gamma": tracks[uav].gamma if uav in tracks else None,
                "state": str(tracks[uav].state) if uav in tracks else "dropped",
                "restarts": pipeline.restarts[uav],
                "reacquired": tally.reacquired[uav],
                "refuted": tally.refuted[uav],
                "rejected": {
                    str(reason): count
                    for reason, count in sorted(pipeline.refusals.of(uav).counts.items())
                },
            }
            for uav in heard
        },
        "center": str(pipeline.center.place),
        "beams": {
            "updates": tally.updates,
            "condition_number_max": tally.condition_number_max,
            "regularised": tally.regularised,
        },
        "unaimed": _unaimed(pipeline, tally),
        "duration_s": 0.0 if tally.first_ns is None else (now_ns - tally.first_ns) * 1e-9,
    }


def _unaimed(pipeline: Pipeline, tally: Tally) -> str | None:
    """Return why no beam was computed in the whole log; None if a beam was computed."""
    update = pipeline.last_update
    if tally.updates:
        return None
    if update is None:
        return "the log is shorter than one update"
    carrier = pipeline.center.vehicle
    if carrier is not None and carrier not in pipeline.tracker:
        return f"no position from the carrier {carrier}"
    if update.unfit is not None and pipeline.tracker.uavs:
        return update.unfit
    if update.beams.left_out:
        first = update.beams.left_out[0]
        return f"{first.uav}: {first.reason}"
    others = [uav for uav in pipeline.tracker.uavs if uav != pipeline.center.vehicle]
    if others and not any(kind_of(uav).reports_itself for uav in others):
        return 'only relayed aircraft were received, and [beams] targets is not "all"'
    if others:
        return "every UAV was silent for too long"
    refused = pipeline.refusals.total.most_common(1)
    seen = f"; most frequent rejection: {refused[0][0]}" if refused else ""
    return f"no UAV reported a usable position{seen}"


def _percentile(values: list[float], percent: float) -> float | None:
    return float(np.percentile(values, percent)) if values else None


def _rms(values: list[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None
