"""What every observer takes and gives, so that tracks need not know which one they use."""

from typing import NamedTuple, Protocol, TypeVar

from companion.values import Fix, FloatArray

State = TypeVar("State")


class Prediction(NamedTuple):
    """A UAV at an asked time; local frame, shapes (3,). A tuple, for several are made a report.

    The position's error lies in an upright cylinder: ``horizontal_m`` bounds its norm in the
    plane, ``vertical_m`` its height, ``bound_m`` its norm. ``velocity_bound_mps`` bounds the
    velocity's error where there is one. ``mu_s2`` is the design's figure of merit for the
    interval, where the model has one.
    """

    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray | None
    bound_m: float
    horizontal_m: float
    vertical_m: float
    velocity_bound_mps: float | None
    mu_s2: float | None


class Observer(Protocol[State]):
    """An observer as pure functions of frozen states. Times are the sender's own."""

    def begin(self, fix: Fix) -> State:
        """The state of a track of one report."""
        ...

    def predict(self, state: State, sender_ns: int) -> Prediction:
        """Where the UAV is at a time, before or after the report that the state holds."""
        ...

    def after(self, state: State, predicted: Prediction, fix: Fix) -> State:
        """The state at a report, from the one before and what that predicted for its time."""
        ...
