"""Construction of the pipeline's parts from the settings.

Over 300 lines: a function for each section of the settings, and nothing else.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from companion.beams.array import geometry
from companion.beams.array.coverage import Coverage, Sector
from companion.beams.hardware import codebooks
from companion.beams.hardware.calibration import Calibration, channel_error
from companion.beams.hardware.calibration_tables import calibration_at
from companion.beams.hardware.codebooks import Codebook
from companion.beams.hardware.devices import Beamformer
from companion.beams.hardware.unit_gains import RELATIVE, UnitGains, parse_unit_gains
from companion.beams.weights.precoding import Precoder
from companion.beams.worth.link_budget import LinkBudget
from companion.mavlink.clock.estimates import ClockAssumptions
from companion.mavlink.clock.sender_clock import SenderClock
from companion.pipeline import elements
from companion.settings.center import VehicleCenter, parse_center
from companion.settings.files import kinematic_design, matrix_of, text_of
from companion.settings.model import CALIBRATION, CODEBOOK, COUPLING, UNIT, Settings
from companion.settings.section import ConfigError
from companion.tracking.attitude_evidence import AttitudeAssumptions
from companion.tracking.gate import GateSettings
from companion.tracking.limits import LIMITS, Airframe, airframe, lag_s
from companion.tracking.noise import NoiseSettings
from companion.tracking.observers.kinematic import KinematicModel, KinematicObserver, scheduled
from companion.tracking.observers.position import PositionModel, PositionObserver
from companion.tracking.track_snapshot import Ages
from companion.tracking.tracker import Tracker, TrackerSettings
from companion.values import FloatArray, Limits, LimitSource, ReportNoise, UserError, kind_of

FLOOR_MARGIN_DB: Final = 2.9
"""Default margin of a likely beam's gain floor above the gain that the link needs, dB."""
COUPLED_MAX: Final = 512  # most elements with coupling; an update of 1024 takes 0.3 s
EXTENT_WAVELENGTHS_MAX: Final = 20_000
"""Largest extent of an array: patterns are sampled at each side lobe."""
DEVICE_ELEMENTS_MAX: Final = 1024  # with a device: the search takes time and memory
COUPLING_MAX: Final = 1e6
"""Limit of the largest entry of a coupling matrix; its inverse is the lower limit."""
COUPLING_CONDITION_MAX: Final = 1e6
"""Limit of the condition number of a coupling matrix."""


def array(settings: Settings) -> geometry.Array:
    """Return the antenna array on its mount, with dead elements, coupling and channel errors.

    Raises ``ConfigError``.
    """
    placed = elements.placed(settings)
    extent = 2.0 * np.linalg.norm(placed.centred_m, axis=1).max() / placed.wavelength_m
    if extent > EXTENT_WAVELENGTHS_MAX:
        raise ConfigError(
            f"array: elements are up to {extent:.3g} wavelengths apart, the limit is"
            f" {EXTENT_WAVELENGTHS_MAX}; check their positions, in metres, and `frequency_hz`"
        )
    size, dead = placed.size, sorted(set(settings.array.dead))
    live = None
    if dead:
        if dead[-1] >= size or len(dead) == size:
            raise ConfigError(
                f"array.dead: {dead[-1]} does not exist, or no element is left;"
                f" list some of 0..{size - 1}, not all"
            )
        live = np.ones(size, dtype=bool)
        live[dead] = False
    if size > COUPLED_MAX and settings.array.coupling is not None:
        raise ConfigError(
            f"array.coupling: {size} elements; with coupling an array has at most {COUPLED_MAX}"
        )
    coupling = matrix_of(settings, COUPLING)
    if coupling is not None:
        if coupling.shape != (size, size) or not np.isfinite(coupling).all():
            raise ConfigError(
                f"array.coupling: shape {coupling.shape}, or an entry is not finite;"
                f" give a finite {size} x {size} matrix"
            )
        most = max(np.abs(coupling.real).max(), np.abs(coupling.imag).max())
        if not 1 / COUPLING_MAX <= most <= COUPLING_MAX:
            allowed = f"{1 / COUPLING_MAX:g} .. {COUPLING_MAX:g}"
            raise ConfigError(f"array.coupling: largest entry {most:.3g} is outside {allowed}")
        condition = np.linalg.cond(coupling)
        if condition > COUPLING_CONDITION_MAX:
            why = f"condition number {condition:.3g}, limit {COUPLING_CONDITION_MAX:g}"
            raise ConfigError(
                f"array.coupling: matrix is nearly singular ({why});"
                " give measured values or leave it out"
            )
    return replace(
        placed, live=live, coupling=coupling, channel_error=_channel_error(settings, size)
    )


