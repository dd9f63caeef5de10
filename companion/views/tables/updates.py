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


@dataclass(frozen=True, slots=True, kw_only=True)
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
        yield (
            TRACKS.name,
            TrackRow(update=update, track=track, place=there, left_out=left_out.get(track.uav)),
        )
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
    Column(name="t_ns", kind=_INT, unit="ns", meaning="when the update was made, since 1970",
           of=lambda r: r.update.t_ns),
    Column(name="t_utc", kind=_TIME, unit="UTC", meaning="the same", of=lambda r: r.update.t_ns),
    Column(name="valid_at_ns", kind=_INT, unit="ns",
           meaning="when its beams are applied: the time of all that it says",
           of=lambda r: r.update.beams.valid_at_ns),
    Column(name="valid_at_utc", kind=_TIME, unit="UTC", meaning="the same",
           of=lambda r: r.update.beams.valid_at_ns),
)

UPDATES: Final = Table("updates", "a beam update: the array and all beams together", (
    *_WHEN,
    Column(name="unfit", kind=_T, unit="", meaning="why there are no beams at all",
           of=lambda r: r.update.unfit),
    Column(name="tracks", kind=_INT, unit="", meaning="UAVs to aim at",
           of=lambda r: len(r.update.tracks)),
    Column(name="beams", kind=_INT, unit="", meaning="UAVs with a beam",
           of=lambda r: len(r.update.beams.beams)),
    Column(name="groups", kind=_INT, unit="", meaning="turns in which they are served",
           of=lambda r: r.update.beams.groups),
    Column(name="method", kind=_T, unit="",
           meaning="how the weights were made: `zf`, `rzf`, `mmse`, `mrt`",
           of=lambda r: r.update.beams.method),
    Column(name="exact", kind=_TRUTH, unit="",
           meaning="whether each UAV lies in a null of all other beams of its turn",
           of=lambda r: r.update.beams.exact),
    Column(name="condition_number", kind=_N, unit="", meaning="of the steering matrix",
           of=lambda r: r.update.beams.condition_number),
    Column(name="carrier_lat_deg", kind=_N, unit="deg", meaning="where the carrier is, WGS84",
           of=lambda r: _of_place(r.carrier, 0)),
    Column(name="carrier_lon_deg", kind=_N, unit="deg", meaning="where the carrier is, WGS84",
           of=lambda r: _of_place(r.carrier, 1)),
    Column(name="carrier_alt_m", kind=_N, unit="m",
           meaning="its height, over the datum of its reports",
           of=lambda r: _of_place(r.carrier, 2)),
    Column(name="carrier_bound_m", kind=_N, unit="m", meaning="bound on the error of its position",
           of=lambda r: _of_carrier(r, "bound_m")),
    Column(name="carrier_roll_deg", kind=_N, unit="deg", meaning="how it is turned",
           of=lambda r: _turned_deg(r.update.carrier, 0)),
    Column(name="carrier_pitch_deg", kind=_N, unit="deg", meaning="how it is turned",
           of=lambda r: _turned_deg(r.update.carrier, 1)),
    Column(name="carrier_yaw_deg", kind=_N, unit="deg",
           meaning="how it is turned, from north, clockwise",
           of=lambda r: _turned_deg(r.update.carrier, 2)),
    Column(name="carrier_attitude_bound_deg", kind=_N, unit="deg",
           meaning="bound on the error of that",
           of=lambda r: degrees(_of_carrier(r, "attitude_bound_rad"))),
    Column(name="carrier_age_s", kind=_N, unit="s",
           meaning="age of its newest report; none of a fixed station",
           of=lambda r: _of_carrier(r, "age_s")),
    Column(name="origin_lat_deg", kind=_N, unit="deg", meaning="origin of the local frame, WGS84",
           of=lambda r: _of_place(r.origin, 0)),
    Column(name="origin_lon_deg", kind=_N, unit="deg", meaning="origin of the local frame, WGS84",
           of=lambda r: _of_place(r.origin, 1)),
    Column(name="origin_alt_m", kind=_N, unit="m", meaning="its height",
           of=lambda r: _of_place(r.origin, 2)),
))

