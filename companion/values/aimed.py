"""Values that the beam stage makes: beams, the UAVs left out, and the weights of one update."""

from dataclasses import dataclass
from enum import StrEnum

from companion.values.health import Cause
from companion.values.numbers import ComplexArray


class Method(StrEnum):
    """How weights are made: zero forcing, regularised zero forcing, least mean square error of what
    is received, or maximum ratio transmission.

    ``REGULARISED`` is also used in place of ``ZERO_FORCING`` where that would cost too much gain.
    """

    ZERO_FORCING = "zf"
    REGULARISED = "rzf"
    MMSE = "mmse"
    MATCHED = "mrt"


class Power(StrEnum):
    """How the beams of one turn share the power.

    EQUAL         alike
    MAX_MIN       so that the least SINR is the greatest
    WEIGHTED_SUM  so that the weighted sum of rates is great
    """

    EQUAL = "equal"
    MAX_MIN = "max-min"
    WEIGHTED_SUM = "weighted-sum"


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


class Widen(StrEnum):
    """How wide beams are made.

    LIKELY     for the angle within which the UAV usually is, over a floor within its bound
    GUARANTEE  for the bound: the greatest least gain within it
    NO         sharp
    """

    LIKELY = "likely"
    GUARANTEE = "guarantee"
    NO = "no"


@dataclass(frozen=True, slots=True, kw_only=True)
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
    widened             True if the main lobe was broadened
    pointing_p95_rad    angle between the predicted and the true direction that is usual at most
    shaped_likely_rad   the likely angle and the bound for which the beam is shaped: they follow the
    shaped_bound_rad    two above no faster than a beam may change its shape; 0: sharp
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
    pointing_p95_rad: float | None = None
    shaped_likely_rad: float = 0.0
    shaped_bound_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A UAV that is tracked but has no beam, and the reason: as a cause and in words."""

    uav: str
    cause: Cause
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
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
        exact             whether each UAV lies in a null of all other beams of its turn; ``method``
                          says zero forcing only once that has been so for a while

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
    exact: bool = False

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
