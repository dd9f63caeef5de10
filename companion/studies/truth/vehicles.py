"""Vehicles of a log: their reports and their true trajectories.

The truth is the simulator's if a log has it: SIM_STATE, or the older SIMSTATE with the heights of
the reports and velocities between neighbours. Otherwise the truth is all reports, in order of the
sender's clock, interpolated. ``pairing`` finds the times of truth messages, ``hindsight`` estimates
the sender's clock.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.recording.declared_faults import DeclaredFault, declared_faults
from companion.settings.center import CenterPlace, FixedCenter, VehicleCenter, parse_center
from companion.studies.truth import pairing
from companion.studies.truth.hindsight import BootClock
from companion.studies.truth.streams import (
    SIM_STATE,
    SIMSTATE,
    VehicleStream,
    gather,
    truth_messages,
)
from companion.studies.truth.trajectory import Times, Trajectory, ascending
from companion.tracking.geodesy import LocalFrame
from companion.values import (
    BoolArray,
    FloatArray,
    Frame,
    GnssStatus,
    IntArray,
    Report,
    RoundTrip,
    UserError,
)

FLYING_SPEED_MPS: Final = 1.0
FLYING_HEIGHT_M: Final = 2.0
BEFORE_FAULT_NS: Final = 1_000_000_000
AFTER_FAULT_NS: Final = 5_000_000_000
"""Time after a declared fault in which the vehicle's own estimate settles."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Flight:
    """One vehicle's flight in a log: its reports in order of arrival, and the truth.

    gnss              last receiver status of the vehicle at each report
    report_at         (N,), index of each report among the frames; empty without frames
    """

    uav: str
    arrival_ns: Times  # (N,), arrivals of the reports
    boot_ms: Times  # (N,), their boot times
    position_ned_m: FloatArray  # (N, 3), local frame
    velocity_ned_mps: FloatArray  # (N, 3), local frame; NaN: not reported
    height_m: FloatArray  # (N,), height above the vehicle's home; NaN: not reported
    gnss: tuple[GnssStatus | None, ...]
    truth: Trajectory
    made_ns: Times  # (N,), creation times of the reports, estimated from the whole log
    frames: tuple[Frame, ...] = ()  # its frames in order of arrival, without truth messages
    report_at: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    round_trips: tuple[RoundTrip, ...] = ()  # TIMESYNC round trips with it
    faults: tuple[tuple[int, int], ...] = ()  # windows of its declared faults: from, to

    def in_fault(self, from_ns: Times, to_ns: Times) -> BoolArray:
        """Return whether each interval, (...), overlaps the window of a declared fault."""
        found = np.zeros(np.shape(from_ns), dtype=bool)
        for begins_ns, ends_ns in self.faults:
            found |= (from_ns <= ends_ns) & (to_ns >= begins_ns)
        return found

    def flying(self, t_ns: Times) -> NDArray[np.bool_]:
        """Return whether the UAV flies: above 1 m/s and, by its last report, above 2 m."""
        _, velocity = self.truth.at(t_ns)
        last = np.searchsorted(self.arrival_ns, t_ns, side="right") - 1
        height = np.where(last < 0, 0.0, self.height_m[np.maximum(last, 0)])
        high = np.isnan(height) | (height > FLYING_HEIGHT_M)
        flies: NDArray[np.bool_] = high & (np.linalg.norm(velocity, axis=1) > FLYING_SPEED_MPS)
        return flies


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Flown:
    """Flights of a log with the array's position: fixed (3,), or a trajectory.

    ``origin`` is the local frame's origin: latitude and longitude in degrees, altitude in metres.
    """

    log: str
    center: str
    flights: tuple[Flight, ...]
    carrier: FloatArray | Trajectory
    span_ns: tuple[int, int]
    origin: tuple[float, float, float]

    def carrier_at(self, t_ns: Times) -> FloatArray:
        """Return the array's true position (K, 3) at times (K,); NaN if unknown."""
        if isinstance(self.carrier, Trajectory):
            return self.carrier.at(t_ns)[0]
        return np.broadcast_to(self.carrier, (len(t_ns), 3))


