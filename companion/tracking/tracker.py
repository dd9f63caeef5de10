"""Tracks of all UAVs: assignment and gating of reports, and the states of tracks.

A track is live while reports arrive, coasting when they fail to, stale when too old for a beam, and
lost; the ages at which it changes are settings. The module keeps no time: only the newest accepted
report and the requested time matter.

Over 300 lines: reports in and tracks out share the state of a track.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any, Final

from companion.tracking.gate import GateSettings, Suspects, is_frozen, refusal
from companion.tracking.history import ReportHistory
from companion.tracking.limits import Refutations
from companion.tracking.newest_positions import NewestPositions
from companion.tracking.noise import NoiseSettings
from companion.tracking.observers.estimates import Observer, Prediction
from companion.tracking.pace import ReportTiming
from companion.tracking.past_predictions import ACCELERATION_MODELS, WINDOWS, PastPredictions
from companion.tracking.receiver_check import ReceiverCheck
from companion.tracking.track_snapshot import Ages, TrackSnapshot
from companion.tracking.velocity_check import VelocityCheck
from companion.values import (
    Estimate,
    Fix,
    Limits,
    Reason,
    Refuted,
    Rejection,
    SenderTime,
    Track,
    TrackState,
    Vector,
    kind_of,
)

ESTABLISHED: Final = 50
"""Number of reports that establish a UAV: tracks with fewer make room for its return."""
SWEEP_NS: Final = 1_000_000_000  # least time between two searches for tracks that make room


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerSettings:
    """Settings of the tracker.

    gate                   when rejected reports restart a track
    noise                  how the bounds on the reports' noise were derived; None: they are trusted
    """

    limits: Limits  # limits of aircraft whose reports carry none
    ages: Ages = field(default_factory=Ages)  # when a track changes its state
    gate: GateSettings = field(default_factory=GateSettings)
    window_s: float = 5.0  # how late a report may arrive and still be sorted in
    feed_forward: bool = False  # whether an estimated acceleration enters predictions
    most: int = 2000  # largest number of tracks, without that of the carrier
    carrier: str | None = None  # vehicle that is always tracked
    noise: NoiseSettings | None = None


@dataclass(slots=True, kw_only=True)
class _Past:
    """State of a UAV that survives a restart of its track.

    ``receiver_check`` is None if stated noise is trusted.
    """

    refutations: Refutations
    receiver_check: ReceiverCheck | None
    velocity_check: VelocityCheck
    pace: ReportTiming


@dataclass(slots=True, kw_only=True)
class _Tracked:
    """Track of one UAV: its newest reports, and the state derived from them.

    ``snapshot`` is None until it is needed, and again after the next report.
    """

    past: _Past
    history: ReportHistory[Any]
    suspects: Suspects[Any]
    arrived: Fix
    newest: Estimate
    reports: int = 1
    believable_ns: int = 0
    unknown_input: Vector | None = None
    mu_max_s2: float | None = None
    acceleration: Vector | None = None
    predictions: PastPredictions = field(default_factory=PastPredictions)
    snapshot: TrackSnapshot | None = None


class Tracker:
    """Tracks of all UAVs by id. ``accept`` takes reports; ``track`` predicts to a time.

    Tracks are on each sender's own timeline, so that link delays change neither the intervals nor
    their order. The caller of ``track`` converts the time to that timeline.
    """

    def __init__(self, observer: Observer[Any], settings: TrackerSettings) -> None:
        self._observer = observer
        self._settings = settings
        self._tracked: dict[str, _Tracked] = {}
        self._positions = NewestPositions()
        self._established: set[str] = set()  # dropped UAVs that had many reports
        self._swept_ns = -SWEEP_NS

    # --- input: reports ---------------------------------------------------------------------

    def accept(self, fix: Fix) -> tuple[Estimate | Rejection, list[Refuted]]:
        """Add a report to its track, or start a track; or return the rejection.

        Also returns the refutations of its aircraft's limits and its receiver's accuracy. They
        raise the bounds before the report is checked.
        """
        tracked = self._tracked.get(fix.uav)
        if tracked is not None:
            tracked.snapshot = None
        past = self._new_past() if tracked is None else tracked.past
        fix, refuted = self._with_raised_limits(past, fix)
        if tracked is None and not self._has_room(fix.uav, fix.arrival_ns):
            why = f"limit of {self._settings.most} tracks reached"
            return _rejected(fix, Reason.TOO_MANY, why), refuted
        if tracked is None or self._is_lost(tracked, fix):
            found: Estimate | Rejection = self._begin(fix, past)
        else:
            found = self._accepted(tracked, fix)
        if isinstance(found, Estimate):
            newest = self._tracked[fix.uav].history.newest.fix
            self._positions.put(fix.uav, newest.position_ned_m)
        if isinstance(found, Estimate) or found.reason is Reason.UNREACHABLE:
            wrong = past.velocity_check.look(fix, self._limits(fix).acceleration_max_mps2)
            refuted += [] if wrong is None else [wrong]
        return found, refuted

    def _new_past(self) -> _Past:
        noise = self._settings.noise
        return _Past(
            refutations=Refutations(),
            receiver_check=None if noise is None else ReceiverCheck(noise),
            velocity_check=VelocityCheck(),
            pace=ReportTiming(),
        )

    def _with_raised_limits(self, past: _Past, fix: Fix) -> tuple[Fix, list[Refuted]]:
        """Return a report with its raised bounds, and the refutations by this report."""
        given = self._limits(fix)
        found = past.refutations.look(fix if fix.limits else fix._replace(limits=given))
        limits, noise = past.refutations.limits(given, fix.sender_ns), fix.noise
        if past.receiver_check is not None:
            refuted = past.receiver_check.look(fix, limits.acceleration_max_mps2)
            noise = past.receiver_check.noise(noise)
            found += [] if refuted is None else [refuted]
        noise = past.velocity_check.noise(noise, fix.sender_ns)
        if limits is given and noise is fix.noise:
            return fix, found
        return fix._replace(limits=limits, noise=noise), found

    def _accepted(self, tracked: _Tracked, fix: Fix) -> Estimate | Rejection:
        index = tracked.history.index(fix.sender_ns)
        if index is None:
            return _rejected(fix, Reason.OUT_OF_ORDER, "older than the window for late reports")
        before = tracked.history.entries[max(index - 1, 0)]
        wrong = self._basic_rejection(tracked, index, fix)
        if wrong is not None:
            return _rejected(fix, *wrong)
        predicted = self._observer.predict(before.state, fix.sender_ns)
        impossible = refusal(predicted, fix)
        if impossible is not None:  # seldom: errors of the times may still explain it
            impossible = refusal(predicted, fix, self._settings.gate.slack_m(before.fix, fix))
        if impossible is not None:
            return self._suspect(tracked, fix, impossible)
        tracked.believable_ns = max(tracked.believable_ns, fix.sender_ns)
        tracked.suspects.interrupt()
        if tracked.suspects.is_second_vehicle(fix.sender_ns):
            return _rejected(fix, Reason.SHARED_ID, "a second vehicle reports under this id")
        return self._use(tracked, index, fix, predicted)

    def _has_room(self, uav: str, now_ns: int) -> bool:
        """Return whether a track of a UAV may begin; others may be dropped for it."""
        others = len(self._tracked) - (self._settings.carrier in self._tracked)
        if uav == self._settings.carrier or others < self._settings.most:
            return True
        return self._make_room(uav) or self._drop_fleeting(now_ns)

    def _drop_fleeting(self, now_ns: int) -> bool:
        """Drop the unestablished tracks that are stale; return whether there was one.

        They are looked for at most once a second, since invented ids can be new at any rate.
        """
        if now_ns - self._swept_ns < SWEEP_NS:
            return False
        self._swept_ns = now_ns
        stale = self.silent(now_ns, self._settings.ages.stale_s)
        fleeting = [uav for uav in stale if self._is_fleeting(uav)]
        for uav in fleeting:
            self.forget(uav)
        return bool(fleeting)

    def _is_fleeting(self, uav: str) -> bool:
        """Return whether a UAV has few reports in all, and does not carry the array."""
        is_known = uav in self._established or uav == self._settings.carrier
        return not is_known and self._tracked[uav].reports < ESTABLISHED

    def _make_room(self, uav: str) -> bool:
        """Drop the latest unestablished track to admit an established UAV; False if impossible."""
        if uav not in self._established:
            return False
        for other in reversed(self._tracked):
            if self._is_fleeting(other):
                self.forget(other)
                return True
        return False

    def _begin(self, fix: Fix, past: _Past, reports: int = 0) -> Estimate:
        first = _initial_estimate(fix)
        past.pace.add(fix)
        self._tracked[fix.uav] = _Tracked(
            past=past,
            history=ReportHistory(self._observer, fix, round(self._settings.window_s * 1e9)),
            suspects=Suspects(self._observer, self._settings.gate),
            arrived=fix,
            newest=first,
            reports=reports + 1,
        )
        return first

    def _is_lost(self, tracked: _Tracked, fix: Fix) -> bool:
        """Return whether the gap before a report is too long to gate the report by its track."""
        gap_s = (fix.sender_ns - tracked.history.newest.fix.sender_ns) * 1e-9
        return gap_s > self._settings.ages.lost_s

    def _basic_rejection(
        self, tracked: _Tracked, index: int, fix: Fix
    ) -> tuple[Reason, str] | None:
        """Reject a report without a prediction: for a repeated stamp, or a resent position."""
        entries = tracked.history.entries
        if index < len(entries) and entries[index].fix.sender_ns == fix.sender_ns:
            return Reason.DUPLICATE, "a second report with the same stamp"
        arrived, tracked.arrived = tracked.arrived, fix
        if index == len(entries) and is_frozen(arrived, fix):
            return Reason.FROZEN, "new stamp on the previous report's position"
        return None

    def _suspect(
        self, tracked: _Tracked, fix: Fix, why: tuple[Reason, str]
    ) -> Estimate | Rejection:
        """Keep a rejected report apart, and restart the track if enough such reports agree."""
        tracked.suspects.add(fix)
        newest_ns = max(tracked.history.newest.fix.sender_ns, tracked.believable_ns)
        silent_s = (fix.sender_ns - newest_ns) * 1e-9
        if not tracked.suspects.agree() or silent_s < tracked.suspects.silence_s:
            return _rejected(fix, *why)
        before = tracked.history.newest
        first, *rest = tracked.suspects.take()
        predicted = self._observer.predict(before.state, first.sender_ns)
        off_m = math.dist(first.position_ned_m, predicted.position_ned_m)
        begun = self._begin(first, tracked.past, tracked.reports)
        anew = self._tracked[fix.uav]
        for later in rest:
            begun = self._use(anew, len(anew.history.entries), later)
        anew.arrived = fix
        return replace(begun, innovation_m=off_m, reacquired=True)

    def _use(
        self, tracked: _Tracked, index: int, fix: Fix, predicted: Prediction | None = None
    ) -> Estimate:
        history = tracked.history
        history.insert(index, fix, predicted)
        tracked.past.pace.add(fix)
        tracked.reports += 1
        entries = history.entries
        is_newest = entries[-1].fix is fix
        if is_newest:
            self._evaluate_past(tracked, fix)
        tracked.newest = self._estimate(tracked, len(entries) - 1)
        tracked.unknown_input = _unknown_input(history)
        if is_newest:
            return tracked.newest
        at = next(i for i, entry in enumerate(entries) if entry.fix is fix)
        return self._estimate(tracked, at)

    def _estimate(self, tracked: _Tracked, at: int) -> Estimate:
        entries = tracked.history.entries
        fix, predicted = entries[at].fix, entries[at].predicted
        if predicted is None:
            return _initial_estimate(fix)
        if predicted.mu_s2 is not None:
            tracked.mu_max_s2 = max(predicted.mu_s2, tracked.mu_max_s2 or 0.0)
        dt_s = (fix.sender_ns - entries[at - 1].fix.sender_ns) * 1e-9 if at else None
        innovation_m = math.dist(fix.position_ned_m, predicted.position_ned_m)
        return Estimate(
            fix=fix,
            position_ned_m=predicted.position_ned_m,
            bound_m=predicted.bound_m,
            innovation_m=innovation_m,
            dt_s=dt_s,
        )

    def _evaluate_past(self, tracked: _Tracked, fix: Fix) -> None:
        """Evaluate earlier predictions by the newest report, and select the model to feed forward.

        Accelerations are clipped to the largest possible size.
        """
        predictions = tracked.predictions
        if self._settings.feed_forward:
            predictions.smooth(fix)
        if not predictions.is_due(fix.sender_ns):
            return
        if not self._settings.feed_forward:
            predictions.add(fix, (None,) * len(ACCELERATION_MODELS))
            return
        most_mps2 = self._limits(fix).acceleration_max_mps2
        slopes = [_cut(one, most_mps2) for one in tracked.history.accelerations(WINDOWS)]
        by_window = {window[0]: slope for window, slope in zip(WINDOWS, slopes, strict=True)}
        predictions.add(fix, tuple(by_window.get(way.window_s) for way in ACCELERATION_MODELS))
        tracked.acceleration = by_window.get(predictions.model.window_s)

    def forget(self, uav: str) -> None:
        """Forget a track, because its sender restarted or no longer sends."""
        tracked = self._tracked.pop(uav, None)
        self._positions.forget(uav)
        room = len(self._established) < self._settings.most  # earlier UAVs take precedence
        if room and tracked is not None and tracked.reports >= ESTABLISHED:
            self._established.add(uav)

    def silent(self, now_ns: int, for_s: float) -> list[str]:
        """Return the UAVs without a report for ``for_s`` seconds, node time."""
        before_ns = now_ns - round(for_s * 1e9)
        return [uav for uav, one in self._tracked.items() if one.arrived.arrival_ns < before_ns]

    # --- output: tracks ---------------------------------------------------------------------

    def track(self, uav: str, now_ns: int, at: SenderTime) -> Track | None:
        """Predict a UAV to ``at.node_ns``; its state is that at ``now_ns``. None if unknown."""
        snapshot = self.snapshot(uav)
        return None if snapshot is None else snapshot.at(now_ns, at)

    def snapshot(self, uav: str) -> TrackSnapshot | None:
        """Return the track of a UAV as it is now; the same one until its next report."""
        tracked = self._tracked.get(uav)
        if tracked is None:
            return None
        if tracked.snapshot is None:
            newest, predictions = tracked.history.newest, tracked.predictions
            check, ages = tracked.past.receiver_check, self._settings.ages
            tracked.snapshot = TrackSnapshot(
                observer=self._observer,
                ages=ages,
                limits=self._limits(newest.fix),
                fix=newest.fix,
                state=newest.state,
                last=tracked.newest,
                coasting_s=tracked.past.pace.silence_s(ages.coasting_s, ages.stale_s),
                reports=tracked.reports,
                unknown_input=tracked.unknown_input,
                mu_max_s2=tracked.mu_max_s2,
                acceleration=tracked.acceleration,
                model=predictions.model,
                smoothing_offset=predictions.smoothing_offset,
                usual_errors=predictions.usual_errors,
                common_error_m=0.0 if check is None else check.common_error_m(newest.fix.noise),
            )
        return tracked.snapshot

    def _limits(self, fix: Fix) -> Limits:
        return fix.limits or self._settings.limits

    def __len__(self) -> int:
        return len(self._tracked)

    def __contains__(self, uav: object) -> bool:
        """Return whether a UAV has a track."""
        return uav in self._tracked

    def newest(self, uav: str) -> Fix | None:
        """Return the newest accepted report of a UAV; None if the UAV has no track."""
        tracked = self._tracked.get(uav)
        return tracked.history.newest.fix if tracked else None

    @property
    def uavs(self) -> list[str]:
        """Ids of all UAVs with a track, in the order in which the tracks started."""
        return list(self._tracked)

    def state(self, uav: str, now: SenderTime) -> TrackState | None:
        """Return the state of a UAV's track, without a prediction; None if it has no track."""
        tracked = self._tracked.get(uav)
        if tracked is None:
            return None
        ages, newest = self._settings.ages, tracked.history.newest.fix
        coasting_s = tracked.past.pace.silence_s(ages.coasting_s, ages.stale_s)
        return ages.state((now.sender_ns - newest.sender_ns) * 1e-9, coasting_s)

    def near(self, position_ned_m: Vector, within_m: float, better_than: str) -> list[str]:
        """Return the UAVs whose newest accepted report is within a distance of a local position.

        Only those of kinds that identify an aircraft better than that of the UAV ``better_than``.
        """
        return self._positions.near(position_ned_m, within_m, kind_of(better_than).rank)


