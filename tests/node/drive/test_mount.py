"""Mounts: hamlib's dummy rotator, and one of 30 degrees/s with a lag of 0.2 s that follows UAVs
over a slow radio, compared with pointing at the newest report."""

import math
import socket
import socketserver
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect
from support import HANG_S

from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.node.drive.lag import MountLag
from companion.node.drive.loop import DeviceCommand, DeviceError, DeviceInput, Drive, SafeState
from companion.node.drive.rotctld import Rotator
from companion.node.drive.sources import BeamRequest, command_of
from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Frame, Tick, UserError
from sitl_replay.flight import scenario
from sitl_replay.flight.vehicles import schedule

START_NS = 1_760_000_000_000_000_000
STEP_S, RATE_DEG, LAG_S = 0.01, 30.0, 0.2


class Clock:
    def __init__(self) -> None:
        self.t_ns = START_NS

    def now_ns(self) -> int:
        return self.t_ns


class Mount:
    """At most 30 degrees/s, with a lag of 0.2 s as dead time or smoothing."""

    def __init__(self, smooth: bool) -> None:
        self.azimuth_deg = self.elevation_deg = 0.0
        self._smooth = smooth
        self._told = (0.0, 0.0)
        self._waiting: list[tuple[float, float, float]] = []

    def point(self, t_s: float, azimuth_deg: float, elevation_deg: float) -> None:
        self._waiting.append((t_s, azimuth_deg, elevation_deg))

    def advance(self, t_s: float) -> None:
        while self._waiting and self._waiting[0][0] <= t_s - (0.0 if self._smooth else LAG_S):
            self._told = self._waiting.pop(0)[1:]
        most = RATE_DEG * STEP_S
        share = STEP_S / LAG_S if self._smooth else 1.0
        off = [
            told - now
            for told, now in zip(self._told, (self.azimuth_deg, self.elevation_deg), strict=True)
        ]
        self.azimuth_deg += min(max(share * off[0], -most), most)
        self.elevation_deg += min(max(share * off[1], -most), most)


@pytest.fixture
def serving() -> Iterator[Any]:
    """Serve a mount as rotctld does, in the time of a clock."""
    servers = []

    def serve(mount: Mount, clock: Clock) -> int:
        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                for line in self.rfile:
                    words = line.decode().split()
                    answer = ""
                    if words[0] == "+\\dump_caps":
                        answer = "Min Azimuth: -36000\nMax Azimuth: 36000\n"
                        answer += "Min Elevation: 0\nMax Elevation: 90\n"
                    elif words[0] == "+P":
                        t_s = (clock.t_ns - START_NS) * 1e-9
                        mount.point(t_s, float(words[1]), float(words[2]))
                    elif words[0] == "+p":
                        answer = f"get_pos:\nAzimuth: {mount.azimuth_deg:.2f}\n"
                        answer += f"Elevation: {mount.elevation_deg:.2f}\n"
                    self.wfile.write(answer.encode() + b"RPRT 0\n")

        server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return int(server.server_address[1])

    yield serve
    for server in servers:
        server.shutdown()
        server.server_close()


def over_radio(
    flown: Any, seconds: float, rng: np.random.Generator
) -> list[tuple[float, Any, bytes]]:
    """Return arrival time, sender and frame: 1.2 Hz of each kind, 0.6 s late (2.2 s at the 95th
    percentile), a tenth lost; the carrier's own frames arrive by wire."""
    last: dict[tuple[str, int], float] = {}
    sigma = math.log(2.2 / 0.6) / 1.645
    arrivals = []
    for t_s, vehicle, raw in schedule(flown, 1, START_NS, seconds):
        if vehicle is flown.carrier:
            arrivals.append((t_s + 0.003, vehicle, raw))
            continue
        kind = (vehicle.name, raw[7])
        if t_s - last.get(kind, -1e9) < 1 / 1.2:
            continue
        last[kind] = t_s
        delay_s = 0.6 * math.exp(sigma * rng.standard_normal())
        if rng.random() > 0.1:
            arrivals.append((t_s + delay_s, vehicle, raw))
    return sorted(arrivals, key=lambda one: one[0])


