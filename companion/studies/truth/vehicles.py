"""The vehicles of a log: their reports, and where they truly were.

The truth is the simulator's where a log has it: SIM_STATE, or ArduPilot's older SIMSTATE
(ardupilotmega.xml, 164), which says where but not how high: its heights are those of the reports,
its velocities those between neighbours. Otherwise the truth is the reports seen afterwards: all of
them, in the order of the sender's clock, interpolated. A sender's clock is put on the log's
timeline with hindsight: by the least delay within ``WINDOW_NS`` before and after.

Over 300 lines: one reader: what a log holds of each vehicle.
"""

import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from companion.mavlink.trust.dedupe import Dedupe
from companion.mavlink.wire.decode import GLOBAL_POSITION_INT, GPS_RAW_INT, decode
from companion.recording.reader import read_log
from companion.settings.center import CenterPlace, FixedCenter, VehicleCenter, parse_center
from companion.tracking.geodesy import LocalFrame
from companion.values import FloatArray, Frame, GnssStatus, Report, UserError

Times = NDArray[np.int64]
Kind = Literal["SIM_STATE", "SIMSTATE", "reports"]

SIM_STATE: Final = 108
SIMSTATE: Final = 164
REBOOT_STEP_NS: Final = 10_000_000_000
WINDOW_NS: Final = 10_000_000_000
GAP_NS: Final = 2_500_000_000
"""Longest gap between two points of a trajectory across which it is interpolated."""
PAIRED_NS: Final = 50_000_000
"""Longest distance in arrival from a truth message to the report that dates it.

Truth messages carry no time: each is taken to be as late as the report that arrived nearest.
"""
FLYING_SPEED_MPS: Final = 1.0
FLYING_HEIGHT_M: Final = 2.0

_READ: Final = (GLOBAL_POSITION_INT, GPS_RAW_INT, SIM_STATE, SIMSTATE)
_SIM_STATE = struct.Struct("<21fii")
_SIMSTATE = struct.Struct("<9fii")


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Positions and velocities, (N, 3), local frame, at ascending times (N,)."""

    kind: Kind
    t_ns: Times
    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray

    def at(self, t_ns: Times) -> tuple[FloatArray, FloatArray]:
        """Position and velocity (K, 3) at times (K,), by cubic Hermite; NaN where not known."""
        if len(self.t_ns) < 2:
            return np.full((len(t_ns), 3), np.nan), np.full((len(t_ns), 3), np.nan)
        after = np.clip(np.searchsorted(self.t_ns, t_ns, side="right"), 1, len(self.t_ns) - 1)
        before = after - 1
        span_ns = self.t_ns[after] - self.t_ns[before]
        known = (t_ns >= self.t_ns[before]) & (t_ns <= self.t_ns[after]) & (span_ns <= GAP_NS)
        span_s = span_ns[:, None] * 1e-9
        s = ((t_ns - self.t_ns[before]) / span_ns)[:, None]
        p0, p1 = self.position_ned_m[before], self.position_ned_m[after]
        v0, v1 = self.velocity_ned_mps[before] * span_s, self.velocity_ned_mps[after] * span_s
        bend, twist = 3 * (p1 - p0) - 2 * v0 - v1, 2 * (p0 - p1) + v0 + v1
        position = p0 + s * (v0 + s * (bend + s * twist))
        velocity = (v0 + s * (2 * bend + s * 3 * twist)) / span_s
        position[~known] = velocity[~known] = np.nan
        return position, velocity


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """One vehicle of a log: its reports in order of arrival, and the truth.

    uav               its name
    arrival_ns        (N,), when each report arrived
    boot_ms           (N,), its boot time
    position_ned_m    (N, 3), local frame
    velocity_ned_mps  (N, 3), local frame; NaN: not reported
    height_m          (N,), height above the vehicle's home; NaN: not reported
    gnss              what the vehicle had last said of its receiver when each report came
    truth             where it truly was
    """

    uav: str
    arrival_ns: Times
    boot_ms: Times
    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray
    height_m: FloatArray
    gnss: tuple[GnssStatus | None, ...]
    truth: Trajectory

    def flying(self, t_ns: Times) -> NDArray[np.bool_]:
        """Whether it flies: faster than 1 m/s and, by its last report, more than 2 m up."""
        _, velocity = self.truth.at(t_ns)
        last = np.searchsorted(self.arrival_ns, t_ns, side="right") - 1
        height = np.where(last < 0, 0.0, self.height_m[np.maximum(last, 0)])
        high = np.isnan(height) | (height > FLYING_HEIGHT_M)
        flies: NDArray[np.bool_] = high & (np.linalg.norm(velocity, axis=1) > FLYING_SPEED_MPS)
        return flies


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """A log: its flights, and the array's position (fixed (3,), or a trajectory)."""

    log: str
    center: str
    flights: tuple[Flight, ...]
    carrier: FloatArray | Trajectory
    span_ns: tuple[int, int]

    def carrier_at(self, t_ns: Times) -> FloatArray:
        """The array's true position (K, 3) at times (K,); NaN where not known."""
        if isinstance(self.carrier, Trajectory):
            return self.carrier.at(t_ns)[0]
        return np.broadcast_to(self.carrier, (len(t_ns), 3))


