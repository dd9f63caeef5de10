"""The page's modules under node without a browser: ``node:test`` only.

Each ``*.test.mjs`` runs the modules on a recording canvas and in virtual time. ``WEB_ROOT=DIR``
takes the modules from another directory than ``web``.
"""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from support import HANG_S, ROOT

from companion.server.responses import encode
from companion.values import UtcNs
from companion.values.described import members
from companion.views.as_json import FORMER_NAMES, as_json
from companion.views.labels import labels as made_labels
from companion.views.uav_state import UavState

HERE = Path(__file__).parent
OLDEST = (20, 6)
"""First version of node whose loader can treat the page's files as modules."""


def node() -> str:
    """Return a suitable node; skip if there is none."""
    found = shutil.which("node")
    if found is None:
        pytest.skip("no node: install Node.js to test the page's modules")
    said = subprocess.run(
        [found, "--version"], capture_output=True, text=True, check=True, timeout=HANG_S
    ).stdout
    version = tuple(int(part) for part in re.findall(r"\d+", said)[:2])
    if version < OLDEST:
        pytest.skip(f"node {said.strip()} is too old for the page's modules: 20.6 or later")
    return found


@pytest.mark.timeout(600)  # for a hanging test
def test_page_module_tests_pass(tmp_path: Path) -> None:
    tests = sorted(HERE.glob("*.test.mjs"))
    assert tests
    # In one process: `node --test` starts one per file, which takes longer than the tests.
    everything = tmp_path / "all.mjs"
    everything.write_text("".join(f"await import({json.dumps(one.as_uri())});\n" for one in tests))
    labels = tmp_path / "labels.json"
    labels.write_bytes(encode(as_json(made_labels(), UtcNs)))
    done = subprocess.run(
        [node(), "--test-reporter=spec", str(everything)],
        env=os.environ | {"LABELS": str(labels)},
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=580,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_page_uses_no_deprecated_names() -> None:
    """They are removed in the next version."""
    old = {name for names in FORMER_NAMES.values() for name in names} - {"source"}
    old |= {member.name for member in members(UavState) if member.meaning.deprecated}
    used = " ".join(file.read_text("utf-8") for file in (ROOT / "web").glob("*.js"))
    assert not [name for name in old if re.search(rf"\b{name}\b", used)]
