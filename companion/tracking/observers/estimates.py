"""Interface of the observers, which keeps tracks independent of the observer in use."""

from typing import NamedTuple, Protocol, TypeVar

from companion.values import Fix, Vector

State = TypeVar("State")


class Prediction(NamedTuple):
    """Predicted state of a UAV at a given time; vectors are in the local frame.

        velocity_bound_mps  bound on the norm of the velocity error; None without a velocity

    The position error lies in the upright cylinder of ``horizontal_m`` and ``vertical_m``. The
    class is a tuple for speed: several are created for each report.
    """

    position_ned_m: Vector  # estimated position
    velocity_ned_mps: Vector | None  # estimated velocity; None if there is none
    bound_m: float  # bound on the norm of the position error
    horizontal_m: float  # bound on its norm in the plane
    vertical_m: float  # bound on its height
    velocity_bound_mps: float | None
    mu_s2: float | None  # mu of the design for this interval, s²; None if the model has none


class Observer(Protocol[State]):
    """Observer as pure functions of frozen states. Times are the sender's own, in ns."""

    def begin(self, fix: Fix) -> State:
        """Return the state of a track that has one report."""
        ...

    def predict(self, state: State, sender_ns: int) -> Prediction:
        """Predict a UAV's state at a time before or after the state's report."""
        ...

    def carry(self, state: State, sender_ns: int) -> tuple[Vector, Vector] | None:
        """Predict position and velocity if ``reach.py`` bounds them; else return None.

        ``reach.py`` does if the observer's own bound is no smaller than that from the newest report
        alone.
        """
        ...

    def after(self, state: State, predicted: Prediction, fix: Fix) -> State:
        """Return the state at a report, from the previous state and its prediction."""
        ...
