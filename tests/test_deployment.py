"""The container's files, as far as they can be tested without a container."""

import fnmatch
import json
import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from support import BIN, HANG_S, ROOT, started

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")
COMPOSE = (ROOT / "docker-compose.yml").read_text(encoding="utf-8")


def lint(text: str, tmp_path: Path) -> "subprocess.CompletedProcess[str]":
    """Run hadolint on a Dockerfile."""
    path = tmp_path / "Dockerfile"
    path.write_text(text, encoding="utf-8")
    command = [BIN / "hadolint", path]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANG_S)


def against_schema(text: str, tmp_path: Path) -> int:
    """Return the exit status of the check against the Compose specification."""
    path = tmp_path / "docker-compose.yml"
    path.write_text(text, encoding="utf-8")
    command = [BIN / "check-jsonschema", "--builtin-schema", "vendor.compose-spec", path]
    return subprocess.run(command, capture_output=True, check=False, timeout=HANG_S).returncode


def instruction(name: str) -> list[str]:
    """Return the exec form of the Dockerfile's last instruction of that name."""
    text = DOCKERFILE.replace("\\\n", " ")
    found: list[str] = re.findall(rf"^{name} .*?(\[.*\])$", text, re.MULTILINE)
    return list(json.loads(found[-1]))


def test_dockerfile_passes_hadolint(tmp_path: Path) -> None:
    assert lint(DOCKERFILE, tmp_path).stdout == ""
    careless = DOCKERFILE.replace("USER 10001:10001", "USER root").replace(
        "WORKDIR /tmp", "RUN cd /tmp && pip install numpy"
    )
    assert lint(careless, tmp_path).returncode != 0


def test_compose_file_matches_its_schema(tmp_path: Path) -> None:
    assert against_schema(COMPOSE, tmp_path) == 0
    assert against_schema(COMPOSE.replace("read_only:", "readonly:"), tmp_path) != 0


def test_make_check_covers_dockerfile_and_compose_file() -> None:
    recipe = (ROOT / "Makefile").read_text(encoding="utf-8").split("\ncheck:")[1].split("\n\n")[0]
    assert "hadolint Dockerfile" in recipe
    assert "vendor.compose-spec docker-compose.yml" in recipe


def unpinned(dockerfile: str) -> list[str]:
    """Return each stage of a Dockerfile whose base image has no digest."""
    bases = dict(re.findall(r"^ARG (\w+)=(\S+)$", dockerfile, re.MULTILINE))
    images = re.findall(r"^FROM (?:\$\{(\w+)\}|(\S+))", dockerfile, re.MULTILINE)
    named = [bases.get(argument, argument) or image for argument, image in images]
    return [image for image in named if not re.fullmatch(r"\S+@sha256:[0-9a-f]{64}", image)]


def test_base_images_are_pinned_by_digest() -> None:
    assert unpinned(DOCKERFILE) == []
    tag = "python:3.11-slim-bookworm"
    assert unpinned(re.sub(r"(ARG BASE=)\S+", rf"\g<1>{tag}", DOCKERFILE)) == [tag]
    assert unpinned(DOCKERFILE.replace("FROM ${BASE}", f"FROM {tag}")) == [tag]
    # `/opt/venv` is copied from one image to the other: both need the same Python and Debian.
    tags = re.findall(r"^ARG \w+=(python:\S+)@", DOCKERFILE, re.MULTILINE)
    assert len(tags) == 2
    assert len({one.replace("-slim", "") for one in tags}) == 1


def test_packages_are_installed_as_hashed_wheels() -> None:
    (install,) = [line for line in DOCKERFILE.splitlines() if "requirements.lock" in line][-1:]
    assert "--require-hashes" in install
    assert "--only-binary :all:" in install