def _channel_error(settings: Settings, size: int) -> FloatArray | None:
    """Return the error bound of each channel (M,), from the calibration or else the settings."""
    given, table = settings.hardware, calibration(settings, size)
    if table is not None and table.phase_error_rad:
        return channel_error(np.array(table.phase_error_rad), np.array(table.gain_error_db))
    if not given.phase_error_deg and not given.gain_error_db:
        return None
    all_elements = np.ones(size)
    return channel_error(
        np.radians(given.phase_error_deg) * all_elements, given.gain_error_db * all_elements
    )


def calibration(settings: Settings, size: int) -> Calibration | None:
    """Return the calibration of the channels of ``size`` elements; None if there is none.

    Raises ``ConfigError``.
    """
    text = text_of(settings, CALIBRATION)
    try:
        found = None if text is None else calibration_at(text, settings.array.frequency_hz)
    except UserError as error:
        raise ConfigError(f"hardware.calibration: {error}") from error
    if found is not None and len(found.order) != size:
        channels = f"{len(found.order)} channels for {size} elements"
        raise ConfigError(f"hardware.calibration: {channels}; list one channel per element")
    return found


def coverage(settings: Settings) -> Coverage:
    """Return the directions in which beams may point. Raises ``ConfigError``."""
    given = settings.array

    def radians(limits: tuple[float, float] | None) -> tuple[float, float] | None:
        return None if limits is None else (np.radians(limits[0]), np.radians(limits[1]))

    view = given.field_of_view_deg
    try:
        return Coverage(
            field_of_view_rad=None if view is None else np.radians(view),
            azimuth_limits_rad=radians(given.azimuth_limits_deg),
            elevation_limits_rad=radians(given.elevation_limits_deg),
            hidden=tuple(
                Sector(
                    azimuth_from_rad=math.radians(azimuth_from),
                    azimuth_to_rad=math.radians(azimuth_to),
                    elevation_from_rad=math.radians(elevation_from),
                    elevation_to_rad=math.radians(elevation_to),
                )
                for azimuth_from, azimuth_to, elevation_from, elevation_to in given.hidden_deg
            ),
        )
    except UserError as error:
        raise ConfigError(f"array: {error}") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Equipment:
    """Hardware and radio link, which the pipeline itself does not need."""

    codebook: Codebook | None  # stored beams; None without
    calibration: Calibration | None  # calibration of the hardware; None without
    budget: LinkBudget  # power, bandwidth and noise figure of the radio link
    uav_antennas: int  # antennas that each UAV combines
    device: Beamformer | None = None  # device for which weights are quantised
    unit_gains: UnitGains = RELATIVE  # possible gains of a TMYTEK unit's channels


def codebook(settings: Settings, antenna: geometry.Array) -> Codebook | None:
    """Return the codebook that the settings describe; reads its file. None if there is none.

    Raises ``ConfigError``.
    """
    kept = settings.codebook
    try:
        if kept.kind == "dft":
            return codebooks.dft(antenna, kept.oversampling)
        listed = matrix_of(settings, CODEBOOK)
        return None if listed is None else codebooks.listed(listed, antenna)
    except ConfigError:
        raise
    except UserError as error:
        raise ConfigError(f"codebook: {error}") from error