def named(logs: Sequence[Path]) -> str:
    """Return the name of a flight: the names of its logs."""
    return " + ".join(log.name for log in logs)


def load(logs: Path | Sequence[Path], center_text: str | None) -> Flown:
    """Read the flights of a log, or of the logs of a flight.

    Raises ``UserError`` or ``LogError`` if the logs contain nothing to study.
    """
    logs = [logs] if isinstance(logs, Path) else logs
    path = " ".join(map(str, logs))
    center: CenterPlace = parse_center(center_text or "home")
    streams = gather(logs)
    if not streams:
        raise UserError(f"{path}: no position reports; give a log with a flying vehicle")
    first = min((each.reports[0] for each in streams.values()), key=lambda report: report.t_ns)
    home = FixedCenter(lat_deg=first.lat_deg, lon_deg=first.lon_deg, alt_m=first.alt_m or 0.0)
    stands = center if isinstance(center, FixedCenter) else home
    local = LocalFrame(stands.lat_deg, stands.lon_deg, stands.alt_m)
    faults = tuple(fault for log in logs for fault in declared_faults(log))
    # A single report is not a path.
    flights = {
        uav: _flight(uav, stream, local, _windows(faults, stream))
        for uav, stream in streams.items()
        if len({report.boot_ms for report in stream.reports}) > 1
    }
    carrier: FloatArray | Trajectory = np.zeros(3)
    if isinstance(center, VehicleCenter):
        if str(center) not in flights:
            raise UserError(f"{path}: the carrier {center} reports no position; check --center")
        carrier = flights.pop(str(center)).truth
    arrivals = [report.t_ns for stream in streams.values() for report in stream.reports]
    return Flown(
        log=named(logs),
        center=str(center if center_text and center_text != "home" else home),
        flights=tuple(flights.values()),
        carrier=carrier,
        span_ns=(min(arrivals), max(arrivals)),
        origin=local.origin,
    )


def _windows(
    faults: tuple[DeclaredFault, ...], stream: VehicleStream
) -> tuple[tuple[int, int], ...]:
    """Return the windows of a vehicle's faults; outside them its assumptions hold."""
    sysid = stream.reports[0].source.sysid
    return tuple(
        (fault.from_ns - BEFORE_FAULT_NS, fault.to_ns + AFTER_FAULT_NS)
        for fault in faults
        if fault.sysid == sysid
    )


def _flight(
    uav: str, stream: VehicleStream, local: LocalFrame, faults: tuple[tuple[int, int], ...]
) -> Flight:
    reports = stream.reports
    arrival_ns = np.array([report.t_ns for report in reports])
    boot_ms = np.array([report.boot_ms for report in reports])
    position = np.array(
        [local.position_ned_m(r.lat_deg, r.lon_deg, r.alt_m or 0.0) for r in reports]
    )
    velocity = np.array([_velocity(local, report) for report in reports])
    height = np.array([np.nan if r.relative_alt_m is None else r.relative_alt_m for r in reports])
    clock = stream.clock()
    # Every report has a stamp; equal stamps are interchangeable.
    rows = {stamp: row for row, stamp in enumerate(stream.stamps)}
    numbers = [rows[r.t_ns, (r.boot_ms or 0) * 1_000_000] for r in reports]
    made_ns = clock.made_ns[numbers]
    truth = (
        _simulated(stream, clock, local)
        or _placed(stream, clock, local, made_ns=made_ns, velocity_ned_mps=velocity)
        or ascending("reports", made_ns, position, velocity)
    )
    return Flight(
        uav=uav,
        arrival_ns=arrival_ns,
        boot_ms=boot_ms,
        position_ned_m=position,
        velocity_ned_mps=velocity,
        height_m=height,
        gnss=tuple(stream.gnss),
        truth=truth,
        made_ns=made_ns,
        frames=tuple(stream.frames),
        report_at=np.array(stream.report_at, dtype=np.int64),
        round_trips=tuple(stream.round_trips),
        faults=faults,
    )