@pytest.mark.parametrize("name", ["companion", "sim"])
def test_containers_run_without_privileges(name: str) -> None:
    service = yaml.safe_load(COMPOSE)["services"][name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["user"] == "10001:10001"
    assert re.findall(r"^USER (\S+)$", DOCKERFILE, re.MULTILINE) == ["10001:10001"]
    assert "privileged" not in service
    assert not {"cap_add", "devices", "network_mode", "pid", "ipc"} & set(service)


@pytest.mark.parametrize("name", ["companion", "sim"])
def test_containers_have_limits(name: str) -> None:
    service = yaml.safe_load(COMPOSE)["services"][name]
    assert (service["pids_limit"], service["mem_limit"]) == (128, "1g")
    assert service["tmpfs"] == ["/tmp:size=64m"]
    volumes = [volume for volume in service.get("volumes", []) if not volume.endswith(":ro")]
    assert volumes == (["recordings:/recordings"] if name == "companion" else [])


def test_page_is_published_on_loopback_only() -> None:
    services = yaml.safe_load(COMPOSE)["services"]
    published = [port for one in services.values() for port in one.get("ports", [])]
    assert [port for port in published if port.endswith(":8080")] == ["127.0.0.1:8080:8080"]
    assert services["sim"]["profiles"] == ["demo"]
    assert "profiles" not in services["companion"]


@pytest.mark.full
def test_container_commands_run(start_node: Any) -> None:
    """The commands of image and compose file start with addresses of this machine and
    receive data.
    """
    services = yaml.safe_load(COMPOSE)["services"]
    assert services["companion"]["command"] == instruction("CMD")
    assert instruction("ENTRYPOINT") == ["companion"]
    command = [
        {"udpin:0.0.0.0:14550": RUN[2], "0.0.0.0:8080": RUN[4]}.get(word, word)
        for word in services["companion"]["command"]
    ]
    record = command.index("--record")
    node = start_node(*command[:record], *command[record + 2 :])
    sim = [
        word.replace("companion:14550", f"127.0.0.1:{node.udp_port}")
        for word in services["sim"]["command"]
    ]
    assert services["sim"]["entrypoint"] == ["sitl-replay"]
    with started([BIN / "sitl-replay", *sim], stdout=subprocess.DEVNULL) as flying:
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        flying.terminate()


@pytest.mark.full
@pytest.mark.parametrize("token", [None, "s3cret"])
def test_container_health_check_uses_readyz(
    start_node: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, token: str | None
) -> None:
    if token:
        monkeypatch.setenv("COMPANION_TOKEN", token)
    node = start_node(*RUN)

    def check() -> int:
        program, *arguments = instruction("HEALTHCHECK")
        assert program == "python"
        here = [word.replace("http://127.0.0.1:8080", node.url) for word in arguments]
        command = [sys.executable, *here]
        return subprocess.run(command, capture_output=True, timeout=HANG_S, check=False).returncode

    assert check() == 1  # no report yet
    to = f"udpout:127.0.0.1:{node.udp_port}"
    with started(
        [BIN / "sitl-replay", "fly", "paper", "--to", to], stdout=subprocess.DEVNULL
    ) as flying:
        waited = next((n for n in range(100) if check() == 0), None)
        flying.terminate()
    assert waited is not None


def context(target: Path) -> None:
    """Return the ``docker build`` context: the tree without what .dockerignore excludes."""
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    assert rules[0] == "*"
    drop = [Path(rule).name for rule in rules if rule.startswith("**/")]
    for name in (rule[1:] for rule in rules if rule.startswith("!")):
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, target / name, ignore=shutil.ignore_patterns(*drop))
        else:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target / name)
    assert not any(fnmatch.fnmatch(path.name, "*.pyc") for path in target.rglob("*"))


