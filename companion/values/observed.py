"""Measurements of the array's own receiver: the direction of a UAV, or powers through beams."""

from dataclasses import dataclass
from typing import Annotated, Final

from companion.values.described import Meaning

READINGS_MAX: Final = 256  # most powers of one observation


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """Event: what the array's receiver measured of one UAV.

    Either a direction (``azimuth_rad``, ``elevation_rad``, ``bound_rad``) or powers (``beams``,
    ``powers_db``, ``power_bound_db``) is given. Angles are in the array frame. ``powers_db`` are
    relative: only their differences are used, so that transmit power, range and gain of the
    receiver do not matter. The true measurement time is within ``time_bound_ns`` of
    ``measured_ns``.
    """

    t_ns: Annotated[int, Meaning("when the measurement arrived", 1)]
    measured_ns: Annotated[int, Meaning("when it was made", 2)]
    time_bound_ns: Annotated[
        int, Meaning("largest error of the time at which it was made", 3, wire="uint64")
    ] = 0
    uav: Annotated[str, Meaning("UAV that was measured", 4, label="UAV", example="3:1")]
    azimuth_rad: Annotated[
        float | None, Meaning("direction in the array's frame, right of boresight positive", 5)
    ] = None
    elevation_rad: Annotated[
        float | None, Meaning("direction in the array's frame, above boresight positive", 6)
    ] = None
    bound_rad: Annotated[
        float | None, Meaning("largest angle between the measured and the true direction", 7)
    ] = None
    update: Annotated[
        int | None,
        Meaning(
            "number of the update whose weights were used; null: beams of the codebook were used", 8
        ),
    ] = None
    beams: Annotated[
        tuple[int, ...],
        Meaning("beams through which power was measured: indices of columns, from 0", 9),
    ] = ()
    powers_db: Annotated[
        tuple[float, ...], Meaning("power through each of these beams, on any common scale", 10)
    ] = ()
    power_bound_db: Annotated[float | None, Meaning("largest error of each power", 11)] = None

    @property
    def is_direction(self) -> bool:
        """Whether a direction was measured, not powers."""
        return self.azimuth_rad is not None
