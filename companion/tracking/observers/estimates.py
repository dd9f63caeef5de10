"""The interface of the observers, so that tracks need not know which one they use."""

from typing import NamedTuple, Protocol, TypeVar

from companion.values import Fix, Vector

State = TypeVar("State")


class Prediction(NamedTuple):
    """A UAV at a given time; vectors are in the local frame.

        velocity_bound_mps  bound on the norm of the velocity error; None without a velocity

    The position error lies in the upright cylinder of ``horizontal_m`` and ``vertical_m``. It is a
    tuple because several are made for each report.
    """

    position_ned_m: Vector  # estimated position
    velocity_ned_mps: Vector | None  # estimated velocity; None if there is none
    bound_m: float  # bound on the norm of the position error
    horizontal_m: float  # bound on its norm in the plane
    vertical_m: float  # bound on its height
    velocity_bound_mps: float | None
    mu_s2: float | None  # mu of the design for this interval, s²; None where the model has none


class Observer(Protocol[State]):
    """An observer as pure functions of frozen states. Times are the sender's own, in ns."""

    def begin(self, fix: Fix) -> State:
        """The state of a track with one report."""
        ...

    def predict(self, state: State, sender_ns: int) -> Prediction:
        """The UAV at a time before or after the report that the state holds."""
        ...

    def carry(self, state: State, sender_ns: int) -> tuple[Vector, Vector] | None:
        """Position and velocity at a time, where ``reach.py`` bounds them; None where it does not.

        That is where the observer's own bound is no smaller than what the newest report leaves.
        """
        ...

    def after(self, state: State, predicted: Prediction, fix: Fix) -> State:
        """The state at a report, from the previous state and its prediction for that time."""
        ...
