"""Number of UAVs that this machine can serve, measured with simulated traffic.

UAVs on straight courses report to a pipeline in this process, first a few, then more. The processor
time of reports and updates grows with their number; the result is the number at which it reaches
``SHARE``. The rest is left for recording, HTTP and other programs.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from companion.mavlink.wire.encode import global_position_int, pack
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.tracking.geodesy import LocalFrame
from companion.values import Event, Frame, Source, Tick

SHARE: Final = 0.5  # fraction of one processor that reports and updates may take
RATE_HZ: Final = 10  # reports per second of each UAV
FEW: Final = 4
MORE: Final = 16  # simulated UAVs in the second run
MOST: Final = 250  # largest result: more would be extrapolated too far
SETTLED_S: Final = 2
MEASURED_S: Final = 3  # duration of the flight before and during the measurement
HOME: Final = (47.0, 8.0, 500.0)
_S: Final = 1_000_000_000
_BEGIN_NS: Final = 1_700_000_000 * _S


@dataclass(frozen=True, slots=True)
class Capacity:
    """Result of the capacity measurement."""

    uavs: int | None  # UAVs that take SHARE of a processor; None: more than MOST
    report_s: float  # time that a report takes
    update_s: float  # time that an update of MORE beams takes


def measure(
    settings: Settings,
    clock_s: Callable[[], float] = time.process_time,
    *,
    processor: float = 1.0,
    done: Callable[[float], None] = lambda _: None,
) -> Capacity:
    """Simulate ``FEW`` and then ``MORE`` UAVs around an array of these settings, about a second.

    ``processor`` is the fraction of one processor that this process may use. ``done`` is called
    with the share of the work that is done: with thousands of elements it takes half a minute.
    """
    update_hz = settings.beams.update_hz
    few = _simulate(settings, FEW, clock_s, lambda share: done(share * FEW / (FEW + MORE)))
    more = _simulate(
        settings, MORE, clock_s, lambda share: done((FEW + share * MORE) / (FEW + MORE))
    )
    report_s = (few.report_s + more.report_s) / 2
    each_s = max(0.0, (more.update_s - few.update_s) / (MORE - FEW))
    alone_s = max(0.0, more.update_s - MORE * each_s)
    spare = SHARE * processor - update_hz * alone_s
    uavs = int(max(0.0, spare) / (RATE_HZ * report_s + update_hz * each_s))
    return Capacity(None if uavs > MOST else uavs, report_s, more.update_s)


@dataclass(frozen=True, slots=True)
class _Times:
    report_s: float
    update_s: float


def _simulate(
    settings: Settings, number: int, clock_s: Callable[[], float], done: Callable[[float], None]
) -> _Times:
    """Return the mean times of a report and of an update with this number of UAVs."""
    center = {"source": ",".join(map(str, HOME))}
    pipeline = Pipeline(settings.override(center=center, beams={"targets": "all"}))
    took_s, counts = {Frame: 0.0, Tick: 0.0}, {Frame: 0, Tick: 0}
    for event in _traffic(number, settings.beams.update_hz):
        began_s = clock_s()
        pipeline.step(event)
        if isinstance(event, Tick):
            done((event.t_ns - _BEGIN_NS) / ((SETTLED_S + MEASURED_S) * _S))
        if event.t_ns >= _BEGIN_NS + SETTLED_S * _S:
            took_s[type(event)] += clock_s() - began_s
            counts[type(event)] += 1
    return _Times(took_s[Frame] / counts[Frame], took_s[Tick] / counts[Tick])


def _traffic(number: int, update_hz: float) -> Iterator[Event]:
    """Yield reports and ticks in order of time; the UAVs fly outwards on different courses."""
    frame = LocalFrame(*HOME)
    update_ns, due_ns = round(_S / update_hz), _BEGIN_NS
    for step in range((SETTLED_S + MEASURED_S) * RATE_HZ):
        t_s = step / RATE_HZ
        for uav in range(number):
            t_ns = _BEGIN_NS + round(t_s * _S) + uav * 1_000_000
            while due_ns <= t_ns:
                yield Tick(due_ns)
                due_ns += update_ns
            north, east = (uav % 4 - 1.5), (uav // 4 + 0.5)
            far_m = 200.0 + 8.0 * t_s
            place = frame.place(north * far_m, east * far_m, -60.0)
            velocity = (8.0 * north, 8.0 * east, 0.0)
            source = Source(1 + uav, 1)
            said = global_position_int(
                source,
                round(t_s * 1e3) + 5000,
                place,
                relative_alt_m=60.0,
                velocity_ned_mps=velocity,
                heading_deg=None,
            )
            yield Frame(
                t_ns=t_ns, link="sky", source=source, msgid=said.msgid, raw=pack(said, step % 256)
            )
