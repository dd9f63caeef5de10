"""The sections of the settings that describe the array, its beams and its radio."""

from typing import Annotated, Literal, Self

from pydantic import (
    AfterValidator,
    Field,
    FiniteFloat,
    PositiveFloat,
    model_validator,
)

from companion.section import Section
from companion.values import Method, Normalisation, Policy

Metres = Annotated[float, Field(ge=-1e4, le=1e4)]
Position = tuple[Metres, Metres, Metres]
Interval = tuple[FiniteFloat, FiniteFloat]
HiddenSector = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


def _rising(interval: Interval) -> Interval:
    if not interval[0] < interval[1]:
        raise ValueError("from and to, the first less than the second")
    return interval


def _once(names: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(names)) < len(names):
        raise ValueError("each UAV once, in descending order")
    return names


class ArraySettings(Section):
    """The antenna array, and how it sits on its carrier.

    ``ula``: ``elements`` along y. ``ura``: ``rows`` down and ``columns`` to the right. ``uca``:
    ``elements`` on a circle in the xy plane. ``list``: ``positions_m``, rows of x, y, z in the
    array frame (x boresight, y right, z down), or of x, y, z and the direction in which the element
    faces; ``positions`` names a file of them (CSV or .npy), which is read into ``positions_m``.
    ``spacing_m`` takes the place of ``spacing_wavelengths``.

    Mount angles are of array from body (yaw, then pitch, then roll); ``lever_arm_m`` is where the
    array stands in the body frame, from the point whose position the carrier reports.

    ``field_of_view_deg`` is a full cone about boresight, the two limits are those to which the
    hardware can steer (array frame). ``hidden_deg`` are sectors that the airframe hides, in the
    body frame: azimuth from and to (to the right of the nose), elevation from and to.
    """

    kind: Literal["ula", "ura", "uca", "list"] = "ula"
    elements: Annotated[int, Field(ge=1, le=4096)] = 64
    rows: Annotated[int, Field(ge=1, le=256)] = 8
    columns: Annotated[int, Field(ge=1, le=256)] = 8
    positions: str | None = None
    positions_m: Annotated[tuple[tuple[Metres, ...], ...], Field(max_length=4096)] | None = None
    frequency_hz: Annotated[float, Field(ge=1e3, le=1e15)] = 30e9
    spacing_wavelengths: Annotated[float, Field(gt=0, le=1e4)] = 0.5
    spacing_m: Annotated[float, Field(gt=0, le=1e4)] | None = None
    element: Literal["isotropic", "cosine", "3gpp"] = "isotropic"
    element_exponent: Annotated[float, Field(ge=0, le=100)] = 1.0
    mount_roll_deg: float = 0.0
    mount_pitch_deg: float = 0.0
    mount_yaw_deg: float = 0.0
    lever_arm_m: Position = (0.0, 0.0, 0.0)
    field_of_view_deg: Annotated[float, Field(gt=0, le=360)] | None = None
    azimuth_limits_deg: Annotated[Interval, AfterValidator(_rising)] | None = None
    elevation_limits_deg: Annotated[Interval, AfterValidator(_rising)] | None = None
    hidden_deg: tuple[HiddenSector, ...] = ()

    @model_validator(mode="after")
    def _listed(self) -> Self:
        listed = self.positions is not None or self.positions_m is not None
        if (self.kind == "list") != listed:
            raise ValueError('kind = "list" goes with positions or positions_m, and they with it')
        if self.kind == "ura" and self.rows * self.columns > 4096:
            raise ValueError("rows x columns is at most 4096")
        return self


class BeamSettings(Section):
    """When weights are made, for when, for whom, how, and what is done when that costs too much.

    ``update_hz`` is how often weights are made unasked, for recordings and for the page. Whoever
    asks gets weights made for that moment and the lead asked for, however seldom that is.

    ``method`` is zero forcing, regularised (by ``regularisation`` times the number of elements) or
    maximum ratio. Where zero forcing would cost any UAV more than ``loss_limit_db`` against a beam
    for it alone, or the condition number passes ``condition_limit``, the ``policy`` decides:
    ``regularise`` by as little as will do, ``group`` the UAVs into turns, or ``drop`` those of the
    lowest ``priority`` (UAVs in descending order; those not named follow in the order in which
    they were first heard). ``widen``: main lobes and nulls are as wide as the pointing bound.

    Up to ``condition_limit`` = 1000 zero forcing holds to 1e-9: its error grows with the square.
    """

    update_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0
    actuation_delay_s: Annotated[float, Field(ge=0, le=10)] = 0.01
    targets: Literal["telemetry", "all"] = "telemetry"
    method: Method = Method.ZERO_FORCING
    policy: Policy = Policy.REGULARISE
    loss_limit_db: Annotated[float, Field(gt=0, le=60)] = 3.0
    condition_limit: Annotated[float, Field(gt=1, le=1e3)] = 100.0
    regularisation: Annotated[float, Field(gt=0, le=1e6)] = 0.01
    normalisation: Normalisation = Normalisation.UNIT_RESPONSE
    priority: Annotated[tuple[str, ...], AfterValidator(_once)] = ()
    widen: bool = True


class CodebookSettings(Section):
    """The stored beams of an array that can only choose among them.

    ``dft``: for lines and rectangles, ``oversampling`` times as many beams as elements on each
    axis. ``file``: a .npy file of M rows (elements) and a column for each beam.
    """

    kind: Literal["none", "dft", "file"] = "none"
    oversampling: Annotated[int, Field(ge=1, le=16)] = 1
    file: str | None = None

    @model_validator(mode="after")
    def _named(self) -> Self:
        if (self.kind == "file") != (self.file is not None):
            raise ValueError('kind = "file" goes with file, and file with it')
        return self


class HardwareSettings(Section):
    """What drives the array: a calibration table (CSV: channel, element, phase_deg, gain_db)."""

    calibration: str | None = None


class RadioSettings(Section):
    """The radio link, for the signal-to-noise figures: power of all beams together, bandwidth,
    the noise figure of the UAVs' receivers, and how many antennas each combines."""

    tx_power_dbm: Annotated[float, Field(ge=-100, le=100)] = 20.0
    bandwidth_hz: PositiveFloat = 50e6
    noise_figure_db: Annotated[float, Field(ge=0, le=60)] = 7.0
    uav_antennas: Annotated[int, Field(ge=1, le=256)] = 4
