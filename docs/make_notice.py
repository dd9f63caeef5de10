"""Writes what the image redistributes: NOTICE for people, sbom.cdx.json (CycloneDX) for programs.

    python docs/make_notice.py           write both
    python docs/make_notice.py --check   fail where they differ

Packages and versions are those of requirements.lock, which holds the checksums of every wheel that
each may be; licences are what the installed
packages say of themselves. The page's vendored files are in the tables of their READMEs.
"""

import json
import re
import sys
from importlib import metadata
from pathlib import Path
from typing import Any, Final, NamedTuple

ROOT: Final = Path(__file__).parents[1]
TAKEN_AWAY: Final = frozenset(
    ("editables", "hatchling", "pathspec", "pluggy", "setuptools", "trove-classifiers")
)
"""Packages that the Dockerfile removes once the image is built."""
SAID: Final = {
    "clarabel": "Apache-2.0",
    "contourpy": "BSD-3-Clause",
    "cycler": "BSD-3-Clause",
    "fonttools": "MIT",
    "jinja2": "BSD-3-Clause",
    "kiwisolver": "BSD-3-Clause",
    "lxml": "BSD-3-Clause",
    "matplotlib": "PSF-based (matplotlib 1.3.0 and later)",
    "protobuf": "BSD-3-Clause",
    "pymap3d": "BSD-2-Clause",
    "pymavlink": "LGPL-3.0-only",
    "pyserial": "BSD-3-Clause",
    "qdldl": "Apache-2.0",
    "scipy": "BSD-3-Clause",
    "tzdata": "Apache-2.0",
    "uvloop": "MIT OR Apache-2.0",
    "cloudpickle": "BSD-3-Clause",
    "lz4": "BSD-3-Clause",
}
"""Licences of packages that state theirs in words only."""
CLASSIFIERS: Final = {"MIT License": "MIT", "Apache Software License": "Apache-2.0"}
HEAD: Final = """uav-companion-beams
Copyright of its authors; licensed under the Apache License, Version 2.0 (LICENSE).

The image and the wheel bring work of others. Each Python package keeps its own licence text, in the
folder of its name and version beside its code (*.dist-info); each file of the page has its licence
beside it (web/vendor). pymavlink is used as a library that can be replaced: it lies in the image as
the package that its authors publish, and its source is published with it.

The base image adds Debian and Python, whose licences it has in /usr/share/doc and
/usr/local/lib/python3.11/LICENSE.txt.
"""


class Part(NamedTuple):
    """Something that is redistributed; its SHA-256, where it is one file."""

    name: str
    version: str
    licence: str
    checksum: str | None
    kind: str


def packages() -> list[Part]:
    """The locked packages that stay in the image."""
    found = []
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    for name, version in re.findall(r"^([a-z0-9._-]+)==(\S+)", text, re.MULTILINE):
        if name not in TAKEN_AWAY:
            found.append(
                Part(name=name, version=version, licence=licence(name), checksum=None, kind="pypi")
            )
    return found


def licence(package: str) -> str:
    """The licence that an installed package states. Raises ``KeyError`` where it states none."""
    if package in SAID:
        return SAID[package]
    stated = metadata.metadata(package)
    if expression := stated.get("License-Expression"):
        return str(expression)
    for line in stated.get_all("Classifier") or []:
        if line.startswith("License ::"):
            return CLASSIFIERS[line.split(" :: ")[-1]]
    raise KeyError(package)


def vendored() -> list[Part]:
    """The files of others that the page and the documents bring."""
    found = []
    row = re.compile(
        r"\| `([^`]+)` \| npm package `([^`]+)`[^|]*\| ([^|]+) \| ([^|]+) \| `(\w+)` \|"
    )
    text = (ROOT / "web" / "vendor" / "README.md").read_text(encoding="utf-8")
    for file, package, version, said, checksum in row.findall(text):
        if not re.search(r"LICENSE|NOTICE", file):
            part = Part(
                name=package,
                version=version.strip(),
                licence=said.strip(),
                checksum=checksum,
                kind="npm",
            )
            found.append(part)
    return found


def notice(parts: list[Part]) -> str:
    """The text of NOTICE."""
    lines = dict.fromkeys(f"  {one.name} {one.version}: {one.licence}" for one in parts)
    return HEAD + "\n" + "\n".join(lines) + "\n"


def sbom(parts: list[Part]) -> dict[str, Any]:
    """The bill of materials, CycloneDX 1.5."""
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": {"type": "application", "name": "uav-companion-beams"}},
        "components": [
            {
                "type": "library",
                "name": one.name,
                "version": one.version,
                "purl": f"pkg:{one.kind}/{one.name}@{one.version}",
                "licenses": [{"license": {"name": one.licence}}],
            }
            | ({} if one.checksum is None else {"hashes": [_hash(one.checksum)]})
            for one in parts
        ],
    }


def _hash(checksum: str) -> dict[str, str]:
    return {"alg": "SHA-256", "content": checksum}


def main() -> None:
    """Write both files, or compare them."""
    parts = [*packages(), *vendored()]
    made = {
        ROOT / "NOTICE": notice(parts),
        ROOT / "docs" / "sbom.cdx.json": json.dumps(sbom(parts), indent=1) + "\n",
    }
    for path, text in made.items():
        if "--check" not in sys.argv:
            path.write_text(text, encoding="utf-8")
        elif not path.exists() or path.read_text(encoding="utf-8") != text:
            sys.exit(f"{path.relative_to(ROOT)} is out of date: python docs/make_notice.py")


if __name__ == "__main__":
    main()
