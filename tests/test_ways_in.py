"""Every way into the service has a budget, and a test that exhausts it."""

import subprocess
import sys
from typing import get_args

import pytest
from support import HANG_S, ROOT

from companion.mavlink.links.urls import Scheme
from companion.recording.foreign.kinds import Piecewise

sys.path.insert(0, str(ROOT / "docs"))
import make_api
from make_security import WAYS

COVERED = [one for way in WAYS for one in way.covers]


def covered(kind: str) -> set[str]:
    return {one.partition(":")[2] for one in COVERED if one.startswith(f"{kind}:")}


def test_each_way_in_has_one_row() -> None:
    assert len(COVERED) == len(set(COVERED))


def test_every_link_scheme_has_a_budget() -> None:
    assert {one.partition(":")[0] for one in covered("link")} == set(get_args(Scheme))


def test_every_route_has_a_budget() -> None:
    assert covered("route") == set(make_api.document()["paths"]) | {"/v1/stream"}


def test_every_kind_of_log_has_a_budget() -> None:
    assert covered("file") >= set(get_args(Piecewise)) | {"mcap", "tlog", "csv"}


def test_every_device_has_a_budget() -> None:
    files = {path.stem for path in (ROOT / "companion" / "node" / "drive").glob("*.py")}
    assert covered("device") <= files


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.name)
def test_the_test_of_a_budget_exists(way: object) -> None:
    file, _, name = way.test.partition("::")  # type: ignore[attr-defined]
    text = (ROOT / file).read_text(encoding="utf-8")
    assert not name or f"def {name}(" in text


def test_table_in_the_documentation_is_current() -> None:
    command = [sys.executable, "docs/make_security.py", "--check"]
    assert subprocess.run(command, cwd=ROOT, check=False, timeout=HANG_S).returncode == 0, (
        "run `python docs/make_security.py`"
    )
