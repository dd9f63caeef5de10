"""The tables of updates: the array, the tracks and the beams, a row each ten times a second."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from companion.recording.tables.columns import Column, Kind, Table
from companion.tracking.geodesy import LocalFrame, Place
from companion.values import Beam, Carrier, FloatArray, Track, Update
from companion.views.center_state import euler_deg
from companion.views.words import degrees


@dataclass(frozen=True, slots=True)
class UpdateRow:
    """An update, with the origin of the local frame and the carrier's place, where known."""

    update: Update
    origin: Place | None
    carrier: Place | None


@dataclass(frozen=True, slots=True)
class TrackRow:
    """A track at an update, its place, and why it has no beam; None where it has one."""

    update: Update
    track: Track
    place: Place
    left_out: str | None


@dataclass(frozen=True, slots=True)
class BeamRow:
    """A beam at an update."""

    update: Update
    beam: Beam


def rows(update: Update, local: LocalFrame | None) -> Iterator[tuple[str, Any]]:
    """The rows of an update, each with the name of its table."""
    carrier = None if update.carrier is None else update.carrier.position_ned_m
    origin = None if local is None else Place(*local.origin)
    place = None if local is None or carrier is None else local.place(*carrier.tolist())
    yield UPDATES.name, UpdateRow(update, origin, place)
    left_out = {out.uav: update.unfit or out.reason for out in update.beams.left_out}
    for track in update.tracks:
        assert local is not None  # it begins with the first report
        there = local.place(*np.asarray(track.position_ned_m).tolist())
        yield TRACKS.name, TrackRow(update, track, there, left_out.get(track.uav))
    for beam in update.beams.beams:
        yield BEAMS.name, BeamRow(update, beam)


def _axis(vector: FloatArray | None, axis: int) -> float | None:
    return None if vector is None else float(vector[axis])


def _of_carrier(row: UpdateRow, name: str) -> Any:
    return getattr(row.update.carrier, name, None)


def _turned_deg(carrier: Carrier | None, angle: int) -> float | None:
    return None if carrier is None else euler_deg(carrier.body_from_local)[angle]


def _of_place(place: Place | None, axis: int) -> float | None:
    return None if place is None else place[axis]


_T, _N, _TIME, _INT, _TRUTH = Kind.TEXT, Kind.NUMBER, Kind.TIME, Kind.INTEGER, Kind.TRUTH

# fmt: off
_WHEN: Final = (
    Column("t_ns", _INT, "ns", "when the update was made, since 1970", lambda r: r.update.t_ns),
    Column("t_utc", _TIME, "UTC", "the same", lambda r: r.update.t_ns),
    Column("valid_at_ns", _INT, "ns", "when its beams are applied: the time of all that it says",
           lambda r: r.update.beams.valid_at_ns),
    Column("valid_at_utc", _TIME, "UTC", "the same", lambda r: r.update.beams.valid_at_ns),
)

UPDATES: Final = Table("updates", "a beam update: the array and all beams together", (
    *_WHEN,
    Column("unfit", _T, "", "why there are no beams at all", lambda r: r.update.unfit),
    Column("tracks", _INT, "", "UAVs to aim at", lambda r: len(r.update.tracks)),
    Column("beams", _INT, "", "UAVs with a beam", lambda r: len(r.update.beams.beams)),
    Column("groups", _INT, "", "turns in which they are served", lambda r: r.update.beams.groups),
    Column("method", _T, "", "how the weights were made: `zf`, `rzf`, `mmse`, `mrt`",
           lambda r: r.update.beams.method),
    Column("exact", _TRUTH, "", "whether each UAV lies in a null of all other beams of its turn",
           lambda r: r.update.beams.exact),
    Column("condition_number", _N, "", "of the steering matrix",
           lambda r: r.update.beams.condition_number),
    Column("carrier_lat_deg", _N, "deg", "where the carrier is, WGS84",
           lambda r: _of_place(r.carrier, 0)),
    Column("carrier_lon_deg", _N, "deg", "where the carrier is, WGS84",
           lambda r: _of_place(r.carrier, 1)),
    Column("carrier_alt_m", _N, "m", "its height, over the datum of its reports",
           lambda r: _of_place(r.carrier, 2)),
    Column("carrier_bound_m", _N, "m", "bound on the error of its position",
           lambda r: _of_carrier(r, "bound_m")),
    Column("carrier_roll_deg", _N, "deg", "how it is turned",
           lambda r: _turned_deg(r.update.carrier, 0)),
    Column("carrier_pitch_deg", _N, "deg", "how it is turned",
           lambda r: _turned_deg(r.update.carrier, 1)),
    Column("carrier_yaw_deg", _N, "deg", "how it is turned, from north, clockwise",
           lambda r: _turned_deg(r.update.carrier, 2)),
    Column("carrier_attitude_bound_deg", _N, "deg", "bound on the error of that",
           lambda r: degrees(_of_carrier(r, "attitude_bound_rad"))),
    Column("carrier_age_s", _N, "s", "age of its newest report; none of a fixed station",
           lambda r: _of_carrier(r, "age_s")),
    Column("origin_lat_deg", _N, "deg", "origin of the local frame, WGS84",
           lambda r: _of_place(r.origin, 0)),
    Column("origin_lon_deg", _N, "deg", "origin of the local frame, WGS84",
           lambda r: _of_place(r.origin, 1)),
    Column("origin_alt_m", _N, "m", "its height", lambda r: _of_place(r.origin, 2)),
))

