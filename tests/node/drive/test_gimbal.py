"""Gimbals over pymavlink: commands sent, and evaluation of the gimbal's own attitude."""

import math
import random
import socket
from collections.abc import Iterator
from typing import Any

import pytest
from device_stand_ins import into
from pymavlink.dialects.v20 import all as dialect
from support import HANG_S, rounds

from companion.node.drive import targets
from companion.node.drive.gimbal import Gimbal
from companion.node.drive.loop import DeviceCommand, DeviceError, Drive, SafeState
from companion.values import Frame, Source, UserError


@pytest.fixture
def heard() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(HANG_S)
        yield sock


def message(sock: socket.socket) -> tuple[Any, Any]:
    data, sender = sock.recvfrom(2048)
    return dialect.MAVLink(None).decode(bytearray(data)), sender


def test_gimbal_receives_pitch_and_yaw(heard: socket.socket) -> None:
    port = heard.getsockname()[1]
    gimbal = targets.device(f"gimbal:127.0.0.1:{port}:7:154", print, list)
    gimbal.open()
    gimbal.apply(
        DeviceCommand(
            valid_at_ns=0,
            unfit=None,
            uav="1:1",
            bearing_rad=math.radians(270),
            above_rad=math.radians(12),
        )
    )
    said, _ = message(heard)
    assert said.get_type() == "GIMBAL_MANAGER_SET_PITCHYAW"
    assert (said.target_system, said.target_component, said.gimbal_device_id) == (7, 154, 0)
    assert (said.get_srcSystem(), said.get_srcComponent()) == (7, 191)
    assert math.degrees(said.yaw) == pytest.approx(-90, abs=1e-4)
    assert math.degrees(said.pitch) == pytest.approx(12, abs=1e-4)
    assert math.isnan(said.pitch_rate)
    flags = dialect.GIMBAL_MANAGER_FLAGS_YAW_IN_EARTH_FRAME | dialect.GIMBAL_MANAGER_FLAGS_YAW_LOCK
    assert said.flags & flags == flags
    gimbal.rest(SafeState.HOLD)
    gimbal.rest(SafeState.BORESIGHT)
    said, _ = message(heard)
    assert (said.yaw, said.pitch) == (0.0, 0.0)
    gimbal.close()
    with pytest.raises(DeviceError, match="no socket"):
        gimbal.apply(DeviceCommand(valid_at_ns=0, unfit=None))


def test_gimbal_receives_positions_when_configured(heard: socket.socket) -> None:
    port = heard.getsockname()[1]
    gimbal = targets.device(f"gimbal-roi:127.0.0.1:{port}:7:154", print, list)
    gimbal.open()
    gimbal.apply(
        DeviceCommand(
            valid_at_ns=0,
            unfit=None,
            uav="1:1",
            bearing_rad=1.0,
            above_rad=0.1,
            place=(-47.1234567, 170.7654321, 612.25),
        )
    )
    said, _ = message(heard)
    assert said.get_type() == "COMMAND_INT"
    assert said.command == dialect.MAV_CMD_DO_SET_ROI_LOCATION
    assert (said.target_system, said.target_component) == (7, 154)
    assert said.frame == dialect.MAV_FRAME_GLOBAL
    assert (said.x, said.y, said.z) == (-471234567, 1707654321, 612.25)
    gimbal.rest(SafeState.HOLD)
    gimbal.rest(SafeState.BORESIGHT)
    said, _ = message(heard)
    assert said.command == dialect.MAV_CMD_DO_SET_ROI_NONE
    gimbal.close()


@pytest.mark.parametrize(
    ("flags", "sysid", "length"),
    [(16, 7, 1.0), (64, 7, 1.0), (32, 7, 1.0), (16 | 32, 7, 1.0), (16, 8, 1.0), (16, 7, 1.09)],
)
def test_gimbal_lag_is_estimated_from_its_attitude(
    heard: socket.socket, flags: int, sysid: int, length: float
) -> None:
    """Across north, where angles wrap; attitudes relative to the vehicle, of another vehicle's
    gimbal or of a second one are ignored. Quaternions need not have the length 1."""
    clock = [0]
    gimbal = Gimbal(
        host="127.0.0.1",
        port=heard.getsockname()[1],
        target=Source(7, 154),
        now_ns=lambda: clock[0],
    )
    gimbal.open()
    mav = dialect.MAVLink(None, srcSystem=sysid, srcComponent=154)
    second = dialect.MAVLink(None, srcSystem=7, srcComponent=155)
    aside = second.gimbal_device_attitude_status_encode(0, 0, 0, 16, [0, 0, 0, 1], 0, 0, 0, 0)
    from_north = not flags & dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
    for n in range(150):
        t_s = 0.1 * n
        clock[0] = round(t_s * 1e9)
        gimbal.apply(
            DeviceCommand(
                valid_at_ns=0, unfit=None, uav="1:1", bearing_rad=math.sin(0.5 * t_s), above_rad=0.0
            )
        )
        _, sender = message(heard)
        half = math.sin(0.5 * (t_s + 0.1 - 0.3)) / 2
        told = mav.gimbal_device_attitude_status_encode(
            0, 0, 0, flags, [length * math.cos(half), 0, 0, length * math.sin(half)], 0, 0, 0, 0
        )
        heard.sendto(told.pack(mav), sender)
        if from_north and sysid == 7:
            heard.sendto(aside.pack(second), sender)
    assert gimbal.lead_s == pytest.approx(0.3 if from_north and sysid == 7 else 0.0, abs=0.03)
    gimbal.close()