def equipment(settings: Settings, antenna: geometry.Array) -> Equipment:
    """Return the equipment that the settings describe; reads the files that they name.

    Raises ``ConfigError``.
    """
    stored = codebook(settings, antenna)
    device = None if settings.hardware.device is None else Beamformer(settings.hardware.device)
    if device is not None and antenna.size > DEVICE_ELEMENTS_MAX:
        raise ConfigError(
            f"hardware.device: the array has {antenna.size} elements; weights are quantised for at"
            f" most {DEVICE_ELEMENTS_MAX}"
        )
    text = text_of(settings, UNIT)
    try:
        gains = RELATIVE if text is None else parse_unit_gains(text)
    except UserError as error:
        raise ConfigError(f"hardware.unit: {error}") from error
    channels = calibration(settings, antenna.size)
    budget, antennas = radio(settings)
    return Equipment(
        codebook=stored,
        calibration=channels,
        budget=budget,
        uav_antennas=antennas,
        device=device,
        unit_gains=gains,
    )


def precoder(settings: Settings) -> Precoder:
    """Return the precoder that the settings describe."""
    given = settings.beams
    budget, antennas = radio(settings)
    worth_db = 0.0 if settings.link.needed_sinr_db is not None else settings.link.needed_db
    return Precoder(
        method=given.method,
        policy=given.policy,
        loss_limit_db=given.loss_limit_db,
        condition_limit=given.condition_limit,
        regularisation=given.regularisation,
        normalisation=given.normalisation,
        priority=given.priority,
        widen=given.widen,
        floor_db=worth_db + FLOOR_MARGIN_DB if given.floor_db is None else given.floor_db,
        power=given.power,
        rate_weights=given.rate_weights,
        budget=budget,
        uav_antennas=antennas,
        worth_db=worth_db,
    )


def radio(settings: Settings) -> tuple[LinkBudget, int]:
    """Return the link budget, and the number of antennas that each UAV combines, as set."""
    given = settings.radio
    budget = LinkBudget(
        tx_power_dbm=given.tx_power_dbm,
        bandwidth_hz=given.bandwidth_hz,
        noise_figure_db=given.noise_figure_db,
    )
    return budget, given.uav_antennas


def noise(settings: Settings) -> NoiseSettings:
    """Return the bounds on the errors of reports, as set."""
    given = settings.observer
    most_m = given.position_noise_m
    default = ReportNoise(
        horizontal_m=most_m,
        vertical_m=most_m,
        position_m=most_m,
        velocity_mps=given.velocity_noise_mps,
    )
    return NoiseSettings(default, given.accuracy_factor if given.follow_accuracy else None)


def attitude_assumptions(settings: Settings) -> AttitudeAssumptions:
    """Return the assumptions about the errors of the carrier's reported attitudes."""
    given = settings.center
    return AttitudeAssumptions(
        bound_rad=math.radians(given.attitude_bound_deg),
        factor=settings.observer.accuracy_factor,
        follows_accuracy=given.follow_attitude_accuracy,
        mount_rad=math.radians(given.mount_bound_deg),
    )


@dataclass(frozen=True, slots=True)
class AircraftAssumptions:
    """Assumptions about one aircraft: limits, lag of its positions, angular acceleration."""

    limits: Limits
    lag_s: tuple[float, float]
    turn_degps2: float

    @property
    def lag_middle_s(self) -> float:
        """Middle of the position lag's interval, which is subtracted from a position's time."""
        return (self.lag_s[0] + self.lag_s[1]) / 2

    @property
    def lag_rest_s(self) -> float:
        """Half the width of the position lag's interval."""
        return (self.lag_s[1] - self.lag_s[0]) / 2


