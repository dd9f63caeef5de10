"""The service in a sandbox with the limits of the container: read-only files, another user, no
capabilities.

The image itself is not run here: its build downloads packages, which no test may do.
"""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest
import yaml
from support import BIN, HANG_S, ROOT, Node, end, free_port, started

USER = 10001
"""The user of the image."""
RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
RECORDINGS = "/recordings"
MEMORY_UNITS = {"m": 2**20, "g": 2**30}

NO_FILES: Mapping[str, Path] = {}
BLUEOS = ROOT / "examples" / "blueos"

Sandbox = Callable[..., list[str]]


@pytest.fixture
def recordings(tmp_path: Path) -> Path:
    """The only folder that the sandboxed service may write to."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    if os.getuid() == 0:
        os.chown(folder, USER, USER)
    return folder


@pytest.fixture
def sandbox(recordings: Path) -> Sandbox:
    """Return a command within bubblewrap's sandbox; skips where there is none."""
    bwrap = shutil.which("bwrap")
    if bwrap is None:
        pytest.skip("no bwrap: install bubblewrap")
    command = [bwrap, "--die-with-parent", "--new-session", "--unshare-pid", "--as-pid-1"]
    command += ["--unshare-ipc", "--unshare-uts", "--proc", "/proc", "--dev", "/dev"]
    command += ["--perms", "1777", "--tmpfs", "/tmp"]
    packages = sorted({Path(path) for path in (sys.base_prefix, sys.prefix, ROOT)})
    for path in (*map(Path, ("/usr", "/bin", "/lib", "/lib64", "/etc")), *packages):
        for parent in (*reversed(path.parents), path):  # readable for the other user
            command += ["--perms", "0755", "--dir", str(parent)] if parent != Path("/") else []
        command += ["--ro-bind-try", str(path), str(path)]
    command += ["--bind", str(recordings), RECORDINGS, "--chdir", "/tmp"]

    def within(*words: object, user: int = USER, files: Mapping[str, Path] = NO_FILES) -> list[str]:
        inside = [*command]
        for place, file in files.items():
            inside += ["--ro-bind", str(file), place]
        inside += ["--remount-ro", "/", "--remount-ro", "/dev", "--clearenv", "--cap-drop", "ALL"]
        inside += ["--setenv", "PATH", f"{BIN}:/usr/bin:/bin"]
        inside += ["--setenv", "OPENBLAS_NUM_THREADS", "1"]
        if os.getuid() == 0:
            # The user changes in the sandbox, where the folders above are readable for all users.
            for one in ("SETUID", "SETGID", "SETPCAP"):
                inside += ["--cap-add", f"CAP_{one}"]
            inside += ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups"]
            inside += ["--inh-caps=-all", "--bounding-set=-all", "--no-new-privs"]
        else:
            inside += ["--unshare-user", "--uid", str(user), "--gid", str(user)]
        return [*inside, *map(str, words)]

    trial = within("true")
    done = subprocess.run(trial, capture_output=True, text=True, check=False, timeout=HANG_S)
    if done.returncode != 0:
        pytest.skip(f"no sandbox here: {done.stderr.strip()}")
    return within


@contextlib.contextmanager
def confined(command: list[str]) -> Iterator[tuple[Node, int]]:
    """A service in the sandbox, and its process id outside."""
    node = Node(*command, code="import os, sys\nos.execv(sys.argv[1], sys.argv[1:])")
    try:
        children = Path(f"/proc/{node.process.pid}/task/{node.process.pid}/children")
        (service,) = map(int, children.read_text(encoding="ascii").split())
        yield node, service
    finally:
        end(node.process)


def status(process: int) -> dict[str, str]:
    """Return what the kernel reports of a process."""
    lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    return {key: value.strip() for key, _, value in (line.partition(":") for line in lines)}


def writable(process: int) -> set[str]:
    """Return each place of a process where a file system is mounted for writing."""
    lines = Path(f"/proc/{process}/mountinfo").read_text(encoding="utf-8").splitlines()
    mounts = [line.split()[4:6] for line in lines]
    return {place for place, options in mounts if "rw" in options.split(",")}