def bearing_deg(flown: Any, uav: str, t_s: float) -> float:
    there, here = flown.truth(uav, t_s)[0], flown.truth("5:1", t_s)[0]
    north, east = (there.position_ned_m[i] - here.position_ned_m[i] for i in (0, 1))
    return math.degrees(math.atan2(east, north))


@pytest.mark.full
@pytest.mark.parametrize("smooth", [False, True], ids=["dead time", "smoothing"])
@pytest.mark.parametrize("name", ["waypoints", "racetrack"])
def test_mount_error_is_half_that_of_following_reports(
    serving: Any, name: str, smooth: bool
) -> None:
    flown = {"waypoints": scenario.waypoints, "racetrack": scenario.racetrack}[name](3)
    clock, ours, rival = Clock(), Mount(smooth), Mount(smooth)
    settings = Settings().override(center={"source": "5:1"}, observer={"lag_s": (0.0, 0.0)})
    pipeline = Pipeline(settings)
    equipment = assembly.equipment(settings, pipeline.array)
    wanted = BeamRequest(uavs=("1:1",), any_uav=False, takes=DeviceInput.POINTING)

    class Here:
        def ask(self, lead_s: float) -> DeviceCommand:
            return command_of(pipeline, equipment, pipeline.look(clock.t_ns, lead_s), wanted)

    rotator = Rotator("127.0.0.1", serving(ours, clock), clock.now_ns)
    drive = Drive(
        source=Here(),
        device=rotator,
        update_hz=10.0,
        safe=SafeState.HOLD,
        now_ns=clock.now_ns,
        say=lambda *_: None,
    )
    seconds, off = 90.0, {"ours": list[float](), "rival": list[float]()}
    arrivals = over_radio(flown, seconds, np.random.default_rng(3))
    mav: Any = dialect.MAVLink(None)
    seen_deg = 0.0
    for n in range(round(seconds / STEP_S)):
        t_s = n * STEP_S
        clock.t_ns = START_NS + round(t_s * 1e9)
        while arrivals and arrivals[0][0] <= t_s:
            at_s, vehicle, raw = arrivals.pop(0)
            msgid = int.from_bytes(raw[7:10], "little")
            at_ns = START_NS + round(at_s * 1e9)
            pipeline.step(
                Frame(t_ns=at_ns, link="radio", source=vehicle.source, msgid=msgid, raw=raw)
            )
            if vehicle.name == "1:1" and raw[7] == GLOBAL_POSITION_INT:
                said = mav.decode(bytearray(raw))
                north = (said.lat * 1e-7 - flown.origin.lat_deg) * 111_320.0
                east = (said.lon * 1e-7 - flown.origin.lon_deg) * 111_320.0
                east *= math.cos(math.radians(flown.origin.lat_deg))
                near = math.degrees(math.atan2(east, north))
                seen_deg = near + 360 * round((seen_deg - near) / 360)
        if n % 10 == 0:
            pipeline.step(Tick(clock.t_ns))
            drive.step()
            rival.point(t_s, seen_deg, 0.0)
        ours.advance(t_s)
        rival.advance(t_s)
        if t_s > 30:
            true = bearing_deg(flown, "1:1", t_s)
            for who, mount in (("ours", ours), ("rival", rival)):
                off[who].append((mount.azimuth_deg - true + 180) % 360 - 180)
    rms = {who: float(np.sqrt(np.mean(np.square(values)))) for who, values in off.items()}
    drive.end()
    print(name, smooth, rms, rotator.lead_s)
    assert drive.status().applied > 800
    assert rms["ours"] <= 0.5 * rms["rival"]
    assert 0.15 <= rotator.lead_s <= 0.4