def assumed(
    settings: Settings, uav: str, mav_type: int | None, autopilot: int | None
) -> AircraftAssumptions:
    """Return the assumptions about a UAV: of its own settings, of its type, or the general ones.

    If no setting applies, the defaults of its type do. ``mav_type`` and ``autopilot`` are from its
    heartbeat; None if none was received.
    """
    given = settings.observer
    kind = Airframe.ADSB if kind_of(uav).may_be_manned else airframe(mav_type)
    known = LIMITS[kind]
    told = [given.uav.get(uav), given.types.get(kind.value), given]
    speed = next((one.speed_max_mps for one in told if one and one.speed_max_mps), None)
    most = next(
        (one.acceleration_max_mps2 for one in told if one and one.acceleration_max_mps2), None
    )
    lag = next((one.lag_s for one in told if one and one.lag_s), None)
    source = LimitSource.TYPE if speed is None and most is None else LimitSource.SETTINGS
    limits = Limits(speed or known.speed_mps, most or known.acceleration_mps2, source)
    if lag is None:
        lag = lag_s(kind, autopilot) if kind is not Airframe.ADSB else known.lag_s
    apart_s = settings.clocks.apart_s.get(uav, 0.0)
    lag = lag[0] - apart_s, lag[1] + apart_s
    turn_degps2 = settings.center.turn_acceleration_max_degps2
    return AircraftAssumptions(
        limits, lag, known.turn_degps2 if turn_degps2 is None else turn_degps2
    )


def widest(assumptions: Sequence[AircraftAssumptions]) -> AircraftAssumptions:
    """Return the assumptions that contain all given ones, with the source of the last."""
    if len(assumptions) == 1:
        return assumptions[0]
    limits = [one.limits for one in assumptions]
    lags = [one.lag_s for one in assumptions]
    return AircraftAssumptions(
        Limits(
            max(one.speed_max_mps for one in limits),
            max(one.acceleration_max_mps2 for one in limits),
            limits[-1].limits_source,
        ),
        (min(low for low, _ in lags), max(high for _, high in lags)),
        max(one.turn_degps2 for one in assumptions),
    )


def default_limits(settings: Settings) -> Limits:
    """Return the limits of an aircraft of unknown type."""
    return assumed(settings, "0:0", None, None).limits


def observer(settings: Settings) -> PositionObserver | KinematicObserver:
    """Return the observer that every track uses."""
    given, limits = settings.observer, default_limits(settings)
    if given.model == "position":
        return PositionObserver(
            PositionModel(
                speed_max_mps=limits.speed_max_mps,
                acceleration_max_mps2=limits.acceleration_max_mps2,
                alpha=None if given.alpha == "auto" else given.alpha,
                feedthrough_s=given.feedthrough_s,
                velocity_lead_s=given.velocity_lead_s,
            )
        )
    gain = scheduled(kinematic_design(settings))
    return KinematicObserver(
        KinematicModel(limits.speed_max_mps, limits.acceleration_max_mps2, gain)
    )


def clock(settings: Settings) -> SenderClock:
    """Return a clock estimator for a new sender."""
    given = settings.clocks
    return SenderClock(
        ClockAssumptions(
            constant_delay_s=given.constant_delay_s,
            trust_gnss=given.trust_gnss,
            node_utc_error_s=given.node_utc_error_s,
            window_s=given.window_s,
            drift_max_ppm=given.drift_max_ppm,
        )
    )


def tracker(settings: Settings) -> Tracker:
    """Return a new tracker, without tracks."""
    given, kept, limits = settings.observer, settings.tracks, default_limits(settings)
    leads = given.model == "position"
    lead_m = abs(given.feedthrough_s) * limits.speed_max_mps if leads else 0.0
    feeds = given.model == "kinematic" and given.feed_forward
    place = parse_center(settings.center.source or "home")
    return Tracker(
        observer(settings),
        TrackerSettings(
            limits=limits,
            ages=Ages(kept.coasting_s, kept.stale_s, kept.lost_s),
            gate=GateSettings(
                reacquire_reports=kept.reacquire_reports,
                reacquire_s=kept.reacquire_s,
                lead_m=lead_m,
                drift_max=settings.clocks.drift_max_ppm * 1e-6,
            ),
            window_s=kept.window_s,
            feed_forward=feeds,
            most=kept.most,
            carrier=str(place) if isinstance(place, VehicleCenter) else None,
            noise=noise(settings),
        ),
    )