def test_target_is_followed_first_and_another_gimbal_once_it_is_silent() -> None:
    gimbal = Gimbal(host="127.0.0.1", port=9, target=Source(7, 154))

    def followed(t_s: float, component: int) -> bool:
        frame = Frame(
            t_ns=round(t_s * 1e9), link="", source=Source(7, component), msgid=285, raw=b""
        )
        return gimbal._is_followed(frame)

    assert followed(0.0, 155) and followed(0.1, 154)
    assert not followed(0.2, 155) and followed(1.0, 154)
    assert not followed(2.9, 155) and followed(3.1, 155)
    assert not followed(3.2, 156) and followed(3.3, 154)


def test_gimbal_does_not_support_mute() -> None:
    with pytest.raises(UserError, match="does not support mute; choose hold or boresight"):
        targets.device("gimbal:127.0.0.1:1:1:154", print, list).check(SafeState.MUTE)


@pytest.mark.parametrize(
    "target",
    ["gimbal:here", "gimbal:h:1:1", "gimbal:h:0:1:1", "gimbal:h:1:256:1", "gimbal-roi:h:1:1"],
)
def test_invalid_gimbal_target_is_rejected(target: str) -> None:
    with pytest.raises(UserError, match="is not gimbal"):
        targets.device(target, print, list)


# --- hostile gimbals ------------------------------------------------------------------------------

HOLD = DeviceCommand(valid_at_ns=0, unfit=None, uav="1:1", bearing_rad=0.5)


@pytest.fixture
def linked(heard: socket.socket) -> Iterator[tuple[Gimbal, Any]]:
    """A gimbal, and the function by which it sends: one datagram for each argument."""
    gimbal = Gimbal(host="127.0.0.1", port=heard.getsockname()[1], target=Source(7, 154))
    gimbal.open()
    gimbal.apply(HOLD)
    _, sender = message(heard)
    yield gimbal, lambda *datagrams: [heard.sendto(one, sender) for one in datagrams]
    gimbal.close()


def attitude(*quaternion: float) -> bytes:
    mav = dialect.MAVLink(None, srcSystem=7, srcComponent=154)
    said = mav.gimbal_device_attitude_status_encode(0, 0, 0, 16, quaternion, 0, 0, 0, 0)
    return bytes(said.pack(mav))


NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    "quaternion",
    [(NAN, 0, 0, 0), (0, INF, 0, -INF), (3e38, 3e38, 3e38, 3e38), (0, 0, 0, 0), (9, 0, 0, 0)],
)
def test_impossible_attitude_is_counted_and_reported_once(
    linked: tuple[Gimbal, Any], quaternion: tuple[float, ...]
) -> None:
    gimbal, send = linked
    said: list[str] = []
    drive = Drive(
        source=Always(),
        device=gimbal,
        update_hz=10.0,
        safe=SafeState.HOLD,
        now_ns=lambda: 0,
        say=into(said),
    )
    drive._open = True
    for n in (1, 2):
        send(attitude(*quaternion))
        drive.step()
        assert drive.status().rejected == {"malformed": n}
    assert said == ["a reply of the device is rejected (malformed); others are only counted"]
    assert gimbal._seen_rad == 0.0 and drive.status().applied == 2


@pytest.mark.parametrize("length", [0.92, 1.0, 1.09])
def test_yaw_of_a_quaternion_does_not_depend_on_its_length(
    linked: tuple[Gimbal, Any], length: float
) -> None:
    gimbal, send = linked
    send(attitude(length * math.cos(1.0), 0, 0, length * math.sin(1.0)))
    gimbal.apply(HOLD)
    assert gimbal._seen_rad == pytest.approx(2.0)


def test_any_datagram_of_a_gimbal_is_used_or_counted(linked: tuple[Gimbal, Any]) -> None:
    gimbal, send = linked
    rng, valid = random.Random(5), attitude(1, 0, 0, 0)
    used = 0
    for _ in range(rounds(300, 3000)):
        data = bytearray(valid[: rng.randrange(1, len(valid) + 1)])
        for _ in range(rng.randrange(3)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        used += bytes(data) == valid
        counted = sum(gimbal.rejected.values())
        send(bytes(data))
        gimbal.apply(HOLD)
        assert bytes(data) == valid or sum(gimbal.rejected.values()) > counted
        send(valid)  # what was cut before does not damage the next one
        gimbal.apply(HOLD)
        used += 1
        assert len(gimbal._lag._reports) == min(used, gimbal._lag._reports.maxlen or 0)


def test_flood_of_a_gimbal_is_a_failure(linked: tuple[Gimbal, Any]) -> None:
    gimbal, _ = linked
    endless = Endless()
    gimbal._socket, before = endless, gimbal._socket  # type: ignore[assignment]
    assert before is not None
    before.close()
    with pytest.raises(DeviceError, match="more than 1000 messages between two updates"):
        gimbal.apply(HOLD)
    assert endless.read == 1000


class Endless:
    """A socket whose peer sends faster than it is read."""

    def __init__(self) -> None:
        self.read = 0

    def recv(self, _: int) -> bytes:
        self.read += 1
        return b"\xfd" * 20

    def close(self) -> None: ...


class Always:
    def ask(self, lead_s: float) -> DeviceCommand:
        return HOLD
