"""Settings of measurements by the array's own receiver."""

from typing import Annotated

from pydantic import AfterValidator, Field

from companion.settings.outlets import host_and_port
from companion.settings.section import Section


def _address(text: str) -> str:
    host_and_port(text)
    return text


class ObservationSettings(Section):
    """Measurements of the array's own receiver, which confine the carrier's attitude.

    enabled         accept observations over HTTP (with the token, if one is set) and UDP
    udp             address (IP:PORT) at which binary observations are received; None: none
    oldest_s        largest age of an observation on arrival, seconds
    drift_max_degps largest rate at which the error of reported attitudes changes, degrees per
                    second
    outliers        largest number of wrong observations among the newest 10 of one UAV
    false_uavs      largest number of UAVs with false positions, if three or more are observed
    follow          whether the beam of a UAV whose position is refuted follows the direction in
                    which the array sees it
    """

    enabled: bool = False
    udp: Annotated[str, AfterValidator(_address)] | None = None
    oldest_s: Annotated[float, Field(gt=0, le=10)] = 1.0
    drift_max_degps: Annotated[float, Field(ge=0, le=90)] = 0.3
    outliers: Annotated[int, Field(ge=0, le=4)] = 0
    false_uavs: Annotated[int, Field(ge=0, le=1)] = 1
    follow: bool = False
