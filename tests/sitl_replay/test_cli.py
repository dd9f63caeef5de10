"""The command line: its output, and one-line errors on stderr."""

import json
import random
import re
import signal
import socket
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from pymavlink.dialects.v20 import ardupilotmega as dialect
from support import HANG_S, line_of, started

from companion.recording.reader import LogError
from companion.recording.writer import Writer
from companion.values import Frame, Source, Tick
from sitl_replay.cli import main
from sitl_replay.faults.asked import KINDS, Fault
from sitl_replay.faults.content import sender_of
from sitl_replay.faults.traffic import Network
from sitl_replay.flight import scenario
from sitl_replay.flight.vehicles import schedule
from sitl_replay.receiver.asked import OPTIONS
from sitl_replay.traffic.observations import ReceiverPlan
from sitl_replay.traffic.recorder import TlogWriter

COMMAND = [sys.executable, "-c", "from sitl_replay.cli import main; main()"]
SOMEWHERE = "udpout:127.0.0.1:9"


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        bound.settimeout(20.0)
        yield bound


def url_of(bound: socket.socket, scheme: str = "udpout") -> str:
    return f"{scheme}:127.0.0.1:{bound.getsockname()[1]}"


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["fly", "papr", "--to", SOMEWHERE], "'papr' is not one of 'paper', 'hover'"),
        (["fly", "paper"], "Missing option '--to'"),
        (["fly", "paper", "--to", "udp:127.0.0.1:9"], "is not a link; give one of udpin:, udpout:"),
        (["fly", "paper", "--to", "serial:nowhere:57600"], "serial:nowhere:57600: No such file"),
        (["fly", "paper", "--to", "serial:/dev/null:57600"], "serial:/dev/null:57600: "),
        (["fly", "paper", "--to", "tcpin:192.0.2.1:9"], "tcpin:192.0.2.1:9: Cannot assign"),
        (
            ["fly", "paper", "--to", SOMEWHERE, "--fault", "los=1"],
            "'los' is not a fault; give drift, reboot",
        ),
        (
            ["play", "empty.tlog", "--to", SOMEWHERE, "--fault", "loss=2"],
            "'loss=2': P is '2', allowed: 0 to 1; for example loss=0.1",
        ),
        (
            ["fly", "paper", "--to", SOMEWHERE, "--fault", "loss=0", "--fault", "loss=1"],
            "loss is given 2 times",
        ),
        (["fly", "paper", "--to", SOMEWHERE, "--receiver", "9100"], "is not the address of a"),
        (["fly", "paper", "--to", SOMEWHERE, "--receive", "bias=9"], "'bias=9': allowed: at most"),
        (["fly", "paper", "--to", SOMEWHERE, "--token", "no-such"], "'no-such' does not exist"),
        (["fly", "paper", "--to", "udpout:127.0.0.1:99999"], "is not a port"),
        (["fly", "paper", "--to", "udpout:no-such-host.invalid:9"], "no-such-host.invalid"),
        (["fly", "paper", "--to", SOMEWHERE, "--uavs", "1001"], "1<=x<=1000"),
        (["fly", "adsb", "--to", SOMEWHERE, "--uavs", "2"], "adsb: 2 UAVs; allowed: 3 to 1000"),
        (["fly", "paper", "--to", SOMEWHERE, "--duration", "nan"], "a positive number of seconds"),
        (["fly", "paper", "--to", SOMEWHERE, "--duration", "-1"], "a positive number of seconds"),
        (["fly", "paper", "--to", SOMEWHERE, "--record", "."], "is a directory"),
        (["fly", "paper", "--to", SOMEWHERE, "--record", "no/such/a.tlog"], "no/such/a.tlog"),
        (["play", ".", "--to", SOMEWHERE], "is a directory"),
        (["play", "nowhere.tlog", "--to", SOMEWHERE], "does not exist"),
        (
            ["play", "empty.tlog", "--to", SOMEWHERE, "--speed", "fast"],
            "is not a positive number or 'max'",
        ),
        (
            ["record", "--from", "127.0.0.1:9", "--out", "a.tlog"],
            "is not a link; give one of udpin:",
        ),
        (["record", "--from", "udpin:127.0.0.1:9"], "Missing option '--out'"),
        (["record", "--from", "udpin:192.0.2.1:9999", "--out", "a.tlog"], "udpin:192.0.2.1"),
        (["land"], "No such command 'land'"),
    ],
)
def test_command_error_is_one_line(
    arguments: list[str], complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.tlog").touch()
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code not in (0, None)
    assert isinstance(result.exception, SystemExit)
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("sitl-replay: ")
    assert complaint in line


def test_refused_connection_is_a_one_line_error() -> None:
    with socket.socket() as gone:
        gone.bind(("127.0.0.1", 0))
        url = url_of(gone, "tcp")
    result = CliRunner().invoke(main, ["fly", "paper", "--to", url])
    assert result.exit_code == 1
    assert result.stderr == f"sitl-replay: {url}: Connection refused\n"


def commands() -> list[click.Command]:
    return [main, *main.commands.values()]


@pytest.mark.parametrize("command", commands(), ids=lambda command: str(command.name))
def test_every_help_has_an_example(command: click.Command) -> None:
    arguments = [] if command is main else [str(command.name)]
    result = CliRunner().invoke(main, [*arguments, "--help"])
    assert result.exit_code == 0
    assert "Example: sitl-replay" in " ".join(result.stdout.split())


def test_list_command_shows_every_scenario() -> None:
    text = CliRunner().invoke(main, ["list"]).stdout
    listed = json.loads(CliRunner().invoke(main, ["list", "--json"]).stdout)
    assert [one["name"] for one in listed] == list(scenario.BUILDERS)
    assert len(listed) == 9
    for one in listed:
        assert f"{one['name']:9} {one['description']}\n" in text


def test_fly_sends_frames_and_prints_a_summary(receiver: socket.socket, tmp_path: Path) -> None:
    tlog = tmp_path / "a.tlog"
    arguments = ["fly", "hover", "--uavs", "2", "--to", url_of(receiver), "--duration", "0.3"]
    result = CliRunner().invoke(main, [*arguments, "--seed", "8", "--record", str(tlog), "--json"])
    assert (result.exit_code, result.stderr) == (0, "")
    summary = json.loads(result.stdout)
    meant = [sent.raw for sent in schedule(scenario.hover(2), seed=8, duration_s=0.3)]
    assert summary["frames"] == sum(summary["by_message"].values()) == len(meant)
    assert tlog.stat().st_size == summary["bytes"] + 8 * summary["frames"]
    assert 0.2 < summary["duration_s"] < 1.0
    sources = {receiver.recv(300)[5] for _ in meant}
    assert sources == {1, 2, 5}


def test_fly_passes_the_seed_to_the_scenario(receiver: socket.socket, tmp_path: Path) -> None:
    # The recording holds the sent frames with timestamps; positions identify the flown tour.
    tlog = tmp_path / "a.tlog"
    arguments = ["fly", "waypoints", "--to", url_of(receiver), "--duration", "0.3", "--seed", "9"]
    result = CliRunner().invoke(main, [*arguments, "--record", str(tlog)])
    assert result.exit_code == 0
    flown = schedule(scenario.waypoints(4, seed=9), seed=9, duration_s=0.3)
    meant = {t.raw for t in flown if t.raw[7] == 33}
    assert meant
    assert all(raw in tlog.read_bytes() for raw in meant)


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_a_flight_cleanly(
    receiver: socket.socket, tmp_path: Path, stop: signal.Signals
) -> None:
    tlog = tmp_path / "a.tlog"
    arguments = ["fly", "paper", "--to", url_of(receiver), "--record", str(tlog)]
    with started(
        [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as flight:
        receiver.recv(300)
        receiver.recv(300)
        flight.send_signal(stop)
        out, err = flight.communicate(timeout=HANG_S)
    assert (flight.returncode, err) == (0, "")
    (line,) = out.splitlines()
    assert line.startswith("sent ")
    assert tlog.stat().st_size > 0


def test_record_runs_until_a_signal(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    tlog = tmp_path / "heard.tlog"
    raw = next(schedule(scenario.hover())).raw
    arguments = ["record", "--from", f"udpin:127.0.0.1:{port}", "--out", str(tlog), "--json"]
    with (
        started([*COMMAND, *arguments], stdout=subprocess.PIPE, text=True) as recording,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        sender.connect(("127.0.0.1", port))
        sender.settimeout(0.02)
        accepted = 0
        while accepted < 5:  # a port without a listener refuses earlier packets
            assert recording.poll() is None
            try:
                sender.send(raw)
                sender.recv(1)
            except ConnectionRefusedError:
                accepted = 0
            except TimeoutError:
                accepted += 1
        recording.send_signal(signal.SIGTERM)
        out, _ = recording.communicate(timeout=HANG_S)
    assert recording.returncode == 0
    summary = json.loads(out)
    assert summary["frames"] >= 5
    assert summary["rejected"] == {}
    assert tlog.stat().st_size == summary["frames"] * (8 + len(raw))


def written(path: Path, stamps_s: list[float]) -> list[bytes]:
    """Write a tlog with the given timestamps; return its frames."""
    frames = [sent.raw for sent in schedule(scenario.hover(), duration_s=2.0)][: len(stamps_s)]
    with TlogWriter(path) as writer:
        for t_s, raw in zip(stamps_s, frames, strict=True):
            writer.write(1_760_000_000_000_000_000 + round(t_s * 1e9), raw)
    return frames


def test_play_sends_the_frames_of_a_log(receiver: socket.socket, tmp_path: Path) -> None:
    pytest.importorskip("companion.recording.reader")
    log = tmp_path / "a.tlog"
    frames = written(log, [0.0, 0.05, 0.1, 0.2])
    result = CliRunner().invoke(main, ["play", str(log), "--to", url_of(receiver), "--json"])
    assert (result.exit_code, result.stderr) == (0, "")
    assert [receiver.recv(300) for _ in frames] == frames
    summary = json.loads(result.stdout)
    assert (summary["frames"], summary["clamped"]) == (4, 0)
    assert 0.2 <= summary["duration_s"] < 0.6


@pytest.mark.parametrize("content", [b"", random.Random(1).randbytes(100), b"\n" * 5000], ids=len)
def test_log_without_frames_is_a_one_line_error(content: bytes, tmp_path: Path) -> None:
    pytest.importorskip("companion.recording.reader")
    log = tmp_path / "bad.tlog"
    log.write_bytes(content)
    result = CliRunner().invoke(main, ["play", str(log), "--to", SOMEWHERE])
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    (line,) = result.stderr.splitlines()
    assert "bad.tlog" in line


def test_log_error_during_playback_is_a_one_line_error(
    receiver: socket.socket, monkeypatch: pytest.MonkeyPatch, cut_log: Path
) -> None:
    # Behaviour of a reader on a damaged file: some frames, then its error.
    raw = next(schedule(scenario.hover())).raw

    def torn() -> Iterator[Frame]:
        yield Frame(t_ns=0, link="log", source=scenario.CARRIER.source, msgid=0, raw=raw)
        raise LogError("torn.tlog: cut short")

    monkeypatch.setattr("sitl_replay.cli.frames_of", lambda *_: torn())
    result = CliRunner().invoke(main, ["play", str(cut_log), "--to", url_of(receiver)])
    assert (result.exit_code, result.stderr) == (1, "sitl-replay: torn.tlog: cut short\n")
    assert receiver.recv(300) == raw


def test_bad_timestamps_are_reported_once(receiver: socket.socket, tmp_path: Path) -> None:
    pytest.importorskip("companion.recording.reader")
    log = tmp_path / "a.tlog"
    written(log, [0.0, 100.0, 300.0, 300.1, 200.0])
    arguments = ["play", str(log), "--to", url_of(receiver), "--speed", "100", "--json"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0
    (line,) = result.stderr.splitlines()
    assert "3 time stamps" in line
    assert 0.1 <= json.loads(result.stdout)["duration_s"] < 0.6


def test_rejections_of_a_log_are_summarised(receiver: socket.socket, tmp_path: Path) -> None:
    pytest.importorskip("companion.recording.reader")
    log = tmp_path / "a.tlog"
    frames = written(log, [0.0, 0.01, 1e7, 0.02, 0.03, 0.04])
    damaged = bytearray(log.read_bytes())
    damaged[-3] ^= 0x40  # in the last frame
    log.write_bytes(damaged)
    result = CliRunner().invoke(main, ["play", str(log), "--to", url_of(receiver), "--json"])
    summary = json.loads(result.stdout)
    assert [receiver.recv(300) for _ in frames[:-1]] == frames[:-1]
    assert (result.exit_code, summary["frames"], summary["clamped"]) == (0, 5, 1)
    assert summary["rejected"] == {"bad-crc": 1}
    assert "1 time stamps" in result.stderr
    assert summary["duration_s"] < 1.0


def test_link_lost_during_playback_is_a_failure(receiver: socket.socket) -> None:
    def leave() -> None:
        server.accept()[0].close()

    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(HANG_S)
        leaving = threading.Thread(target=leave, daemon=True)
        leaving.start()
        lost = url_of(server, "tcp")
        arguments = ["--to", lost, "--to", url_of(receiver), "--duration", "0.5", "--json"]
        result = CliRunner().invoke(main, ["fly", "paper", *arguments])
        leaving.join(HANG_S)
    assert result.exit_code == 1
    summary = json.loads(result.stdout)
    assert [text.startswith(lost) for text in summary["lost"]] == [True]
    assert summary["frames"] > 20


@pytest.mark.parametrize("command", ["play", "fly"])
def test_help_describes_every_fault(command: str) -> None:
    text = " ".join(CliRunner().invoke(main, [command, "--help"]).stdout.split())
    for kind in KINDS.values():
        assert f"{kind.form}: {kind.meaning}. Example: {kind.example}" in text


def test_fly_sends_the_measurements_of_a_receiver(receiver: socket.socket, tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("0123456789abcdef\n")
    arguments = ["fly", "hover", "--uavs", "2", "--to", SOMEWHERE, "--duration", "0.3", "--json"]
    arguments += ["--receiver", url_of(receiver, "udp"), "--receive", "rate=50"]
    result = CliRunner().invoke(main, [*arguments, "--receive", "lost=0.5", "--token", str(token)])
    assert result.exit_code == 0
    sent = json.loads(result.stdout)["observations"]["sent"]
    assert 2 < sent < 28
    assert {receiver.recv(4096)[:8] for _ in range(sent)} == {b"UAVOBSRV"}


def test_token_is_that_of_the_file_or_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans = []

    async def fly(*_: object, receiver: ReceiverPlan, **__: object) -> None:
        plans.append(receiver)

    monkeypatch.setattr("sitl_replay.traffic.player.fly", fly)
    token = tmp_path / "token"
    token.write_text("of-the-file\n")
    monkeypatch.setenv("COMPANION_TOKEN", "of-the-environment")
    words = ["fly", "hover", "--to", SOMEWHERE, "--receiver", "http://127.0.0.1:9"]
    for more in ([], ["--token", str(token)]):
        assert CliRunner().invoke(main, [*words, *more]).exit_code == 0
    assert [plan.token for plan in plans] == ["of-the-environment", "of-the-file"]


def test_help_and_list_name_every_option_of_the_receiver() -> None:
    text = " ".join(CliRunner().invoke(main, ["fly", "--help"]).stdout.split())
    listed = CliRunner().invoke(main, ["list"]).stdout
    for kind in OPTIONS.values():
        assert f"{kind.form}: {kind.meaning}. Example: {kind.example}" in text
        assert kind.name in listed


def written_as(kind: str, folder: Path, stamps_s: list[float]) -> tuple[Path, list[bytes]]:
    """Write a log of the given format with the given timestamps; a raw one has boot clocks
    instead."""
    if kind == "tlog":
        return folder / "a.tlog", written(folder / "a.tlog", stamps_s)
    frames = []
    for t_s in stamps_s:
        message = dialect.MAVLink_attitude_message(round(1000 * t_s), *[1.0] * 6)
        frames.append(message.pack(dialect.MAVLink(None, srcSystem=3, srcComponent=1)))
    if kind == "raw":
        path = folder / "a.raw"
        path.write_bytes(b"".join(frames))
        return path, frames
    writer = Writer(
        where=folder / "a.mcap", settings_toml="", versions={}, weights_hz=None, started_ns=0
    )
    for t_s, raw in zip(stamps_s, frames, strict=True):
        t_ns = 10**18 + round(t_s * 1e9)
        writer.event(
            Frame(t_ns=t_ns, link="udpin:127.0.0.1:1", source=Source(3, 1), msgid=30, raw=raw)
        )
        writer.event(Tick(t_ns))
    return writer.close({}), frames


@pytest.mark.parametrize("kind", ["tlog", "raw", "mcap"])
def test_bad_timestamps_are_clamped_in_every_log_format(
    kind: str, receiver: socket.socket, tmp_path: Path
) -> None:
    path, frames = written_as(kind, tmp_path, [0.0, 10.0, 10.1, 200.0, 200.1])
    arguments = ["play", str(path), "--to", url_of(receiver), "--speed", "50", "--json"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0
    assert [receiver.recv(300) for _ in frames] == frames
    summary = json.loads(result.stdout)
    assert (summary["frames"], summary["clamped"], summary["faults"]) == (5, 2, {})
    assert 0.2 <= summary["duration_s"] < 0.6
    (line,) = result.stderr.splitlines()
    assert "2 time stamps step back, or jump by more than 5 s" in line


def test_faults_are_summarised(receiver: socket.socket, tmp_path: Path) -> None:
    path, frames = written_as("tlog", tmp_path, [0.01 * number for number in range(60)])
    arguments = ["play", str(path), "--to", url_of(receiver), "--seed", "7"]
    for text in ("duplication@1:1=1", "loss=0.5", "jitter@77=1"):
        arguments += ["--fault", text]
    summary = json.loads(CliRunner().invoke(main, [*arguments, "--json"]).stdout)
    assert summary["frames"] == len(frames)
    assert list(summary["faults"]) == ["loss", "duplication@1:1", "jitter@77"]
    lost, doubled = summary["faults"]["loss"], summary["faults"]["duplication@1:1"]
    assert summary["faults"]["jitter@77"] == 0
    network = Network(faults=[Fault.parse("loss=0.5")], links=1, seed=7, touched=Counter())
    for raw in frames:
        network.take(0.0, raw)
    assert lost == len(frames) - len(kept := [one.raw for one in network.due()])
    got = [receiver.recv(300) for _ in range(len(frames) - lost + doubled)]
    assert set(got) == set(kept)
    assert sum(sender_of(raw) == (1, 1) for raw in set(got)) == doubled > 0
    text = CliRunner().invoke(main, arguments).stdout
    assert text.endswith(f", loss: {lost}, duplication@1:1: {doubled}, jitter@77: 0\n")


def test_tcp_server_flight_serves_connecting_peers(tmp_path: Path) -> None:
    arguments = ["fly", "paper", "--to", "tcpin:127.0.0.1:0", "--fault", "reboot=0.1", "--json"]
    with started(
        [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as flight:
        line = line_of(flight, flight.stderr)
        found = re.fullmatch(r"tcpin:127\.0\.0\.1:(\d+): waiting for the first peer\n", line)
        assert found, line
        with socket.create_connection(("127.0.0.1", int(found[1])), timeout=HANG_S) as peer:
            received = 0
            while received < 4000:
                data = peer.recv(4096)
                assert data, "it hung up"
                received += len(data)
            flight.send_signal(signal.SIGTERM)
            while data := peer.recv(4096):
                received += len(data)
            out, _ = flight.communicate(timeout=HANG_S)
    assert flight.returncode == 0
    summary = json.loads(out)
    assert summary["faults"]["reboot"] > 5
    assert (summary["bytes"], summary["dropped"], summary["lost"]) == (received, 0, [])
