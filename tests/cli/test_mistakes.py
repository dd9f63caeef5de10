"""Command-line errors: one line with a hint, the correct exit status, and no files left behind."""

import os
import re
import shlex
import struct
import subprocess
import urllib.request
from pathlib import Path
from typing import IO

import pytest
from click.testing import CliRunner
from pymavlink.dialects.v20 import all as dialect
from support import BIN, HANG_S, started

from companion.cli.main import main
from companion.recording.foreign import kinds
from companion.values import Reason
from sitl_replay.cli import main as sitl

FILES = {
    "flight.bin": b"\xa3\x95\x80\x80YFMT",
    "flight.ulg": b"ULog\x01\x12\x35\x01" + bytes(64),
    "flight.log": b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n",
    "net.pcap": b"\xd4\xc3\xb2\xa1\x02\x00\x04\x00" + bytes(64),
    "net.pcapng": b"\x0a\x0d\x0d\x0a" + bytes(64),
    "flight.tlog.gz": b"\x1f\x8b\x08\x00" + bytes(64),
    "flight.tlog.zst": b"\x28\xb5\x2f\xfd" + bytes(64),
    "flight.tlog.xz": b"\xfd7zXZ\x00" + bytes(64),
    "logs.zip": b"PK\x03\x04" + bytes(64),
    "flight.bag": b"#ROSBAG V2.0\n" + bytes(64),
    "flight.db3": b"SQLite format 3\x00" + bytes(64),
    "picture.png": b"\x89PNG\r\n\x1a\n" + bytes(64),
    "table.csv": b"lat,lon\n47.1,8.5\n",
    "empty.tlog": b"",
    "noise.tlog": bytes(range(256)) * 8,
    "tiny.tlog": b"\x00\x01",
    "half.mcap": b"\x89MCAP0\r\n",
    "misspelt.toml": b"[beams]\nupdate_hertz = 3\n",
    "section.toml": b"[beam]\nupdate_hz = 3\n",
    "bare.toml": b"update_hz = 3\n",
    "range.toml": b"[beams]\nupdate_hz = -1\n",
    "type.toml": b"[array]\nelements = 'many'\n",
    "broken.toml": b"[beams\n",
    "map.toml": b"[page]\nmap = 'nothere.pmtiles'\n[server]\nlisten = '127.0.0.1:0'\n",
    "latin.toml": "[beams]\n# \xe9\n".encode("latin-1"),
}
SAYS: list[tuple[str, int, str]] = [
    # arguments, exit status, part of the error line
    ("replay", 2, "Missing argument 'LOG...'. See companion replay --help"),
    ("replay nothere.tlog", 1, "nothere.tlog: no such file"),
    ("replay .", 1, ".: is a folder; name the logs in it"),
    ("replay flight.bin", 1, "flight.bin: DataFlash, but no position in it"),
    ("replay flight.ulg", 1, "flight.ulg: ULog, but no position in it"),
    ("replay flight.log", 1, "a DataFlash log as text: give the original .bin"),
    ("replay net.pcap", 1, "net.pcap: a capture, but no MAVLink frame in it"),
    ("replay net.pcapng", 1, "net.pcapng: a capture, but no MAVLink frame in it"),
    ("replay flight.tlog.gz", 1, "gunzip it first"),
    ("replay flight.tlog.zst", 1, "unzstd it first"),
    ("replay flight.tlog.xz", 1, "unxz it first"),
    ("replay logs.zip", 1, "unpack it first"),
    ("replay flight.bag", 1, "a ROS bag"),
    ("replay flight.db3", 1, "a database"),
    ("replay picture.png", 1, "a picture"),
    ("replay table.csv", 1, "it is text without a column unix_s or time or t_s, lat_deg"),
    ("replay good.tlog --center good.tlog", 1, "not the log of one vehicle; give the carrier"),
    ("replay good.tlog --latency -1", 2, "-1.0 is not in the range"),
    ("replay empty.tlog", 1, "empty.tlog: is empty"),
    ("replay noise.tlog", 1, "no MAVLink frame in it"),
    ("replay half.mcap", 1, "half.mcap"),
    ("replay good.tlog --speed fast", 2, "'fast' is neither max nor a number of at least 0.001"),
    ("replay good.tlog --speed 0", 2, "neither max nor a number of at least 0.001"),
    ("replay good.tlog --speed nan", 2, "neither max nor a number of at least 0.001"),
    ("replay good.tlog --listen 127.0.0.1:0", 2, "need --serve"),
    ("replay good.tlog --insecure", 2, "need --serve"),
    ("replay good.tlog --config nothere.toml", 1, "nothere.toml: No such file"),
    ("replay good.tlog --config misspelt.toml", 1, "did you mean beams.update_hz?"),
    ("replay good.tlog --config section.toml", 1, "beam is not a setting; did you mean beams?"),
    ("replay good.tlog --config bare.toml", 1, "did you mean beams.update_hz?"),
    ("replay good.tlog --config range.toml", 1, "beams.update_hz = -1"),
    ("replay good.tlog --config type.toml", 1, "array.elements = 'many'"),
    ("replay good.tlog --config broken.toml", 1, "broken.toml: not TOML"),
    ("replay good.tlog --config latin.toml", 1, "it is not UTF-8 text"),
    (
        "run --config map.toml --center 5:1 --link udpin:127.0.0.1:0",
        1,
        "page.map = 'nothere.pmtiles': No such",
    ),
    ("replay good.tlog --config .", 1, "Is a directory"),
    ("replay good.tlog --center here", 1, "'here' is not SYSID:COMPID"),
    ("replay good.tlog --center 999:1", 1, "at most 255"),
    ("replay good.tlog --center 95,8,500", 1, "latitude must be -90..90"),
    ("replay good.tlog --center 47,8", 1, "is not LAT,LON,ALT"),
    ("replay good.tlog --centre 5:1", 2, "No such option '--centre'"),
    ("replay good.tlog --no-record", 1, "no beam was computed: no UAV reported a usable position"),
    ("replay good.tlog --no-record --center 5:1", 1, "no position from the carrier 5:1"),
    ("replay good.tlog nothere.tlog", 1, "nothere.tlog: no such file"),
    ("replay good.tlog table.csv", 1, "table.csv: no MAVLink frame in it"),
    ("replay good.tlog tiny.tlog", 1, "tiny.tlog: no MAVLink frame in it"),
    ("replay good.tlog half.mcap", 1, "half.mcap"),
    ("replay good.tlog --speed 1000 tiny.tlog", 1, "tiny.tlog: no MAVLink frame in it"),
    ("weights good.tlog", 2, "Missing option '--at'"),
    ("weights good.tlog --at noon", 1, "neither seconds from the start nor a time"),
    ("weights good.tlog --at 2026-01-01T12:00:00", 1, "time zone is missing; append Z"),
    ("weights good.tlog --at 9999", 1, "--at 9999: the log is"),
    ("weights good.tlog --at -9999", 1, "the log begins later"),
    ("weights good.tlog --at 1 --out gone/w.npy", 2, "folder gone does not exist; create it"),
    ("weights good.tlog --at 1 --format matlab", 2, "'matlab' is not one of"),
    ("weights good.tlog --at 1 --lead-ms -5", 2, "-5.0 is not in the range"),
    ("weights good.tlog --at 1 --lead-ms nan", 2, "'nan' is not a finite number"),
    ("replay good.tlog --latency nan", 2, "'nan' is not a finite number"),
    ("replay good.tlog --speed 1e-300", 2, "neither max nor a number of at least 0.001"),
    ("study beams good.tlog --out report --hz 1e-300", 1, "give updates per second, 0.001 to"),
    ("drive rotctld:127.0.0.1:1 --rate nan", 2, "'nan' is not a finite number"),
    ("design --dt 1e308", 2, "allowed: at most 1e+06"),
    ("design --dt nan", 1, "positive number of seconds"),
    ("design --dt 0.15 --feedthrough 1e308", 2, "allowed: at most 1e+06"),
    ("design --dt 0.1 --model kinematic --acceleration 1e308", 2, "allowed: at most 1e+06"),
    ("export good.tlog", 2, "Missing option '--out'"),
    ("export good.tlog --out tables --format excel", 2, "'excel' is not one of"),
    ("export noise.tlog --out tables", 1, "noise.tlog: no MAVLink frame in it"),
    ("export good.tlog --out good.tlog", 2, "'good.tlog' is a file"),
    ("run", 1, "--center SYSID:COMPID"),
    ("run --center 5:1", 1, "--link udpin:0.0.0.0:14550"),
    ("run --center 5:1 --link udp:", 1, "did you mean udpin:0.0.0.0:14550, which listens?"),
    ("run --center 5:1 --link 14550", 1, "did you mean udpin:0.0.0.0:14550?"),
    ("run --center 5:1 --link upd:0.0.0.0:1", 1, "did you mean udpin:?"),
    ("run --center 5:1 --link /dev/ttyACM0", 1, "did you mean serial:/dev/ttyACM0:57600?"),
    ("run --center 5:1 --link serial:/dev/ttyUSB0", 1, "a baud rate is missing"),
    ("run --center 5:1 --link tcp:localhost", 1, "did you mean tcp:localhost:14550?"),
    ("run --center 5:1 --link udpin:0.0.0.0:99999", 1, "99999 is not a port"),
    ("run --center 5:1 --link udpin:::1:14550", 1, "put an IPv6 host, and no other, in brackets"),
    ("run --center 5:1 --link udpin:0.0.0.0:0 --listen 8080", 1, "is not HOST:PORT"),
    ("run --center 5:1 --link udpin:0.0.0.0:0 --listen 0.0.0.0:0", 1, "set COMPANION_TOKEN"),
    ("demo --seconds 0", 2, "0.0 is not in the range"),
    ("demo --port 70000", 2, "70000 is not in the range"),
    ("recover", 2, "Missing argument 'FILE...'"),
    ("recover nothere.active", 1, "nothere.active"),
    ("study", 2, ""),
    ("rply good.tlog", 2, "Did you mean 'replay'? See companion --help"),
    ("drive", 2, "Missing argument 'TARGET'. See companion drive --help"),
    ("drive rotcld:127.0.0.1:4533", 1, "did you mean rotctld:HOST:PORT?"),
    ("drive rotctld:127.0.0.1", 1, "'rotctld:127.0.0.1' is not rotctld:HOST:PORT"),
    ("drive rotctld:127.0.0.1:99999", 1, "is not rotctld:HOST:PORT"),
    ("drive gimbal:127.0.0.1:14550", 1, "is not gimbal:HOST:PORT:SYSID:COMPID"),
    ("drive adar1000:x", 1, "is not adar1000:BUS.DEVICE"),
    ("drive none:pointing --service nowhere", 1, "'nowhere' is not http://HOST:PORT"),
    ("drive none:pointing --service https://", 1, "is not http://HOST:PORT"),
    ("drive none:pointing --config nothere.toml", 1, "nothere.toml: No such file"),
    ("drive none:pointing --config misspelt.toml", 1, "did you mean beams.update_hz?"),
    ("drive none:pointing --rate 0", 2, "0.0 is not in the range 0.1<=x<=1000"),
    ("drive none:pointing --aim center", 2, "'center' is not one of 'first', 'centre'"),
    ("drive none:pointing --on-stale stop", 2, "'stop' is not one of 'hold', 'boresight'"),
    ("fleet wach", 2, "Did you mean 'watch'? See companion fleet --help"),
    ("fleet watch nowhere", 1, "'nowhere' is not http://HOST:PORT"),
    ("fleet watch http://127.0.0.1:99999", 1, "is not http://HOST:PORT"),
    ("fleet watch http://a..b", 1, "'http://a..b' is not http://HOST:PORT"),
    ("fleet watch http://٠", 1, "is not http://HOST:PORT"),
    (f"fleet watch http://{'a' * 64}:80", 1, "is not http://HOST:PORT"),
    ("fleet watch http://127.0.0.1:1", 1, "http://127.0.0.1:1: "),
    ("fleet watch --seconds 0", 2, "0.0 is not in the range x>0"),
    ("replay --fleet", 2, "Missing argument 'LOG...'. See companion replay --help"),
    ("replay good.tlog --fleet", 1, "not a recording of a fleet's node"),
    ("replay good.tlog --fleet --serve", 2, "--fleet excludes --config"),
    ("replay good.tlog --fleet --out x.mcap", 2, "--fleet excludes --config"),
    ("replay nothere.mcap half.mcap --fleet", 1, "nothere.mcap: no such file"),
    ("study fleet", 2, "Missing option '--out'"),
    ("study fleet --nodes three --out report", 2, "is not FROM..TO, such as 3..100"),
    ("study fleet --nodes 3..2 --out report", 2, "the smaller is not first"),
    ("study fleet --steps 0 --out report", 2, "0 is not in the range 1<=x<=20"),
    ("study fleet --out good.tlog", 1, "good.tlog is not a folder; name another one"),
    ("study beams good.tlog --center 5:1 --out a/report", 1, "no UAV gets a beam while"),
    ("study link good.tlog --out report --snr loud", 2, "is not FROM:TO:STEP in dB"),
    ("study nosuch", 2, "No such command 'nosuch'. See companion study --help"),
    ("export beams", 1, '[codebook]: no stored beams; set kind = "dft"'),
    ("export beams --format oai --out x", 2, "'oai' is not 'oai-dbt'"),
    ("calibrate table.csv --out c.csv", 1, "is not the header"),
    ("calibrate nothere.csv --out c.csv", 2, "'nothere.csv' does not exist"),
    ("design --dt often", 2, "is not a list of numbers such as 0.1,0.5"),
    ("check --config nothere.toml", 1, "nothere.toml: No such file"),
    ("run --center 5:1 --link zenoh:", 1, "a key without wildcards such as mavlink_raw"),
    ("sitl-replay fly", 2, "Choose from: paper, "),
    ("sitl-replay fly papr --to udpout:127.0.0.1:1", 2, "'papr' is not one of 'paper'"),
    ("sitl-replay fly paper", 2, "Missing option '--to'. See sitl-replay fly --help"),
    ("sitl-replay fly paper --to udp:127.0.0.1:1", 2, "did you mean udpin:127.0.0.1:1"),
    ("sitl-replay fly paper --to udpout:127.0.0.1:1 --uavs 0", 2, "in the range 1<=x<=1000"),
    (
        "sitl-replay fly paper --to udpout:127.0.0.1:1 --fault los=1",
        2,
        "'los' is not a fault; give drift",
    ),
    (
        "sitl-replay fly paper --to udpout:127.0.0.1:1 --fault loss=2",
        2,
        "allowed: 0 to 1; for example",
    ),
    (
        "sitl-replay fly paper --to udpout:127.0.0.1:1 --record gone/x.tlog",
        1,
        "gone/x.tlog: No such file or directory",
    ),
    ("sitl-replay fly paper --to tcp:127.0.0.1:1", 1, "tcp:127.0.0.1:1: "),
    ("sitl-replay play noise.tlog --to udpout:127.0.0.1:1", 1, "no MAVLink frame in it"),
    ("sitl-replay play good.tlog --to udpout:127.0.0.1:1 --speed fast", 2, "or 'max'"),
    ("sitl-replay ply good.tlog", 2, "Did you mean one of: 'fly', 'play'?"),
    (
        "run --center 5:1 --link udpin:127.0.0.1:0 --listen 127.0.0.1:0 --record good.tlog",
        1,
        "recording.directory (--record) 'good.tlog': good.tlog is not a folder; name",
    ),
    (
        "run --center 5:1 --link udpin:127.0.0.1:0 --listen 127.0.0.1:0 --record good.tlog/sub",
        1,
        "'good.tlog/sub': good.tlog is not a folder; name",
    ),
    (
        "run --center 5:1 --link udpin:127.0.0.1:0 --listen 127.0.0.1:0 --record /proc/nope",
        1,
        "recording.directory (--record) '/proc/nope': the folder cannot be created",
    ),
    ("replay good.tlog --out good.tlog/x.mcap", 1, "--out 'good.tlog': good.tlog is not a folder"),
    ("replay good.tlog --out /dev/full", 1, "--out '/dev/full': /dev/full is not a folder"),
    (
        "replay good.tlog --out /proc/nope/x.mcap",
        1,
        "--out '/proc/nope': the folder cannot be created",
    ),
    ("export good.tlog --out /proc/nope", 1, "--out '/proc/nope': the folder cannot be created"),
    (
        "export good.tlog --out good.tlog/sub --format csv",
        1,
        "good.tlog is not a folder; name another one",
    ),
    ("study dt --out /proc/nope", 1, "--out '/proc/nope': the folder cannot be created"),
    ("study paper --out good.tlog/sub", 1, "good.tlog is not a folder; name another one"),
    ("study fleet --out good.tlog/sub", 1, "good.tlog is not a folder; name another one"),
    (
        "drive adar1000:0.0 --seconds 1 --service http://127.0.0.1:9",
        1,
        "adar1000: needs the package spidev: pip install 'uav-companion-beams[spi]'",
    ),
    (
        "drive rotctld:127.0.0.1:9 --seconds 0.1 --service http://127.0.0.1:9",
        1,
        "Connection refused; service: http://127.0.0.1:9: ",
    ),
    ("drive phaser-memory:ip:x", 1, "[codebook]: no stored beams; set kind"),
    ("drive none:pointing --uav", 2, "Option '--uav' requires an argument"),
    ("recover .", 1, ".: is a directory, not a recording"),
    ("recover empty.tlog", 1, "empty.tlog: not an MCAP recording"),
    ("recover noise.tlog", 1, "noise.tlog: not an MCAP recording"),
    ("recover good.tlog", 1, "good.tlog: not an MCAP recording"),
    ("recover good.tlog/x", 1, "good.tlog/x: cannot be recovered: Not a directory"),
    ("replay good.tlog/x", 1, "good.tlog/x: cannot be read: Not a directory"),
    ("replay /dev/null", 1, "/dev/null: not a file"),
    ("replay /proc/self/mem", 1, "/proc/self/mem: cannot be read: Input/output error"),
    ("replay good.tlog --config noise.tlog", 1, "noise.tlog: not TOML: it is not UTF-8 text"),
    ("replay good.tlog --config good.tlog/x", 1, "good.tlog/x: Not a directory"),
    ("replay good.tlog --serve --listen 127.0.0.1:1x", 1, "'127.0.0.1:1x' is not HOST:PORT"),
    ("replay good.tlog --serve --listen 192.0.2.1:0", 1, "set COMPANION_TOKEN"),
    ("replay good.tlog --serve --insecure --listen 192.0.2.1:0", 1, "192.0.2.1:0: "),
    ("replay good.tlog --speed inf", 2, "'inf' is neither max nor a number of at least 0.001"),
    ("replay good.tlog --latency x", 2, "'x' is not a valid float range"),
    ("weights . --at 1", 1, ".: is a folder; name the logs in it"),
    ("weights empty.tlog --at 1", 1, "empty.tlog: is empty"),
    ("weights noise.tlog --at 1", 1, "no MAVLink frame in it"),
    ("weights good.tlog --at 1 --out .", 2, "'.' is a directory"),
    ("weights good.tlog --at 1 --center 250:1", 1, "no beams at 1: no report yet"),
    ("weights good.tlog --at", 2, "Option '--at' requires an argument"),
    ("weights good.tlog --at nan", 1, "neither seconds from the start nor a time"),
    ("export . --out tables", 1, ".: is a folder; name the logs in it"),
    ("export good.tlog --out ''", 2, "'' is not the name of a folder"),
    ("study dt --out ''", 2, "'' is not the name of a folder"),
    ("run --record ''", 1, "'' is not the name of a folder; give one, such as ."),
    ("export empty.tlog --out tables", 1, "empty.tlog: is empty"),
    ("export beams --out . --format oai-dbt", 2, "is a directory"),
    ("export beams --config noise.tlog --out x", 1, "noise.tlog: not TOML"),
    ("study paper", 2, "Missing option '--out'"),
    ("study prediction noise.tlog --out report", 1, "no MAVLink frame in it"),
    ("study prediction empty.tlog --out report", 1, "empty.tlog: is empty"),
    ("study prediction . --out report", 1, ".: is a folder"),
    ("study prediction good.tlog --out report --links moon", 1, "--links moon: give some of clean"),
    ("study prediction good.tlog --out report --jobs 0", 2, "0 is not in the range x>=1"),
    (
        "study prediction good.tlog --out report --cluster nowhere",
        1,
        "not an address such as tcp://HOST:8786",
    ),
    ("study beams empty.tlog --out report", 1, "empty.tlog: is empty"),
    ("study link noise.tlog --out report", 1, "no MAVLink frame in it"),
    ("study deepsense noise.tlog --out report", 1, "noise.tlog: "),
    ("study fleet --uavs x --out report", 2, "is not FROM..TO"),
    ("calibrate noise.tlog --out c.csv", 1, "noise.tlog: not UTF-8 text"),
    ("calibrate table.csv --out .", 2, "is a directory"),
    ("design --dt 0", 1, "give a positive number of seconds"),
    ("design --dt 0.1,,", 2, "is not a list of numbers such as 0.1,0.5"),
    ("design --dt 0.1 --model x", 2, "'x' is not one of 'position', 'kinematic'"),
    ("design --dt 0.1 --mu-max -1", 2, "-1.0 is not in the range x>=0"),
    ("check --config .", 1, "Is a directory"),
    ("check --config noise.tlog", 1, "noise.tlog: not TOML"),
    ("check --seconds -1", 2, "-1.0 is not in the range"),
    ("check --link udp --seconds 0", 1, "did you mean udpin:0.0.0.0:14550"),
    ("run --config .", 1, "Is a directory"),
    (
        "run --center 5:1 --link udpin:192.0.2.1:14550 --listen 127.0.0.1:0",
        1,
        "udpin:192.0.2.1:14550: ",
    ),
    ("run --center 5:1 --link udpin:127.0.0.1:0 --listen /tmp/x", 1, "'/tmp/x' is not HOST:PORT"),
    (
        "run --center 5:1 --link udpin:127.0.0.1:0 --listen 127.0.0.1:0 --foxglove 99999",
        2,
        "99999 is not in the range",
    ),
    ("fleet watch ftp://x", 1, "'ftp://x' is not http://HOST:PORT"),
    ("sitl-replay fly paper --to udpout:127.0.0.1:1 --record .", 2, "is a directory"),
    (
        "sitl-replay fly paper --to udpout:127.0.0.1:1 --record /dev/full --duration 1",
        1,
        "the output cannot be written: No space left on device",
    ),
    (
        "sitl-replay fly paper --to serial:/dev/nope:57600",
        1,
        "serial:/dev/nope:57600: No such file",
    ),
    ("sitl-replay play . --to udpout:127.0.0.1:1", 2, "is a directory"),
    ("sitl-replay play empty.tlog --to udpout:127.0.0.1:1", 1, "empty.tlog: is empty"),
    ("sitl-replay play nothere --to udpout:127.0.0.1:1", 2, "does not exist"),
    ("sitl-replay record --from udpin:127.0.0.1:0 --out .", 2, "is a directory"),
    (
        "sitl-replay record --from udpin:127.0.0.1:0 --out good.tlog/x --duration 1",
        1,
        "good.tlog/x: Not a directory",
    ),
    (
        "sitl-replay record --from udpin:192.0.2.1:1 --out /dev/null --duration 1",
        1,
        "udpin:192.0.2.1:1: ",
    ),
    ("sitl-replay record", 2, "Missing option '--from'"),
    ("sitl-replay list x", 2, "unexpected extra argument"),
]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COMPANION_TOKEN", raising=False)
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
    beats = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    stamped = bytearray()
    for second in range(5):
        stamped += struct.pack(">Q", 1_760_000_000_000_000 + second * 1_000_000)
        stamped += dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(beats)
    (tmp_path / "good.tlog").write_bytes(stamped)
    return tmp_path


