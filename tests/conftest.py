"""Fixtures that several rooms' tests share."""

import os

# Before numpy is loaded, as the commands do: more BLAS threads make small matrices slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support import ROOT, Node


@pytest.fixture
def cut_log() -> Path:
    """A short cut-out of a simulated flight that comes with the tests."""
    return ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"


@pytest.fixture
def start_node() -> Iterator[Any]:
    """Starts nodes, and ends those that a test left."""
    nodes: list[Node] = []

    def start(*arguments: str) -> Node:
        nodes.append(Node(*arguments))
        return nodes[-1]

    yield start
    for node in nodes:
        if node.process.poll() is None:
            node.process.kill()
            node.process.communicate()
