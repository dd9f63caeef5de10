"""Every command and snippet of the README and the guides is run.

Code blocks are split into commands and settings. A command's first words select how it is run; a
command without a runner fails, and so does a runner without a command. Differences from the
README: the flight is the tests' short one, addresses are those of this run, and a command that
runs forever is stopped once it has shown its result.
"""

import json
import re
import shlex
import shutil
import signal
import socket
import subprocess
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support import BIN, HANG_S, ROOT, Node, end, line_of, shared_log, started

from companion.settings.model import Settings
from tests.cli.test_calibrate_mount import recorded

GUIDES = ("commands", "first-flight", "integrator")
PAGES = [ROOT / "README.md", *(ROOT / "docs" / f"{name}.md" for name in GUIDES)]
README = "\n\n".join(page.read_text(encoding="utf-8") for page in PAGES)
BLOCKS = [
    "\n".join(line[4:] for line in block.split("\n")).strip()
    for block in re.findall(r"(?:^    .*\n?|^\n(?=    ))+", README, re.MULTILINE)
]
SETTINGS = [block for block in BLOCKS if block.startswith("[")]
PYTHON = [block for block in BLOCKS if block.startswith("from ")]
COMMANDS = [
    line for block in BLOCKS if block not in SETTINGS + PYTHON for line in block.split("\n") if line
]
COMMANDS += re.findall(r"`((?:make|companion|sitl-replay|docker) [^`…]*)`", README)

Started = Callable[..., Any]


def words_of(command: str) -> list[str]:
    """Return the words of a command without its comment; a program of .venv by its name."""
    words = shlex.split(command, comments=True)
    return [words[0].removeprefix(".venv/bin/"), *words[1:]]


def run(words: list[str], where: Path) -> "subprocess.CompletedProcess[str]":
    """Run one of this project's programs to its successful end."""
    done = subprocess.run(
        [BIN / words[0], *words[1:]],
        cwd=where,
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done


def study(words: list[str], where: Path, studied: Callable[..., Path]) -> None:
    """Run a study as in the README except for the report's path; once per session."""
    *asked, out, place = words[2:]
    assert (out, place) == ("--out", "report")
    short = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    # The compass is studied after 50 s in the air.
    log = str(shared_log("sitl_4circle_wander.tlog") if asked[0] == "compass" else short)
    made = studied(*(log if word == "flight.tlog" else word for word in asked))
    assert (made / f"{asked[0]}.html").exists()


def make(words: list[str], _: Path, start_node: Started) -> None:
    """Parse what make would run; not executed, because it would create an environment."""
    command = ["make", "--dry-run", "--always-make", *words[1:]]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=HANG_S
    )
    assert done.returncode == 0, done.stderr
    does = {
        "demo": "companion demo",
        "test": "not full",
        "test-all": "HYPOTHESIS_PROFILE=full",
        "check": "dead_code",
        "bench": "benchmark",
        "site": "make_site",
    }
    assert does[words[1]] in done.stdout


def curl(words: list[str], where: Path, node: Node) -> None:
    """Send the request to a running demo from Python."""
    (url,) = [word for word in words if word.startswith("http://127.0.0.1:8080/")]
    headers = dict(words[i + 1].split(": ") for i, word in enumerate(words) if word == "-H")
    request = urllib.request.Request(url.replace("http://127.0.0.1:8080", node.url), None, headers)
    with urllib.request.urlopen(request, timeout=HANG_S) as answer:
        body = answer.read()
    if "-o" in words:
        (where / words[words.index("-o") + 1]).write_bytes(body)
        assert np.load(where / "weights.npy").shape == (64, 4)
    elif url.endswith("/metrics"):
        assert b"companion_frames_total" in body
    else:
        last_word = {"status": "version", "GLOBAL_POSITION_INT": "message"}.get(url.split("/")[-1])
        assert (last_word in json.loads(body)) if last_word else (b'"1:1"' in body)


def to_its_end(words: list[str], where: Path, start_node: Started) -> None:
    """Run a replay, design or study to its end."""
    words = [str(one) for word in words for one in (sorted(where.glob(word)) or [word])]
    done = run(words, where)
    assert done.stdout or (where / "weights.npy").exists()
    if "--out" in words:
        assert (where / words[words.index("--out") + 1]).exists()