# --- hamlib -------------------------------------------------------------------------------------


def opened(port: int) -> Rotator:
    """Return a rotator once rotctld listens."""
    rotator = Rotator("127.0.0.1", port)
    waiting = threading.Event()
    for _ in range(round(HANG_S / 0.05)):
        try:
            rotator.open()
        except DeviceError:
            waiting.wait(0.05)
        else:
            return rotator
    raise AssertionError("rotctld does not listen")


def test_hamlib_dummy_is_driven_within_its_limits(rotctld: int) -> None:
    rotator = opened(rotctld)
    assert rotator._limits_deg == (-180.0, 450.0, 0.0, 90.0)
    rotator.apply(
        DeviceCommand(
            valid_at_ns=0,
            unfit=None,
            uav="1:1",
            bearing_rad=math.radians(350),
            above_rad=math.radians(-5),
        )
    )
    with socket.create_connection(("127.0.0.1", rotctld), HANG_S) as other:
        other.sendall(b"+p\n")
        assert b"get_pos:" in other.recv(4096)
    rotator.apply(
        DeviceCommand(
            valid_at_ns=0,
            unfit=None,
            uav="1:1",
            bearing_rad=math.radians(10),
            above_rad=math.radians(95),
        )
    )
    rotator.rest(SafeState.HOLD)
    rotator.rest(SafeState.BORESIGHT)
    rotator.close()
    with pytest.raises(DeviceError, match="not connected"):
        rotator.apply(DeviceCommand(valid_at_ns=0, unfit=None))


def test_nearest_equivalent_azimuth_within_limits_is_chosen() -> None:
    rotator = Rotator("127.0.0.1", 1)
    rotator._limits_deg = (-180.0, 450.0, 0.0, 90.0)
    near = [rotator._near(azimuth) for azimuth in (350.0, 10.0, 100.0, 170.0, 260.0)]
    assert near == [-10.0, 10.0, 100.0, 170.0, 260.0]
    rotator._last_deg = 440.0
    assert rotator._near(95.0) == 95.0 + 360.0 * (95.0 + 360.0 <= 450.0)


def test_rotator_does_not_support_mute() -> None:
    with pytest.raises(UserError, match="does not support mute; choose hold or boresight"):
        Rotator("127.0.0.1", 1).check(SafeState.MUTE)


def test_unreachable_rotator_is_a_device_error() -> None:
    with pytest.raises(DeviceError, match="Connection refused"):
        Rotator("127.0.0.1", 1).open()


def test_reports_before_the_first_command_give_no_lag() -> None:
    """A gimbal at its boresight reports for as long as there are no beams."""
    lag = MountLag()
    for number in range(40):
        lag.note_report(number * 10_000_000, 0.01 * number)
    assert lag.lag_s == 0.0


