"""Observations as JSON: their model, and the conversion to the value inside the program.

Names, units and meanings derive from ``companion.values.Observation``; the rules of validity are
``companion.values.reason_invalid``: the model limits only times, so that they can be converted.
They are given in other units than inside: ``measured_at`` (UTC) or ``age_s``, and ``time_bound_s``.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from companion.values import UAV_FORMS, Observation, reason_invalid
from companion.values.described import Meaning, meaning
from companion.values.observed import TIME_BOUND_MAX_NS
from companion.views.as_json import parse_rfc3339

AGE_MAX_S: Final = 3600.0  # largest ``age_s``; the settings limit the age further


def _means(name: str, unit: str = "", example: Any = None, **limits: Any) -> Any:
    """Return a field of the model, described by the meaning of an observation's value."""
    text = meaning(Observation, name).text + (f", {unit}" if unit else "")
    return Field(description=text, examples=None if example is None else [example], **limits)


class ObservationInput(BaseModel):
    """One measurement of the array's own receiver: a direction, or powers through beams.

    Give exactly one of ``measured_at`` and ``age_s``. For a direction, give ``azimuth_deg``,
    ``elevation_deg`` and ``bound_deg``; for powers ``beams``, ``powers_db`` and
    ``power_bound_db``, and ``update`` if the weights of an update were used.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    uav: Annotated[str, _means("uav", UAV_FORMS, "3:1")]
    measured_at: Annotated[
        str | None, _means("measured_ns", "UTC (RFC 3339)", "2026-11-20T13:00:00.123Z")
    ] = None
    age_s: Annotated[
        float | None,
        Field(description="instead of measured_at: time since it was made, s", ge=0, le=AGE_MAX_S),
    ] = None
    time_bound_s: Annotated[
        float, _means("time_bound_ns", "s", ge=0, le=TIME_BOUND_MAX_NS / 1e9)
    ] = 0.0
    azimuth_deg: Annotated[float | None, _means("azimuth_rad", "deg", 12.5)] = None
    elevation_deg: Annotated[float | None, _means("elevation_rad", "deg", -3.0)] = None
    bound_deg: Annotated[float | None, _means("bound_rad", "deg", 2.0)] = None
    update: Annotated[int | None, _means("update")] = None
    beams: Annotated[list[int] | None, _means("beams")] = None
    powers_db: Annotated[list[float] | None, _means("powers_db", "dB")] = None
    power_bound_db: Annotated[float | None, _means("power_bound_db", "dB")] = None


@dataclass(frozen=True, slots=True)
class ObservationError:
    """Observation of a request that was not used."""

    item: Annotated[int, Meaning("index of the observation in the request, from 0")]
    title: Annotated[str, Meaning("what is wrong, in one line", example="uav: is missing")]


@dataclass(frozen=True, slots=True)
class ObservationsAccepted:
    """Result of a request with observations, of which at least one was accepted."""

    accepted: Annotated[int, Meaning("observations accepted")]
    dropped: Annotated[
        int, Meaning("observations dropped, because more arrived than are processed")
    ]
    errors: Annotated[list[ObservationError], Meaning("observations that are invalid, and why")]


def to_observation(
    given: object, *, arrival_ns: int, now_ns: int, utc_offset_ns: int
) -> Observation | str:
    """Return the observation in an item of a request, or in one line why it is invalid.

    arrival_ns     when the request arrived, on the node's timeline; ``age_s`` counts from it
    now_ns         present time, at which the observation becomes an event
    utc_offset_ns  UTC less the node's timeline
    """
    try:
        item = ObservationInput.model_validate(given)
    except ValidationError as error:
        wrong = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(str(part) for part in wrong["loc"])
        return f"{where}: {wrong['msg']}" if where else str(wrong["msg"])
    if (item.measured_at is None) is (item.age_s is None):
        return "give exactly one of measured_at and age_s"
    if item.measured_at is None:
        measured_ns = arrival_ns - _ns(item.age_s or 0.0)
    else:
        try:
            measured_ns = parse_rfc3339(item.measured_at) - utc_offset_ns
        except ValueError as error:
            return f"measured_at: {error}"
    observation = Observation(
        t_ns=now_ns,
        measured_ns=measured_ns,
        time_bound_ns=_ns(item.time_bound_s),
        uav=item.uav,
        azimuth_rad=_radians(item.azimuth_deg),
        elevation_rad=_radians(item.elevation_deg),
        bound_rad=_radians(item.bound_deg),
        update=item.update,
        beams=tuple(item.beams or ()),
        powers_db=tuple(item.powers_db or ()),
        power_bound_db=item.power_bound_db,
    )
    return reason_invalid(observation) or observation


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


def _radians(angle_deg: float | None) -> float | None:
    return None if angle_deg is None else math.radians(angle_deg)