def _velocity(local: LocalFrame, report: Report) -> FloatArray:
    if report.velocity_ne_mps is None or report.velocity_down_mps is None:
        return np.full(3, np.nan)
    there = np.array([*report.velocity_ne_mps, report.velocity_down_mps])
    velocity: FloatArray = local.local_from_ned(report.lat_deg, report.lon_deg) @ there
    return velocity


def _simulated(stream: VehicleStream, clock: BootClock, local: LocalFrame) -> Trajectory | None:
    """Return the trajectory by SIM_STATE messages; None without a valid position or time."""
    said = truth_messages(stream, SIM_STATE, clock)
    points, attitudes, kept = [], [], []
    for fields in said.fields:
        lat_deg, lon_deg, alt_m = fields[13:16]
        lat_1e7, lon_1e7 = fields[21:23]
        if lat_1e7 or lon_1e7:  # single precision resolves only half a metre
            lat_deg, lon_deg = lat_1e7 * 1e-7, lon_1e7 * 1e-7
        kept.append(bool(lat_deg or lon_deg))
        if kept[-1]:
            velocity = local.local_from_ned(lat_deg, lon_deg) @ np.array(fields[18:21])
            points.append((local.position_ned_m(lat_deg, lon_deg, alt_m), velocity))
            attitudes.append(fields[:4])
    if len(points) < 2:
        return None
    positions, velocities = (np.array(column) for column in zip(*points, strict=True))
    brackets = said.brackets.rows(np.array(kept))
    boot_ns = pairing.boot_times_ns(brackets, positions, velocities)
    t_ns = clock.node_ns(boot_ns, brackets.life)
    turned = np.array(attitudes)
    return ascending("SIM_STATE", t_ns, positions, velocities, turned if turned.any() else None)


def _placed(
    stream: VehicleStream,
    clock: BootClock,
    local: LocalFrame,
    *,
    made_ns: Times,
    velocity_ned_mps: FloatArray,
) -> Trajectory | None:
    """Return the trajectory by SIMSTATE, at the heights of the reports created at ``made_ns``.

    The reported velocities give the times between its points. None if there is no valid position or
    time.
    """
    said = truth_messages(stream, SIMSTATE, clock)
    places = np.array([fields[9:11] for fields in said.fields]).reshape(-1, 2)
    kept: BoolArray = np.array(places.any(axis=1))
    if kept.sum() < 2:
        return None
    brackets = said.brackets.rows(kept)
    order = np.argsort(made_ns, kind="stable")
    alt_m = np.array([report.alt_m or 0.0 for report in stream.reports])

    def reported(values: FloatArray, at_ns: Times) -> FloatArray:
        from_ns = made_ns[order[0]]
        found: FloatArray = np.interp(at_ns - from_ns, made_ns[order] - from_ns, values[order])
        return found

    def track(at_ns: Times) -> FloatArray:
        heights_m = reported(alt_m, at_ns)
        rows = zip((places[kept] * 1e-7).tolist(), heights_m.tolist(), strict=True)
        return np.array([local.position_ned_m(lat, lon, high_m) for (lat, lon), high_m in rows])

    roughly_ns = clock.node_ns(brackets.before_ns, brackets.life)
    level = track(roughly_ns)
    velocity = np.stack([reported(axis, roughly_ns) for axis in velocity_ned_mps.T], axis=1)
    velocity[:, 2], level[:, 2] = 0.0, 0.0  # heights carry no information on time
    t_ns = clock.node_ns(pairing.boot_times_ns(brackets, level, velocity), brackets.life)
    return ascending("SIMSTATE", t_ns, track(t_ns), np.full_like(level, np.nan))