TRACKS: Final = Table("tracks", "a UAV to aim at, at an update, as it is when beams are applied", (
    *_WHEN,
    Column("uav", _T, "", "who it is", lambda r: r.track.uav),
    Column("state", _T, "", "`live`, `coasting`, `stale` or `lost`", lambda r: r.track.state),
    Column("left_out", _T, "", "why it has no beam", lambda r: r.left_out),
    Column("age_s", _N, "s", "age of its newest accepted report", lambda r: r.track.age_s),
    Column("lat_deg", _N, "deg", "latitude, WGS84", lambda r: r.place[0]),
    Column("lon_deg", _N, "deg", "longitude, WGS84", lambda r: r.place[1]),
    Column("alt_m", _N, "m", "height, over the datum of its reports", lambda r: r.place[2]),
    Column("north_m", _N, "m", "position in the local frame",
           lambda r: _axis(r.track.position_ned_m, 0)),
    Column("east_m", _N, "m", "position in the local frame",
           lambda r: _axis(r.track.position_ned_m, 1)),
    Column("down_m", _N, "m", "position in the local frame",
           lambda r: _axis(r.track.position_ned_m, 2)),
    Column("velocity_north_mps", _N, "m/s", "velocity in the local frame",
           lambda r: _axis(r.track.velocity_ned_mps, 0)),
    Column("velocity_east_mps", _N, "m/s", "velocity in the local frame",
           lambda r: _axis(r.track.velocity_ned_mps, 1)),
    Column("velocity_down_mps", _N, "m/s", "velocity in the local frame",
           lambda r: _axis(r.track.velocity_ned_mps, 2)),
    Column("unknown_input_north_mps", _N, "m/s", "estimate of the unknown input",
           lambda r: _axis(r.track.unknown_input_mps, 0)),
    Column("unknown_input_east_mps", _N, "m/s", "estimate of the unknown input",
           lambda r: _axis(r.track.unknown_input_mps, 1)),
    Column("unknown_input_down_mps", _N, "m/s", "estimate of the unknown input",
           lambda r: _axis(r.track.unknown_input_mps, 2)),
    Column("bound_m", _N, "m", "bound on the error of the position", lambda r: r.track.bound_m),
    Column("bound_horizontal_m", _N, "m", "its part in the plane",
           lambda r: r.track.horizontal_bound_m),
    Column("bound_vertical_m", _N, "m", "its part in height", lambda r: r.track.vertical_bound_m),
    Column("error_p95_m", _N, "m", "error that 95 of 100 predictions at this age stayed below",
           lambda r: r.track.error_p95_m),
    Column("speed_limit_mps", _N, "m/s", "speed that the bound assumes it never exceeds",
           lambda r: r.track.limits.speed_mps),
    Column("acceleration_limit_mps2", _N, "m/s²", "the same of its acceleration",
           lambda r: r.track.limits.acceleration_mps2),
    Column("limit_source", _T, "", "where both are from: `settings`, `type` or `raised`",
           lambda r: r.track.limits.source),
    Column("clock_bound_s", _N, "s", "bound on the error of its clock, contained in the others",
           lambda r: r.track.clock_bound_s),
    Column("dt_s", _N, "s", "interval between its last two reports", lambda r: r.track.dt_s),
    Column("latency_s", _N, "s", "latency of the newest", lambda r: r.track.latency_s),
    Column("gamma", _N, "", "certified gain over all intervals so far; position model only",
           lambda r: r.track.gamma),
    Column("innovation_m", _N, "m", "from the prediction to the last report",
           lambda r: r.track.innovation_m),
    Column("reports", _INT, "", "reports accepted so far", lambda r: r.track.reports),
))

BEAMS: Final = Table("beams", "a beam at an update", (
    *_WHEN,
    Column("uav", _T, "", "whose beam it is", lambda r: r.beam.uav),
    Column("azimuth_deg", _N, "deg", "from boresight to the right, in the array's frame",
           lambda r: degrees(r.beam.azimuth_rad)),
    Column("elevation_deg", _N, "deg", "upwards, in the array's frame",
           lambda r: degrees(r.beam.elevation_rad)),
    Column("range_m", _N, "m", "from the array to the predicted position",
           lambda r: r.beam.range_m),
    Column("azimuth_rate_degps", _N, "deg/s", "how the azimuth changes",
           lambda r: degrees(r.beam.azimuth_rate_radps)),
    Column("elevation_rate_degps", _N, "deg/s", "how the elevation changes",
           lambda r: degrees(r.beam.elevation_rate_radps)),
    Column("range_rate_mps", _N, "m/s", "how the range changes", lambda r: r.beam.range_rate_mps),
    Column("pointing_bound_deg", _N, "deg",
           "bound on the angle between predicted and true direction; unknown: anywhere",
           lambda r: degrees(r.beam.pointing_bound_rad)),
    Column("pointing_p95_deg", _N, "deg", "the same angle as it usually is at most",
           lambda r: degrees(r.beam.pointing_p95_rad)),
    Column("gain_db", _N, "dB", "array gain towards the predicted direction",
           lambda r: r.beam.gain_db),
    Column("loss_db", _N, "dB", "what it lacks against a beam for this UAV alone",
           lambda r: r.beam.loss_db),
    Column("group", _INT, "", "the turn in which the UAV is served, from 0",
           lambda r: r.beam.group),
    Column("widened", _TRUTH, "", "whether the main lobe was broadened", lambda r: r.beam.widened),
))
# fmt: on
