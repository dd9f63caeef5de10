"""Fixtures that several rooms' tests share."""

import faulthandler
import fcntl
import gc
import hashlib
import os
import subprocess

# Before numpy is loaded, as the commands do: more BLAS threads make small matrices slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from collected_texts import CollectedTexts, collect
from figures import FILE, Figures
from hypothesis import settings
from soak_table import table  # noqa: F401 - a fixture
from support import BIN, HANG_S, ROOT, Node, dummy_rotator, end

# How fast this machine is, and what else it does, is no property of the code: no deadlines.
settings.register_profile("quick", deadline=None, max_examples=25)
settings.register_profile("full", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))

ALONE = (
    "tests/browser/", "tests/live/", "tests/node/", "tests/test_readme.py", "tests/test_client.py",
    "tests/test_deployment.py", "tests/test_confinement.py", "tests/test_acceptance.py",
    "tests/server/test_stream_load.py", "tests/server/test_ghosts.py",
    "tests/recording/test_background.py", "tests/recording/test_foxglove.py",
)  # fmt: skip
"""Tests that start services: one after the other, beside those of the pure rooms."""
FULL = ("tests/live/", "tests/browser/test_reports.py", "tests/studies/paper/test_experiments.py")
"""Left to `make test-all`, all of them."""


@pytest.hookimpl(tryfirst=True)  # xdist reads the groups in this very hook
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Which tests share a worker of xdist: services one at a time, and what a study has made."""
    for item in items:
        if item.nodeid.startswith(FULL):
            item.add_marker(pytest.mark.full)
        if item.nodeid.startswith(ALONE):
            item.add_marker(pytest.mark.xdist_group("alone"))
        elif item.nodeid.startswith("tests/studies/"):
            item.add_marker(pytest.mark.xdist_group("studies"))
        else:  # what a file's tests share is made once
            item.add_marker(pytest.mark.xdist_group(item.nodeid.partition("::")[0]))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[object]:
    """What is there before the first test stays to the end: the garbage collector looks at what
    the tests make alone. Over everything that is imported and collected, one look takes longer
    than most tests."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


# --- the last resort against a test that hangs ---------------------------------------------------

LAST_RESORT_S = 120.0
"""How much longer than its limit a test takes before its process is ended."""
STDERR = pytest.StashKey[int]()
"""Where the process writes its errors, whatever is captured."""


FIGURES = pytest.StashKey[Figures]()
TEXTS = pytest.StashKey[CollectedTexts]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[STDERR] = os.dup(2)
    config.stash[FIGURES] = Figures()
    config.stash[TEXTS] = collect()


def pytest_unconfigure(config: pytest.Config) -> None:
    gc.unfreeze()  # else what is there goes in any order, and extensions complain
    os.close(config.stash[STDERR])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """pytest-timeout raises an exception in the test, once. uvloop does not handle its signal,
    Hypothesis takes the exception for a bad example and runs that again, and what cleans up after
    it may wait as well. Then the process shows where it is and ends: the test has failed, and xdist
    starts another for the rest."""
    _watch(item)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


@pytest.hookimpl(trylast=True)
def pytest_exception_interact(node: pytest.Item | pytest.Collector) -> None:
    """After a failure pytest and pytest-timeout no longer watch, though the teardown is to come."""
    if isinstance(node, pytest.Item):
        _watch(node)


def _watch(item: pytest.Item) -> None:
    marker = item.get_closest_marker("timeout")
    given = marker.args[0] if marker else item.config.getoption("timeout")
    limit_s = float(item.config.getini("timeout") if given is None else given)
    if limit_s > 0:
        seconds, file = limit_s + LAST_RESORT_S, item.config.stash[STDERR]
        faulthandler.dump_traceback_later(seconds, exit=True, file=file)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Errors, notices and details that a test caused keep the rules for such texts."""
    faults = item.config.stash[TEXTS].faults()
    assert not faults or os.environ.get("COLLECT_TEXTS"), "\n".join(faults)


# --- fixtures -----------------------------------------------------------------------------------

SHORT_BYTES = 100_000
"""Of ``short_log``: some 5 s."""


@pytest.fixture(scope="session")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """``studied("paper")``: where ``companion study paper`` has written everything. A command is
    run once a session, whoever asks."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    (shared / "studies").mkdir(exist_ok=True)

    def study(*words: str) -> Path:
        out = shared / "studies" / hashlib.sha256(repr(words).encode()).hexdigest()[:16]
        with out.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # another worker may be making it
            if not out.exists():
                half = out.with_suffix(".half")
                command = [BIN / "companion", "study", *words, "--out", half]
                done = subprocess.run(
                    command, capture_output=True, text=True, check=False, timeout=HANG_S
                )
                # A bound that was broken is a result as well, and all is written.
                assert done.returncode in (0, 3), done.stderr
                half.rename(out)
        return out

    return study


@pytest.fixture(scope="session")
def figures(pytestconfig: pytest.Config) -> Figures:
    """Where benchmarks put what they found."""
    return pytestconfig.stash[FIGURES]


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """What benchmarks found, and what is not as it was."""
    found = config.stash[FIGURES]
    if found.found:
        terminalreporter.section(f"figures: {FILE}")
        for line in found.write():
            terminalreporter.write_line(line)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A real file system of 20 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounting = ["mount", "-t", "tmpfs", "-o", "size=20m", "none", folder]
    try:
        subprocess.run(mounting, check=True, capture_output=True, timeout=HANG_S)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no file system can be mounted here")
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True, timeout=HANG_S)


@pytest.fixture
def cut_log() -> Path:
    """A short cut-out of a simulated flight that comes with the tests."""
    return ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"


@pytest.fixture(scope="session")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its first seconds, for what does not depend on how long it is; the last frame is torn."""
    log = tmp_path_factory.mktemp("logs") / "short.tlog"
    cut = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    log.write_bytes(cut.read_bytes()[:SHORT_BYTES])
    return log


@pytest.fixture
def aeroplane() -> Path:
    """20 s of an aeroplane's own DataFlash log, truth included, that come with the tests."""
    return ROOT / "tests" / "data" / "sitl_planes_cut_1.bin"


@pytest.fixture
def carrier() -> Path:
    """The same of the copter that it circles."""
    return ROOT / "tests" / "data" / "sitl_planes_cut_5.bin"


@pytest.fixture
def rotctld() -> Iterator[int]:
    """Port of hamlib's rotctld with its dummy rotator."""
    with dummy_rotator() as port:
        yield port


@pytest.fixture
def start_node() -> Iterator[Any]:
    """Starts nodes, and ends those that a test left."""
    nodes: list[Node] = []

    def start(*arguments: str, code: str | None = None) -> Node:
        nodes.append(Node(*arguments, code=code))
        return nodes[-1]

    yield start
    for node in nodes:
        end(node.process)


@pytest.fixture
def full_pipe() -> Iterator[int]:
    """The writing side of a pipe that takes nothing more, since its reader is stopped."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    with suppress(BlockingIOError):
        while True:
            os.write(write, bytes(4096))
    os.set_blocking(write, True)
    yield write
    os.close(write)
    os.close(read)
