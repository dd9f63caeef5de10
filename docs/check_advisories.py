"""Compares locked packages with published security advisories, without a network.

    python docs/check_advisories.py DATABASE              fail where a locked version is affected
    python docs/check_advisories.py DATABASE --keep FILE  also keep the advisories of these packages

DATABASE is a folder of advisories in the OSV format (JSON or YAML), such as a checkout of the
Python Packaging Advisory Database, or a FILE that was kept before. The packages are those of both
lock files, and those whose files the page contains (sbom.cdx.json).
"""

import argparse
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml
from packaging.version import InvalidVersion, Version

ROOT: Final = Path(__file__).parents[1]
ACCEPTED: Final[dict[str, str]] = {}
"""Advisories that do not apply to this use of the package, by id, each with its reason."""
EVENTS: Final = {"introduced": 0, "fixed": 1, "last_affected": 2}
"""Events of a range; at the same version they apply in this order."""


class Package(NamedTuple):
    """A package of an ecosystem, named as OSV names it."""

    ecosystem: str
    name: str


def normalized(name: str) -> str:
    """A package's name without the differences that the ecosystem ignores."""
    return re.sub(r"[-_.]+", "-", name).lower()


def locked(root: Path) -> dict[Package, set[str]]:
    """The versions of each package that is installed or contained."""
    found: dict[Package, set[str]] = {}
    for lock in ("requirements.lock", "requirements-dev.lock"):
        text = (root / lock).read_text(encoding="utf-8")
        for name, version in re.findall(r"^([A-Za-z0-9._-]+)==(\S+)", text, re.MULTILINE):
            found.setdefault(Package("PyPI", normalized(name)), set()).add(version)
    bill = json.loads((root / "docs" / "sbom.cdx.json").read_text(encoding="utf-8"))
    for component in bill["components"]:
        if component["purl"].startswith("pkg:npm/"):
            package = Package("npm", normalized(component["name"]))
            found.setdefault(package, set()).add(component["version"])
    return found


def advisories(database: Path, packages: set[Package]) -> Iterator[dict[str, Any]]:
    """What a database publishes about these packages; withdrawn advisories are left out."""
    if database.is_file():
        entries = iter(json.loads(database.read_text(encoding="utf-8")))
    else:
        entries = (entry for path in sorted(database.rglob("*")) for entry in _read(path, packages))
    for entry in entries:
        if any(_package(one) in packages for one in entry["affected"]) and not entry.get(
            "withdrawn"
        ):
            yield entry


def _read(path: Path, packages: set[Package]) -> Iterator[dict[str, Any]]:
    if path.suffix not in (".json", ".yaml") or not path.is_file():
        return
    text = path.read_text(encoding="utf-8")
    # A database has thousands of files; only those that name one of the packages are parsed.
    names = {normalized(name) for name in re.findall(r"\bname\"?:\s*[\"']?([\w.-]+)", text)}
    if names & {package.name for package in packages}:
        entry = json.loads(text) if path.suffix == ".json" else yaml.load(text, _Loader)
        if isinstance(entry, dict) and "affected" in entry:
            yield entry


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    """Reads dates as text, which JSON can hold."""

    yaml_implicit_resolvers: Final = {
        first: [(tag, known) for tag, known in all_known if not tag.endswith(":timestamp")]
        for first, all_known in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


def _package(affected: dict[str, Any]) -> Package:
    named = affected.get("package", {})
    return Package(named.get("ecosystem", ""), normalized(named.get("name", "")))


def kept(entry: dict[str, Any], packages: set[Package]) -> dict[str, Any]:
    """The part of an advisory that decides whether it applies to one of these packages."""
    parts = []
    for one in entry["affected"]:
        if _package(one) in packages:
            ranges = [given for given in one.get("ranges", []) if given["type"] != "GIT"]
            part = {"package": {key: one["package"][key] for key in ("ecosystem", "name")}}
            # Ranges contain the listed versions.
            parts.append(
                part | ({"ranges": ranges} if ranges else {"versions": one.get("versions", [])})
            )
    known = {key: entry[key] for key in ("id", "aliases", "modified") if key in entry}
    return known | {"affected": parts}


def affects(affected: dict[str, Any], version: str) -> bool:
    """Whether a version is listed, or in a range, by OSV's algorithm.

    A range whose versions cannot be ordered counts: a person has to look at it.
    """
    if version in affected.get("versions", []):
        return True
    return any(
        _contains(given["events"], Version(version))
        for given in affected.get("ranges", [])
        if given["type"] != "GIT"
    )


def _contains(events: list[dict[str, str]], version: Version) -> bool:
    try:
        ordered = sorted(
            (Version(at), EVENTS[kind])
            for event in events
            for kind, at in event.items()
            if kind in EVENTS
        )
    except InvalidVersion:
        return True
    inside = False
    for at, kind in ordered:
        if kind == EVENTS["introduced"] and version >= at:
            inside = True
        elif (kind == EVENTS["fixed"] and version >= at) or version > at:
            inside = False
    return inside


def faults(entries: list[dict[str, Any]], packages: dict[Package, set[str]]) -> list[str]:
    """One line for each locked version that an advisory affects and that is not accepted."""
    found = []
    for entry in entries:
        names = [entry["id"], *entry.get("aliases", [])]
        if any(name in ACCEPTED for name in names):
            continue
        for one in entry["affected"]:
            for version in sorted(packages.get(_package(one), ())):
                if affects(one, version):
                    found.append(
                        f"{_package(one).name} {version} is affected by {', '.join(names)}"
                    )
    return found


def main() -> None:
    """Compare, and print what was compared."""
    parser = argparse.ArgumentParser(description="Compare locked packages with advisories.")
    parser.add_argument("database", type=Path, help="folder of OSV files, or a kept file")
    parser.add_argument("--keep", type=Path, help="write the advisories of these packages there")
    parser.add_argument("--root", type=Path, default=ROOT, help="folder of the lock files")
    given = parser.parse_args()
    packages = locked(given.root)
    entries = list(advisories(given.database, set(packages)))
    if given.keep:
        lines = ",\n".join(json.dumps(kept(one, set(packages))) for one in entries)
        given.keep.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    newest = max((str(one.get("modified", "")) for one in entries), default="never")
    found = faults(entries, packages)
    print(f"{len(packages)} packages, {len(entries)} advisories about them, last changed {newest}")
    if found:
        sys.exit("\n".join(found))


if __name__ == "__main__":
    main()
