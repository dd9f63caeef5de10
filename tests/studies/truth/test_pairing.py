"""Times of truth messages: on a circle with known times, and against the autopilot's own log."""

import struct
from pathlib import Path

import numpy as np
import pytest
from pymavlink import DFReader  # reference implementation: only tests may import it
from support import ROOT, SHARED, shared_log

from companion.mavlink.wire.encode import Outgoing, pack
from companion.studies.truth import vehicles
from companion.studies.truth.vehicles import Flight
from companion.tracking.geodesy import LocalFrame
from companion.values import Source

S = 1_000_000_000
MS = 1_000_000
EPOCH_US = 1_700_000_000_000_000
SPEED_MPS, RADIUS_M = 20.0, 80.0
HOME = (47.4, 8.5, 400.0)


def frame(msgid: int, payload: bytes) -> bytes:
    """A MAVLink 2 frame of 1:1 with its checksum."""
    return pack(Outgoing(Source(1, 1), msgid, payload), 0)


def circle(t_s: float) -> tuple[float, float, float, float]:
    """Latitude, longitude (1e-7 degrees), north and east speed."""
    angle = SPEED_MPS / RADIUS_M * t_s
    north, east = RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle)
    lat, lon, _ = LocalFrame(*HOME).place(north, east, 0.0)
    return lat * 1e7, lon * 1e7, -SPEED_MPS * np.sin(angle), SPEED_MPS * np.cos(angle)


def report(t_s: float) -> bytes:
    lat, lon, north, east = circle(t_s)
    fields = (round(t_s * 1e3), round(lat), round(lon), 450_000, 50_000)
    return frame(
        33, struct.pack("<IiiiihhhH", *fields, round(north * 1e2), round(east * 1e2), 0, 0)
    )


def truth(t_s: float) -> bytes:
    lat, lon, north, east = circle(t_s)
    fields = [1.0] + [0.0] * 12 + [lat * 1e-7, lon * 1e-7, 450.0, 0.0, 0.0, north, east, 0.0]
    return frame(108, struct.pack("<21fii", *fields, round(lat), round(lon)))


def log(path: Path, every_s: float, from_s: float, held: bool, with_neighbour: bool) -> np.ndarray:
    """A log of reports at 10 Hz and truth messages; returns when the latter were made, seconds.

    every_s         interval of the truth messages
    from_s          when the first is made
    held            whether the link holds all back for up to 3 s again and again
    with_neighbour  whether a SYSTEM_TIME is sent right after every second truth message
    """
    made_s = np.arange(20.0 + from_s, 80.0, every_s)
    sent = [(t_s, 0, report(t_s)) for t_s in np.arange(20.0, 80.0, 0.1)]
    sent += [(t_s, 1, truth(t_s)) for t_s in made_s]
    if with_neighbour:
        sent += [(t_s, 2, frame(2, struct.pack("<QI", 0, int(t_s * 1e3)))) for t_s in made_s[::2]]
    with path.open("wb") as file:
        rng = np.random.default_rng(5)
        opens_s, last_us, until_s = 0.0, 0, 0.0
        for t_s, _, raw in sorted(sent):
            if held and t_s > until_s:
                opens_s = t_s + rng.uniform(0.2, 3.0)
                until_s = opens_s + rng.uniform(0.5, 3.0)
            came_s = until_s if held and opens_s < t_s <= until_s else t_s + rng.uniform(0, 0.004)
            last_us = max(last_us + 20, round(came_s * 1e6))
            file.write((EPOCH_US + last_us).to_bytes(8, "big") + raw)
    return made_s