@pytest.mark.parametrize(("given", "status", "says"), SAYS)
def test_command_error_is_one_line(folder: Path, given: str, status: int, says: str) -> None:
    before = sorted(folder.rglob("*"))
    words = shlex.split(given)
    program, words = (sitl, words[1:]) if words[0] == "sitl-replay" else (main, words)
    name = "companion" if program is main else "sitl-replay"
    done = CliRunner().invoke(program, words, prog_name=name)
    assert done.exit_code == status, done.output
    if says:
        *before_it, line = done.stderr.splitlines()
        assert says in line
        assert line.startswith(f"{name}: ")
        assert len(before_it) <= 2  # notes: no --center, a truncated log, a device that is retried
    assert sorted(folder.rglob("*")) == before


ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+")
OUTPUTS = [
    "companion --help",
    "companion design --dt 0.1",
    "companion replay flight.tlog --no-record --json",
    "companion weights flight.tlog --at 5 --center 5:1",
    "companion demo --port 0 --json --seconds 60",
    "sitl-replay list",
]


@pytest.mark.parametrize("given", OUTPUTS)
def test_output_that_cannot_be_written_ends_the_command(
    given: str, folder: Path, cut_log: Path
) -> None:
    """A full disk is one line; a pipe whose reader has ended is the reader's own wish."""
    (folder / "flight.tlog").symlink_to(cut_log)
    program, *words = given.split()
    with Path("/dev/full").open("w") as full:
        done = run(program, words, full)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (
        1,
        f"{program}: the output cannot be written: No space left on device",
    )
    assert "Traceback" not in done.stderr
    with without_reader() as pipe:
        done = run(program, words, pipe)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr and "Error" not in done.stderr


