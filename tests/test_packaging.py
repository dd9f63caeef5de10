"""What is installed by name: wheel, source archive and Debian package, without the repository."""

import configparser
import email.parser
import gzip
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import urllib.request
import venv
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import hcl2
import pytest
from hcl2 import SerializationOptions
from markdown_it import MarkdownIt
from markdown_it.token import Token
from packaging.metadata import Metadata
from support import HANG_S, ROOT, line_of, started

import companion

EPOCH = {"SOURCE_DATE_EPOCH": "1700000000"}
DOC = "usr/share/doc/uav-companion-beams"
DESCRIPTION = (ROOT / "deploy" / "description.md").read_text(encoding="utf-8")
FORBIDDEN = "/Build", "/tests/", ".pyc", "/.venv", ".mcap"


def build(folder: Path, source: Path = ROOT, *targets: str) -> list[Path]:
    """Build wheel and source archive; return the files."""
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(folder)]
    command += [word for target in targets or ("wheel", "sdist") for word in ("-t", target)]
    environment = {**os.environ, **EPOCH}
    subprocess.run(
        command, cwd=source, env=environment, check=True, capture_output=True, timeout=HANG_S
    )
    return sorted(folder.iterdir())


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return build(tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def wheel(built: list[Path]) -> Path:
    (found,) = (path for path in built if path.suffix == ".whl")
    return found


@pytest.fixture(scope="module")
def archive(built: list[Path]) -> Path:
    (found,) = (path for path in built if path.suffix == ".gz")
    return found


def test_two_builds_are_identical(built: list[Path], tmp_path: Path) -> None:
    """Also the wheel that is built from the source archive."""
    again = build(tmp_path / "again")
    assert [path.name for path in again] == [path.name for path in built]
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in built]
    with tarfile.open(built[0] if built[0].suffix == ".gz" else built[1]) as tar:
        tar.extractall(tmp_path, filter="data")
    (source,) = tmp_path.glob("uav_companion_beams-*")
    (rebuilt,) = build(tmp_path / "rebuilt", source, "wheel")
    (wheel,) = (path for path in built if path.suffix == ".whl")
    assert rebuilt.read_bytes() == wheel.read_bytes()


def test_metadata_is_valid_for_an_index(wheel: Path, archive: Path) -> None:
    """What ``twine check`` checks: the metadata, and a long description that is declared."""
    with zipfile.ZipFile(wheel) as zipped:
        (name,) = (name for name in zipped.namelist() if name.endswith("/METADATA"))
        raw = zipped.read(name)
    with tarfile.open(archive) as tar:
        member = tar.extractfile(f"{archive.name.removesuffix('.tar.gz')}/PKG-INFO")
        assert member is not None
        assert member.read() == raw
    found = Metadata.from_email(raw, validate=True)
    assert (found.name, str(found.version)) == ("uav-companion-beams", companion.__version__)
    assert found.description_content_type == "text/markdown"
    assert found.description == DESCRIPTION
    assert found.license_expression == "Apache-2.0"
    assert found.author_email == maintainer()


def targets_of(tokens: Sequence[Token]) -> list[str]:
    """The targets of all links and images in a Markdown document."""
    found = [
        str(token.attrs[name])
        for token in tokens
        for name in ("href", "src")
        if name in token.attrs
    ]
    return found + [target for token in tokens for target in targets_of(token.children or [])]


def test_description_needs_nothing_beside_it(archive: Path) -> None:
    """An index shows it alone: no relative link or image, no command of the repository."""
    assert targets_of(MarkdownIt().parse("[a](docs/a.md) ![b](b.png)")) == ["docs/a.md", "b.png"]
    targets = targets_of(MarkdownIt().enable("table").parse(DESCRIPTION))
    assert [target for target in targets if not target.startswith("https://")] == []
    assert not re.search(r"^    make |`make ", DESCRIPTION, re.MULTILINE)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    cells = re.findall(r"^\| (`.+?) \|", DESCRIPTION, re.MULTILINE)
    assert set(re.findall(r"`(\w+)`", " ".join(cells))) == extras.keys() - {"dev"}
    mentioned = set(re.findall(r"`(docs/[\w.-]+)`", DESCRIPTION))
    with tarfile.open(archive) as tar:
        names = {name.partition("/")[2] for name in tar.getnames()}
    assert mentioned and mentioned <= names


def test_description_says_what_the_readme_says(archive: Path) -> None:
    """The same words, apart from the picture and the links, which work in the source archive."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    plain = re.sub(
        r"(?<!!)\[([^]]*)\]\([^)]*\)", r"\1", re.sub(r"^!\[.*\n\n", "", readme, flags=re.M)
    )
    introduction = plain.partition("\n## ")[0]
    assert len(introduction) > 1000 and DESCRIPTION.startswith(introduction)
    library = (
        "`companion` is also a library." + plain.partition("`companion` is also a library.")[2]
    )
    snippet = library.partition("Licence:")[0]
    assert snippet.count("\n") > 5 and snippet in DESCRIPTION
    with tarfile.open(archive) as tar:
        names = {name.partition("/")[2] for name in tar.getnames()}
    links = set(re.findall(r"\]\(([\w./-]+)\)", readme))
    assert "docs/links.md" in links and links <= names


def test_wheel_contains_the_page_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as zipped:
        names = set(zipped.namelist())
    page = {path.relative_to(ROOT / "web") for path in (ROOT / "web").rglob("*") if path.is_file()}
    assert {f"companion/_web/{path.as_posix()}" for path in page} <= names
    assert not [name for name in names if any(part in name for part in FORBIDDEN)]
    tops = {name.split("/")[0] for name in names}
    stem = f"uav_companion_beams-{companion.__version__}"
    assert tops == {"companion", "sitl_replay", f"{stem}.dist-info", f"{stem}.data"}


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh environment with the wheel, the packages of this one, and a watch on open files.

    Returns the directory of its scripts.
    """
    folder = tmp_path_factory.mktemp("clean") / "env"
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet"]
    pip += ["--no-deps", "--no-index", str(wheel)]
    subprocess.run(pip, check=True, capture_output=True, timeout=HANG_S)
    # Packages by path, without their .pth files: the editable installation is not among them.
    (packages / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    (packages / "sitecustomize.py").write_text(
        "import os, sys\n"
        f"ROOT, OWN = {f'{ROOT}{os.sep}'!r}, {str(Path(sys.prefix))!r}\n"
        f"SEEN = os.open({str(folder / 'seen')!r}, os.O_CREAT | os.O_APPEND | os.O_WRONLY)\n"
        "def watch(event, given):\n"
        "    if event == 'open' and isinstance(given[0], str):\n"
        "        path = os.path.abspath(given[0])\n"
        "        if path.startswith(ROOT) and not path.startswith(OWN):\n"
        "            os.write(SEEN, (path + '\\n').encode())\n"
        "sys.addaudithook(watch)\n"
    )
    return folder / "bin"


def test_installed_demo_needs_no_repository(installed: Path, tmp_path: Path) -> None:
    """The page, its modules and the API reference come from the wheel."""
    command = [installed / "companion", "demo", "--port", "0"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with started(command, cwd=tmp_path, **pipes) as process:
        (address,) = re.findall(r"http://\S+", line_of(process, process.stdout))
        for path in ("/", "/docs", "/openapi.json", "/v1/status"):
            with urllib.request.urlopen(address + path, timeout=HANG_S) as answer:
                body = answer.read().decode()
            assert answer.status == 200
            if path in ("/", "/docs"):
                for link in re.findall(r'(?:src|href)="(/?[\w./-]+\.(?:js|css))"', body):
                    with urllib.request.urlopen(f"{address}/{link.lstrip('/')}") as part:
                        assert part.status == 200
        assert json.loads(body)["version"] == companion.__version__
        process.terminate()
        said = process.communicate(timeout=HANG_S)
    assert process.returncode == 0, said
    assert list((tmp_path / "recordings").glob("*.mcap"))
    assert (installed.parent / "seen").read_text() == ""


def test_installed_commands_find_their_files(installed: Path, tmp_path: Path) -> None:
    """A study with its page and figures, and the simulator."""
    for words in (
        ["companion", "study", "dt", "--out", str(tmp_path / "report")],
        ["sitl-replay", "list"],
    ):
        command = [installed / words[0], *words[1:]]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, timeout=HANG_S)
    assert (tmp_path / "report" / "dt.html").is_file()
    assert (installed.parent / "seen").read_text() == ""


# --- the Debian package ---------------------------------------------------------------------------


def deb(out: Path, *options: str) -> Path:
    """Build the Debian package."""
    if shutil.which("dpkg-deb") is None:
        pytest.skip("no dpkg-deb on this machine")
    command = [sys.executable, ROOT / "deploy" / "build_deb.py", "--out", out, *options]
    subprocess.run(
        command, env={**os.environ, **EPOCH}, check=True, capture_output=True, timeout=HANG_S
    )
    (package,) = out.glob("*.deb")
    return package


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return deb(tmp_path_factory.mktemp("deb"), "--no-packages")


@pytest.fixture(scope="module")
def unpacked(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("root")
    for option, target in (("-x", folder), ("-e", folder / "DEBIAN")):
        subprocess.run(["dpkg-deb", option, package, target], check=True, timeout=HANG_S)
    return folder


def maintainer() -> str:
    """The first author of pyproject.toml."""
    author = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["authors"][0]
    return f"{author['name']} <{author['email']}>"


def test_debian_package_can_be_for_another_python(tmp_path: Path) -> None:
    built = deb(tmp_path, "--no-packages", "--python", "3.13")
    command = ["dpkg-deb", "--field", built, "Depends"]
    found = subprocess.run(command, capture_output=True, text=True, check=True, timeout=HANG_S)
    assert found.stdout.startswith("python3 (>= 3.13), python3 (<< 3.14~), ")


def test_debian_package_is_reproducible(package: Path, tmp_path: Path) -> None:
    assert deb(tmp_path, "--no-packages").read_bytes() == package.read_bytes()


def test_debian_package_is_well_formed(package: Path, unpacked: Path) -> None:
    """What lintian would object to first."""
    fields = email.parser.Parser().parsestr((unpacked / "DEBIAN/control").read_text())
    assert fields["Version"] == companion.__version__
    assert fields["Architecture"] == "all"  # without the packages; else that of their wheels
    major, minor = sys.version_info[:2]
    assert f"python3 (>= {major}.{minor}), python3 (<< {major}.{minor + 1}~)" in fields["Depends"]
    assert fields["Maintainer"] == maintainer()
    changes = gzip.decompress((unpacked / DOC / "changelog.gz").read_bytes()).decode()
    assert f"\n -- {maintainer()}  " in changes
    assert set(fields) >= {"Maintainer", "Section", "Priority", "Description", "Installed-Size"}
    assert (unpacked / "DEBIAN/conffiles").read_text() == "/etc/companion.toml\n"
    for script in ("postinst", "prerm", "postrm"):
        path = unpacked / "DEBIAN" / script
        assert os.access(path, os.X_OK)
        assert "set -e" in path.read_text()
        subprocess.run(["sh", "-n", path], check=True, timeout=HANG_S)
    command = ["dpkg-deb", "-c", package]
    listed = subprocess.run(command, capture_output=True, text=True, check=True, timeout=HANG_S)
    for line in listed.stdout.splitlines():
        mode, owner, *_, name = line.split()
        assert owner == "root/root"
        assert mode in ("drwxr-xr-x", "-rwxr-xr-x", "-rw-r--r--"), line
        assert name.startswith(("./etc", "./usr")) or name == "./"
        assert "__pycache__" not in name
    assert {path.name for path in (unpacked / DOC).iterdir()} == {
        *("copyright", "changelog.gz", "CHANGELOG.md.gz", "NOTICE")
    }


def test_debian_unit_is_valid(unpacked: Path) -> None:
    """The documented unit, as a system user with access to serial devices only."""
    text = (unpacked / "usr/lib/systemd/system/companion.service").read_text()
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read_string(text)
    service = unit["Service"]
    assert service["ExecStart"].startswith("/usr/bin/companion run --config /etc/companion.toml")
    assert "DynamicUser" not in service
    assert service["User"] in (unpacked / "usr/lib/sysusers.d/companion.conf").read_text().split()
    assert service["SupplementaryGroups"] == "dialout"
    assert (service["PrivateDevices"], service["DevicePolicy"]) == ("no", "closed")
    assert "multi-user.target" in unit["Install"]["WantedBy"]
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze on this machine")
    path = unpacked / "companion.service"
    path.write_text(text.replace("/usr/bin/companion", str(unpacked / "usr/bin/companion")))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", path],
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert [line for line in done.stderr.splitlines() if "companion.service" in line] == []


def test_debian_system_user_can_be_created(unpacked: Path, tmp_path: Path) -> None:
    """An error of this file would end the installation."""
    if shutil.which("systemd-sysusers") is None:
        pytest.skip("no systemd-sysusers on this machine")
    (tmp_path / "etc").mkdir()
    users = unpacked / "usr/lib/sysusers.d/companion.conf"
    done = subprocess.run(
        ["systemd-sysusers", f"--root={tmp_path}", users],
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "companion:x:" in (tmp_path / "etc/passwd").read_text()


def test_debian_launchers_start_python_with_interrupts_blocked(
    unpacked: Path, tmp_path: Path
) -> None:
    """A starting interpreter would answer with a traceback, and a shell could forget them."""
    python, launchers = tmp_path / "python3", list((unpacked / "usr/bin").iterdir())
    assert len(launchers) == 2
    python.write_text("#!/bin/sh\nexec grep SigBlk /proc/self/status\n")
    python.chmod(0o755)
    for path in launchers:
        launcher = tmp_path / path.name
        launcher.write_text(path.read_text().replace("/usr/bin/python3", str(python)))
        launcher.chmod(0o755)
        assert "/env " in launcher.read_text().splitlines()[0]
        done = subprocess.run(
            [launcher], capture_output=True, text=True, timeout=HANG_S, check=True
        )
        blocked = int(done.stdout.split()[1], 16)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            assert blocked >> (number - 1) & 1, (path.name, number)


@pytest.fixture
def launched(unpacked: Path) -> Iterator[Path]:
    """The unpacked package, started with this Python and its packages."""
    for path in (unpacked / "usr/bin").iterdir():
        text = path.read_text().replace("/usr/bin/python3", sys.executable)
        path.write_text(text)
    packages = unpacked / "usr/lib/uav-companion-beams/dependencies.pth"
    packages.write_text(f"{sysconfig.get_path('purelib')}\n")
    yield unpacked
    packages.unlink()


def test_debian_package_runs_its_check(launched: Path, tmp_path: Path) -> None:
    """With the settings of the package; the centre is left to the user, and is asked for."""
    command = [launched / "usr/bin/companion", "check", "--seconds", "0", "--json"]
    settings = launched / "etc/companion.toml"
    command += ["--config", settings, "--center", "5:1", "--listen", "127.0.0.1:0"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=HANG_S, check=False
    )
    assert done.stderr.splitlines()[1:] == []  # at most the number of failed checks
    subjects = {finding["subject"] for finding in json.loads(done.stdout)["findings"]}
    assert "link udpin:0.0.0.0:14550" in subjects
    version = [launched / "usr/bin/companion", "--version"]
    done = subprocess.run(version, capture_output=True, text=True, timeout=HANG_S, check=True)
    assert done.stdout == f"companion, version {companion.__version__}\n"
    command = [launched / "usr/bin/companion", "run", "--config", settings]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=HANG_S, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith("companion: center.source is not set")


@pytest.mark.full
@pytest.mark.parametrize("arch", ["amd64", "arm64"])
def test_debian_package_has_all_packages_for_its_architecture(arch: str, tmp_path: Path) -> None:
    """Needs the package registry. Extension modules are those of the architecture."""
    built = deb(tmp_path, "--arch", arch)
    folder = tmp_path / "root"
    subprocess.run(["dpkg-deb", "-x", built, folder], check=True, timeout=HANG_S)
    machines = {path.read_bytes()[18] for path in folder.rglob("*.so*") if path.is_file()}
    assert machines == {62 if arch == "amd64" else 183}  # ELF's numbers of the machines
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    assert "numpy==" in lock
    assert list((folder / "usr/lib/uav-companion-beams").glob("numpy-*.dist-info"))


# --- the image ------------------------------------------------------------------------------------


def bake_targets() -> dict[str, Any]:
    """The targets of docker-bake.hcl, with variables as written."""
    text = (ROOT / "docker-bake.hcl").read_text(encoding="utf-8")
    options = SerializationOptions(
        with_comments=False, explicit_blocks=False, strip_string_quotes=True
    )
    found = hcl2.loads(text, serialization_options=options)
    (version,) = (one["TAG"]["default"] for one in found["variable"] if "TAG" in one)
    assert version == companion.__version__
    assert found["group"] == [{"default": {"targets": ["companion"]}}]
    return {name: target for one in found["target"] for name, target in one.items()}


def test_bake_definition_builds_both_architectures() -> None:
    targets = bake_targets()
    assert targets.keys() == {"companion", "blueos"}
    for target in targets.values():
        assert target["platforms"] == ["linux/amd64", "linux/arm64"]
        assert (ROOT / target["context"] / target["dockerfile"]).is_file()
        assert all("${TAG}" in tag or tag.endswith(":latest") for tag in target["tags"])
    # `FROM ${IMAGE}` is the image of the first target, not one of a registry.
    extension = targets["blueos"]
    assert extension["contexts"] == {extension["args"]["IMAGE"]: "target:companion"}
    assert "\nFROM ${IMAGE}\n" in (ROOT / "examples/blueos/Dockerfile").read_text(encoding="utf-8")


@pytest.mark.skipif(shutil.which("buildx") is None, reason="no buildx on the PATH")
def test_buildx_reads_the_bake_definition(tmp_path: Path) -> None:
    """Also the compose file, which buildx reads besides it and merges with targets of one name."""
    command = ["buildx", "bake", "--print", "--progress=quiet", "companion", "blueos"]
    environment = os.environ | {"DOCKER_CONFIG": str(tmp_path), "REGISTRY": "registry.example/"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True,
        timeout=HANG_S,
    )  # fmt: skip
    printed = json.loads(done.stdout)["target"]
    for name, target in bake_targets().items():
        assert printed[name]["platforms"] == target["platforms"]
        assert printed[name]["context"] == target["context"]
    version = companion.__version__
    assert printed["blueos"]["tags"] == [f"registry.example/companion-blueos:{version}"]
    assert printed["blueos"]["args"] == {"IMAGE": "companion", "VERSION": version}
    assert set(printed["companion"]["tags"]) == {
        f"registry.example/uav-companion-beams:{tag}" for tag in (version, "latest")
    }