def _initial_estimate(fix: Fix) -> Estimate:
    return Estimate(
        fix=fix,
        position_ned_m=fix.position_ned_m,
        bound_m=fix.noise.position_m,
        innovation_m=None,
        dt_s=None,
    )


def _rejected(fix: Fix, reason: Reason, detail: str) -> Rejection:
    return Rejection(t_ns=fix.arrival_ns, source=fix.uav, reason=reason, detail=detail)


def _cut(acceleration: Vector | None, most_mps2: float) -> Vector | None:
    """Clip an acceleration to the largest allowed size."""
    if acceleration is None:
        return None
    north, east, down = acceleration
    size = math.sqrt(north * north + east * east + down * down)
    if size <= most_mps2:
        return acceleration
    share = most_mps2 / size
    return share * north, share * east, share * down


def _unknown_input(history: ReportHistory[Any]) -> Vector | None:
    """Return the unknown input over the newest interval: W^ = (x^+ - x^) / dT, m/s.

    See docs/math.md 3, paper eq. (12); None if there are fewer than two reports.
    """
    if len(history.entries) < 2:
        return None
    before, newest = history.entries[-2:]
    if newest.predicted is None:
        return None
    start = before.fix if before.predicted is None else before.predicted
    dt_s = (newest.fix.sender_ns - before.fix.sender_ns) * 1e-9
    (n, e, d), (to_n, to_e, to_d) = start.position_ned_m, newest.predicted.position_ned_m
    return (to_n - n) / dt_s, (to_e - e) / dt_s, (to_d - d) / dt_s