@pytest.mark.parametrize("is_full", [True, False], ids=["full disk", "no reader"])
def test_service_whose_stdout_takes_nothing_serves_and_says_where(
    is_full: bool, folder: Path
) -> None:
    words = [
        "run",
        "--link",
        "udpin:127.0.0.1:0",
        "--listen",
        "127.0.0.1:0",
        "--center",
        "47,8,400",
    ]
    with (
        Path("/dev/full").open("w") if is_full else without_reader() as out,
        started(
            [BIN / "companion", *words], stdout=out, stderr=subprocess.PIPE, text=True, cwd=folder
        ) as process,
    ):
        address = next(found[0] for line in process.stderr if (found := ADDRESS.search(line)))
        with urllib.request.urlopen(f"{address}/healthz", timeout=HANG_S) as answer:
            assert answer.status == 200
        process.terminate()
        assert process.wait(HANG_S) == 0


def without_reader() -> IO[str]:
    """Return a pipe whose reader has ended."""
    read, write = os.pipe()
    os.close(read)
    return os.fdopen(write, "w")


def run(program: str, words: list[str], out: IO[str]) -> "subprocess.CompletedProcess[str]":
    command = [BIN / program, *words]
    return subprocess.run(
        command, stdout=out, stderr=subprocess.PIPE, text=True, timeout=HANG_S, check=False
    )


def test_every_rejection_reason_has_a_distinct_text() -> None:
    meanings = [reason.meaning for reason in Reason]
    assert all(meanings) and len(set(meanings)) == len(meanings)


def test_text_is_distinguished_from_binary() -> None:
    assert kinds.looks_like_text("Höhe,m\n".encode()[:3])  # truncated within a character
    assert kinds.looks_like_text(b"a\tb\r\n")
    assert not kinds.looks_like_text(b"")
    assert not kinds.looks_like_text(bytes(range(256)))
    assert not kinds.looks_like_text(b"\xfd\x09\x00\x00")
