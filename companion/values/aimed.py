"""Beams and their weights."""

from dataclasses import dataclass
from enum import StrEnum

from companion.values.numbers import ComplexArray


class Method(StrEnum):
    """How weights are made. RZF is also what ZF gives way to when it costs too much."""

    ZERO_FORCING = "zf"
    REGULARISED = "rzf"
    MATCHED = "mrt"


class Normalisation(StrEnum):
    """What the power of a set of weights is scaled to; the directions of the columns are the same.

    ``UNIT_RESPONSE``: each UAV receives 1 from its own column, AᵀF has a unit diagonal (the
    published form). ``STREAM``: each column has unit power. ``TOTAL``: all of them together have
    unit power, by one common factor. ``ANTENNA``: the busiest element has the power 1/M that a
    uniform share of unit power would give it, by one common factor.
    """

    UNIT_RESPONSE = "unit-response"
    STREAM = "stream"
    TOTAL = "total"
    ANTENNA = "antenna"


class Policy(StrEnum):
    """What is done when zero forcing would cost a user too much: load the matrix, serve groups one
    after the other, or leave out those of the lowest priority."""

    REGULARISE = "regularise"
    GROUP = "group"
    DROP = "drop"


@dataclass(frozen=True, slots=True)
class Beam:
    """One beam: azimuth (to the right) and elevation (up) in the array frame, range in metres, and
    how fast they change (None where a velocity is not known).

    ``gain_db`` is the array gain towards the predicted direction under unit weight power, element
    gain included; ``loss_db`` what it lacks against a beam for this UAV alone (maximum ratio).
    ``pointing_bound_rad`` is how far the true direction can lie from the predicted one (None:
    anywhere). ``group`` numbers the turn in which the UAV is served: all are 0 unless the
    policy groups. ``widened``: its main lobe was broadened to that bound.
    """

    uav: str
    azimuth_rad: float
    elevation_rad: float
    range_m: float
    azimuth_rate_radps: float | None
    elevation_rate_radps: float | None
    range_rate_mps: float | None
    pointing_bound_rad: float | None
    gain_db: float
    loss_db: float
    group: int = 0
    widened: bool = False


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A UAV that is tracked but has no beam, and why."""

    uav: str
    reason: str


@dataclass(frozen=True, slots=True)
class BeamSet:
    """The weights of one update. ``weights``: (M, N), columns in the order of ``beams``.

    With A the (M, N) steering matrix of the predicted directions, zero forcing has AᵀF = I among
    the UAVs of a group (diagonal, under another normalisation): nulls on the others.
    ``condition_number`` is that of A in the 2-norm, its columns at one length, the worst of the
    groups (None without beams).
    ``t_ns`` is when the update was made, ``valid_at_ns`` when the beams are applied.
    """

    t_ns: int
    valid_at_ns: int
    beams: tuple[Beam, ...]
    weights: ComplexArray
    method: Method
    normalisation: Normalisation
    condition_number: float | None
    left_out: tuple[LeftOut, ...]

    @property
    def uavs(self) -> tuple[str, ...]:
        return tuple(beam.uav for beam in self.beams)

    @property
    def regularised(self) -> bool:
        return self.method is Method.REGULARISED

    @property
    def groups(self) -> int:
        """How many turns it takes to serve all."""
        return max((beam.group for beam in self.beams), default=-1) + 1
