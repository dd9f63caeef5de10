"""Writes what the image redistributes: NOTICE for people, sbom.cdx.json (CycloneDX) for programs.

    python docs/make_notice.py           write both
    python docs/make_notice.py --check   fail where they differ

Packages, versions and checksums are those of requirements.lock; a package has one checksum for each
of its files, any of which may be installed. Licences are those that the installed packages state.
Base images are those of the Dockerfile, and the page's files those of web/vendor/README.md. The
bill of materials also lists what only builds the image, with the scope "excluded"; NOTICE does not.
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
FINAL_IMAGE: Final = "BASE"
"""Argument of the Dockerfile that names the image's own base; other images only build it."""
IMAGE_LICENCE: Final = "PSF-2.0 for Python; /usr/share/doc of the image for Debian's packages"
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
CLASSIFIERS: Final = {
    "MIT License": "MIT",
    "Apache Software License": "Apache-2.0",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
}
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
    """A package or an image, with the SHA-256 of each file that it may be."""

    name: str
    version: str
    licence: str
    checksums: tuple[str, ...]
    purl: str
    kind: str = "library"
    builds_only: bool = False


def packages() -> list[Part]:
    """The locked packages."""
    found = []
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    for entry in re.split(r"^(?=[a-z0-9])", text, flags=re.MULTILINE)[1:]:
        name, version = re.findall(r"^([a-z0-9._-]+)==(\S+)", entry)[0]
        part = Part(
            name=name,
            version=version,
            licence=licence(name),
            checksums=tuple(re.findall(r"--hash=sha256:(\w+)", entry)),
            purl=f"pkg:pypi/{name}@{version}",
            builds_only=name in TAKEN_AWAY,
        )
        found.append(part)
    return found


def images() -> list[Part]:
    """The base images of the Dockerfile."""
    found = []
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    row = re.compile(r"^ARG (\w+)=([a-z/]+):(\S+)@sha256:(\w+)$", re.MULTILINE)
    for argument, name, tag, digest in row.findall(text):
        part = Part(
            name=name,
            version=tag,
            licence=IMAGE_LICENCE,
            checksums=(digest,),
            purl=f"pkg:oci/{name}@sha256%3A{digest}?tag={tag}",
            kind="container",
            builds_only=argument != FINAL_IMAGE,
        )
        found.append(part)
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
    """The packages whose files the page contains."""
    found: dict[str, Part] = {}
    row = re.compile(
        r"\| `([^`]+)` \| npm package `([^`]+)`[^|]*\| ([^|]+) \| ([^|]+) \| `(\w+)` \|"
    )
    text = (ROOT / "web" / "vendor" / "README.md").read_text(encoding="utf-8")
    for file, package, version, stated, checksum in row.findall(text):
        if not re.search(r"LICENSE|NOTICE", file):
            before = found[package].checksums if package in found else ()
            found[package] = Part(
                name=package,
                version=version.strip(),
                licence=stated.strip(),
                checksums=(*before, checksum),
                purl=f"pkg:npm/{package}@{version.strip()}",
            )
    return list(found.values())


def notice(parts: list[Part]) -> str:
    """The text of NOTICE."""
    lines = [
        f"  {one.name} {one.version}: {one.licence}"
        for one in parts
        if one.kind == "library" and not one.builds_only
    ]
    return HEAD + "\n" + "\n".join(lines) + "\n"


def sbom(parts: list[Part]) -> str:
    """The bill of materials, CycloneDX 1.5; each checksum on a line of its own."""
    code = (ROOT / "companion" / "__init__.py").read_text(encoding="utf-8")
    own = {
        "type": "application",
        "name": "uav-companion-beams",
        "version": re.findall(r'^__version__ = "(.*)"', code, re.MULTILINE)[0],
        "licenses": licences("Apache-2.0"),
    }
    content = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": own},
        "components": [component(one) for one in parts],
    }
    text = json.dumps(content, indent=1)
    return re.sub(r'\{\s+("alg": "SHA-256"),\s+("content": "\w+")\s+\}', r"{\1, \2}", text) + "\n"


def component(part: Part) -> dict[str, Any]:
    """A part as CycloneDX describes it."""
    return {
        "type": part.kind,
        "name": part.name,
        "version": part.version,
        "scope": "excluded" if part.builds_only else "required",
        "hashes": [{"alg": "SHA-256", "content": one} for one in part.checksums],
        "licenses": licences(part.licence),
        "purl": part.purl,
    }


def licences(stated: str) -> list[dict[str, Any]]:
    """A licence as CycloneDX states it: an SPDX identifier, an SPDX expression, or words."""
    if re.fullmatch(r"[\w.+-]+", stated):
        return [{"license": {"id": stated}}]
    if re.search(r" (AND|OR|WITH) ", stated):
        return [{"expression": stated}]
    return [{"license": {"name": stated}}]


def main() -> None:
    """Write both files, or compare them."""
    parts = [*packages(), *vendored(), *images()]
    made = {ROOT / "NOTICE": notice(parts), ROOT / "docs" / "sbom.cdx.json": sbom(parts)}
    for path, text in made.items():
        if "--check" not in sys.argv:
            path.write_text(text, encoding="utf-8")
        elif not path.exists() or path.read_text(encoding="utf-8") != text:
            sys.exit(f"{path.relative_to(ROOT)} is out of date: python docs/make_notice.py")


if __name__ == "__main__":
    main()
