"""Every kind of link of a live service: signed, serial, several at once, lost and restored."""

import json
import os
import shutil
import signal
import socket
import subprocess
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as dialect
from support import BIN, HANG_S, read_metadata

from companion.recording.reader import read_log
from sitl_replay.flight import scenario
from sitl_replay.flight.vehicles import schedule

HTTP = ("--listen", "127.0.0.1:0", "--center", "47.3977,8.5456,500")
UDP = "udpin:127.0.0.1:0"
KEY = bytes(range(32))


def report(boot_ms: int, sysid: int = 1) -> Any:
    return dialect.MAVLink_global_position_int_message(
        boot_ms, 473977000 + sysid * 10_000, 85456000, 550_000, 40_000, 0, 0, 0, 65535
    )


class Sender:
    """Frames over UDP, signed or unsigned, one per 50 ms of its boot clock."""

    def __init__(self, port: int, sysid: int, key: bytes | None = None) -> None:
        self.mav = dialect.MAVLink(None, sysid, 1)
        if key is not None:
            self.mav.signing.secret_key = key
            self.mav.signing.link_id = 3
            self.mav.signing.sign_outgoing = True
            self.mav.signing.timestamp = round((time.time() - 1_420_070_400) * 1e5)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._sysid = sysid
        self._boot_ms = 10_000

    def frame(self, *, v1: bool = False) -> bytes:
        self._boot_ms += 50
        raw = bytes(report(self._boot_ms, self._sysid).pack(self.mav, force_mavlink1=v1))
        self.mav.seq = (self.mav.seq + 1) % 256
        return raw

    def send(self, raw: bytes) -> bytes:
        self._socket.send(raw)
        time.sleep(0.002)  # so that each arrives as a separate datagram with its own time
        return raw

    def __enter__(self) -> "Sender":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


def rejected(node: Any) -> dict[str, int]:
    counts: dict[str, int] = node.json("/v1/status")["rejected"]
    return counts


def test_signatures_are_checked_across_a_restart(start_node: Any, tmp_path: Path) -> None:
    """Right key, wrong key, no signature, a replayed frame, MAVLink 1 in between, restart."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    url = f"udpin:127.0.0.1:{port}"
    (tmp_path / "radio.key").write_bytes(KEY)
    (tmp_path / "radio.key").chmod(0o600)
    settings = tmp_path / "settings.toml"
    settings.write_text(
        f'[links]\nurls = ["{url}"]\n'
        f'[signing]\nkeys = {{"{url}" = "{tmp_path / "radio.key"}"}}\n'
        f'timestamps = "{tmp_path / "timestamps.json"}"\n'
    )
    run = ("run", "--config", str(settings), *HTTP, "--record", str(tmp_path / "recordings"))
    node = start_node(*run)
    with (
        Sender(port, 1, KEY) as right,
        Sender(port, 2, bytes(32)) as wrong,
        Sender(port, 3) as none,
    ):
        first = right.send(right.frame())
        for _ in range(9):
            right.send(right.frame())
            wrong.send(wrong.frame())
            none.send(none.frame())
            none.send(none.frame(v1=True))
        right.send(first)
        last = right.send(right.frame())
        node.wait_until("/v1/status", lambda s: s["links"][0]["frames"] == 11)
        assert rejected(node) == {"bad-signature": 9, "unsigned": 18, "replayed": 1}
        assert [uav["id"] for uav in node.json("/v1/uavs")["uavs"]] == ["1:1"]
        assert node.json("/v1/status")["links"][0]["lost"] == rejected(node)
        assert node.stop()[0] == 0

        again = start_node(*run)
        again_socket = Sender(port, 1)
        with again_socket:
            again_socket.send(last)
            again.wait_until("/v1/status", lambda s: s["rejected"].get("replayed") == 1)
            right.send(right.frame())
            again.wait_until("/v1/status", lambda s: s["links"][0]["frames"] == 1)
        again.stop(signal.SIGKILL)

        third = start_node(*run)
        right.send(last)
        third.wait_until("/v1/status", lambda s: s["rejected"].get("replayed") == 1)
        end = time.monotonic() + 15
        while third.json("/v1/status")["frames"] == 0:  # rejected until newer than lost ones
            assert time.monotonic() < end
            right.send(right.frame())
            right.mav.signing.timestamp = round((time.time() - 1_420_070_400) * 1e5)
            time.sleep(0.05)


def test_invalid_signing_key_is_reported_at_startup(tmp_path: Path) -> None:
    (tmp_path / "radio.key").write_text("secret")
    settings = tmp_path / "settings.toml"
    settings.write_text(
        f'[links]\nurls = ["udpin:127.0.0.1:0"]\n[signing]\ntimestamps = "{tmp_path}/t.json"\n'
        f'keys = {{"udpin:127.0.0.1:0" = "{tmp_path / "radio.key"}"}}\n'
    )
    done = subprocess.run(
        [BIN / "companion", "run", "--config", settings, *HTTP],
        capture_output=True,
        text=True,
        check=False,
        timeout=HANG_S,
    )
    assert done.returncode != 0
    assert "radio.key" in done.stderr and "32 bytes" in done.stderr
    assert done.stderr.count("\n") == 1


def test_unwritable_signing_timestamps_keep_the_recording_intact(
    start_node: Any, tmp_path: Path
) -> None:
    """The signing timestamp folder disappears: this is reported, and the recording is complete."""
    (tmp_path / "radio.key").write_bytes(KEY)
    kept = tmp_path / "kept"
    settings = tmp_path / "settings.toml"
    settings.write_text(
        f'[links]\nurls = ["{UDP}"]\n[signing]\ntimestamps = "{kept}/timestamps.json"\n'
        f'keys = {{"{UDP}" = "{tmp_path / "radio.key"}"}}\n'
    )
    recordings = tmp_path / "recordings"
    node = start_node("run", "--config", str(settings), *HTTP, "--record", str(recordings))
    with Sender(node.udp_port, 1, KEY) as sender:
        sender.send(sender.frame())
        node.wait_until("/v1/status", lambda s: s["frames"] == 1)
        shutil.rmtree(kept)
        sender.send(sender.frame())
        node.wait_until(
            "/v1/events", lambda e: any(one["subject"] == "signing" for one in e["events"])
        )
    code, _, err = node.stop()
    assert code != 0
    assert err.splitlines()[-1].startswith("companion: ")
    assert "Traceback" not in err
    (recording,) = recordings.iterdir()
    assert recording.suffix == ".mcap"
    assert "digest" in read_metadata(recording)["summary"]


@pytest.fixture
def pty() -> Iterator[tuple[int, str]]:
    """The far end of a serial line, and the device's name."""
    far, near = os.openpty()
    tty.setraw(near)
    yield far, os.ttyname(near)
    os.close(far)
    os.close(near)


