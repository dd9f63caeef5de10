"""Contents read from a log: against pymavlink, and against known motions."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil  # reference implementation: only tests may import it
from support import ROOT, shared_log

from companion.studies.truth import vehicles
from companion.studies.truth.hindsight import boot_clock
from companion.studies.truth.streams import gather
from companion.studies.truth.trajectory import Trajectory
from companion.studies.truth.vehicles import Flight
from companion.tracking.geodesy import LocalFrame
from companion.values import UserError

S = 1_000_000_000


def cubic(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A motion that cubic Hermite interpolation reproduces exactly."""
    c = np.array([[1.0, -2.0, 3.0], [0.5, 4.0, -1.0], [0.3, -0.2, 0.1], [0.02, 0.01, -0.03]])
    powers = t_s[:, None] ** np.arange(4)
    slopes = np.arange(1, 4) * t_s[:, None] ** np.arange(3)
    return powers @ c, slopes @ c[1:]


def test_interpolation_is_exact_for_a_cubic() -> None:
    t_s = np.array([0.0, 0.4, 1.0, 2.5])
    position, velocity = cubic(t_s)
    trajectory = Trajectory(
        kind="reports",
        t_ns=np.round(t_s * S).astype(np.int64),
        position_ned_m=position,
        velocity_ned_mps=velocity,
    )
    asked_s = np.array([0.0, 0.1, 0.4, 0.9, 1.7, 2.5])
    position, velocity = trajectory.at(np.round(asked_s * S).astype(np.int64))
    expected = cubic(asked_s)
    assert position == pytest.approx(expected[0])
    assert velocity == pytest.approx(expected[1])


def test_flight_of_more_than_twelve_hours_is_rejected(tmp_path: Path) -> None:
    """A table of 252 kB, with a line a minute over 82 hours, took gigabytes."""
    table = tmp_path / "days.csv"
    head = "unix_s,id,lat_deg,lon_deg,alt_m"
    lines = [f"{1_795_314_424 + 59 * n},1,47,8,{400 + n % 7}" for n in range(800)]
    table.write_text("\n".join([head, *lines]))
    with pytest.raises(UserError, match=r"days\.csv: the flight is longer than 12 hours"):
        gather([table])