TRACKS: Final = Table("tracks", "a UAV to aim at, at an update, as it is when beams are applied", (
    *_WHEN,
    Column(name="uav", kind=_T, unit="", meaning="who it is", of=lambda r: r.track.uav),
    Column(name="state", kind=_T, unit="", meaning="`live`, `coasting`, `stale` or `lost`",
           of=lambda r: r.track.state),
    Column(name="left_out", kind=_T, unit="", meaning="why it has no beam",
           of=lambda r: r.left_out),
    Column(name="age_s", kind=_N, unit="s", meaning="age of its newest accepted report",
           of=lambda r: r.track.age_s),
    Column(name="lat_deg", kind=_N, unit="deg", meaning="latitude, WGS84", of=lambda r: r.place[0]),
    Column(name="lon_deg", kind=_N, unit="deg", meaning="longitude, WGS84",
           of=lambda r: r.place[1]),
    Column(name="alt_m", kind=_N, unit="m", meaning="height, over the datum of its reports",
           of=lambda r: r.place[2]),
    Column(name="north_m", kind=_N, unit="m", meaning="position in the local frame",
           of=lambda r: _axis(r.track.position_ned_m, 0)),
    Column(name="east_m", kind=_N, unit="m", meaning="position in the local frame",
           of=lambda r: _axis(r.track.position_ned_m, 1)),
    Column(name="down_m", kind=_N, unit="m", meaning="position in the local frame",
           of=lambda r: _axis(r.track.position_ned_m, 2)),
    Column(name="velocity_north_mps", kind=_N, unit="m/s", meaning="velocity in the local frame",
           of=lambda r: _axis(r.track.velocity_ned_mps, 0)),
    Column(name="velocity_east_mps", kind=_N, unit="m/s", meaning="velocity in the local frame",
           of=lambda r: _axis(r.track.velocity_ned_mps, 1)),
    Column(name="velocity_down_mps", kind=_N, unit="m/s", meaning="velocity in the local frame",
           of=lambda r: _axis(r.track.velocity_ned_mps, 2)),
    Column(name="unknown_input_north_mps", kind=_N, unit="m/s",
           meaning="estimate of the unknown input",
           of=lambda r: _axis(r.track.unknown_input_mps, 0)),
    Column(name="unknown_input_east_mps", kind=_N, unit="m/s",
           meaning="estimate of the unknown input",
           of=lambda r: _axis(r.track.unknown_input_mps, 1)),
    Column(name="unknown_input_down_mps", kind=_N, unit="m/s",
           meaning="estimate of the unknown input",
           of=lambda r: _axis(r.track.unknown_input_mps, 2)),
    Column(name="bound_m", kind=_N, unit="m", meaning="bound on the error of the position",
           of=lambda r: r.track.bound_m),
    Column(name="bound_horizontal_m", kind=_N, unit="m", meaning="its part in the plane",
           of=lambda r: r.track.horizontal_bound_m),
    Column(name="bound_vertical_m", kind=_N, unit="m", meaning="its part in height",
           of=lambda r: r.track.vertical_bound_m),
    Column(name="error_p95_m", kind=_N, unit="m",
           meaning="error that 95 of 100 predictions at this age stayed below",
           of=lambda r: r.track.error_p95_m),
    Column(name="speed_limit_mps", kind=_N, unit="m/s",
           meaning="speed that the bound assumes it never exceeds",
           of=lambda r: r.track.limits.speed_mps),
    Column(name="acceleration_limit_mps2", kind=_N, unit="m/s²",
           meaning="the same of its acceleration", of=lambda r: r.track.limits.acceleration_mps2),
    Column(name="limit_source", kind=_T, unit="",
           meaning="where both are from: `settings`, `type` or `raised`",
           of=lambda r: r.track.limits.source),
    Column(name="clock_bound_s", kind=_N, unit="s",
           meaning="bound on the error of its clock, contained in the others",
           of=lambda r: r.track.clock_bound_s),
    Column(name="dt_s", kind=_N, unit="s", meaning="interval between its last two reports",
           of=lambda r: r.track.dt_s),
    Column(name="latency_s", kind=_N, unit="s", meaning="latency of the newest",
           of=lambda r: r.track.latency_s),
    Column(name="gamma", kind=_N, unit="",
           meaning="certified gain over all intervals so far; position model only",
           of=lambda r: r.track.gamma),
    Column(name="innovation_m", kind=_N, unit="m", meaning="from the prediction to the last report",
           of=lambda r: r.track.innovation_m),
    Column(name="reports", kind=_INT, unit="", meaning="reports accepted so far",
           of=lambda r: r.track.reports),
))

BEAMS: Final = Table("beams", "a beam at an update", (
    *_WHEN,
    Column(name="uav", kind=_T, unit="", meaning="whose beam it is", of=lambda r: r.beam.uav),
    Column(name="azimuth_deg", kind=_N, unit="deg",
           meaning="from boresight to the right, in the array's frame",
           of=lambda r: degrees(r.beam.azimuth_rad)),
    Column(name="elevation_deg", kind=_N, unit="deg", meaning="upwards, in the array's frame",
           of=lambda r: degrees(r.beam.elevation_rad)),
    Column(name="range_m", kind=_N, unit="m", meaning="from the array to the predicted position",
           of=lambda r: r.beam.range_m),
    Column(name="azimuth_rate_degps", kind=_N, unit="deg/s", meaning="how the azimuth changes",
           of=lambda r: degrees(r.beam.azimuth_rate_radps)),
    Column(name="elevation_rate_degps", kind=_N, unit="deg/s", meaning="how the elevation changes",
           of=lambda r: degrees(r.beam.elevation_rate_radps)),
    Column(name="range_rate_mps", kind=_N, unit="m/s", meaning="how the range changes",
           of=lambda r: r.beam.range_rate_mps),
    Column(name="pointing_bound_deg", kind=_N, unit="deg",
           meaning="bound on the angle between predicted and true direction; unknown: anywhere",
           of=lambda r: degrees(r.beam.pointing_bound_rad)),
    Column(name="pointing_p95_deg", kind=_N, unit="deg",
           meaning="the same angle as it usually is at most",
           of=lambda r: degrees(r.beam.pointing_p95_rad)),
    Column(name="gain_db", kind=_N, unit="dB", meaning="array gain towards the predicted direction",
           of=lambda r: r.beam.gain_db),
    Column(name="loss_db", kind=_N, unit="dB",
           meaning="what it lacks against a beam for this UAV alone", of=lambda r: r.beam.loss_db),
    Column(name="group", kind=_INT, unit="", meaning="the turn in which the UAV is served, from 0",
           of=lambda r: r.beam.group),
    Column(name="widened", kind=_TRUTH, unit="", meaning="whether the main lobe was broadened",
           of=lambda r: r.beam.widened),
))
# fmt: on
