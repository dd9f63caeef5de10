"""What the image is built from: the bill of materials, and advisories about locked packages."""

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from license_expression import get_spdx_licensing
from packageurl import PackageURL
from support import HANG_S, ROOT, shared_log

SBOM = (ROOT / "docs" / "sbom.cdx.json").read_text(encoding="utf-8")
COMPONENTS = json.loads(SBOM)["components"]
BUILD_TOOLS = {"editables", "hatchling", "pathspec", "pluggy", "setuptools", "trove-classifiers"}


def valid(bill: str) -> bool:
    """Return whether a bill of materials matches the schema of CycloneDX 1.5."""
    return JsonStrictValidator(SchemaVersion.V1_5).validate_str(bill) is None


def digests(component: dict[str, Any]) -> list[str]:
    """Return the checksums of a component."""
    return [one["content"] for one in component["hashes"]]


def test_bill_of_materials_matches_its_schema() -> None:
    assert valid(SBOM)
    assert not valid(SBOM.replace('"id": "MIT"', '"id": "MIT or so"', 1))
    assert not valid(SBOM.replace('"SHA-256", "content": "', '"SHA-256", "content": "x', 1))


def test_bill_of_materials_has_every_locked_package() -> None:
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    locked = {
        name: (version, re.findall(r"sha256:(\w{64})", hashes))
        for name, version, hashes in re.findall(
            r"^([a-z0-9._-]+)==(\S+)((?:.*\\\n)+.*)", lock, re.MULTILINE
        )
    }
    assert len(locked) == len(re.findall(r"^[a-z]", lock, re.MULTILINE))
    listed = {
        one["name"]: (one["version"], digests(one))
        for one in COMPONENTS
        if one["purl"].startswith("pkg:pypi/")
    }
    assert listed == locked
    assert all(hashes for _, hashes in listed.values())


def test_bill_of_materials_has_both_base_images() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    given = re.findall(r"^ARG \w+=(\w+):(\S+)@sha256:(\w+)$", dockerfile, re.MULTILINE)
    images = [one for one in COMPONENTS if one["type"] == "container"]
    assert [(one["name"], one["version"], *digests(one)) for one in images] == given
    assert [one["scope"] for one in images] == ["required", "excluded"]


@pytest.mark.parametrize("component", COMPONENTS, ids=lambda one: f"{one['name']}-{one['type']}")
def test_component_has_address_licence_and_scope(component: dict[str, Any]) -> None:
    address = PackageURL.from_string(component["purl"])
    assert address.name == component["name"]
    if component["type"] == "container":
        assert address.version == f"sha256:{digests(component)[0]}"
        assert address.qualifiers == {"tag": component["version"]}
    else:
        assert address.version == component["version"]
        assert (component["scope"] == "excluded") == (component["name"] in BUILD_TOOLS)
    (licence,) = component["licenses"]
    if "expression" in licence:
        assert get_spdx_licensing().validate(licence["expression"]).errors == []


ADVISORIES = ROOT / "docs" / "check_advisories.py"


