"""Settings of the array, the beams, the codebook, the hardware and the radio."""

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from companion.settings.section import Section, UavName
from companion.values import ArrayKind, Method, Normalisation, Policy, Power, UserError, Widen

Metres = Annotated[float, Field(ge=-1e4, le=1e4)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Position = tuple[Metres, Metres, Metres]
Interval = tuple[Degrees, Degrees]
HiddenSector = tuple[Degrees, Degrees, Degrees, Degrees]


def _ascending(interval: Interval) -> Interval:
    if not interval[0] < interval[1]:
        raise UserError("give [from, to] with from < to")
    return interval


def _named_width(given: object) -> object:
    """Convert booleans of earlier settings to a ``Widen``: true is GUARANTEE, false is NO."""
    if isinstance(given, bool):
        return Widen.GUARANTEE if given else Widen.NO
    return given


def _unique(names: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(names)) < len(names):
        raise UserError("a UAV is listed twice; list each UAV once, highest priority first")
    return names


class ArraySettings(Section):
    """The antenna array, and its mounting on the carrier.

    ``kind`` is the geometry in the array frame (x boresight, y right, z down):

        ula        ``elements`` along y
        ura        ``rows`` down and ``columns`` to the right
        uca        ``elements`` on a circle in the xy plane
        hexagonal  ``rings`` of hexagons around a centre element, in the yz plane
        list       ``positions_m``: rows of x, y, z, or of x, y, z and the direction that the
                   element faces. ``positions`` names a file of such rows (CSV or .npy), which is
                   read into ``positions_m``

    ``spacing_m``, if given, replaces ``spacing_wavelengths``.

    The mount angles rotate the body frame into the array frame: yaw, then pitch, then roll.
    ``lever_arm_m`` is the position of the array in the body frame (forward, right, down), measured
    from the point whose position the carrier reports.

    ``field_of_view_deg`` is the full angle of a cone around boresight. The azimuth and elevation
    limits are the steering limits of the hardware, in the array frame. ``hidden_deg`` lists sectors
    that the airframe blocks, in the body frame: azimuth from and to (clockwise from the nose),
    elevation from and to.

    ``dead`` lists elements, from 0, that do not radiate; weights are computed without them.
    ``coupling`` is a .npy file of the matrix C (M, M): elements fed with f radiate C f.
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
    azimuth_limits_deg: Annotated[Interval, AfterValidator(_ascending)] | None = None
    elevation_limits_deg: Annotated[Interval, AfterValidator(_ascending)] | None = None
    hidden_deg: Annotated[tuple[HiddenSector, ...], Field(max_length=256)] = ()
    dead: Annotated[tuple[Annotated[int, Field(ge=0, le=4095)], ...], Field(max_length=4095)] = ()
    coupling: str | None = None

    @model_validator(mode="after")
    def _as_list(self) -> Self:
        listed = self.positions is not None or self.positions_m is not None
        if (self.kind is ArrayKind.LIST) != listed:
            raise UserError(
                'kind = "list" needs positions or positions_m; with other kinds leave both out'
            )
        if self.kind is ArrayKind.URA and self.rows * self.columns > 4096:
            raise UserError("too many elements: rows x columns must be at most 4096")
        return self


class BeamSettings(Section):
    """When and how weights are computed, and the fallback where zero forcing costs too much gain.

        update_hz          rate at which weights are computed for recordings and the dashboard; for
                           an HTTP request, weights are computed for the time that it asks for
        update             what renews the weights of ``[records]``: the "timer" of ``update_hz``
                           alone, or besides it each "report", for the beam of its UAV (unless
                           they contain guaranteed gains)
        actuation_delay_s  time from computing weights to applying them
        targets            which tracks get beams
        most               largest number of UAVs with beams: those of ``priority`` first, then
                           those received first; more would slow down all beams and use more memory
        method             zero forcing ("zf"), regularised ("rzf"), minimum mean square error by
                           the link budget ("mmse") or maximum ratio ("mrt")
        regularisation     loading of the regularised method, times the number of elements
        loss_limit_db      largest loss of any UAV by zero forcing, compared with a sharp beam for
                           it alone
        condition_limit    largest condition number of the steering matrix
        policy             what happens beyond either limit: load as little as possible, serve
                           groups in time slots, or drop the UAVs of lowest priority
        priority           UAVs in descending order; the others follow in the order received
        widen              width of the beams: "likely", for the usual error, with a gain floor
                           within the pointing bound; "guarantee", for the bound: the largest least
                           gain within it; "no", sharp. Earlier settings' true means "guarantee",
                           false "no"
        floor_db           gain floor of "likely" beams, over an isotropic element; at least 3 dB
                           below the best possible, and relaxed where it cannot be reached. Unset:
                           2.9 dB more than the link needs ([link] needed_db), most of which nulls
                           may cost
        power              how beams share the power: "equal", "max-min" (largest minimum SINR),
                           "weighted-sum" (of rates); unset: as the normalisation scales them. If
                           set, ``normalisation`` must be "total" (then the default) or "antenna"
        rate_weights       weight of a UAV's rate for "weighted-sum", by UAV id; 1 for the others

    ``condition_limit`` is at most 1000: up to there the zero-forcing identity holds to 1e-9, and
    its error grows with the square of the condition number.
    """

    update_hz: Annotated[float, Field(ge=0.1, le=1000)] = 10.0
    update: Literal["timer", "report"] = "timer"
    actuation_delay_s: Annotated[float, Field(ge=0, le=10)] = 0.01
    targets: Literal["telemetry", "all"] = "telemetry"
    most: Annotated[int, Field(ge=1, le=4096)] = 256
    method: Method = Method.ZERO_FORCING
    policy: Policy = Policy.REGULARISE
    loss_limit_db: Annotated[float, Field(gt=0, le=60)] = 3.0
    condition_limit: Annotated[float, Field(gt=1, le=1e3)] = 100.0
    regularisation: Annotated[float, Field(gt=0, le=1e6)] = 0.01
    normalisation: Normalisation = Normalisation.UNIT_RESPONSE
    priority: Annotated[tuple[UavName, ...], AfterValidator(_unique)] = ()
    widen: Annotated[Widen, BeforeValidator(_named_width)] = Widen.LIKELY
    floor_db: Annotated[float, Field(ge=-60, le=60)] | None = None
    power: Power | None = None
    rate_weights: dict[UavName, Annotated[float, Field(gt=0, le=1e6)]] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _together(cls, given: Any) -> Any:
        """Default to "total" if power is shared, since only jointly scaled columns show shares."""
        if isinstance(given, dict) and given.get("power") is not None:
            return {"normalisation": Normalisation.TOTAL} | given
        return given

    @model_validator(mode="after")
    def _shared(self) -> Self:
        if self.power and self.normalisation not in (Normalisation.TOTAL, Normalisation.ANTENNA):
            raise UserError('power needs normalisation = "total" or "antenna"')
        return self


class CodebookSettings(Section):
    """Stored beams of an array that can only select among them.

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
            raise UserError('kind = "file" needs file; other kinds need none')
        return self


class HardwareSettings(Section):
    """The hardware behind the array.

    ``calibration`` names a table of its channels (CSV: channel, element, phase_deg, gain_db, and if
    known phase_error_deg, gain_error_db), or TOML with one table for each of several frequencies
    (``companion/beams/hardware/calibration_tables.py``).
    ``phase_error_deg`` and ``gain_error_db`` bound the error of each calibrated channel; guaranteed
    gains include them. Bounds in the calibration table take precedence.
    ``device`` is the device for which weights are quantised; guaranteed gains in the API then hold
    for what it radiates. ``unit`` names a file with the possible gains of a TMYTEK unit
    (``companion/beams/hardware/unit_gains.py``).
    """

    calibration: str | None = None
    phase_error_deg: Annotated[float, Field(ge=0, le=180)] = 0.0
    gain_error_db: Annotated[float, Field(ge=0, le=60)] = 0.0
    device: Literal["adar1000", "tmytek", "sivers"] | None = None
    unit: str | None = None


class RadioSettings(Section):
    """Parameters of the radio link, from which SNR and SINR are computed.

    noise_figure_db  noise figure of the UAVs' receivers
    """

    tx_power_dbm: Annotated[float, Field(ge=-100, le=100)] = 20.0  # power of all beams together
    bandwidth_hz: Annotated[float, Field(ge=1, le=1e12)] = 50e6  # noise bandwidth
    noise_figure_db: Annotated[float, Field(ge=0, le=60)] = 7.0
    uav_antennas: Annotated[int, Field(ge=1, le=256)] = 4  # antennas that each UAV combines


class NeedSettings(Section):
    """Requirements of a good link to a UAV.

    needed_db       least array gain over an isotropic antenna, dB
    needed_sinr_db  if set, used instead: SINR of the lowest rate, by the budget of ``[radio]``

    A link is good if the guaranteed gain suffices, weak if only the likely gain does, and none
    otherwise.
    """

    needed_db: Annotated[float, Field(ge=-60, le=60)] = 0.0
    needed_sinr_db: Annotated[float, Field(ge=-60, le=60)] | None = None
