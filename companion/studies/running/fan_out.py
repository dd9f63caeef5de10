"""Parallel execution of one function over many items: on local cores, or on a Dask cluster.

Results are in the order of the items, so that a parallel run gives the same result as a serial one.
The first error in that order is raised, and pending items are cancelled. Processes are started
fresh ("spawn"), with one BLAS thread each: more threads than cores would slow each other down.

Dask: ``distributed.Client``, its documentation; the extra ``[cluster]``. Its workers limit
themselves to one BLAS thread (``distributed.nanny.pre-spawn-environ``), and must have this package
and access to the named files.
"""

import multiprocessing
import os
import re
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any, Final, TypeVar

from companion.node.signals import ENDS, interrupts_held
from companion.values import UserError
from companion.values.extras import needs

Asked = TypeVar("Asked")
Answer = TypeVar("Answer")
Progress = Callable[[int], None]  # called with the number of finished pieces

CLUSTER_ANSWERS_S: Final = 10
ADDRESS: Final = re.compile(r"(tcp|tls)://([\w.-]+|\[[0-9a-fA-F:.]+\]):\d{1,5}")
BLAS_THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_cores(
    work: Callable[[Asked], Answer], asked: Sequence[Asked], jobs: int, told: Progress
) -> list[Answer]:
    """Return the results of ``jobs`` processes; ``work`` must be a module's function."""
    count = min(jobs, len(asked))
    context = multiprocessing.get_context("spawn")
    with (
        _one_blas_thread(),
        ProcessPoolExecutor(count, mp_context=context, initializer=_left_to_parent) as pool,
    ):
        try:
            with interrupts_held():  # each call may start a worker, which an interrupt would break
                futures = [pool.submit(work, each) for each in asked]
            return _gathered(futures, told)
        except KeyboardInterrupt:
            for child in multiprocessing.active_children():
                child.terminate()  # its result is of no use
            raise
        except BaseException:
            # Wait here: the second call, by ``with``, would revoke the cancellation.
            pool.shutdown(cancel_futures=True)
            raise


def _gathered(futures: "Sequence[Future[Answer]]", told: Progress) -> list[Answer]:
    """Return the results in order; raise the first error in order as soon as it is known."""
    first = 0
    for done, _ in enumerate(as_completed(futures), start=1):
        told(done)
        while first < len(futures) and futures[first].done():
            futures[first].result()
            first += 1
    return [future.result() for future in futures]


def _left_to_parent() -> None:
    """Ignore Ctrl-C in a worker: a terminal sends it to every process, the parent handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDS)


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in BLAS_THREADS}
    os.environ.update(dict.fromkeys(BLAS_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def on_cluster(
    work: Callable[[Asked], Answer],
    asked: Sequence[Asked],
    address: str,
    told: Progress,
    answers_s: float = CLUSTER_ANSWERS_S,
) -> list[Answer]:
    """Return the results of the workers of the Dask scheduler at an address.

    Raises ``UserError`` if the address is malformed, ``distributed`` is not installed, or no worker
    appears within ``answers_s``.
    """
    # With an address that it cannot parse, the client would leave a thread running.
    if not ADDRESS.fullmatch(address):
        raise UserError(f"--cluster {address}: not an address such as tcp://HOST:8786")
    with needs("distributed", "cluster", "--cluster"):
        import distributed
    dask: Any = distributed  # typed in part
    try:
        client = dask.Client(address, timeout=answers_s, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UserError(f"--cluster {address}: no scheduler answers: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=answers_s)
        except TimeoutError as error:
            raise UserError(f"--cluster {address}: the scheduler has no workers") from error
        # Not pure: the files may change between calls.
        futures = client.map(work, asked, pure=False, retries=0)
        try:
            for done, _ in enumerate(dask.as_completed(futures, loop=client.loop), start=1):
                told(done)
                wrong = [future for future in futures if future.status == "error"]
                if wrong and all(future.done() for future in futures[: futures.index(wrong[0])]):
                    wrong[0].result()
            return [future.result() for future in futures]
        finally:
            client.cancel(futures)