def test_serial_link_with_split_frames_and_noise(start_node: Any, pty: tuple[int, str]) -> None:
    """Frames split at arbitrary bytes, with noise before them."""
    far, device = pty
    node = start_node("run", "--link", UDP, "--link", f"serial:{device}:57600", *HTTP)
    node.wait_until("/v1/status", lambda s: s["links"][1]["state"] == "up")
    flown = b"".join(t.raw for t in schedule(scenario.paper(2), 1, time.time_ns(), 2.0))
    data = b"\xfe\x09noise" + flown
    for at in range(0, len(data), 37):
        os.write(far, data[at : at + 37])
    status = node.wait_until(
        "/v1/status",
        lambda s: s["links"][1]["frames"] == len(list(schedule(scenario.paper(2), 1, 0, 2.0))),
    )
    assert status["links"][1]["bytes"] == len(data)
    assert {uav["id"] for uav in node.json("/v1/uavs")["uavs"]} == {"1:1", "2:1", "5:1"}


def test_link_down_and_up_are_each_reported_once(start_node: Any) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        node = start_node("run", "--link", UDP, "--link", f"tcp:127.0.0.1:{port}", *HTTP)
        peer, _ = server.accept()
        with Sender(node.udp_port, 1) as sender:
            peer.sendall(sender.frame())
            node.wait_until("/v1/status", lambda s: s["links"][1]["frames"] == 1)
            peer.close()
            server.close()
            node.wait_until("/v1/status", lambda s: s["links"][1]["state"] == "connecting")
            reasons = json.loads(node.get("/readyz")[1])["reasons"]
            assert "no link is up" not in reasons
            time.sleep(1.5)  # some failed attempts
            with socket.create_server(("127.0.0.1", port)) as back:
                peer, _ = back.accept()
                with peer:
                    peer.sendall(sender.frame())
                    node.wait_until("/v1/status", lambda s: s["links"][1]["frames"] == 2)
                    events = node.wait_until(
                        "/v1/events", lambda e: any("back" in one["text"] for one in e["events"])
                    )["events"]
    about = [one["text"] for one in events if one["subject"] == f"tcp:127.0.0.1:{port}"]
    assert len(about) == 2, about
    assert "down" in about[0] and "back" in about[1]


def test_tracks_are_live_two_reports_after_a_restart(start_node: Any, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    run = ("run", "--link", f"udpin:127.0.0.1:{port}", *HTTP, "--record", str(tmp_path))
    senders = [Sender(port, sysid) for sysid in range(1, 9)]
    node = start_node(*run)
    for _ in range(20):
        for sender in senders:
            sender.send(sender.frame())
    node.wait_until("/v1/uavs", lambda a: [u["state"] for u in a["uavs"]] == ["live"] * 8)
    node.stop(signal.SIGKILL)

    again = start_node(*run)
    for _ in range(2):
        for sender in senders:
            sender.send(sender.frame())
    uavs = again.wait_until("/v1/uavs", lambda a: len(a["uavs"]) == 8)["uavs"]
    assert {(uav["state"], uav["reports"]) for uav in uavs} <= {("live", 1), ("live", 2)}
    beams = again.json("/v1/beams")
    assert len(beams["beams"]) + len(beams["left_out"]) == 8
    for sender in senders:
        sender.__exit__()
    again.wait_until("/v1/status", lambda s: s["frames"] == 16)
    assert again.stop()[0] == 0
    finished = sorted(tmp_path.glob("*.mcap"))
    assert len(finished) == 2  # the file of the killed service was recovered
    assert not list(tmp_path.glob("*.active"))
    assert sum(1 for event in read_log(finished[1]) if type(event).__name__ == "Frame") == 16
