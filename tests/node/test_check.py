"""``companion check``: reports faults before a run, and whatever limits a site."""

import contextlib
import json
import os
import socket
import subprocess
import threading
from pathlib import Path
from typing import Any

import pytest
from support import BIN, HANG_S, started

from companion.node import machine
from companion.node.check import check
from companion.node.machine import Finding, Grade
from companion.settings.model import Settings


def looked(**sections: Any) -> dict[str, Finding]:
    settings = Settings().override(**sections)
    return {each.subject: each for each in machine.look(settings, token=None, insecure=False)}


def test_ports_in_use_are_faults() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as web,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mavlink,
    ):
        mavlink.bind(("127.0.0.1", 0))
        listen = f"127.0.0.1:{web.getsockname()[1]}"
        url = f"udpin:127.0.0.1:{mavlink.getsockname()[1]}"
        found = looked(server={"listen": listen}, links={"urls": [url]})
        assert found[f"http {listen}"].grade is Grade.FAULT
        assert "--listen" in found[f"http {listen}"].remedy
        assert found[f"link {url}"].grade is Grade.FAULT
        assert "stop the program" in found[f"link {url}"].remedy
    found = looked(server={"listen": listen}, links={"urls": [url]})
    assert found[f"http {listen}"].grade is Grade.OK
    assert found[f"link {url}"].grade is Grade.OK


def test_public_server_without_token_is_a_fault() -> None:
    found = looked(server={"listen": "0.0.0.0:0"})["http 0.0.0.0:0"]
    assert found.grade is Grade.FAULT
    assert "COMPANION_TOKEN" in found.text


def test_missing_serial_device_is_a_fault() -> None:
    found = looked(links={"urls": ["serial:/dev/nothere:57600"]})
    assert found["link serial:/dev/nothere:57600"].grade is Grade.FAULT
    assert "plugged in" in found["link serial:/dev/nothere:57600"].remedy


def test_present_serial_device_is_ok() -> None:
    master, slave = os.openpty()
    device = os.ttyname(slave)
    found = looked(links={"urls": [f"serial:{device}:57600"]})
    assert found[f"link serial:{device}:57600"].grade is Grade.OK
    os.close(master)
    os.close(slave)


def test_recording_folder_is_checked(tmp_path: Path) -> None:
    folder = tmp_path / "to" / "be" / "made"
    assert looked(recording={"directory": str(folder)})[f"recordings {folder}"].grade is Grade.OK
    assert not folder.exists()
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with contextlib.chdir(tmp_path):
        assert looked(recording={"directory": "."})["recordings ."].grade is Grade.OK
    for name in ("file/recordings", "loop", "loop/x", "n" * 300 + ".mcap"):
        there = tmp_path / name
        said = looked(recording={"directory": str(there)})[f"recordings {there}"]
        assert said.grade is Grade.FAULT


def test_silent_link_and_missing_carrier_are_reported(tmp_path: Path) -> None:
    settings = Settings().override(
        links={"urls": ["udpin:127.0.0.1:0"]}, server={"listen": "127.0.0.1:0"}
    )
    found = list(check(settings, 0.2))
    (heard,) = (each for each in found if each.text == "nothing received")
    assert "MAVProxy" in heard.remedy
    carrier = found[-1]
    assert (carrier.subject, carrier.grade) == ("carrier", Grade.FAULT)
    assert carrier.text == "the carrier of the array is not set"
    assert carrier.remedy == "give --center SYSID:COMPID or LAT,LON,ALT"


@pytest.mark.parametrize(
    ("said", "grade", "text"),
    [
        (b"GET / HTTP/1.1\r\n", Grade.FAULT, "without usable data (16 garbage)"),
        (b"MSG,8,5,211,4CA2D6,10057,,,,,,,,,,,,,,,,0\r\n", Grade.DOUBT, "no aircraft yet"),
    ],
)
def test_unexpected_receiver_data_is_reported(said: bytes, grade: Grade, text: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"sbs:127.0.0.1:{server.getsockname()[1]}"
        accepted: list[socket.socket] = []

        def speak() -> None:
            accepted.append(server.accept()[0])
            accepted[0].sendall(said)

        speaking = threading.Thread(target=speak, daemon=True)
        speaking.start()
        settings = Settings().override(
            links={"urls": [url, "cot:udp:127.0.0.1:0"]}, server={"listen": "127.0.0.1:0"}
        )
        found = list(check(settings, 1.0))
        speaking.join(HANG_S)
        accepted[0].close()
    _, judged = (each for each in found if each.subject == f"link {url}")
    assert judged.grade is grade and text in judged.text
    (silent,) = (each for each in found if each.text == "nothing received")
    assert silent.remedy == "send Cursor on Target to this address"


@pytest.mark.full
def test_flight_is_assessed(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    flies = [BIN / "sitl-replay", "fly", "waypoints", "--to", f"udpout:127.0.0.1:{port}"]
    asks = [BIN / "companion", "check", "--link", f"udpin:127.0.0.1:{port}", "--json"]
    asks += ["--listen", "127.0.0.1:0", "--center", "5:1", "--seconds", "8"]
    with started(flies, stdout=subprocess.DEVNULL) as sending:
        done = subprocess.run(
            asks, capture_output=True, text=True, timeout=HANG_S, check=False, cwd=tmp_path
        )
        sending.terminate()
    assert done.returncode == 0, done.stdout + done.stderr
    found = {each["subject"]: each for each in json.loads(done.stdout)["findings"]}
    assert "frames from 1:1" in found[f"link udpin:127.0.0.1:{port}"]["text"]
    assert found["carrier 5:1"]["grade"] == "ok"
    judged = [each for name, each in found.items() if name.startswith("UAV ")]
    assert len(judged) >= 2
    assert all(each["text"].split(":")[0] in ("good", "weak", "none") for each in judged)
    assert "beams take" in found["this machine"]["text"]
    assert list(tmp_path.iterdir()) == []
