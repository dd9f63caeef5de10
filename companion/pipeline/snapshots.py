"""Snapshots of UAVs and of the carrier, from which any thread may predict."""

from typing import NamedTuple

from companion.pipeline.senders import Timeline
from companion.tracking.track_snapshot import TrackSnapshot
from companion.values import Carrier, Fix, Track


class UavSnapshot(NamedTuple):
    """One UAV after all events so far: its track and its clock, for any thread."""

    track: TrackSnapshot
    timeline: Timeline

    def at(self, now_ns: int, valid_at_ns: int) -> Track:
        """Predict the UAV to ``valid_at_ns``; its state is that at ``now_ns``."""
        return self.track.at(now_ns, self.timeline.time(valid_at_ns))


class ReportedCarrier(NamedTuple):
    """The carrier as it reports itself: its pose, and for a vehicle its track and newest report."""

    carrier: Carrier
    track: Track | None = None
    fix: Fix | None = None
    turn_acceleration_radps2: float = 0.0