def test_trajectory_is_unknown_outside_and_in_gaps() -> None:
    t_s = np.array([0.0, 1.0, 4.0, 5.0])
    position, velocity = cubic(t_s)
    trajectory = Trajectory(
        kind="reports",
        t_ns=np.round(t_s * S).astype(np.int64),
        position_ned_m=position,
        velocity_ned_mps=velocity,
    )
    position, velocity = trajectory.at(np.array([-1, S // 2, 2 * S, 3 * S, 4 * S, 6 * S]))
    known = [False, True, False, False, True, False]
    assert list(~np.isnan(position[:, 0])) == known
    assert list(~np.isnan(velocity[:, 2])) == known
    lone = Trajectory(
        kind="reports",
        t_ns=np.array([5]),
        position_ned_m=np.zeros((1, 3)),
        velocity_ned_mps=np.zeros((1, 3)),
    )
    assert np.isnan(lone.at(np.array([5]))[0]).all()


def without(path: Path, out: Path, name: str) -> Path:
    """Write a log without the messages of one name."""
    reader = mavutil.mavlogfile(str(path))
    with out.open("wb") as file:
        while (m := reader.recv_msg()) is not None:
            if m.get_type() != name:
                file.write(round(m._timestamp * 1e6).to_bytes(8, "big") + bytes(m.get_msgbuf()))
    reader.f.close()
    return out


def test_simstate_truth_matches_sim_state(cut: Path, tmp_path: Path) -> None:
    """SIMSTATE has the horizontal position of SIM_STATE to its last digit; height is from
    reports."""
    newer = vehicles.load(cut, "5:1")
    older = vehicles.load(without(cut, tmp_path / "older.tlog", "SIM_STATE"), "5:1")
    neither = without(tmp_path / "older.tlog", tmp_path / "neither.tlog", "SIMSTATE")
    assert {flight.truth.kind for flight in vehicles.load(neither, "5:1").flights} == {"reports"}
    for one, other in zip(newer.flights, older.flights, strict=True):
        assert other.truth.kind == "SIMSTATE"
        position, velocity = other.truth.at(one.truth.t_ns)
        off_m = np.abs(position - one.truth.position_ned_m)
        off_mps = np.abs(velocity - one.truth.velocity_ned_mps)
        flying = one.flying(one.truth.t_ns) & ~np.isnan(off_m).any(axis=1)
        assert flying.sum() > 100
        assert np.median(off_m[flying], axis=0) == pytest.approx([0, 0, 0], abs=0.5)
        assert np.percentile(off_m[flying, :2], 95) < 0.3
        assert np.percentile(off_mps[flying, :2], 95) < 1.0


def test_estimated_times_have_the_minimum_delay() -> None:
    """A drifting clock, late reports, a restart: recovered up to the minimum delay of some
    seconds."""
    rng = np.random.default_rng(3)
    made_ns = np.arange(0, 120 * S, S // 10)
    drift = 1e-4
    boot_ms = np.round(made_ns * (1 - drift) * 1e-6).astype(np.int64) + 777_000
    boot_ms[700:] -= boot_ms[700] - 100
    late_ns = np.round(rng.exponential(0.05, len(made_ns)) * S).astype(np.int64)
    found = boot_clock(made_ns + late_ns, boot_ms * 1_000_000).made_ns
    error_s = (found - made_ns) * 1e-9
    assert np.abs(error_s).max() < 0.006  # half a window of drift, and a report with low delay
    assert np.abs(error_s - np.median(error_s)).mean() < 0.001


@pytest.fixture(scope="module")
def cut() -> Path:
    return ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"


def by_pymavlink(path: Path) -> tuple[dict[str, list[list[float]]], dict[str, list[list[float]]]]:
    """Reports and SIM_STATE, position and velocity, of each source, by another reader."""
    reader = mavutil.mavlogfile(str(path))
    reports: dict[str, list[list[float]]] = {}
    states: dict[str, list[list[float]]] = {}
    while (m := reader.recv_match(type=["GLOBAL_POSITION_INT", "SIM_STATE"])) is not None:
        source = f"{m.get_srcSystem()}:{m.get_srcComponent()}"
        if m.get_type() == "SIM_STATE":
            row = [m.lat_int * 1e-7, m.lon_int * 1e-7, m.alt, m.vn, m.ve, m.vd]
            states.setdefault(source, []).append(row)
        else:
            row = [m.lat * 1e-7, m.lon * 1e-7, m.alt * 1e-3, m.vx * 1e-2, m.vy * 1e-2, m.vz * 1e-2]
            reports.setdefault(source, []).append(row)
    reader.close()
    return reports, states


def test_log_contents_match_pymavlink(cut: Path) -> None:
    place = (47.3977419, 8.5455938, 25.0)
    flown = vehicles.load(cut, "47.3977419,8.5455938,25")
    reports, states = by_pymavlink(cut)
    assert (
        {flight.uav for flight in flown.flights} == set(reports) == {f"{n}:1" for n in range(1, 6)}
    )
    local = LocalFrame(*place)
    for flight in flown.flights:
        assert flight.truth.kind == "SIM_STATE"
        told = [local.position_ned_m(*row[:3]) for row in reports[flight.uav]]
        assert flight.position_ned_m == pytest.approx(np.array(told), abs=1e-6)
        velocities = np.array([row[3:] for row in reports[flight.uav]])
        assert flight.velocity_ned_mps == pytest.approx(velocities, abs=1e-3)
        truly = np.array([local.position_ned_m(*row[:3]) for row in states[flight.uav]])
        kept = flight.truth.position_ned_m
        assert len(truly) - 2 <= len(kept) <= len(truly)
        assert np.abs(truly[:, None] - kept[None]).max(axis=2).min(axis=0).max() < 1e-6
    assert np.array_equal(flown.carrier_at(np.zeros(2, dtype=np.int64)), np.zeros((2, 3)))


def test_truth_and_reports_agree_in_time(cut: Path) -> None:
    """The simulated autopilot itself is 20 to 30 ms behind; a larger clock error would be
    visible."""
    for flight in vehicles.load(cut, "5:1").flights:
        made_ns = flight.made_ns
        position, velocity = flight.truth.at(made_ns)
        known = ~np.isnan(position[:, 0])
        assert known.mean() > 0.9
        speed = np.linalg.norm(velocity[known], axis=1)
        miss = flight.position_ned_m[known] - position[known]
        along_s = np.sum(miss * velocity[known], axis=1) / speed**2
        assert -0.04 < np.median(along_s) < 0.01
        assert np.linalg.norm(miss, axis=1).max() < 1.0


def test_carrier_is_excluded_from_flights_and_moves(cut: Path) -> None:
    flown = vehicles.load(cut, "5:1")
    assert flown.center == "5:1"
    assert {flight.uav for flight in flown.flights} == {"1:1", "2:1", "3:1", "4:1"}
    middle = (flown.span_ns[0] + flown.span_ns[1]) // 2
    position = flown.carrier_at(np.array([middle, flown.span_ns[1] + 60 * S]))
    assert np.linalg.norm(position[0]) < 100
    assert np.isnan(position[1]).all()


def test_reports_are_the_truth_without_a_simulator() -> None:
    flown = vehicles.load(shared_log("real_dronekit_flight2015.tlog"), None)
    (flight,) = flown.flights
    assert flight.truth.kind == "reports"
    assert flown.center.startswith("-35.")
    made_ns = flight.made_ns
    some = slice(500, 600)
    position, _ = flight.truth.at(made_ns[some])
    assert position == pytest.approx(flight.position_ned_m[some])


def test_flying_requires_speed_and_height(straight_flight: Callable[..., Flight]) -> None:
    high, low = straight_flight(), straight_flight(height_m=1.5)
    t_ns = high.truth.t_ns[10:20]
    assert high.flying(t_ns).all()
    assert not low.flying(t_ns).any()
    assert not high.flying(high.truth.t_ns[-1:] + S).any()
    zero = high.position_ned_m * 0
    still = Trajectory(
        kind="reports", t_ns=high.truth.t_ns, position_ned_m=zero, velocity_ned_mps=zero
    )
    assert not replace(high, truth=still).flying(t_ns).any()


@pytest.mark.parametrize(
    ("center", "says"),
    [("9:1", "the carrier 9:1 reports no position"), ("x", "'x' is not SYSID:COMPID")],
)
def test_unknown_carrier_is_rejected(cut: Path, center: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        vehicles.load(cut, center)