def test_image_installs_and_runs_from_its_build_context(tmp_path: Path) -> None:
    """Installed separately, read-only, without HOME and in another directory; the page is
    included.
    """
    source, installed, record = (tmp_path / name for name in ("src", "installed", "recordings"))
    source.mkdir()
    context(source)
    wheel = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    wheel += ["--no-build-isolation", "--target", str(installed), str(source)]
    subprocess.run(wheel, check=True, capture_output=True, timeout=HANG_S)
    shutil.rmtree(source)
    for path in [installed, *installed.rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    environment = {name: value for name, value in os.environ.items() if name != "HOME"}
    environment |= {"PYTHONPATH": str(installed), "PYTHONDONTWRITEBYTECODE": "1"}
    code = (
        "import companion, pathlib\n"
        f"assert pathlib.Path(companion.__file__).is_relative_to({str(installed)!r})\n"
        "from companion.server.page import web_directory\n"
        f"assert web_directory().is_relative_to({str(installed)!r})\n"
        "assert (web_directory() / 'index.html').is_file()\n"
        "from companion.studies.figures.pages import page\n"
        "page('figures/page.html.j2', answer={'command': '', 'versions': {}}, figures={})\n"
        "from companion.node import start\n"
        "from companion.cli.main import main\n"
        "from companion.settings.model import Settings\n"
        "settings = Settings().override(center={'source': '5:1'},\n"
        "    links={'urls': ['udpin:127.0.0.1:0']}, server={'listen': '127.0.0.1:0'},\n"
        f"    recording={{'directory': {str(record)!r}}})\n"
        "from companion.cli.voice import Lines\n"
        "start.run(settings, Lines(), seconds=0.5)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    for path in [installed, *installed.rglob("*")]:
        if path.is_dir():
            path.chmod(0o755)  # so that pytest can remove it
    assert done.returncode == 0, done.stderr
    assert len(list(record.glob("*.mcap"))) == 1


@pytest.mark.full
def test_commands_run_without_packages_left_out_of_the_image(tmp_path: Path) -> None:
    """An LMI design, a study with figures and a replay, without the omitted packages."""
    (line,) = re.findall(r"pip uninstall --yes (highspy .*) pip ", DOCKERFILE)
    gone = [name for name in line.split() if name != "setuptools"]
    code = (
        "import sys\n"
        "class Gone:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.partition('.')[0] in {gone!r}:\n"
        "            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Gone())\n"
        "from companion.cli.main import main\n"
        "main(sys.argv[1:])\n"
    )
    log = str(ROOT / "tests" / "data" / "sitl_4circle_cut.tlog")
    for words in (
        ["design", "--method", "lmi", "--dt", "0.2"],
        ["study", "dt", "--out", "report"],
        ["replay", log, "--center", "5:1"],
    ):
        done = subprocess.run(
            [sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True,
            timeout=HANG_S, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
    assert list((tmp_path / "report").glob("*.png")) or list((tmp_path / "report").glob("*.html"))


PACKAGES_MB = 330
"""Largest size of the packages: with a base of some 125 MB the image stays below 450 MB."""


@pytest.mark.full
def test_reduced_packages_are_small_and_work(tmp_path: Path) -> None:
    """The locked packages as installed here, reduced as in the image."""
    if shutil.which("strip") is None:
        pytest.skip("no strip: install binutils")
    packages = tmp_path / "venv" / "lib"
    (line,) = re.findall(r"pip uninstall --yes (highspy .*) pip ", DOCKERFILE)
    builds = ["editables", "hatchling", "pathspec", "pluggy", "trove-classifiers"]
    gone = {*line.split(), *builds}
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    for name in set(re.findall(r"^([\w.-]+)==", lock, re.MULTILINE)) - gone:
        for part in {file.parts[0] for file in metadata.files(name) or ()} - {"..", "__pycache__"}:
            found = Path(str(metadata.distribution(name).locate_file(part)))
            if found.is_dir():
                shutil.copytree(found, packages / part, dirs_exist_ok=True)
            else:
                packages.mkdir(parents=True, exist_ok=True)
                shutil.copy2(found, packages)
    before = taken_mb(packages)
    steps = re.findall(r"&& (find /opt/venv.*?)(?= \\\n    &&|\n\n)", DOCKERFILE, re.DOTALL)
    assert len(steps) == 3
    for step in steps:
        command = step.replace("/opt/venv/lib", str(packages))
        subprocess.run(["sh", "-ec", command], check=True, timeout=HANG_S)
    assert taken_mb(packages) < min(PACKAGES_MB, before - 100)
    loads = (
        "import importlib, pathlib, sys\n"
        "root = pathlib.Path(sys.argv[1])\n"
        "import numpy, scipy, cvxpy, matplotlib.pyplot, PIL.Image\n"
        "assert all(root in pathlib.Path(one.__file__).parents for one in (numpy, cvxpy, PIL))\n"
        "known = [one for one in root.rglob('*.so') if '.libs' not in str(one)]\n"
        "for one in known:\n"
        "    name = '.'.join(one.relative_to(root).with_name(one.name.split('.')[0]).parts)\n"
        "    if name != 'scipy.linalg._matfuncs_sqrtm_triu':  # imports itself\n"
        "        importlib.import_module(name)\n"
        "print(len(known))\n"
    )
    python = Path(sys.executable).resolve()  # without the packages of this environment
    environment = {**os.environ, "PYTHONPATH": f"{packages}{os.pathsep}{ROOT}"}
    log = str(ROOT / "tests" / "data" / "sitl_4circle_cut.tlog")
    for words in (
        ["-c", loads, str(packages)],
        ["-m", "companion", "design", "--method", "lmi", "--dt", "0.2"],
        ["-m", "companion", "study", "dt", "--out", "report"],
        ["-m", "companion", "replay", log, "--center", "5:1"],
    ):
        done = subprocess.run(
            [python, *words], cwd=tmp_path, env=environment, capture_output=True, text=True,
            timeout=HANG_S, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr


def taken_mb(folder: Path) -> float:
    """Return the size of the files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 2**20


def test_service_tests_run_one_at_a_time(request: pytest.FixtureRequest) -> None:
    """The ``conftest.ALONE`` group reaches xdist, which reads it from the test's id."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        assert request.node.nodeid.endswith("@alone")
