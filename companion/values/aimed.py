"""Output of the beam stage: beams, the UAVs left out, and the weights of one update."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated, Self

import numpy as np

from companion.values.described import DescribedEnum, Meaning
from companion.values.health import Cause
from companion.values.numbers import ComplexArray, FloatArray, IntArray


class Method(DescribedEnum):
    """Method of computing weights; regularised zero forcing also replaces costly zero forcing."""

    ZERO_FORCING = "zf", "zero forcing"
    REGULARISED = "rzf", "regularised zero forcing"
    MMSE = "mmse", "minimum mean square error"
    MATCHED = "mrt", "maximum ratio transmission"


class ArrayKind(DescribedEnum):
    """Geometry of an array, in the array frame (x boresight, y right, z down)."""

    ULA = "ula", "uniform line along y"
    URA = "ura", "uniform rectangle of rows down and columns to the right"
    UCA = "uca", "uniform circle in the xy plane"
    HEXAGONAL = "hexagonal", "rings of a triangular lattice in the aperture plane, yz"
    LIST = "list", "elements at listed positions"


class Power(DescribedEnum):
    """Method of power allocation between the beams of one time slot."""

    EQUAL = "equal", "equally"
    MAX_MIN = "max-min", "so that the least SINR is as large as possible"
    WEIGHTED_SUM = "weighted-sum", "so that the weighted sum of rates is large"


class Normalisation(DescribedEnum):
    """Scale of the columns of the weights F, (M, N); their directions do not change.

    A is the (M, N) steering matrix; see docs/math.md 7.
    """

    UNIT_RESPONSE = ("unit-response", "each UAV receives 1 from its own column, as in the paper")
    STREAM = "stream", "each column has unit power"
    TOTAL = "total", "all columns together have unit power, by one common factor"
    ANTENNA = "antenna", "the element with the most power has 1/M, by one common factor"


class Policy(DescribedEnum):
    """Fallback if zero forcing would cost a UAV too much gain."""

    REGULARISE = "regularise", "add a diagonal loading to the Gram matrix"
    GROUP = "group", "serve groups of UAVs, each in a time slot of its own"
    DROP = "drop", "leave out the UAVs of lowest priority"


class Widen(DescribedEnum):
    """Criterion for the width of the beams."""

    LIKELY = "likely", "for the usual pointing error, with a guaranteed floor within the bound"
    GUARANTEE = "guarantee", "for the bound: the largest guaranteed gain within it"
    NO = "no", "as narrow as the array allows"


class WeightFormat(StrEnum):
    """Format of exported weights, with its HTTP media type.

    The media types of devices are this product's own; the manufacturers have registered none.
    """

    media_type: str

    def __new__(cls, value: str, media_type: str = "") -> Self:
        made = str.__new__(cls, value)
        made._value_ = value
        made.media_type = media_type
        return made

    JSON = "json", "application/json"
    NPY = "npy", "application/x-npy"
    RAW = "raw", "application/octet-stream"
    ADAR1000 = "adar1000", "application/vnd.adi.adar1000+csv"
    TMYTEK = "tmytek", "application/vnd.tmytek.bbox+csv"
    SIVERS = "sivers", "application/vnd.sivers.eder+text"


@dataclass(frozen=True, slots=True, kw_only=True)
class Beam:
    """Beam of one UAV: its direction, rates of change, gain and pointing errors.

    shaped_likely_rad, shaped_bound_rad  angles for which the main lobe is shaped; they follow
        ``pointing_p95_rad`` and ``pointing_bound_rad``, with hysteresis; 0: not shaped
    """

    uav: Annotated[str, Meaning("UAV that the beam points at", 1, label="UAV", example="3:1")]
    azimuth_rad: Annotated[
        float, Meaning("direction in the array's frame, right of boresight positive", 2)
    ]
    elevation_rad: Annotated[
        float, Meaning("direction in the array's frame, above boresight positive", 3)
    ]
    range_m: Annotated[float, Meaning("distance from the array to the predicted position", 4)]
    azimuth_rate_radps: Annotated[float | None, Meaning("rate of change of the azimuth", 7)]
    elevation_rate_radps: Annotated[float | None, Meaning("rate of change of the elevation", 8)]
    range_rate_mps: Annotated[float | None, Meaning("rate of change of the range", 9)]
    pointing_bound_rad: Annotated[
        float | None,
        Meaning(
            "largest angle between the predicted and the true direction; null: unlimited",
            5,
            label="Pointing bound",
        ),
    ]
    gain_db: Annotated[
        float, Meaning("array gain towards the predicted direction, over an isotropic element", 6)
    ]
    loss_db: Annotated[float, Meaning("gain lost against a beam for this UAV alone", 10)]
    group: Annotated[int, Meaning("time slot in which the beam is applied, from 0", 11)] = 0
    widened: Annotated[bool, Meaning("whether the main lobe is broadened", 12)] = False
    pointing_p95_rad: Annotated[
        float | None,
        Meaning("estimated 95th percentile of the angle to the true direction, not a bound", 13),
    ] = None
    shaped_likely_rad: float = 0.0
    shaped_bound_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Tracked UAV that gets no beam, with the cause and the reason in words."""

    uav: Annotated[str, Meaning("UAV without a beam", 1)]
    cause: Cause
    reason: Annotated[str, Meaning("why the UAV has no beam", 2)]


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamSet:
    """Beams and weights of one update.

    Zero forcing gives AᵀF = I within a time slot (without conjugation; diagonal under other
    normalisations): each UAV lies in a null of the others' beams. See docs/math.md 7.
    """

    t_ns: Annotated[
        int, Meaning("when the update was computed", 1, absent={"api": "`age_s` replaces it"})
    ]
    valid_at_ns: Annotated[int, Meaning("when the beams are applied", 2)]
    beams: tuple[Beam, ...]
    weights: ComplexArray  # F, (M, N) complex: one row per element, columns in the order of beams
    method: Annotated[Method, Meaning("how the weights were computed", 6)]
    normalisation: Annotated[Normalisation, Meaning("scale of the weights' columns", 10)]
    condition_number: Annotated[
        float | None,
        Meaning(
            "condition number of the steering matrix, columns scaled to equal length, the largest "
            "over the time slots; null without beams",
            7,
        ),
    ]
    left_out: tuple[LeftOut, ...]  # UAVs without a beam
    exact: Annotated[
        bool, Meaning("whether each UAV lies in a null of every other beam of its time slot", 11)
    ] = False

    @property
    def uavs(self) -> tuple[str, ...]:
        return tuple(beam.uav for beam in self.beams)

    def of(self, columns: Sequence[int]) -> Self:
        """Return the same beams without those of other columns."""
        beams = tuple(self.beams[i] for i in columns)
        return replace(self, beams=beams, weights=self.weights[:, columns])

    @property
    def slots(self) -> IntArray:
        """Time slot of each beam's UAV, (N,)."""
        return np.array([beam.group for beam in self.beams], dtype=np.int64)

    @property
    def ranges_m(self) -> FloatArray:
        """Predicted range of each beam's UAV, (N,)."""
        return np.array([beam.range_m for beam in self.beams], dtype=float)

    @property
    def regularised(self) -> Annotated[bool, Meaning("whether zero forcing was regularised", 12)]:
        return self.method is Method.REGULARISED

    @property
    def groups(self) -> Annotated[int, Meaning("time slots that serve all UAVs once", 13)]:
        return max((beam.group for beam in self.beams), default=-1) + 1
