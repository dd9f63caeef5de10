"""Sources of a drive's beams: a service over HTTP, or the pipeline of this process."""

import asyncio
import math
import statistics
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from companion.beams.aim import directions
from companion.beams.array.geometry import Array
from companion.beams.hardware import codebooks, tables
from companion.beams.hardware.calibration import Calibration
from companion.beams.hardware.devices import Beamformer
from companion.client import Client, ServiceError
from companion.node.drive.loop import TEXT_MAX, DeviceCommand, DeviceInput, SourceLostError
from companion.pipeline.assembly import Equipment
from companion.pipeline.fold import Pipeline
from companion.values import IntArray, Update, UserError, WeightFormat
from companion.views import beam_state
from companion.views.as_json import as_json
from companion.views.quantised import device_table

ADAR1000: Final = WeightFormat.ADAR1000.media_type
MIN_MEAN_VECTOR: Final = 0.1  # length of the mean of unit directions below which it is undefined
ANSWERS_S: Final = 5.0  # timeout for an answer of the event loop
STORED_MAX: Final = 1 << 16  # limit on the index of a stored beam
REGISTER_LIMITS: Final = np.array([1 << 16, 5, 1 << 16, 128, 128, 2, 64, 64])
"""Limits of the columns of a table for ADAR1000: channels count from 1, I and Q have six bits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamRequest:
    """Request for beams: the first of these UAVs that has one, else any UAV if ``any_uav``.

    centre        a mount points at the centre of all of them instead
    stored_beams  size of the codebook in the device; None: it has none

    Raises ``UserError`` if an array is to point at a centre.
    """

    uavs: tuple[str, ...]
    any_uav: bool
    takes: DeviceInput
    stored_beams: int | None = None
    centre: bool = False

    def __post_init__(self) -> None:
        if self.centre and self.takes is not DeviceInput.POINTING:
            raise UserError('aim = "centre" works only for a mount; set aim = "first"')


class HttpSource:
    """Source of beams: a service over HTTP."""

    def __init__(self, client: Client, wanted: BeamRequest) -> None:
        self._client = client
        self._wanted = wanted

    def ask(self, lead_s: float) -> DeviceCommand:
        """Return the device command for ``lead_s`` from now; takes at most two requests."""
        lead_ms = min(max(lead_s, 0.0), 10.0) * 1e3
        valid_at_ns = time.time_ns() + round(lead_ms * 1e6)
        try:
            told = self._client.beams(lead_ms)
            text = (
                self._client.table(ADAR1000, lead_ms)
                if self._wanted.takes is DeviceInput.REGISTERS
                else None
            )
        except ServiceError as error:
            if error.status == 409:
                return DeviceCommand(valid_at_ns=valid_at_ns, unfit=error.title)
            raise SourceLostError(str(error)) from error
        try:
            command = command_for(told, text, self._wanted, valid_at_ns)
            _require_plausible(command)
        except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
            raise SourceLostError(
                "beams are malformed; check the address of the service"
            ) from error
        return command


def _require_plausible(command: DeviceCommand) -> None:
    """Raise ``ValueError`` for values of a service that no device can apply."""
    lat_deg, lon_deg, alt_m = command.place or (0.0, 0.0, 0.0)
    limited = ((lat_deg, 90.0), (lon_deg, 180.0), (alt_m, 1e6), (command.above_rad, math.pi / 2))
    if not all(abs(value) <= most for value, most in (*limited, (command.bearing_rad, 7.0))):
        raise ValueError("position or direction out of range")
    if command.stored is not None and not 0 <= command.stored < STORED_MAX:
        raise ValueError("index of a stored beam out of range")
    rows = command.registers
    if rows is None:
        return
    channels = {(chip, channel) for chip, channel, *_ in rows.tolist()}
    if not ((rows >= 0) & (rows < REGISTER_LIMITS)).all() or len(channels) != len(rows):
        raise ValueError("registers out of range, or twice for one channel")


class LocalSource:
    """Source of beams: the pipeline of this process, which runs on an event loop."""

    def __init__(
        self,
        *,
        loop: asyncio.AbstractEventLoop,
        pipeline: Pipeline,
        equipment: Equipment,
        now_ns: Callable[[], int],
        wanted: BeamRequest,
    ) -> None:
        self._loop = loop
        self._pipeline = pipeline
        self._equipment = equipment
        self._now_ns = now_ns
        self._wanted = wanted

    def ask(self, lead_s: float) -> DeviceCommand:
        """Return the device command for ``lead_s`` from now; the loop computes only the beams."""
        asked = asyncio.run_coroutine_threadsafe(self._look(lead_s), self._loop)
        try:
            update = asked.result(ANSWERS_S)
        except (TimeoutError, asyncio.CancelledError) as error:
            raise SourceLostError("timeout") from error
        return command_of(self._pipeline, self._equipment, update, self._wanted)

    async def _look(self, lead_s: float) -> Update:
        return self._pipeline.look(self._now_ns(), lead_s)


def command_of(
    pipeline: Pipeline, equipment: Equipment, update: Update, wanted: BeamRequest
) -> DeviceCommand:
    """Return the device command from one update. Only the requested beam is quantised."""
    beams, text = update.beams, None
    uav = followed_uavs(beams.uavs, wanted)
    if update.unfit is None and uav is not None and wanted.takes is DeviceInput.REGISTERS:
        try:
            table = device_table(Beamformer.ADAR1000, beams, pipeline.array, equipment, uav)
            text = tables.encode(table)
        except UserError as error:
            return DeviceCommand(valid_at_ns=beams.valid_at_ns, unfit=str(error))
    pointed, codebook = beam_state.pointing(pipeline, update), equipment.codebook
    shown: list[dict[str, Any]] = [
        {"uav": uav} | as_json(one, pipeline.utc_ns)
        for uav, one in zip(beams.uavs, pointed, strict=bool(pointed))
    ]
    if wanted.takes is DeviceInput.STORED and codebook is not None and shown:
        best, _ = codebooks.best(codebook, pipeline.array, directions(beams))
        for beam, index in zip(shown, best.tolist(), strict=True):
            beam["codebook"] = {"best": index}
    size = None if codebook is None else codebook.size
    told = {"unfit": update.unfit, "beams": shown, "codebook_beams": size}
    return command_for(told, text, wanted, beams.valid_at_ns)


def stored_registers(array: Array, equipment: Equipment) -> list[IntArray]:
    """Return the registers (M, 8) of each beam of the codebook. Raises ``UserError`` without one.

    Each beam is fitted towards its direction of largest gain.
    """
    codebook = equipment.codebook
    if codebook is None:
        raise UserError('[codebook]: no stored beams; set kind = "dft" or kind = "file"')
    wanted = [
        tables.WantedBeam(
            uav=str(k),
            weights=column,
            azimuth_rad=0.0,
            elevation_rad=0.0,
            steering=column.conj()[:, np.newaxis],
        )
        for k, column in enumerate(codebook.weights.T)
    ]
    calibration = equipment.calibration or Calibration.ideal(range(array.size))
    text = tables.encode(tables.fit(Beamformer.ADAR1000, wanted, calibration))
    return [registers_of(text, beam.uav) for beam in wanted]


def followed_uavs(uavs: Collection[str], wanted: BeamRequest) -> str | None:
    """Return the UAV to follow of those that have beams; None if no wanted UAV has one."""
    uav = next((one for one in wanted.uavs if one in uavs), None)
    return next(iter(uavs), None) if uav is None and wanted.any_uav else uav


def command_for(
    told: dict[str, Any], text: str | None, wanted: BeamRequest, valid_at_ns: int
) -> DeviceCommand:
    """Return the device command for the requested UAV, from an answer of the API."""
    if told["unfit"] is not None:
        return DeviceCommand(valid_at_ns=valid_at_ns, unfit=str(told["unfit"])[:TEXT_MAX])
    named = {beam["uav"]: beam for beam in told["beams"]}
    uav = followed_uavs(named, wanted)
    if uav is None:
        return DeviceCommand(valid_at_ns=valid_at_ns, unfit="none of the UAVs to follow has a beam")
    if wanted.centre:
        several = named if wanted.any_uav else wanted.uavs
        return _middle([named[one] for one in several if one in named], valid_at_ns)
    beam, rows = named[uav], None if text is None else registers_of(text, uav)
    if rows is not None and not len(rows):
        return DeviceCommand(
            valid_at_ns=valid_at_ns, unfit=f"{uav} has no beam in the device's table"
        )
    stored = None
    if wanted.takes is DeviceInput.STORED:
        size = told["codebook_beams"]
        if size is None or wanted.stored_beams not in (None, size):
            return DeviceCommand(
                valid_at_ns=valid_at_ns,
                unfit="codebook of the service differs from --config, or is missing",
            )
        stored = beam["codebook"]["best"]
    return DeviceCommand(
        valid_at_ns=valid_at_ns,
        unfit=None,
        uav=uav,
        bearing_rad=math.radians(beam["bearing_deg"]),
        above_rad=math.radians(beam["above_horizon_deg"]),
        place=(beam["lat_deg"], beam["lon_deg"], beam["alt_m"]),
        registers=rows,
        stored=stored,
    )


def _middle(beams: list[dict[str, Any]], valid_at_ns: int) -> DeviceCommand:
    """Return the mean direction of beams, and the mean position of their UAVs."""
    bearing = np.radians([beam["bearing_deg"] for beam in beams])
    above = np.radians([beam["above_horizon_deg"] for beam in beams])
    level = np.cos(above)
    north, east, up = (
        float(part.sum())
        for part in (level * np.cos(bearing), level * np.sin(bearing), np.sin(above))
    )
    if math.hypot(north, east, up) < MIN_MEAN_VECTOR * len(beams):
        return DeviceCommand(
            valid_at_ns=valid_at_ns,
            unfit="mean direction of the UAVs is undefined, as they surround the array; follow"
            " fewer UAVs",
        )
    lat_deg, alt_m = (
        statistics.fmean(beam[name] for beam in beams) for name in ("lat_deg", "alt_m")
    )
    first_deg = beams[0]["lon_deg"]
    east_deg = [math.remainder(beam["lon_deg"] - first_deg, 360.0) for beam in beams]
    lon_deg = math.remainder(first_deg + statistics.fmean(east_deg), 360.0)
    return DeviceCommand(
        valid_at_ns=valid_at_ns,
        unfit=None,
        uav="+".join(beam["uav"] for beam in beams),
        bearing_rad=math.atan2(east, north),
        above_rad=math.atan2(up, math.hypot(north, east)),
        place=(lat_deg, lon_deg, alt_m),
    )


def registers_of(text: str, uav: str) -> IntArray:
    """Return the registers (M, 8) of a UAV's beam in an ADAR1000 text; empty without a beam."""
    rows = [line.split(",") for line in text.splitlines()[1:]]
    return np.array(
        [
            [*map(int, (*row[2:6], row[7], row[8])), int(row[9], 16), int(row[10], 16)]
            for row in rows
            if row[1] == uav
        ],
        dtype=np.int64,
    ).reshape(-1, 8)
