"""Models of the API's answers about beams, for the OpenAPI document; see ``models``."""

from typing import Annotated, Literal

from pydantic import BaseModel, Field

Time = Annotated[str, Field(examples=["2026-11-20T13:00:00.123Z"])]
Uav = Annotated[str, Field(examples=["3:1"])]
Method = Literal["zf", "rzf", "mrt"]
Normalisation = Literal["unit-response", "stream", "total", "antenna"]
Matrix = list[list[float]]


class StoredBeam(BaseModel):
    """Which beam of the codebook serves a UAV, and which is next."""

    best: int
    gain_db: float
    next: int | None
    next_in_s: float | None
    candidates: list[int]
    ssb_candidates: list[int]
    sweep_share: float


class BeamState(BaseModel):
    """One beam. Azimuth and elevation as the array has them, the bearing from north."""

    uav: Uav
    azimuth_deg: Annotated[float, Field(examples=[-12.5])]
    elevation_deg: Annotated[float, Field(examples=[8.0])]
    range_m: Annotated[float, Field(examples=[412.0])]
    bearing_deg: float
    above_horizon_deg: float
    lat_deg: float
    lon_deg: float
    alt_m: float
    azimuth_rate_dps: float | None
    elevation_rate_dps: float | None
    range_rate_mps: float | None
    gain_db: float
    guaranteed_gain_db: float | None
    power_dbm: float
    eirp_dbm: float
    loss_db: float
    cost_db: float
    group: int
    widened: bool
    pointing_bound_deg: float | None
    pointing_p95_deg: float | None
    guaranteed_sinr_db: float | None
    sinr_db: float | None
    codebook: StoredBeam | None


class ArrayState(BaseModel):
    """The antenna array."""

    kind: str
    elements: int
    frequency_hz: float
    half_power_beamwidth_deg: float | None
    half_power_beamwidth_elevation_deg: float | None
    boresight_bearing_deg: float | None


class LeftOut(BaseModel):
    """A UAV that has no beam, and why."""

    uav: Uav
    reason: str


class Beams(BaseModel):
    """The beams that are applied at ``valid_at``."""

    valid_at: Time
    age_s: float
    lead_ms: float
    beams: list[BeamState]
    array: ArrayState
    method: Method
    policy: Literal["regularise", "group", "drop"]
    normalisation: Normalisation
    condition_number: float | None
    regularised: bool
    groups: int
    codebook_beams: int | None
    unfit: str | None
    left_out: list[LeftOut]


class Weights(BaseModel):
    """The complex weights, M rows; columns in the order of ``uavs``."""

    valid_at: Time
    lead_ms: float
    uavs: list[Uav]
    groups: list[int]
    method: Method
    normalisation: Normalisation
    condition_number: float | None
    re: Matrix
    im: Matrix


class BeamPattern(BaseModel):
    """The response of one beam along the cut."""

    uav: Uav
    at_deg: float
    target_deg: float
    response_db: list[float]
    peak_azimuth_deg: float
    peak_elevation_deg: float
    peak_db: float
    half_power_beamwidth_deg: float | None
    side_lobe_db: float | None
    null_depths_db: dict[str, float]


class Pattern(BaseModel):
    """The array's response in dB along a cut through each beam."""

    valid_at: Time
    lead_ms: float
    cut: Literal["azimuth", "elevation"]
    method: Method
    angles_deg: list[float]
    patterns: list[BeamPattern]