def served(words: list[str], where: Path, start_node: Started) -> None:
    """Serve a replay of a recording, which answers until stopped."""
    words[words.index("--listen") + 1] = "127.0.0.1:0"
    with started(
        [BIN / words[0], *words[1:]], cwd=where, stderr=subprocess.PIPE, text=True,
        stdout=subprocess.DEVNULL,
    ) as process:  # fmt: skip
        lines = iter(lambda: line_of(process, process.stderr), "")
        said = (re.search(r"serves (http://\S+) and replays", line) for line in lines)
        found = next((one for one in said if one), None)
        assert found is not None
        with urllib.request.urlopen(found[1] + "/v1/status", timeout=HANG_S) as answer:
            assert json.load(answer)["replay"]["log"] == "recording.mcap"
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=HANG_S)
    assert process.returncode == 0


def live(words: list[str], where: Path, start_node: Started) -> None:
    """Run a live service with the README's settings."""
    if words[1:] == ["--config", "settings.toml"] or "settings.toml" in words:
        (block,) = SETTINGS
        with socket.create_server(("127.0.0.1", 0)) as nobody:
            address = f"127.0.0.1:{nobody.getsockname()[1]}"
        text = block.replace("192.0.2.7:5760", address).replace("0.0.0.0:14550", "127.0.0.1:0")
        (where / "settings.toml").write_text(text, encoding="utf-8")
    words = [word.replace("0.0.0.0:14550", "127.0.0.1:0") for word in words[1:]]
    node = start_node(*words, "--listen", "127.0.0.1:0")
    status = node.json("/v1/status")
    assert status["center"]["source"] == "5:1"
    assert status["recording"]["state"] == ("recording" if "--record" in words else "off")
    returncode, _, err = node.stop()
    assert returncode == 0, err


def traffic(words: list[str], where: Path, start_node: Started) -> None:
    """Send traffic to a service, which receives it."""
    node = start_node(
        *("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
    )
    here = f"127.0.0.1:{node.udp_port}"
    words = [re.sub(r"127\.0\.0\.1:1455\d", here, word) for word in words]
    with started([BIN / words[0], *words[1:]], cwd=where, stdout=subprocess.DEVNULL) as sending:
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        sending.terminate()


def compose(words: list[str], where: Path, start_node: Started) -> None:
    """Check that the named services and profiles exist, and validate the file if compose is
    installed."""
    known = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))["services"]
    rest = words[2:]
    if rest[0] == "--profile":
        assert any(rest[1] in service.get("profiles", []) for service in known.values())
        rest = rest[2:]
    assert rest[0] == "up"
    assert set(rest[1:]) <= set(known)
    if (
        shutil.which("docker")
        and not subprocess.run(
            ["docker", "compose", "version"], capture_output=True, check=False, timeout=HANG_S
        ).returncode
    ):
        subprocess.run(
            ["docker", "compose", "config", "--quiet"], cwd=ROOT, check=True, timeout=HANG_S
        )


def checked(words: list[str], where: Path, start_node: Started) -> None:
    """Check that good results are listed line by line, and that the missing traffic is reported."""
    words = [word.replace("0.0.0.0:14550", "127.0.0.1:0") for word in words]
    done = subprocess.run(
        [BIN / words[0], *words[1:], "--seconds", "0.2", "--listen", "127.0.0.1:0"],
        cwd=where, capture_output=True, text=True, check=False, timeout=HANG_S,
    )  # fmt: skip
    assert done.returncode == 1
    assert "nothing received" in done.stdout


def calibrated(words: list[str], where: Path, start_node: Started) -> None:
    """Suggest the mount of a recorded flight with observations."""
    folder = where / "observed"
    folder.mkdir()
    assert "mount_yaw_deg" in run([*words[:-1], str(recorded(folder))], where).stdout


def forwarded(words: list[str], where: Path, start_node: Started) -> None:
    """Check MAVProxy's options; MAVProxy itself runs in tests/live."""
    done = run([words[0], "--help"], where)
    for option in words[1:]:
        assert option.split("=")[0] in done.stdout, option


def demonstrated(words: list[str], where: Path, start_node: Started) -> None:
    """Check that the demo runs and records."""
    run([*words, "--port", "0", "--seconds", "1"], where)
    assert list((where / "recordings").glob("*.mcap"))


