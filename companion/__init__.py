"""Location-aware beamforming from MAVLink: bytes in, array weights out.

The library interface for notebooks and programs; everything else is internal and may change::

    from companion import Pipeline, Settings, Tick, read_log

    pipeline = Pipeline(Settings().override(center={"source": "5:1"}))
    for event in read_log("flight.tlog"):
        pipeline.step(event)
    now_ns = event.t_ns
    for track in pipeline.tracks(now_ns, valid_at_ns=now_ns):
        print(track.uav, track.position_ned_m, track.bound_m)
    update = pipeline.look(now_ns, lead_s=0.02)
    print(update.beams.uavs, update.beams.weights.shape)

``Settings``: all settings; ``override(section={...})`` returns a copy with some replaced.
``Pipeline``: ``step(event)`` processes events in chronological order; ``look(now_ns, lead_s)``
returns targets and beams, ``tracks(now_ns, valid_at_ns)`` every tracked UAV,
``clock_estimate(uav)`` the state of its clock, ``local`` the local frame. ``Frame``, ``Tick``,
``RoundTrip``: events, from a ``Source``; ``Observation``: a measurement of the array's receiver.
``Estimate``, ``Track``, ``Beam``: what comes out: an accepted report, the predicted state of a UAV,
the beam of a UAV. ``read_log(path)``: the events of any kind of log.
``UserError``: raised for a user's mistakes.

Names are loaded on first use, so that importing this package is fast. Set OPENBLAS_NUM_THREADS=1
before numpy loads: with two BLAS threads an update for 100 UAVs takes two to three times as long,
and weights differ in the last digits, so that the digest does too.
"""

TYPE_CHECKING = False  # for type checkers only: importing `typing` would take longer than all this
if TYPE_CHECKING:
    from companion.pipeline.fold import Pipeline
    from companion.recording.reader import read_log
    from companion.settings.model import Settings
    from companion.values import (
        Beam,
        Estimate,
        Frame,
        Observation,
        RoundTrip,
        Source,
        Tick,
        Track,
        UserError,
    )

__version__ = "1.0.0"
__all__ = [
    "Beam",
    "Estimate",
    "Frame",
    "Observation",
    "Pipeline",
    "RoundTrip",
    "Settings",
    "Source",
    "Tick",
    "Track",
    "UserError",
    "__version__",
    "read_log",
]

_WHERE = {
    "Pipeline": "companion.pipeline.fold",
    "Settings": "companion.settings.model",
    "read_log": "companion.recording.reader",
}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    where = _WHERE.get(name, "companion.values")
    found: object = getattr(__import__(where, fromlist=[name]), name)
    return found
