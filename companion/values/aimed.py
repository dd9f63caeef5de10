"""Values that the beam stage makes: beams, the UAVs left out, and the weights of one update."""

from dataclasses import dataclass
from enum import StrEnum

from companion.values.numbers import ComplexArray


class Method(StrEnum):
    """How weights are made: zero forcing, regularised zero forcing, or maximum ratio transmission.

    ``REGULARISED`` is also used in place of ``ZERO_FORCING`` where that would cost too much gain.
    """

    ZERO_FORCING = "zf"
    REGULARISED = "rzf"
    MATCHED = "mrt"


class Normalisation(StrEnum):
    """How the columns of the weights F, (M, N), are scaled. Their directions do not change.

        UNIT_RESPONSE  each UAV receives 1 from its own column: AᵀF has a unit diagonal (published
                       form)
        STREAM         each column has unit power
        TOTAL          all columns together have unit power, by one common factor
        ANTENNA        the busiest element has power 1/M, its uniform share of unit power, by one
                       factor

    A is the (M, N) steering matrix; see docs/math.md 7.
    """

    UNIT_RESPONSE = "unit-response"
    STREAM = "stream"
    TOTAL = "total"
    ANTENNA = "antenna"


class Policy(StrEnum):
    """What is done where zero forcing would cost a user too much gain.

    REGULARISE  add a diagonal loading to the Gram matrix
    GROUP       serve groups of UAVs one after the other
    DROP        leave out the UAVs of lowest priority
    """

    REGULARISE = "regularise"
    GROUP = "group"
    DROP = "drop"


@dataclass(frozen=True, slots=True)
class Beam:
    """One UAV's beam: where it points, how well, and how that direction changes.

    uav                 the UAV's name
    azimuth_rad         array frame, positive to the right of boresight
    elevation_rad       array frame, positive up
    range_m             from the array to the predicted position
    *_rate_*            time derivatives of the three; None where no velocity is known
    pointing_bound_rad  largest angle between the predicted and the true direction; None:
                        anywhere
    gain_db             array gain towards the predicted direction for weights of unit power,
                        element gain included
    loss_db             what ``gain_db`` lacks against a beam for this UAV alone (maximum ratio)
    group               number of the turn in which the UAV is served; 0 unless the policy
                        groups
    widened             True if the main lobe was broadened to the pointing bound
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
    """A UAV that is tracked but has no beam, and the reason."""

    uav: str
    reason: str


@dataclass(frozen=True, slots=True)
class BeamSet:
    """The beams and weights of one update.

        t_ns              when the update was made, node time
        valid_at_ns       when the beams are to be applied, node time
        beams             N beams
        weights           F, (M, N) complex: one row per element, columns in the order of ``beams``
        method            how F was made
        normalisation     how its columns are scaled
        condition_number  of the steering matrix A in the 2-norm, columns scaled to equal length;
                          the largest over the groups; None without beams
        left_out          UAVs without a beam

    Zero forcing gives AᵀF = I within a group (no conjugate; diagonal under other normalisations):
    each UAV lies in a null of the others' beams. See docs/math.md 7.
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
        """Number of turns in which all UAVs are served; 0 without beams."""
        return max((beam.group for beam in self.beams), default=-1) + 1
