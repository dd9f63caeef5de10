"""Positions sent to other programs: each aircraft's present position, from its track.

Only live and coasting tracks are sent. A late report may change the next position, but the times
sent for an aircraft never go backwards.
"""

import math
from collections.abc import Iterable
from typing import Final

from companion.mavlink.wire import cot_text
from companion.mavlink.wire.encode import (
    Outgoing,
    UtmPosition,
    global_position_int,
    utm_global_position,
)
from companion.pipeline.fold import Pipeline
from companion.tracking.noise import GEOID_M
from companion.values import AltitudeDatum, Source, Track, TrackState, kind_of

SENT_STATES: Final = (TrackState.LIVE, TrackState.COASTING)  # states of tracks that are sent
_REBOOT_MS: Final = 60_000  # a larger backward step of a boot clock means a reboot


class Positions:
    """Positions of vehicles that report themselves, as messages from these vehicles.

    ``utm``: as UTM_GLOBAL_POSITION, ``every_s`` apart; otherwise as GLOBAL_POSITION_INT.
    """

    def __init__(self, *, utm: bool = False, every_s: float = 0.0) -> None:
        self._utm = utm
        self._every_s = every_s
        self._boot_ms: dict[str, int] = {}  # boot time in the last message, by UAV

    def outgoing(self, pipeline: Pipeline, tracks: Iterable[Track]) -> list[Outgoing]:
        """Return the messages for the tracks at their time, stamped by each sender's clock."""
        found = [
            message
            for track in tracks
            if kind_of(track.uav).reports_itself
            and track.state in SENT_STATES
            and (message := self._one(pipeline, track)) is not None
        ]
        for uav in self._boot_ms.keys() - set(pipeline.tracker.uavs):
            del self._boot_ms[uav]
        return found

    def _one(self, pipeline: Pipeline, track: Track) -> Outgoing | None:
        newest = pipeline.tracker.newest(track.uav)
        place = _place(pipeline, track)
        velocity = _velocity_ned_mps(pipeline, track, place)
        if newest is None or velocity is None:
            return None
        report = newest.report
        boot_ms = pipeline.senders.time(track.uav, track.valid_at_ns).sender_ns // 1_000_000
        last_ms = self._boot_ms.get(track.uav)
        if last_ms is not None and last_ms - _REBOOT_MS < boot_ms <= last_ms:
            return None
        self._boot_ms[track.uav] = boot_ms
        relative_alt_m = report.relative_alt_m
        if relative_alt_m is not None:
            relative_alt_m += place[2] - report.alt_m
        if self._utm:
            return self._as_utm(pipeline, track, place, relative_alt_m, velocity)
        return global_position_int(
            Source.parse(track.uav),
            boot_ms & 0xFFFF_FFFF,
            place,
            relative_alt_m=relative_alt_m or 0.0,
            velocity_ned_mps=velocity,
            heading_deg=report.heading_deg,
        )

    def _as_utm(
        self,
        pipeline: Pipeline,
        track: Track,
        place: tuple[float, float, float],
        relative_alt_m: float | None,
        velocity_ned_mps: tuple[float, float, float],
    ) -> Outgoing:
        """Return a track as UTM_GLOBAL_POSITION.

        Its height is above the ellipsoid, so it is given only with a known undulation.
        """
        known = pipeline.settings.observer.geoid_m is not None
        undulation_m, off_m = _geoid(pipeline) if known else (0.0, 0.0)
        lat_deg, lon_deg, alt_m = place
        said = UtmPosition(
            utc_ns=pipeline.utc_ns(track.valid_at_ns),
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            hae_m=alt_m + undulation_m if known else None,
            relative_alt_m=relative_alt_m,
            velocity_ned_mps=velocity_ned_mps,
            horizontal_m=track.horizontal_bound_m,
            vertical_m=track.vertical_bound_m + off_m,
            every_s=self._every_s,
        )
        return utm_global_position(Source.parse(track.uav), said)


def events(pipeline: Pipeline, tracks: Iterable[Track], stale_s: float) -> list[bytes]:
    """Return a Cursor on Target event for each live or coasting aircraft, without duplicates."""
    return [
        _event(pipeline, track, stale_s)
        for track in tracks
        if track.state in SENT_STATES and pipeline.targets.identities.same_as(track.uav) is None
    ]


def _event(pipeline: Pipeline, track: Track, stale_s: float) -> bytes:
    lat_deg, lon_deg, alt_m = place = _place(pipeline, track)
    velocity = _velocity_ned_mps(pipeline, track, place)
    newest = pipeline.tracker.newest(track.uav)
    datum = AltitudeDatum.PRESSURE if newest is None else newest.report.alt_datum
    known = datum is not AltitudeDatum.PRESSURE
    undulation_m, geoid_m = 0.0, 0.0  # in the schema, height is above the ellipsoid
    if datum is AltitudeDatum.MSL:
        undulation_m, geoid_m = _geoid(pipeline)
    course_deg = speed_mps = None
    if velocity is not None:
        course_deg = math.degrees(math.atan2(velocity[1], velocity[0])) % 360
        speed_mps = math.hypot(velocity[0], velocity[1])
    where = cot_text.CotPosition(
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        hae_m=alt_m + undulation_m if known else None,
        ce_m=track.horizontal_bound_m,
        le_m=track.vertical_bound_m + geoid_m if known else None,
        course_deg=course_deg,
        speed_mps=speed_mps,
    )
    at_ns = pipeline.utc_ns(track.valid_at_ns)
    stale_ns = at_ns + round(stale_s * 1e9)
    return cot_text.event(track.uav, at_ns, stale_ns, where, _remarks_text(track, datum, geoid_m))


def _geoid(pipeline: Pipeline) -> tuple[float, float]:
    """Return the height of mean sea level above the ellipsoid, and its largest error."""
    given = pipeline.settings.observer
    return (0.0, GEOID_M) if given.geoid_m is None else (given.geoid_m, given.geoid_error_m)


def _remarks_text(track: Track, datum: AltitudeDatum, geoid_m: float) -> str:
    """Return text that explains the numbers of a Cursor on Target event."""
    words = [
        f"ce {track.horizontal_bound_m:.1f} m and le are guaranteed bounds, not standard deviations"
    ]
    if track.error_p95_m is not None:
        words.append(f"95 of 100 errors stay below {track.error_p95_m:.1f} m")
    words.append(
        {
            AltitudeDatum.MSL: f"height from mean sea level: le includes {geoid_m:.0f} m for the"
            " geoid",
            AltitudeDatum.PRESSURE: "only a pressure altitude is known, so hae is not given",
            AltitudeDatum.GEOMETRIC: "height above the ellipsoid",
        }[datum]
    )
    return "; ".join([*words, f"newest report {track.age_s:.1f} s old"])


def _place(pipeline: Pipeline, track: Track) -> tuple[float, float, float]:
    assert pipeline.local is not None, "a track is in the local frame"
    return pipeline.local.place(*track.position_ned_m.tolist())


def _velocity_ned_mps(
    pipeline: Pipeline, track: Track, place: tuple[float, float, float]
) -> tuple[float, float, float] | None:
    """Return the velocity in north-east-down at the aircraft, from the local frame; else None."""
    if track.velocity_ned_mps is None or pipeline.local is None:
        return None
    there_from_local = pipeline.local.local_from_ned(place[0], place[1]).T
    north, east, down = (there_from_local @ track.velocity_ned_mps).tolist()
    return north, east, down