def check_advisories(database: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Compare the locked packages with a database."""
    command = [sys.executable, ADVISORIES, database, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANG_S)


def advisory(number: int, name: str, ecosystem: str = "PyPI", **affected: Any) -> dict[str, Any]:
    """Return an advisory in the OSV format."""
    package = {"ecosystem": ecosystem, "name": name}
    return {
        "id": f"TEST-{number}",
        "aliases": [f"CVE-{number}"],
        "modified": "2026-01-01T00:00:00Z",
        "affected": [{"package": package, **affected}],
    }


def between(*events: tuple[str, str], kind: str = "ECOSYSTEM") -> dict[str, Any]:
    """Return what an advisory says of a range of versions."""
    return {"ranges": [{"type": kind, "events": [dict([event]) for event in events]}]}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Lock files with two packages, and a bill of materials with one of the page."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "requirements.lock").write_text("some-package==2.3 \\\n", encoding="utf-8")
    lock = "some-package==2.3 \\\ntool==1.10 ; sys_platform != 'win32' \\\n"
    (tmp_path / "requirements-dev.lock").write_text(lock, encoding="utf-8")
    page = {"purl": "pkg:npm/chart@1.6.32", "name": "chart", "version": "1.6.32"}
    bill = json.dumps({"components": [page]})
    (tmp_path / "docs" / "sbom.cdx.json").write_text(bill, encoding="utf-8")
    return tmp_path


def test_affected_versions_are_reported_offline(root: Path) -> None:
    """From JSON and YAML; of other packages, other versions and withdrawn advisories, nothing."""
    database = root / "database"
    database.mkdir()
    since_2 = between(("introduced", "2.0"))
    entries = [
        advisory(1, "Some_Package", **since_2),
        advisory(2, "tool", **between(("introduced", "0"), ("fixed", "1.9"))),
        advisory(3, "chart", "npm", **between(("introduced", "0"), kind="SEMVER")),
        advisory(4, "chart", **since_2),  # of another ecosystem
        advisory(5, "another", **since_2),
        advisory(6, "some-package", **since_2) | {"withdrawn": "2026-02-01T00:00:00Z"},
    ]
    for entry in entries:
        path = database / f"{entry['id']}.json"
        path.write_text(json.dumps(entry), encoding="utf-8")
    text = (
        "id: TEST-7\nmodified: 2026-03-01T00:00:00Z\naffected:\n"
        "- package: {ecosystem: PyPI, name: tool}\n  versions: ['1.9', '1.10']\n"
    )
    (database / "TEST-7.yaml").write_text(text, encoding="utf-8")
    file = root / "kept.json"
    done = check_advisories(database, "--root", str(root), "--keep", str(file))
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "some-package 2.3 is affected by TEST-1, CVE-1",
        "chart 1.6.32 is affected by TEST-3, CVE-3",
        "tool 1.10 is affected by TEST-7",
    ]
    assert done.stdout == (
        "3 packages, 4 advisories about them, last changed 2026-03-01T00:00:00Z\n"
    )
    again = check_advisories(file, "--root", str(root))
    assert (again.returncode, again.stdout, again.stderr) == (1, done.stdout, done.stderr)


@pytest.mark.parametrize(
    ("version", "affected", "expected"),
    [
        ("1.0", between(("introduced", "0"), ("fixed", "1.0")), False),
        ("1.0rc1", between(("introduced", "0"), ("fixed", "1.0")), True),
        ("1.0", between(("introduced", "0"), ("last_affected", "1.0")), True),
        ("1.0.post1", between(("introduced", "0"), ("last_affected", "1.0")), False),
        ("1.10", between(("introduced", "1.2"), ("fixed", "1.9"), ("introduced", "1.10")), True),
        ("1.9", between(("introduced", "1.10"), ("introduced", "1.2"), ("fixed", "1.9")), False),
        ("1.0", between(("introduced", "0"), kind="GIT"), False),
        ("1.0", between(("introduced", "0"), ("fixed", "no version")), True),
        ("1.0", {"versions": ["1.0"]}, True),
        ("1.0", {}, False),
    ],
)
def test_version_ranges_follow_osv(version: str, affected: dict[str, Any], expected: bool) -> None:
    assert module().affects(affected, version) is expected


def test_accepted_advisories_are_not_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    checks = module()
    package = checks.Package("PyPI", "tool")
    entry = advisory(1, "tool", versions=["1.0"])
    assert len(checks.faults([entry], {package: {"1.0"}})) == 1
    monkeypatch.setitem(checks.ACCEPTED, "CVE-1", "the function is not called")
    assert checks.faults([entry], {package: {"1.0"}}) == []


def test_accepted_advisories_have_a_reason() -> None:
    assert all(len(reason.split()) > 3 for reason in module().ACCEPTED.values())


def test_locked_versions_have_no_known_advisory() -> None:
    done = check_advisories(shared_log("advisories.json"))
    assert done.returncode == 0, done.stderr


def module() -> Any:
    """Load the script as a module."""
    spec = importlib.util.spec_from_file_location("check_advisories", ADVISORIES)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded
