"""Vendored files of the page and its tests match their published checksums."""

import hashlib
import re
from pathlib import Path

from support import ROOT

VENDOR = ROOT / "web" / "vendor"
FOLDERS = (VENDOR, ROOT / "docs" / "vendor", Path(__file__).parent / "vendor")
ROW = re.compile(r"^\| `(?P<file>[^`]+)` \|.*\| (?P<version>[\d.]+) \| (?P<licence>[\w.-]+) \| "
                 r"`(?P<sha256>[0-9a-f]{64})` \|$", re.MULTILINE)  # fmt: skip


def faults(folder: Path) -> list[str]:
    """Return files that differ from the folder's table or are missing on either side."""
    told = {row["file"]: row["sha256"] for row in ROW.finditer((folder / "README.md").read_text())}
    found = {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.iterdir()
        if path.name != "README.md"
    }
    return sorted(name for name in told | found if told.get(name) != found.get(name))


def test_every_vendored_file_matches_its_checksum() -> None:
    for folder in FOLDERS:
        assert faults(folder) == []
        assert len(list(folder.iterdir())) > 1


def test_changed_missing_and_unlisted_files_are_detected(tmp_path: Path) -> None:
    for path in VENDOR.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "uPlot.min.css").write_bytes(b"changed")
    (tmp_path / "uPlot.LICENSE").unlink()
    (tmp_path / "other.js").write_bytes(b"")
    assert faults(tmp_path) == ["other.js", "uPlot.LICENSE", "uPlot.min.css"]