def test_lag_is_estimated_once_for_all_reports_of_an_update(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A gimbal may send thousands between two updates, and an estimate takes milliseconds."""
    estimated = list[None]()
    monkeypatch.setattr(MountLag, "_estimate", lambda *_: estimated.append(None))
    lag = MountLag()
    lag.note_command(0, 0.0)
    for number in range(1000):
        lag.note_report(number * 1_000_000, 0.1)
    assert not estimated
    assert (lag.lag_s, lag.lag_s) == (0.0, 0.0) and len(estimated) == 1


@pytest.mark.parametrize("lag_s", [0.05, 0.2, 0.7])
def test_lag_is_estimated_from_position_reports(lag_s: float) -> None:
    lag, rng = MountLag(), np.random.default_rng(1)

    def at_rad(t_s: float) -> float:
        return 2.0 * math.sin(0.4 * t_s)

    for n in range(200):
        t_s = 0.1 * n
        lag.note_command(round(t_s * 1e9), at_rad(t_s))
        lag.note_report(round(t_s * 1e9), at_rad(t_s - lag_s) + 0.005 * rng.standard_normal())
    assert lag.lag_s == pytest.approx(lag_s, abs=0.03)


def test_lag_is_estimated_across_full_turns() -> None:
    lag = MountLag()
    for n in range(100):
        t_s = 0.1 * n
        lag.note_command(round(t_s * 1e9), 0.3 * t_s)
        lag.note_report(round(t_s * 1e9), 0.3 * (t_s - 0.4) + 2 * math.pi)
    assert lag.lag_s == pytest.approx(0.4, abs=0.02)


def test_stationary_mount_has_no_lag() -> None:
    lag = MountLag()
    for n in range(200):
        lag.note_command(n * 100_000_000, 1.0)
        lag.note_report(n * 100_000_000, 1.0)
    assert lag.lag_s == 0.0


def test_mount_with_unrelated_motion_has_no_lag() -> None:
    lag, rng = MountLag(), np.random.default_rng(3)
    for n in range(200):
        lag.note_command(n * 50_000_000, math.sin(0.5 * n * 0.05))
        lag.note_report(n * 50_000_000, float(rng.uniform(-1, 1)))
    assert lag.lag_s == 0.0


# --- a rotctld with malformed answers -------------------------------------------------------------


@pytest.fixture
def answers() -> Iterator[Any]:
    """``answers(reply)``: the port of a server that gives every command this reply, byte by byte if
    ``drips``."""
    servers: list[socketserver.TCPServer] = []
    over = threading.Event()

    def serve(reply: bytes, *, drips: bool = False) -> int:
        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                while not over.is_set() and self.request.recv(4096):
                    for at in range(len(reply)) if drips else ():
                        self.request.sendall(reply[at : at + 1])
                        if over.wait(0.02):
                            return
                    if not drips:
                        self.request.sendall(reply)

        server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        server.daemon_threads = True
        servers.append(server)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        return int(server.server_address[1])

    yield serve
    over.set()
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize(
    "reply",
    [
        b"Azimuth: 1.2.3\nElevation: 4\nRPRT 0\n",
        b"Azimuth: -.\nElevation: .\nRPRT 0\n",
        b"Azimuth: " + b"9" * 400 + b"\nElevation: 0\nRPRT 0\n",
        b"Azimuth: nan\nElevation: inf\nRPRT 0\n",
        b"RPRT 0\n",
        b"RPRT -1\n",
        b"\xff\xfe\x00RPRT 0\n",
        b"x" * 100_000,
    ],
)
def test_malformed_answers_are_device_errors(answers: Any, reply: bytes) -> None:
    rotator = Rotator("127.0.0.1", answers(reply))
    with pytest.raises(DeviceError):
        rotator.open()
    rotator.close()


def test_answer_that_nothing_asked_for_is_a_device_error(answers: Any) -> None:
    """It would be taken for the answer to the next command, and so on for ever."""
    reply = b"Azimuth: 5\nElevation: 6\nRPRT 0\n"
    rotator = Rotator("127.0.0.1", answers(2 * reply))
    with pytest.raises(DeviceError, match="answer to no command"):
        rotator.open()
    rotator.close()


def test_answer_that_drips_is_given_up(answers: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.node.drive.rotctld.TIMEOUT_S", 0.3)
    rotator = Rotator("127.0.0.1", answers(b"Azimuth: " + b"1" * 100_000, drips=True))
    with pytest.raises(DeviceError, match="rotctld"):
        rotator.open()
    rotator.close()


def test_impossible_limits_are_ignored(answers: Any) -> None:
    caps = b"Min Azimuth: 90\nMax Azimuth: -90\nMin Elevation: 0\nMax Elevation: 90\n"
    rotator = Rotator("127.0.0.1", answers(caps + b"Azimuth: 5\nElevation: 6\nRPRT 0\n"))
    rotator.open()
    assert rotator._limits_deg == (0.0, 360.0, 0.0, 90.0)
    rotator.close()