def test_service_runs_read_only_without_capabilities_as_another_user(
    sandbox: Sandbox, recordings: Path
) -> None:
    service_command = sandbox(BIN / "companion", *RUN, "--record", RECORDINGS)
    with confined(service_command) as (node, service):
        to = f"udpout:127.0.0.1:{node.udp_port}"
        with started(
            [BIN / "sitl-replay", "fly", "paper", "--to", to], stdout=subprocess.DEVNULL
        ) as flying:
            node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
            node.wait_until("/readyz", lambda answer: answer["ready"])
            flying.terminate()
        kernel = status(service)
        assert Path(f"/proc/{service}/comm").read_text(encoding="utf-8").strip() == "companion"
        for held in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb"):
            assert int(kernel[held], 16) == 0, held
        assert kernel["NoNewPrivs"] == "1"
        # The user outside of the sandbox: the image's, if the tests run as root and can change it.
        outside = USER if os.getuid() == 0 else os.getuid()
        assert kernel["Uid"].split() == [str(outside)] * 4
        assert outside != 0
        # Devices, the terminal of /dev and /proc belong to the sandbox.
        places = {place for place in writable(service) if not place.startswith(("/dev/", "/proc"))}
        assert places == {"/tmp", RECORDINGS}
        limits = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))
        limits = limits["services"]["companion"]
        assert int(kernel["Threads"]) < limits["pids_limit"] / 2
        number, unit = re.findall(r"^(\d+)([mg])$", limits["mem_limit"])[0]
        assert int(kernel["VmHWM"].split()[0]) * 1024 < int(number) * MEMORY_UNITS[unit] / 2
        os.kill(service, signal.SIGTERM)
        node.process.communicate(timeout=HANG_S)
        assert node.process.returncode == 0, node.errors()
    (recording,) = recordings.glob("*.mcap")
    replay = [BIN / "companion", "replay", recording, "--no-record", "--json"]
    done = subprocess.run(replay, capture_output=True, text=True, check=False, timeout=HANG_S)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["reports"]) == 4


def test_sandbox_refuses_what_the_container_refuses(sandbox: Sandbox) -> None:
    """A probe in place of the service: it writes no other file, and gains no privilege."""
    code = (
        "import os, pathlib, socket, sys\n"
        "refused = []\n"
        "for place in sys.argv[1:]:\n"
        "    try:\n"
        "        (pathlib.Path(place) / 'probe').touch()\n"
        "    except OSError:\n"
        "        refused.append(place)\n"
        "for name, attempt in {\n"
        "    'setuid': lambda: os.setuid(0),\n"
        "    'raw socket': lambda: socket.socket(socket.AF_INET, socket.SOCK_RAW, 1),\n"
        "    'chroot': lambda: os.chroot('/tmp'),\n"
        "}.items():\n"
        "    try:\n"
        "        attempt()\n"
        "    except OSError:\n"
        "        refused.append(name)\n"
        "print(*refused, sep=', ')\n"
    )
    places = ["/", "/usr", "/etc", "/dev", ROOT, sys.prefix, "/tmp", RECORDINGS]
    done = subprocess.run(
        sandbox(BIN / "python", "-c", code, *places),
        capture_output=True, text=True, check=False, timeout=HANG_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    expected = [*map(str, places[:-2]), "setuid", "raw socket", "chroot"]
    assert done.stdout.strip().split(", ") == expected


def test_extension_of_blueos_starts_as_its_image_says(
    sandbox: Sandbox, recordings: Path, tmp_path: Path
) -> None:
    """Its command and user: it records in a folder that Docker created, and MAVLink comes by TCP.

    Only the ports differ.
    """
    text = (BLUEOS / "Dockerfile").read_text(encoding="utf-8")
    ((user,), (words,)) = (
        re.findall(pattern, text, re.MULTILINE) for pattern in (r"^USER (\d+):\d+$", r"^CMD (.+)$")
    )
    command = json.loads(words)
    port = free_port()
    for before, after in (
        ("tcp:127.0.0.1:5777", f"tcp:127.0.0.1:{port}"),
        ("0.0.0.0:8080", "127.0.0.1:0"),
    ):
        command[command.index(before)] = after
    if os.getuid() == 0:
        os.chown(recordings, 0, 0)
    recordings.chmod(0o755)
    files = {"/config/companion.toml": BLUEOS / "companion.toml"}
    to = f"tcpin:127.0.0.1:{port}"
    with started([BIN / "sitl-replay", "fly", "paper", "--to", to], stdout=subprocess.DEVNULL):
        inside = sandbox(BIN / "companion", *command, user=int(user), files=files)
        with confined(inside) as (node, service):
            node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
            assert node.json("/v1/status")["center"]["source"] == "1:1"
            kernel = status(service)
            assert int(kernel["CapEff"], 16) == int(kernel["CapBnd"], 16) == 0
            os.kill(service, signal.SIGTERM)
            node.process.communicate(timeout=HANG_S)
            assert node.process.returncode == 0, node.errors()
    assert len([*recordings.glob("*.mcap")]) == 1
