"""Settings of the array, the beams, the codebook, the hardware and the radio."""

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from companion.settings.section import Section
from companion.values import ArrayKind, Method, Normalisation, Policy, Power, UserError, Widen

Metres = Annotated[float, Field(ge=-1e4, le=1e4)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Position = tuple[Metres, Metres, Metres]
Interval = tuple[Degrees, Degrees]
HiddenSector = tuple[Degrees, Degrees, Degrees, Degrees]


def _rising(interval: Interval) -> Interval:
    if not interval[0] < interval[1]:
        raise UserError("from and to, the first less than the second")
    return interval


def _named_width(given: object) -> object:
    """True and false as earlier settings had them: as wide as the bound, and sharp."""
    if isinstance(given, bool):
        return Widen.GUARANTEE if given else Widen.NO
    return given


def _once(names: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(names)) < len(names):
        raise UserError("each UAV once, in descending order")
    return names


class ArraySettings(Section):
    """The antenna array, and how it is mounted on its carrier.

    ``kind`` is the geometry in the array frame (x boresight, y right, z down):

        ula        ``elements`` along y
        ura        ``rows`` down and ``columns`` to the right
        uca        ``elements`` on a circle in the xy plane
        hexagonal  ``rings`` of hexagons about a middle element, in the yz plane
        list       ``positions_m``: rows of x, y, z, or of x, y, z and the direction the element
                   faces. ``positions`` names a file of such rows (CSV or .npy), which is read into
                   ``positions_m``

    ``spacing_m``, where given, takes the place of ``spacing_wavelengths``.

    The mount angles turn the body frame into the array frame: yaw, then pitch, then roll.
    ``lever_arm_m`` is the array's place in the body frame (forward, right, down), measured from the
    point whose position the carrier reports.

    ``field_of_view_deg`` is the full angle of a cone about boresight. The azimuth and elevation
    limits are those of the hardware's steering, in the array frame. ``hidden_deg`` lists sectors
    that the airframe hides, in the body frame: azimuth from and to (clockwise from the nose),
    elevation from and to.

    ``dead`` lists elements, from 0, that radiate nothing: weights are made without them.
    ``coupling`` is a .npy file of the matrix C (M, M) by which elements carry C f when they are fed
    with f.
    """

    kind: ArrayKind = ArrayKind.ULA
    elements: Annotated[int, Field(ge=1, le=4096)] = 64
    rows: Annotated[int, Field(ge=1, le=256)] = 8
    columns: Annotated[int, Field(ge=1, le=256)] = 8
    rings: Annotated[int, Field(ge=1, le=36)] = 4
    positions: str | None = None
    positions_m: Annotated[tuple[tuple[Metres, ...], ...], Field(max_length=4096)] | None = None
    frequency_hz: Annotated[float, Field(ge=1e3, le=1e15)] = 30e9
    spacing_wavelengths: Annotated[float, Field(gt=0, le=1e4)] = 0.5
    spacing_m: Annotated[float, Field(gt=0, le=1e4)] | None = None
    element: Literal["isotropic", "cosine", "3gpp"] = "isotropic"
    element_exponent: Annotated[float, Field(ge=0, le=100)] = 1.0
    mount_roll_deg: Degrees = 0.0
    mount_pitch_deg: Degrees = 0.0
    mount_yaw_deg: Degrees = 0.0
    lever_arm_m: Position = (0.0, 0.0, 0.0)
    field_of_view_deg: Annotated[float, Field(gt=0, le=360)] | None = None
    azimuth_limits_deg: Annotated[Interval, AfterValidator(_rising)] | None = None
    elevation_limits_deg: Annotated[Interval, AfterValidator(_rising)] | None = None
    hidden_deg: tuple[HiddenSector, ...] = ()
    dead: Annotated[tuple[Annotated[int, Field(ge=0, le=4095)], ...], Field(max_length=4095)] = ()
    coupling: str | None = None

    @model_validator(mode="after")
    def _listed(self) -> Self:
        listed = self.positions is not None or self.positions_m is not None
        if (self.kind is ArrayKind.LIST) != listed:
            raise UserError('kind = "list" goes with positions or positions_m, and they with it')
        if self.kind is ArrayKind.URA and self.rows * self.columns > 4096:
            raise UserError("rows x columns is at most 4096")
        return self


class BeamSettings(Section):
    """When weights are made, by which method, and what is done where that costs too much gain.

        update_hz          how often weights are made unasked, for recordings and the dashboard; a
                           request over HTTP is answered with weights made for its own time
        actuation_delay_s  time from making weights to applying them
        targets            which tracks get beams
        most               UAVs that have beams at a time, those of ``priority`` first and then who
                           was here first; others would cost all of them their rate and memory
        method             zero forcing ("zf"), regularised ("rzf"), least mean square error by the
                           link budget ("mmse") or maximum ratio ("mrt")
        regularisation     loading of the regularised method, times the number of elements
        loss_limit_db      most that zero forcing may cost any UAV against a sharp beam for it alone
        condition_limit    largest condition number of the steering matrix
        policy             what is done beyond either limit: load as little as will do, serve groups
                           in time slots, or drop the UAVs of lowest priority
        priority           UAVs in descending order; the others follow in the order first heard
        widen              how wide beams are: "likely", for the error that is usual, over a floor
                           within the pointing bound; "guarantee", for the bound: the greatest least
                           gain within it; "no", sharp. Earlier settings' true is "guarantee", their
                           false "no"
        floor_db           that floor, over an isotropic element, where it leaves 3 dB to the best;
                           it is given up as it is further out of reach. Unset: 2.9 more than the
                           link needs ([link] needed_db), of which nulls may take most
        power              how beams share the power: "equal", "max-min" (the least SINR is the
                           greatest), "weighted-sum" (of rates); unset: as the normalisation makes
                           them. With it the normalisation is "total" unless it is "antenna"
        rate_weights       worth of a UAV's rate for "weighted-sum", by its name; 1 for the others

    ``condition_limit`` is at most 1000: up to there the zero-forcing identity holds to 1e-9, and
    its error grows with the square of the condition number.
    """

    update_hz: Annotated[float, Field(ge=1e-3, le=1000)] = 10.0
    actuation_delay_s: Annotated[float, Field(ge=0, le=10)] = 0.01
    targets: Literal["telemetry", "all"] = "telemetry"
    most: Annotated[int, Field(ge=1, le=4096)] = 256
    method: Method = Method.ZERO_FORCING
    policy: Policy = Policy.REGULARISE
    loss_limit_db: Annotated[float, Field(gt=0, le=60)] = 3.0
    condition_limit: Annotated[float, Field(gt=1, le=1e3)] = 100.0
    regularisation: Annotated[float, Field(gt=0, le=1e6)] = 0.01
    normalisation: Normalisation = Normalisation.UNIT_RESPONSE
    priority: Annotated[tuple[str, ...], AfterValidator(_once)] = ()
    widen: Annotated[Widen, BeforeValidator(_named_width)] = Widen.LIKELY
    floor_db: Annotated[float, Field(ge=-60, le=60)] | None = None
    power: Power | None = None
    rate_weights: dict[str, Annotated[float, Field(gt=0, le=1e6)]] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _together(cls, given: Any) -> Any:
        """Shares of power are seen in columns that are scaled together only."""
        if isinstance(given, dict) and given.get("power") is not None:
            return {"normalisation": Normalisation.TOTAL} | given
        return given

    @model_validator(mode="after")
    def _shared(self) -> Self:
        if self.power and self.normalisation not in (Normalisation.TOTAL, Normalisation.ANTENNA):
            raise UserError('power goes with normalisation = "total" or "antenna"')
        return self


class CodebookSettings(Section):
    """The stored beams of an array that can only choose among them.

    dft   for lines and rectangles: ``oversampling`` times as many beams as elements on each
          axis
    file  a .npy file with a row per element (M) and a column per beam
    """

    kind: Literal["none", "dft", "file"] = "none"
    oversampling: Annotated[int, Field(ge=1, le=16)] = 1
    file: str | None = None

    @model_validator(mode="after")
    def _named(self) -> Self:
        if (self.kind == "file") != (self.file is not None):
            raise UserError('kind = "file" goes with file, and file with it')
        return self


class HardwareSettings(Section):
    """The hardware behind the array.

    ``calibration`` names a table of its channels (CSV: channel, element, phase_deg, gain_db, and if
    known phase_error_deg, gain_error_db), or TOML with a table for each of several frequencies
    (``companion/beams/hardware/calibration_tables.py``).
    ``phase_error_deg`` and ``gain_error_db`` are the most that each channel is off after it: bounds
    for which guaranteed gains then hold. A table that says bounds of its own has the last word.
    ``device`` is what the weights are quantised for: guaranteed gains in the API are then of what
    it radiates. ``unit`` names a file of what gains a TMYTEK unit can have
    (``companion/beams/hardware/unit_gains.py``).
    """

    calibration: str | None = None
    phase_error_deg: Annotated[float, Field(ge=0, le=180)] = 0.0
    gain_error_db: Annotated[float, Field(ge=0, le=60)] = 0.0
    device: Literal["adar1000", "tmytek", "sivers"] | None = None
    unit: str | None = None


class RadioSettings(Section):
    """The radio link, from which signal-to-noise figures are computed.

    noise_figure_db  noise figure of the UAVs' receivers
    """

    tx_power_dbm: Annotated[float, Field(ge=-100, le=100)] = 20.0  # power of all beams together
    bandwidth_hz: Annotated[float, Field(ge=1, le=1e12)] = 50e6  # noise bandwidth
    noise_figure_db: Annotated[float, Field(ge=0, le=60)] = 7.0
    uav_antennas: Annotated[int, Field(ge=1, le=256)] = 4  # antennas that each UAV combines


class NeedSettings(Section):
    """What the link to a UAV needs to be called good.

    needed_db       least array gain over an isotropic antenna, dB
    needed_sinr_db  in its place, the SINR of the lowest rate, by the budget of ``[radio]``

    A link is good where the gain that is guaranteed is enough, weak where only the one that is
    likely is, and none otherwise.
    """

    needed_db: Annotated[float, Field(ge=-60, le=60)] = 0.0
    needed_sinr_db: Annotated[float, Field(ge=-60, le=60)] | None = None
