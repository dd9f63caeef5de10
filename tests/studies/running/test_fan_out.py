"""Parallel work: real processes, and a real Dask cluster on loopback."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from support import HANG_S

from companion.cli.main import main
from companion.studies.running import fan_out

MEET = """
import pathlib, time
here = pathlib.Path({here!r})
(here / str(mine)).touch()
end = time.monotonic() + 30
while len(list(here.iterdir())) < 2 and time.monotonic() < end:
    time.sleep(0.01)  # until the other process is there
answer = len(list(here.iterdir()))
"""


def test_parallel_results_keep_the_input_order() -> None:
    """The first job takes by far the longest."""
    told: list[int] = []
    found = fan_out.on_cores(eval, ["(3 ** 2_000_000).bit_length()", "2", "3", "4"], 2, told.append)
    assert found == [3169926, 2, 3, 4]
    assert told == [1, 2, 3, 4]


def test_two_jobs_run_concurrently(tmp_path: Path) -> None:
    """Each job waits for the other: sequential jobs would not finish."""
    script, here = tmp_path / "meet.py", tmp_path / "here"
    here.mkdir()
    script.write_text(MEET.format(here=str(here)))
    asked = [f"__import__('runpy').run_path({str(script)!r}, {{'mine': {n}}})" for n in (1, 2)]
    assert fan_out.on_cores(eval, [f"{each}['answer']" for each in asked], 2, id) == [2, 2]


def test_workers_use_one_blas_thread_and_ignore_sigint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    found = fan_out.on_cores(os.getenv, fan_out.BLAS_THREADS, 2, id)
    assert found == ["1"] * len(fan_out.BLAS_THREADS)
    assert os.environ["OPENBLAS_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ
    assert fan_out.on_cores(signal.getsignal, [signal.SIGINT], 1, id) == [signal.SIG_IGN]


def blocked_signals(_number: int) -> list[int]:
    return sorted(signal.pthread_sigmask(signal.SIG_BLOCK, ()))


def test_workers_start_with_interrupts_held() -> None:
    """One that arrives while a worker starts would print its traceback; it may be ended later."""
    (blocked,) = fan_out.on_cores(blocked_signals, [0], 1, lambda _: None)
    assert signal.SIGALRM in blocked  # as the parent had it when it started the worker
    assert not {signal.SIGINT, signal.SIGTERM} & set(blocked)


def test_first_error_in_input_order_is_raised() -> None:
    asked = ["__import__('time').sleep(0.5) or int('first')", "int('second')", "1"]
    with pytest.raises(ValueError, match="'first'"):
        fan_out.on_cores(eval, asked, 2, id)


def test_error_cancels_the_remaining_jobs(tmp_path: Path) -> None:
    """Except jobs already sent to the process; no process keeps running."""
    touch = "__import__('time').sleep(0.05) or open({!r}, 'w').close()"
    rest = [touch.format(str(tmp_path / str(n))) for n in range(20)]
    with pytest.raises(ValueError, match="'x'"):
        fan_out.on_cores(eval, ["int('x')", *rest], 1, id)
    assert multiprocessing.active_children() == []
    assert len(list(tmp_path.iterdir())) < 10


@pytest.mark.full
def test_worker_error_is_a_one_line_error(cut_log: Path, tmp_path: Path) -> None:
    asked = ["study", "prediction", str(cut_log), str(tmp_path / "missing.tlog"), "--jobs", "2"]
    done = CliRunner().invoke(main, [*asked, "--center", "5:1", "--out", str(tmp_path)])
    assert done.exit_code == 1
    (line,) = done.stderr.splitlines()
    assert "missing.tlog" in line


# --- Dask ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A scheduler and two workers, each in its own process."""
    distributed = pytest.importorskip("distributed", reason="the extra [cluster] is not here")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
    ) as here:
        yield here


@pytest.mark.full
def test_cluster_result_equals_one_process(cluster: Any, cut_log: Path, tmp_path: Path) -> None:
    asked = ["study", "prediction", str(cut_log), "--center", "5:1", "--lead", "0.5", "--json"]
    answers = []
    for way in (["--jobs", "1"], ["--cluster", cluster.scheduler_address]):
        done = CliRunner().invoke(main, [*asked, *way, "--out", str(tmp_path)])
        assert done.exit_code == 0, done.stderr
        answers.append(json.loads(done.stdout))
    assert answers[0] == answers[1]


def test_cluster_keeps_the_order_and_raises_the_first_error(cluster: Any) -> None:
    address, told = cluster.scheduler_address, list[int]()
    asked = ["__import__('time').sleep(0.3) or 1", "2", "3"]
    assert fan_out.on_cluster(eval, asked, address, told.append) == [1, 2, 3]
    assert told == [1, 2, 3]
    asked = ["__import__('time').sleep(0.3) or int('first')", "int('second')", "1"]
    with pytest.raises(ValueError, match="'first'"):
        fan_out.on_cluster(eval, asked, address, id)
    # The cluster is shared: it is left unchanged.
    assert fan_out.on_cluster(len, ["abc"], address, id) == [3]
    pids = fan_out.on_cluster(eval, ["__import__('os').getpid()"] * 8, address, id)
    assert os.getpid() not in pids


@pytest.mark.parametrize("address", ["", "nonsense", "tcp://h", "tcp://h:port", "http://h:1"])
def test_invalid_scheduler_address_is_rejected(address: str) -> None:
    with pytest.raises(ValueError, match="not an address such as tcp://"):
        fan_out.on_cluster(len, ["abc"], address, id)


def test_unreachable_scheduler_is_reported() -> None:
    pytest.importorskip("distributed", reason="the extra [cluster] is not here")
    with pytest.raises(ValueError, match="no scheduler answers"):
        fan_out.on_cluster(len, ["abc"], "tcp://127.0.0.1:9", id, 0.3)


def test_scheduler_without_workers_is_reported() -> None:
    distributed = pytest.importorskip("distributed", reason="the extra [cluster] is not here")
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0") as empty,
        pytest.raises(ValueError, match="the scheduler has no workers"),
    ):
        fan_out.on_cluster(len, ["abc"], empty.scheduler_address, id, 0.3)


@pytest.mark.parametrize(
    ("package", "extra", "arguments"),
    [
        ("distributed", "cluster", ["prediction", "x.tlog", "--cluster", "tcp://h:1", "--out"]),
        ("torch", "learned", ["prediction", "x.tlog", "--learned", "y.pt", "--out"]),
        ("torch", "learned", ["train", "--out"]),
    ],
)
def test_missing_extra_names_the_package_to_install(
    package: str, extra: str, arguments: list[str], tmp_path: Path, cut_log: Path
) -> None:
    given = [str(cut_log) if word == "x.tlog" else word for word in arguments]
    words = ["study", *given, str(tmp_path / "out")]
    run = f"import sys; sys.modules[{package!r}] = None; from companion.cli.main import main; "
    run += f"main({words})"
    done = subprocess.run(
        [sys.executable, "-c", run], capture_output=True, text=True, check=False, timeout=HANG_S
    )
    assert done.returncode == 1
    line = done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert f"needs the package {package}: pip install 'uav-companion-beams[{extra}]'" in line


def test_torch_and_dask_are_not_imported_unless_used() -> None:
    run = (
        "import sys, companion.cli.main, companion.studies.prediction.comparison;"
        "import companion.studies.running.fan_out;"
        "sys.exit(bool({'torch', 'distributed', 'dask'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", run], check=False, timeout=HANG_S).returncode == 0