def errors_ms(path: Path, made_s: np.ndarray) -> np.ndarray:
    """Errors of the truth message times, without the constant part of the clock."""
    (flight,) = vehicles.load(path, "{},{},{}".format(*HOME)).flights
    expected = np.array([[*circle(t_s)[2:], 0.0] for t_s in made_s])
    found = flight.truth.velocity_ned_mps
    # Matched by velocity: within one lap no two are equal.
    row = [int(np.argmin(np.linalg.norm(found - each, axis=1))) for each in expected[:240]]
    off = (flight.truth.t_ns[row] - EPOCH_US * 1000) * 1e-6 - made_s[:240] * 1e3
    return np.asarray(off)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize(
    ("every_s", "from_s", "with_neighbour"),
    [(0.1, 0.0, False), (0.1, 0.06, True), (0.25, 0.02, True), (0.25, 0.0, False)],
)
def test_message_order_determines_truth_times(
    tmp_path: Path, every_s: float, from_s: float, with_neighbour: bool, held: bool
) -> None:
    """Sent with a report, in between, or at their own rate; continuously and in bursts."""
    made_s = log(tmp_path / "a.tlog", every_s, from_s, held, with_neighbour)
    once = made_s < made_s[0] + 2 * np.pi * RADIUS_M / SPEED_MPS  # the first lap
    off_ms = errors_ms(tmp_path / "a.tlog", made_s[once])
    assert np.abs(off_ms).max() < 8  # .16 m at 20 m/s


def lead_ms(flight: Flight) -> np.ndarray:
    """Lead of each report along the flight direction."""
    position, velocity = flight.truth.at(flight.made_ns)
    speed = np.linalg.norm(velocity, axis=1)
    flies = ~np.isnan(speed) & (speed > 3) & flight.flying(flight.made_ns)
    off = flight.position_ned_m[flies] - position[flies]
    return np.asarray(np.sum(off * velocity[flies], axis=1) / speed[flies] ** 2 * 1e3)


def lead_by_the_autopilot_ms(path: Path) -> float:
    """The same from the autopilot's DataFlash log at equal timestamps, free of link errors."""
    reader = DFReader.DFReader_binary(str(path))
    rows: dict[str, list[list[float]]] = {"SIM2": [], "XKF1": []}
    while (m := reader.recv_match(type=list(rows))) is not None:
        if m.get_type() == "SIM2" or m.C == 0:
            row = [m.TimeUS * 1e-6, m.PN, m.PE, m.VN, m.VE]
            rows[m.get_type()].append(row)
    reader.filehandle.close()
    sim, ekf = np.array(rows["SIM2"]), np.array(rows["XKF1"])
    ekf = ekf[ekf[:, 0] > sim[0, 0] + 60]
    at = [np.interp(ekf[:, 0], sim[:, 0], column) for column in sim[:, 1:].T]
    velocity = np.stack(at[2:], axis=1)
    off = ekf[:, 1:3] - np.stack(at[:2], axis=1)
    off -= np.median(off, axis=0)  # their origins
    return float(np.sum(off * velocity) / np.sum(velocity**2) * 1e3)


@pytest.mark.full
def test_aeroplane_reports_lead_and_copter_reports_lag_the_truth() -> None:
    """The autopilot's own log agrees for its aeroplane: the lead is not a dating error."""
    own_ms = lead_by_the_autopilot_ms(shared_log("sitl_planes_circle_1.bin"))
    assert own_ms == pytest.approx(26.7, abs=1)
    for flight in vehicles.load(SHARED / "sitl_planes_circle.tlog", "5:1").flights:
        assert np.median(lead_ms(flight)) == pytest.approx(own_ms, abs=2)
        assert np.ptp(np.percentile(lead_ms(flight), [1, 99])) < 20
    for flight in vehicles.load(shared_log("sitl_4circle.tlog"), "5:1").flights:
        assert np.median(lead_ms(flight)) == pytest.approx(-30, abs=2)


def test_truth_times_are_consistent_with_its_motion() -> None:
    """The distance between consecutive truth messages matches the time between them."""
    for flight in vehicles.load(ROOT / "tests" / "data" / "sitl_4circle_cut.tlog", "5:1").flights:
        truth = flight.truth
        mean = (truth.velocity_ned_mps[1:] + truth.velocity_ned_mps[:-1]) / 2
        speed2 = np.sum(mean**2, axis=1)
        way = np.sum(np.diff(truth.position_ned_m, axis=0) * mean, axis=1)
        fast = (speed2 > 9) & (np.diff(truth.t_ns) < S)
        off_ms = (way[fast] / speed2[fast] - np.diff(truth.t_ns)[fast] * 1e-9) * 1e3
        assert fast.sum() > 50
        assert np.percentile(np.abs(off_ms), 99) < 6