def load(path: Path, center_text: str | None) -> Flown:
    """Read a log. Raises ``UserError`` or ``LogError`` where there is nothing to study in it."""
    center: CenterPlace = parse_center(center_text or "home")
    reports, gnss, states, places = _gather(path)
    if not reports:
        raise UserError(f"{path}: no vehicle reports a position in it")
    first = min((each[0] for each in reports.values()), key=lambda report: report.t_ns)
    home = FixedCenter(first.lat_deg, first.lon_deg, first.alt_m or 0.0)
    stands = center if isinstance(center, FixedCenter) else home
    local = LocalFrame(stands.lat_deg, stands.lon_deg, stands.alt_m)
    # A vehicle with a single report has no path, and does not fly.
    flights = {
        uav: _flight(uav, each, gnss[uav], states.get(uav, []), places.get(uav, []), local)
        for uav, each in reports.items()
        if len({report.boot_ms for report in each}) > 1
    }
    carrier: FloatArray | Trajectory = np.zeros(3)
    if isinstance(center, VehicleCenter):
        if str(center) not in flights:
            raise UserError(f"{path}: the carrier {center} reports no position in it")
        carrier = flights.pop(str(center)).truth
    arrivals = [report.t_ns for each in reports.values() for report in each]
    return Flown(
        path.name,
        str(center if center_text and center_text != "home" else home),
        tuple(flights.values()),
        carrier,
        (min(arrivals), max(arrivals)),
    )


Reports = dict[str, list[Report]]
Receivers = dict[str, list[GnssStatus | None]]
States = dict[str, list[tuple[int, bytes]]]


def _gather(path: Path) -> tuple[Reports, Receivers, States, States]:
    """Messages by vehicle, with their arrival.

    Returns reports, each once; the receiver's status at each; SIM_STATE; and SIMSTATE.
    """
    reports: Reports = defaultdict(list)
    receivers: Receivers = defaultdict(list)
    states: States = defaultdict(list)
    places: States = defaultdict(list)
    newest: dict[str, GnssStatus] = {}
    dedupe = Dedupe()
    for frame in _frames(path):
        if frame.msgid == SIM_STATE:
            states[str(frame.source)].append((frame.t_ns, frame.payload))
            continue
        if frame.msgid == SIMSTATE:
            places[str(frame.source)].append((frame.t_ns, frame.payload))
            continue
        message = decode(frame)
        if isinstance(message, GnssStatus):
            newest[str(message.source)] = message
        elif isinstance(message, Report) and not dedupe.is_repeat(frame):
            reports[message.uav].append(message)
            receivers[message.uav].append(newest.get(message.uav))
    return reports, receivers, states, places


def _frames(path: Path) -> Iterator[Frame]:
    for event in read_log(path):
        if isinstance(event, Frame) and event.msgid in _READ:
            yield event


def _flight(
    uav: str,
    reports: list[Report],
    gnss: list[GnssStatus | None],
    states: list[tuple[int, bytes]],
    places: list[tuple[int, bytes]],
    local: LocalFrame,
) -> Flight:
    arrival_ns = np.array([report.t_ns for report in reports])
    boot_ms = np.array([report.boot_ms for report in reports])
    position = np.array([_place(local, r.lat_deg, r.lon_deg, r.alt_m or 0.0) for r in reports])
    velocity = np.array([_velocity(local, report) for report in reports])
    height = np.array([np.nan if r.relative_alt_m is None else r.relative_alt_m for r in reports])
    t_ns = true_times_ns(arrival_ns, boot_ms)
    truth = _simulated(states, local, arrival_ns, arrival_ns - t_ns) if states else None
    if truth is None and places:
        alt_m = np.array([r.alt_m or 0.0 for r in reports])
        truth = _placed(places, local, arrival_ns, t_ns, alt_m)
    return Flight(
        uav, arrival_ns, boot_ms, position, velocity, height, tuple(gnss),
        truth or _with_velocities("reports", t_ns, position, velocity),
    )  # fmt: skip


def _place(local: LocalFrame, lat_deg: float, lon_deg: float, alt_m: float) -> FloatArray:
    return local.position_ned_m(lat_deg, lon_deg, alt_m)


def _velocity(local: LocalFrame, report: Report) -> FloatArray:
    if report.velocity_ne_mps is None or report.velocity_down_mps is None:
        return np.full(3, np.nan)
    there = np.array([*report.velocity_ne_mps, report.velocity_down_mps])
    velocity: FloatArray = local.local_from_ned(report.lat_deg, report.lon_deg) @ there
    return velocity


