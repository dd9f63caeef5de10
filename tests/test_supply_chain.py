"""What the image is built from: the bill of materials, and advisories about locked packages."""

import json
import re
from typing import Any

import pytest
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from license_expression import get_spdx_licensing
from packageurl import PackageURL
from support import ROOT

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
