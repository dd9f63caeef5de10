"""Build the Debian package: the service with all locked packages, for one architecture.

    python deploy/build_deb.py [--out DIR] [--arch amd64|arm64] [--python 3.N] [--no-packages]

The packages of requirements.lock are unpacked from wheels into /usr/lib/uav-companion-beams, so
that an installation needs no network. They are chosen for the architecture and the version of
Python, that of the building interpreter unless given; nothing is compiled or run. The unit is the
one of docs/deployment.md, with a system user of its own. ``--no-packages`` leaves the locked
packages out, for tests. Needs dpkg-deb. With SOURCE_DATE_EPOCH, two builds are identical.
"""

import argparse
import gzip
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from datetime import UTC, datetime
from email.utils import format_datetime
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
FILES: Final = ROOT / "deploy" / "debian"
NAME: Final = "uav-companion-beams"
WHEELS: Final = {"amd64": "x86_64", "arm64": "aarch64"}
"""Machine name in wheels, by Debian's name of the architecture."""
GLIBC: Final = ("2_17", "2_26", "2_27", "2_28", "2_31", "2_34")
"""Versions of glibc, up to Debian 12's, for which wheels are built."""
EPOCH_DEFAULT: Final = 1_767_225_600  # 1 January 2026
BUILD_TOOLS: Final = re.compile(r"editables|hatchling|pathspec|pluggy|trove-classifiers")


def main() -> None:
    """Build the package and print its path."""
    asked = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    asked.add_argument("--out", type=Path, default=ROOT / "dist")
    asked.add_argument("--arch", choices=WHEELS, default=_own_arch())
    asked.add_argument("--python", default=f"{sys.version_info.major}.{sys.version_info.minor}")
    asked.add_argument("--no-packages", action="store_true")
    given = asked.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        _fill(tree, given.arch, given.python, not given.no_packages)
        given.out.mkdir(parents=True, exist_ok=True)
        print(_packed(tree, given.out))


def _own_arch() -> str:
    machine = os.uname().machine
    return next((arch for arch, name in WHEELS.items() if name == machine), "amd64")


def _fill(tree: Path, arch: str, python: str, packages: bool) -> None:
    lib = tree / "usr/lib/uav-companion-beams"
    wheel = _wheel(tree.parent)
    if packages:
        _install(lib, "--require-hashes", "-r", str(_lock(tree.parent)), arch=arch, python=python)
    _install(lib, "--no-deps", "--no-index", str(wheel), arch=arch, python=python)
    for program in (lib / "bin").glob("*"):
        program.unlink()  # they name the Python of the building machine
    (lib / "bin").rmdir()
    for origin in lib.glob("*/direct_url.json"):  # names a path of the building machine
        origin.unlink()
        record = origin.with_name("RECORD")
        lines = record.read_text(encoding="utf-8").splitlines(keepends=True)
        kept = (line for line in lines if origin.name not in line)
        record.write_text("".join(kept), encoding="utf-8")
    for module in ("companion", "sitl_replay"):
        name = module.replace("_", "-")
        text = (FILES / "launcher").read_text(encoding="utf-8")
        text = text.replace("@MODULE@", module)
        _write(tree / "usr/bin" / name, text, 0o755)
    service = tree / "usr/lib/systemd/system/companion.service"
    _write(service, unit(*_documented_units()))
    _write(tree / "etc/companion.toml", (FILES / "companion.toml").read_text(encoding="utf-8"))
    for source, target in (
        ("sysusers.conf", "usr/lib/sysusers.d/companion.conf"),
        ("udev.rules", "usr/lib/udev/rules.d/60-companion.rules"),
        ("copyright", f"usr/share/doc/{NAME}/copyright"),
    ):
        _write(tree / target, (FILES / source).read_text(encoding="utf-8"))
    shutil.copy(ROOT / "NOTICE", tree / f"usr/share/doc/{NAME}/NOTICE")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    for name, text in (("changelog", _debian_changelog()), ("CHANGELOG.md", changes)):
        packed = gzip.compress(text.encode(), 9, mtime=0)
        (tree / f"usr/share/doc/{NAME}/{name}.gz").write_bytes(packed)
    _write_control(tree, arch if packages else "all", python)


def _documented_units() -> tuple[str, str]:
    """Return the unit in docs/deployment.md, and its drop-in for serial devices."""
    text = (ROOT / "docs" / "deployment.md").read_text(encoding="utf-8")
    service, serial = (block.split("```")[0] for block in text.split("```ini\n")[1:3])
    return service, serial


def unit(service: str, serial: str) -> str:
    """Return the package's unit: the documented one with serial devices and a system user."""
    for before, after in (
        ("/opt/companion/bin/companion", "/usr/bin/companion"),
        ("/etc/companion/companion.toml", "/etc/companion.toml"),
        ("# A dynamic user; all", "# All"),
        ("DynamicUser=yes\n", "User=companion\nPrivateTmp=yes\nRemoveIPC=yes\n"),
        ("ConfigurationDirectory=companion\n", ""),
    ):
        assert before in service, before
        service = service.replace(before, after)
    settings = dict(line.split("=", 1) for line in serial.splitlines() if "=" in line)
    for key in ("PrivateDevices", "PrivateUsers"):
        service = service.replace(f"{key}=yes\n", f"{key}={settings[key]}\n")
    kept = [line for line in serial.splitlines() if line.startswith(("Supp", "Device"))]
    return service.replace("\n[Install]", "\n".join(["", *kept, "", "[Install]"]))


def _wheel(folder: Path) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def _lock(folder: Path) -> Path:
    """Return the lock file without the build tools."""
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    entries = re.split(r"^(?=[a-z0-9])", text, flags=re.MULTILINE)
    lock = folder / "requirements.lock"
    lock.write_text("".join(e for e in entries if not BUILD_TOOLS.match(e)), encoding="utf-8")
    return lock


def _install(lib: Path, *what: str, arch: str, python: str) -> None:
    machine = WHEELS[arch]
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    command += ["--no-compile", "--target", str(lib), "--only-binary", ":all:"]
    command += ["--implementation", "cp", "--python-version", python]
    for version in GLIBC:
        command += ["--platform", f"manylinux_{version}_{machine}"]
    command += ["--platform", f"manylinux2014_{machine}", "--platform", f"linux_{machine}"]
    subprocess.run([*command, "--upgrade", *what], check=True)


def _write(path: Path, text: str, mode: int = 0o644) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    path.chmod(mode)


def _debian_changelog() -> str:
    date = format_datetime(datetime.fromtimestamp(_epoch(), UTC))
    return (
        f"{NAME} ({_version()}) stable; urgency=medium\n\n"
        f"  * See CHANGELOG.md.gz.\n\n -- {_maintainer()}  {date}\n"
    )


def _maintainer() -> str:
    """Return the first author in pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    author = project["authors"][0]
    return f"{author['name']} <{author['email']}>"


def _version() -> str:
    init = (ROOT / "companion" / "__init__.py").read_text(encoding="utf-8")
    (version,) = re.findall(r'^__version__ = "(.+)"', init, re.MULTILINE)
    return str(version)


def _epoch() -> int:
    return int(os.environ.get("SOURCE_DATE_EPOCH", EPOCH_DEFAULT))


def _write_control(tree: Path, arch: str, python: str) -> None:
    major, minor = map(int, python.split("."))
    kib = sum(path.stat().st_size for path in tree.rglob("*") if path.is_file()) // 1024
    text = (FILES / "control").read_text(encoding="utf-8")
    for key, value in (
        ("VERSION", _version()),
        ("ARCH", arch),
        ("MAINTAINER", _maintainer()),
        ("PYTHON", python),
        ("NEXT", f"{major}.{minor + 1}"),
        ("SIZE", str(kib)),
    ):
        text = text.replace(f"@{key}@", value)
    _write(tree / "DEBIAN/control", text)
    _write(tree / "DEBIAN/conffiles", "/etc/companion.toml\n")
    for script in ("postinst", "prerm", "postrm"):
        _write(tree / "DEBIAN" / script, (FILES / script).read_text(encoding="utf-8"), 0o755)


def _packed(tree: Path, out: Path) -> str:
    epoch = _epoch()
    for path in [tree, *tree.rglob("*")]:
        if path.is_dir():
            path.chmod(0o755)
        elif not os.access(path, os.X_OK) or path.suffix in (".py", ".so"):
            path.chmod(0o644)
        os.utime(path, (epoch, epoch))
    environment = {**os.environ, "SOURCE_DATE_EPOCH": str(epoch)}
    command = ["dpkg-deb", "--root-owner-group", "-Zxz", "-z3", "--build", str(tree), str(out)]
    done = subprocess.run(command, check=True, env=environment, capture_output=True, text=True)
    return done.stdout.strip()


if __name__ == "__main__":
    main()
