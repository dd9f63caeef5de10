"""Samples of a whole recording for the page, computed by a process of its own.

    python -m companion.node.recorded_history RECORDING

The recording is replayed as fast as possible at the lowest priority. Each line of the output is one
JSON object: the progress (``at_s``, ``of_s``), at last the samples as ``/v1/history`` has them, or
``problem`` if the recording cannot be read. The process ends when its standard input is closed, so
that it does not outlive the service.
"""

import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import orjson

from companion.node.replay import Run, layers_for, length_s, log_events
from companion.values import Update, UserError
from companion.views import series
from companion.views.as_json import Json
from companion.views.series import Sample

OPTIONS: Final = orjson.OPT_APPEND_NEWLINE | orjson.OPT_SERIALIZE_NUMPY
PROGRESS_EVERY_S: Final = 0.5
UAV_SAMPLES_MAX: Final = 36_000
"""Limit on samples times UAVs, some 5 MB of JSON; a longer recording is sampled more rarely."""


def lines(recording: Path) -> Iterator[Json]:
    """Yield the progress of a replay, and its samples. Raises ``UserError`` or ``OSError``."""
    settings, _ = layers_for([recording], None, None)
    of_s = length_s([recording])
    run = Run(settings, None)
    samples, every_ns, due_s = list[Sample](), series.EVERY_NS, time.monotonic()
    newest_ns = count = 0  # count of samples, times UAVs
    for event in log_events([recording], settings):
        newest_ns = max(newest_ns, event.t_ns)
        for output in run.step(event):
            if not isinstance(output, Update):
                continue
            if samples and output.t_ns - samples[-1][0] < every_ns:
                continue
            samples.append((output.t_ns, series.moment(run.pipeline, output)))
            count += len(samples[-1][1].uavs)
            if count > UAV_SAMPLES_MAX:
                samples, every_ns = samples[::2], 2 * every_ns
                count = sum(len(one.uavs) for _, one in samples)
        if time.monotonic() >= due_s:
            due_s = time.monotonic() + PROGRESS_EVERY_S
            yield {"at_s": run.at_s, "of_s": of_s}
    yield series.show(samples, newest_ns, run.pipeline.utc_ns, is_rounded=True)


def _end_with_input() -> None:
    sys.stdin.buffer.read()
    os._exit(1)


def main() -> None:
    """Write the lines of the recording that the first argument names."""
    threading.Thread(target=_end_with_input, daemon=True).start()
    with contextlib.suppress(OSError):  # forbidden by some systemd units
        os.nice(19)
    try:
        for line in lines(Path(sys.argv[1])):
            sys.stdout.buffer.write(orjson.dumps(line, option=OPTIONS))
            sys.stdout.buffer.flush()
    except (UserError, OSError, ValueError) as error:
        problem = {"problem": str(error)}
        sys.stdout.buffer.write(orjson.dumps(problem, option=orjson.OPT_APPEND_NEWLINE))


if __name__ == "__main__":
    main()
