"""Location-aware beamforming from MAVLink: bytes in, array weights out.

The library's face, for notebooks and programs; everything else is inside and may change::

    from companion import Pipeline, Settings, Tick, read_log

    pipeline = Pipeline(Settings().override(center={"source": "5:1"}))
    for event in read_log("flight.tlog"):
        pipeline.step(event)
    now_ns = event.t_ns
    for track in pipeline.tracks(now_ns, valid_at_ns=now_ns):
        print(track.uav, track.position_ned_m, track.bound_m)
    update = pipeline.look(now_ns, lead_s=0.02)
    print(update.beams.uavs, update.beams.weights.shape)

``Settings``: all settings; ``override(section={...})`` gives them with some replaced.
``Pipeline``: ``step(event)`` takes events in order of time; ``look(now_ns, lead_s)`` gives targets
and beams, ``tracks(now_ns, valid_at_ns)`` every UAV heard of, ``clock_estimate(uav)`` what is
known of its clock, ``local`` the local frame. ``Frame``, ``Tick``, ``RoundTrip``: the events, of a
``Source``. ``read_log(path)``: the events of any kind of log. ``UserError``: what all of it raises
for what a user can do wrong.

Names are loaded when they are first asked for: to import this package costs next to nothing.
"""

TYPE_CHECKING = False  # for type checkers alone: to import `typing` takes longer than all of this
if TYPE_CHECKING:
    from companion.pipeline.fold import Pipeline
    from companion.recording.reader import read_log
    from companion.settings.model import Settings
    from companion.values import Frame, RoundTrip, Source, Tick, UserError

__version__ = "0.1.0"
__all__ = [
    "Frame",
    "Pipeline",
    "RoundTrip",
    "Settings",
    "Source",
    "Tick",
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
