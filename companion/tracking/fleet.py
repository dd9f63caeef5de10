"""Which track a report belongs to, and how the tracks age.

A track is live while reports come, coasting when they fail to, stale when too old to point a
beam at, and lost; the ages at which it passes on are settings. Nothing here keeps time: the
newest accepted report and the time asked for decide.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from companion.tracking import observer
from companion.tracking.observer import PositionModel, PositionState
from companion.values import Estimate, Fix, FloatArray, Reason, Rejection, Track, TrackState


@dataclass(frozen=True, slots=True)
class Ages:
    """How old the newest report may be, in seconds, before a track passes to the next state."""

    coasting_s: float = 2.0
    stale_s: float = 15.0
    lost_s: float = 60.0

    def state(self, age_s: float) -> TrackState:
        """The state of a track whose newest report is this old."""
        if age_s > self.lost_s:
            return TrackState.LOST
        if age_s > self.stale_s:
            return TrackState.STALE
        return TrackState.COASTING if age_s > self.coasting_s else TrackState.LIVE


@dataclass(slots=True)
class _Tracked:
    newest: Fix
    state: PositionState
    latency_s: float
    reports: int = 1
    dt_s: float | None = None
    innovation_m: float | None = None
    mu_max_s2: float | None = None
    unknown_input_mps: FloatArray | None = None


SenderTime = Callable[[str, int], int]
"""(UAV, time of the node) to that time on the UAV's own timeline, by what is known now."""


class Fleet:
    """All tracks, by UAV id. ``accept`` reports, ask for a ``track`` at a time of the node.

    Tracks live on each sender's own timeline, so that what a link does to a report's arrival
    enters neither the intervals nor their order; ``sender_time`` leads there.
    """

    def __init__(self, model: PositionModel, ages: Ages, sender_time: SenderTime) -> None:
        self._sender_time = sender_time
        self._model = model
        self._ages = ages
        self._tracked: dict[str, _Tracked] = {}

    def accept(self, fix: Fix) -> Estimate | Rejection:
        """Put a report to its track, or begin one; a report older than the track is rejected."""
        latency_s = (fix.arrival_ns - fix.t_ns) * 1e-9
        tracked = self._tracked.get(fix.uav)
        if tracked is None:
            state = observer.begin(fix, self._model)
            self._tracked[fix.uav] = _Tracked(fix, state, latency_s)
            return Estimate(fix, state.estimate_ned_m, state.bound_m, None, None)
        dt_s = (fix.sender_ns - tracked.state.t_ns) * 1e-9
        if dt_s <= 0:
            detail = f"{-dt_s:.3f} s older than the report before it"
            return Rejection(fix.arrival_ns, fix.uav, Reason.OUT_OF_ORDER, detail=detail)
        tracked.state, predicted, tracked.unknown_input_mps = observer.update(
            tracked.state, fix, self._model
        )
        tracked.newest = fix
        innovation_m = observer.norm_m(fix.position_ned_m - predicted.position_ned_m)
        tracked.innovation_m = innovation_m
        tracked.mu_max_s2 = max(predicted.mu_s2, tracked.mu_max_s2 or 0.0)
        tracked.dt_s, tracked.latency_s = dt_s, latency_s
        tracked.reports += 1
        return Estimate(fix, predicted.position_ned_m, predicted.bound_m, innovation_m, dt_s)

    def restart(self, uav: str) -> None:
        """Forget a track: its sender was restarted, and its times begin anew."""
        self._tracked.pop(uav, None)

    def track(self, uav: str, now_ns: int, valid_at_ns: int) -> Track | None:
        """One UAV at ``valid_at_ns``, its state judged at ``now_ns``; None if never seen."""
        tracked = self._tracked.get(uav)
        if tracked is None:
            return None
        use_ns = self._sender_time(uav, valid_at_ns)
        predicted = observer.predict(tracked.state, use_ns, self._model)
        return Track(
            uav=uav,
            state=self._ages.state((self._sender_time(uav, now_ns) - tracked.state.t_ns) * 1e-9),
            valid_at_ns=valid_at_ns,
            age_s=(use_ns - tracked.state.t_ns) * 1e-9,
            position_ned_m=predicted.position_ned_m,
            velocity_ned_mps=observer.velocity_ned_mps(tracked.state, tracked.unknown_input_mps),
            unknown_input_mps=tracked.unknown_input_mps,
            bound_m=predicted.bound_m,
            dt_s=tracked.dt_s,
            latency_s=tracked.latency_s,
            gamma=None if tracked.mu_max_s2 is None else math.sqrt(tracked.mu_max_s2),
            innovation_m=tracked.innovation_m,
            reports=tracked.reports,
        )

    def newest(self, uav: str) -> Fix | None:
        """The newest accepted report of a UAV."""
        tracked = self._tracked.get(uav)
        return tracked.newest if tracked else None

    @property
    def uavs(self) -> list[str]:
        """The ids of all tracks, in the order in which they began."""
        return list(self._tracked)

    def states(self, now_ns: int, uavs: Iterable[str]) -> dict[str, TrackState]:
        """The states of those tracks that exist, without predicting anything."""
        return {
            uav: self._ages.state(
                (self._sender_time(uav, now_ns) - self._tracked[uav].state.t_ns) * 1e-9
            )
            for uav in uavs
            if uav in self._tracked
        }
