"""Settings of the array's carrier: a vehicle, a fixed station, or "home"."""

import math
from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import AfterValidator, Field

from companion.settings.section import Section
from companion.values import Source, UserError, shown

HEIGHT_MAX_M: Final = 1e5  # largest height of a station above or below mean sea level


@dataclass(frozen=True, slots=True)
class VehicleCenter:
    """Carrier that is a vehicle, by its MAVLink source; its position and attitude are tracked."""

    source: Source

    def __str__(self) -> str:
        return str(self.source)


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedCenter:
    """Carrier that is a station at a fixed position, level.

    Latitude and longitude in degrees, altitude in metres, heading in degrees clockwise from true
    north.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float
    heading_deg: float = 0.0

    def __str__(self) -> str:
        return f"{self.lat_deg},{self.lon_deg},{self.alt_m},{self.heading_deg}"


@dataclass(frozen=True, slots=True)
class HomeCenter:
    """Carrier that is a station at the first accepted report's position, level, facing north."""

    def __str__(self) -> str:
        return "home"


CenterPlace = VehicleCenter | FixedCenter | HomeCenter


def parse_center(text: str) -> CenterPlace:
    """Parse a carrier: ``SYSID:COMPID``, ``LAT,LON,ALT[,HEADING]`` or ``home``.

    Raises ``UserError`` for anything else.
    """
    if text == "home":
        return HomeCenter()
    if ":" in text:
        return VehicleCenter(Source.parse(text))
    if "," not in text:
        raise UserError(f"{shown(text)} is not SYSID:COMPID, LAT,LON,ALT[,HEADING] or home")
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 4) or not all(map(math.isfinite, numbers[2:])):
        raise UserError(f"{shown(text)} is not LAT,LON,ALT[,HEADING], such as 47.4,8.55,500,90")
    if not (abs(numbers[0]) <= 90 and abs(numbers[1]) <= 180):
        raise UserError(f"{shown(text)}: latitude must be -90..90 and longitude -180..180 degrees")
    if abs(numbers[2]) > HEIGHT_MAX_M or any(abs(heading) > 360 for heading in numbers[3:]):
        raise UserError(f"{shown(text)}: altitude must be within 100 km, heading -360..360 degrees")
    lat_deg, lon_deg, alt_m, *heading_deg = numbers
    return FixedCenter(
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_m=alt_m,
        heading_deg=heading_deg[0] if heading_deg else 0.0,
    )


def _center_text(text: str) -> str:
    parse_center(text)
    return text


class CenterSettings(Section):
    """Carrier of the array. The ``run`` command needs ``source``.

    ``attitude_bound_deg`` bounds the angular error of a vehicle's attitude, mounting included. It
    is raised while the vehicle's estimator contradicts its compass or reports its attitude as
    invalid, while a GNSS heading or a second attitude contradicts the reported one, and by a larger
    stated covariance. If ``follow_attitude_accuracy`` is set, a smaller stated covariance lowers
    it; ``mount_bound_deg``, the largest error of the array's mounting, is then added.
    ``turn_acceleration_max_degps2`` bounds its angular acceleration since its newest attitude. If
    unset it follows from the vehicle type (HEARTBEAT); it is raised if reported rates refute it.
    Autopilots' headings have errors of a degree or more (simulated: 1.1 degrees in the median;
    docs/field-notes.md 1).
    """

    source: Annotated[str, AfterValidator(_center_text)] | None = None
    attitude_bound_deg: Annotated[float, Field(ge=0, le=180)] = 3.0
    follow_attitude_accuracy: bool = False
    mount_bound_deg: Annotated[float, Field(ge=0, le=180)] = 1.0
    turn_acceleration_max_degps2: Annotated[float, Field(ge=0, le=10_000)] | None = None