RUNNERS: dict[str, Callable[[list[str], Path, Any], None]] = {
    "make": make,
    "curl": curl,
    "companion demo": demonstrated,
    "companion replay": to_its_end,
    "companion replay --serve": served,
    "companion recover": to_its_end,
    "companion check": checked,
    "companion calibrate": calibrated,
    "mavproxy.py": forwarded,
    "companion weights": to_its_end,
    "companion export": to_its_end,
    "companion design": to_its_end,
    "companion study": study,
    "companion run": live,
    "sitl-replay fly": traffic,
    "sitl-replay play": traffic,
    "docker compose": compose,
}
WITH = {"companion study": "studied", "curl": "demo"}
"""Fixture of each runner; the others start their own nodes."""
FULL = {"companion study prediction", "companion check"}
"""Commands mentioned in the text by name, without arguments."""


def runner_of(command: str) -> str:
    """Return the key of ``RUNNERS`` for a command; raise ``LookupError`` if there is none."""
    words = words_of(command)
    if "--serve" in words:
        return "companion replay --serve"
    for key in (" ".join(words[:2]), words[0]):
        if key in RUNNERS:
            return key
    raise LookupError(f"README.md: nobody knows how to run: {command}")


def marked(command: str) -> Any:
    """Return a command as a parameter; slow ones are left to `make test-all`."""
    long = RUNNERS[runner_of(command)] in (study, live, served, traffic)
    return pytest.param(command, marks=pytest.mark.full if long else ())


@pytest.fixture(scope="module")
def demo() -> Iterator[Node]:
    """Run the demo until all its UAVs have beams."""
    node = Node("demo", "--port", "0", "--seconds", "36000")
    try:
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        yield node
    finally:
        end(node.process)


@pytest.fixture(scope="module")
def recording(short_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of a replay of the short flight."""
    made = tmp_path_factory.mktemp("readme") / "recording.mcap"
    run(["companion", "replay", str(short_log), "--out", str(made)], made.parent)
    return made


@pytest.mark.parametrize("command", [marked(command) for command in sorted(set(COMMANDS) - FULL)])
def test_readme_command_works(
    *,
    command: str,
    tmp_path: Path,
    short_log: Path,
    aeroplane: Path,
    carrier: Path,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shutil.copy(short_log, tmp_path / "flight.tlog")
    shutil.copy(aeroplane, tmp_path / "uav.bin")
    shutil.copy(carrier, tmp_path / "carrier.bin")
    if "recording.mcap" in command:
        shutil.copy(request.getfixturevalue("recording"), tmp_path)
    if "flights/*.mcap" in command:
        (tmp_path / "flights").mkdir()
        shutil.copy(request.getfixturevalue("recording"), tmp_path / "flights")
    monkeypatch.chdir(tmp_path)  # `recordings` and similar folders are created here
    words = ["3" if word == "120" else word for word in words_of(command)]  # the flight is 5 s long
    way = runner_of(command)
    RUNNERS[way](words, tmp_path, request.getfixturevalue(WITH.get(way, "start_node")))


def test_readme_client_snippet_works(demo: Node, capsys: pytest.CaptureFixture[str]) -> None:
    (block,) = (block for block in PYTHON if "companion.client" in block)
    exec(block.replace("http://127.0.0.1:8080", demo.url), {})
    weights, beams = capsys.readouterr().out.splitlines()
    assert weights.startswith("('1:1', ") and "(64, 4)" in weights
    assert beams.startswith("beams 20")


def test_readme_library_snippet_works(cut_log: Path) -> None:
    (block,) = (block for block in PYTHON if "companion.client" not in block)
    names: dict[str, Any] = {}
    exec(block.replace('"flight.tlog"', repr(str(cut_log))), names)
    tracks = names["pipeline"].tracks(names["event"].t_ns, names["event"].t_ns)
    assert {track.uav for track in tracks} >= {"1:1", "2:1", "3:1", "4:1"}


def test_abbreviated_commands_are_run_in_full() -> None:
    for name in FULL:
        assert any(
            " ".join(words_of(command)).startswith(name + " ") for command in set(COMMANDS) - FULL
        )


def test_every_runner_is_used() -> None:
    assert {runner_of(command) for command in COMMANDS} == set(RUNNERS)
    assert len(SETTINGS) == 1


def test_command_without_runner_is_detected() -> None:
    with pytest.raises(LookupError, match="companion fnord"):
        runner_of(".venv/bin/companion fnord --now")


def test_readme_settings_are_valid() -> None:
    (block,) = SETTINGS
    settings = Settings.from_toml(block, "README.md")
    assert settings.array.elements == 64