def true_times_ns(arrival_ns: Times, boot_ms: Times) -> Times:
    """When reports were made, (N,), in hindsight: by the least delay of their neighbourhood.

    A boot clock that steps back was restarted, and begins a neighbourhood of its own.
    """
    boot_ns = boot_ms * 1_000_000
    offset_ns = arrival_ns - boot_ns
    life = np.cumsum(np.diff(boot_ns, prepend=boot_ns[0]) < -REBOOT_STEP_NS)
    least_ns = np.empty_like(offset_ns)
    for number in range(life[-1] + 1):
        (rows,) = np.nonzero(life == number)
        here = arrival_ns[rows]
        starts = np.searchsorted(here, here - WINDOW_NS, side="left")
        stops = np.searchsorted(here, here + WINDOW_NS, side="right")
        for row, start, stop in zip(rows, starts, stops, strict=True):
            least_ns[row] = offset_ns[rows[start:stop]].min()
    times: Times = boot_ns + least_ns
    return times


def _simulated(
    states: list[tuple[int, bytes]], local: LocalFrame, arrival_ns: Times, late_ns: Times
) -> Trajectory | None:
    """The trajectory by SIM_STATE; None where it has no place on Earth or cannot be put in time."""
    t_ns, timed = _in_time(states, arrival_ns, late_ns)
    points = []
    for (_, payload), when_ns, ok in zip(states, t_ns, timed, strict=True):
        fields = _SIM_STATE.unpack(payload.ljust(_SIM_STATE.size, b"\0")[: _SIM_STATE.size])
        lat_deg, lon_deg, alt_m = fields[13:16]
        lat_1e7, lon_1e7 = fields[21:23]
        if lat_1e7 or lon_1e7:  # single precision is good to half a metre only
            lat_deg, lon_deg = lat_1e7 * 1e-7, lon_1e7 * 1e-7
        if ok and (lat_deg or lon_deg):
            velocity = local.local_from_ned(lat_deg, lon_deg) @ np.array(fields[18:21])
            points.append((when_ns, _place(local, lat_deg, lon_deg, alt_m), velocity))
    if len(points) < 2:
        return None
    times, positions, velocities = (np.array(column) for column in zip(*points, strict=True))
    return _ascending("SIM_STATE", times, positions, velocities)


def _placed(
    places: list[tuple[int, bytes]],
    local: LocalFrame,
    arrival_ns: Times,
    made_ns: Times,
    alt_m: FloatArray,
) -> Trajectory | None:
    """The trajectory by SIMSTATE, at the reports' heights; None as for ``_simulated``."""
    t_ns, timed = _in_time(places, arrival_ns, arrival_ns - made_ns)
    order = np.argsort(made_ns, kind="stable")
    heights_m = np.interp(t_ns, made_ns[order], alt_m[order])
    points = []
    for (_, payload), when_ns, high_m, ok in zip(places, t_ns, heights_m, timed, strict=True):
        fields = _SIMSTATE.unpack(payload.ljust(_SIMSTATE.size, b"\0")[: _SIMSTATE.size])
        lat_1e7, lon_1e7 = fields[9:11]
        if ok and (lat_1e7 or lon_1e7):
            points.append((when_ns, _place(local, lat_1e7 * 1e-7, lon_1e7 * 1e-7, high_m)))
    if len(points) < 2:
        return None
    times, positions = (np.array(column) for column in zip(*points, strict=True))
    return _with_velocities("SIMSTATE", times, positions, np.full_like(positions, np.nan))


def _in_time(
    states: list[tuple[int, bytes]], arrival_ns: Times, late_ns: Times
) -> tuple[Times, NDArray[np.bool_]]:
    """When each truth message was made (N,), and whether that is known."""
    came_ns = np.array([t_ns for t_ns, _ in states])
    after = np.clip(np.searchsorted(arrival_ns, came_ns), 1, len(arrival_ns) - 1)
    earlier = came_ns - arrival_ns[after - 1] < arrival_ns[after] - came_ns
    nearest = np.where(earlier, after - 1, after)
    timed: NDArray[np.bool_] = np.abs(came_ns - arrival_ns[nearest]) < PAIRED_NS
    times: Times = came_ns - late_ns[nearest]
    return times, timed


def _with_velocities(
    kind: Kind, t_ns: Times, position: FloatArray, velocity: FloatArray
) -> Trajectory:
    """A trajectory; velocities that it lacks are those between neighbours."""
    found = _ascending(kind, t_ns, position, velocity)
    if len(found.t_ns) < 2 or not np.isnan(found.velocity_ned_mps).any():
        return found
    between = np.gradient(found.position_ned_m, (found.t_ns - found.t_ns[0]) * 1e-9, axis=0)
    filled = np.where(np.isnan(found.velocity_ned_mps), between, found.velocity_ned_mps)
    return Trajectory(kind, found.t_ns, found.position_ned_m, filled)


def _ascending(kind: Kind, t_ns: Times, position: FloatArray, velocity: FloatArray) -> Trajectory:
    """A trajectory in order of time, each time once."""
    times, rows = np.unique(t_ns, return_index=True)
    return Trajectory(kind, times, position[rows], velocity[rows])
