"""Identification of one aircraft under two ids: its own telemetry, and relayed reports.

Two beams on one aircraft have nearly equal steering vectors, which ruin zero forcing. A relayed
aircraft is identified with a track of a better kind (telemetry, or Remote ID before ADS-B) after
several reports in a row that agree with it within the errors of both. It is separated again after
as many that do not agree.

The bound of a track without reports grows until it contains every aircraft around it. So only live
tracks are compared, and a coasting one if the aircraft is already identified with it: two beams for
each short outage of the telemetry would be as bad.
"""

import math
from dataclasses import dataclass
from typing import Final

from companion.values import Fix, Track, TrackState

RELAYED_MAX: Final = 8192  # most relayed aircraft remembered; beyond it the oldest is forgotten
REPORTS_TO_DECIDE: Final = 5  # reports in a row that identify, or separate, two tracks
SPEED_APART_MPS: Final = 15.0  # difference in velocity above which two tracks are two aircraft


@dataclass(slots=True, kw_only=True)
class _Relayed:
    """State of a relayed aircraft, for its identification.

    same_as   the better track of the same aircraft; None if there is none
    announced the better track that ``observe`` returned last
    """

    near: str  # the nearest better track; empty if none is near enough
    in_a_row: int = 0  # newest reports for which ``near`` did not change
    same_as: str | None = None
    announced: str | None = None


class Identities:
    """Assignment of relayed aircraft to better tracks. ``merged`` are those that have one."""

    def __init__(self) -> None:
        self.merged: set[str] = set()
        self._relayed: dict[str, _Relayed] = {}

    def same_as(self, uav: str) -> str | None:
        """Return the better track of a relayed aircraft; None if it has none."""
        known = self._relayed.get(uav)
        return None if known is None else known.same_as

    def forget(self, uav: str) -> None:
        """Forget a relayed aircraft."""
        self._relayed.pop(uav, None)
        self.merged.discard(uav)

    def separate(self, better: str) -> None:
        """Separate all relayed aircraft from a track that is too old for a beam."""
        for uav in [one for one in self.merged if self._relayed[one].same_as == better]:
            known = self._relayed[uav]
            known.same_as, known.near, known.in_a_row = None, "", 0
            self.merged.discard(uav)

    def observe(self, relayed: Fix, better: list[Track]) -> str | None:
        """Compare a relayed report with the better tracks at its time.

        Return the track that it is identified with, if that is not the one returned last.
        """
        known = self._relayed.get(relayed.uav)
        same_as = None if known is None else known.same_as
        near = [
            (_apart_m(relayed, track), track.uav)
            for track in better
            if track.state is TrackState.LIVE
            or (track.state is TrackState.COASTING and track.uav == same_as)
        ]
        nearest = min((pair for pair in near if pair[0] is not None), default=None)
        match = nearest[1] if nearest else ""
        if known is None:
            known = self._relayed[relayed.uav] = _Relayed(near=match)
            if len(self._relayed) > RELAYED_MAX:
                self.forget(next(iter(self._relayed)))
        elif known.near != match:
            known.near, known.in_a_row = match, 0
        known.in_a_row += 1
        if known.in_a_row >= REPORTS_TO_DECIDE:
            known.same_as = match or None
            self.merged.discard(relayed.uav)
            if match:
                self.merged.add(relayed.uav)
                if match != known.announced:
                    known.announced = match
                    return match
        return None


def _apart_m(relayed: Fix, track: Track) -> float | None:
    """Return the horizontal distance if report and track can be one aircraft; else None."""
    (n, e, d), (to_n, to_e, to_d) = relayed.position_ned_m, track.position_ned_m.tolist()
    apart_m = math.hypot(n - to_n, e - to_e)
    if apart_m > relayed.noise.horizontal_m + track.horizontal_bound_m:
        return None
    if abs(d - to_d) > relayed.noise.vertical_m + track.vertical_bound_m:
        return None
    ours, theirs = track.velocity_ned_mps, relayed.velocity_ned_mps
    if ours is None or theirs is None or math.dist(ours.tolist(), theirs) <= SPEED_APART_MPS:
        return apart_m
    return None
