"""Device drivers: a chip stand-in that decodes its registers, the Phaser's own class over a
recording libiio, and codes equal to those of the device's table."""

import asyncio
import contextlib
import math
import re
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from device_reading import parse
from device_stand_ins import CHIPS, Chip, iio_module, into, spidev_module
from hypothesis import given
from hypothesis import strategies as st
from support import HANG_S, ROOT, run_async

from companion.beams.hardware.calibration import Calibration
from companion.beams.hardware.devices import Beamformer
from companion.node import moment
from companion.node.drive import running as driving
from companion.node.drive import targets
from companion.node.drive.adar1000 import Chips
from companion.node.drive.gimbal import Gimbal, RoiGimbal
from companion.node.drive.loop import (
    BeamSource,
    Device,
    DeviceCommand,
    DeviceError,
    DeviceInput,
    Drive,
    SafeState,
    SourceLostError,
    library_errors,
)
from companion.node.drive.sources import (
    BeamRequest,
    HttpSource,
    command_for,
    command_of,
    stored_registers,
)
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.values import Severity, Source, UserError, WeightFormat
from companion.views import beam_state, weight_formats

EIGHT = Settings().override(center={"source": "5:1"}, array={"elements": 8, "frequency_hz": 10.5e9})


@pytest.fixture(scope="module")
def flown() -> tuple[DeviceCommand, Any, str]:
    """Return a shot of a real flight, its UAV's beam as read back from the device's table, and that
    table."""
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    pipeline, update = moment.look([log], EIGHT, "3")
    equipment = assembly.equipment(EIGHT, pipeline.array)
    wanted = BeamRequest(uavs=("3:1",), any_uav=False, takes=DeviceInput.REGISTERS)
    shot = command_of(pipeline, equipment, update, wanted)
    text = weight_formats.encode(
        WeightFormat.ADAR1000, update.beams, pipeline, equipment, 0
    ).decode()
    read = parse(Beamformer.ADAR1000, text, Calibration.ideal(range(8)))
    return shot, read, text


class Always:
    """A source that always gives the same; None is a lost service."""

    def __init__(self, *shots: DeviceCommand | None) -> None:
        self._shots = list(shots)
        self.leads_s: list[float] = []

    def ask(self, lead_s: float) -> DeviceCommand:
        self.leads_s.append(lead_s)
        shot = self._shots.pop(0) if len(self._shots) > 1 else self._shots[0]
        if shot is None:
            raise SourceLostError("connection refused")
        return shot


class Ticking:
    """A clock advanced by the test."""

    def __init__(self) -> None:
        self.t_ns = 0

    def now_ns(self) -> int:
        return self.t_ns


# --- ADAR1000 over SPI --------------------------------------------------------------------------


@pytest.fixture
def spidev(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[tuple[int, int], Chip]]:
    monkeypatch.setitem(sys.modules, "spidev", spidev_module())
    CHIPS.clear()
    yield CHIPS


def factor(gain: int, i: int, q: int) -> complex:
    """Return what a channel's registers radiate by the data sheet's tables: sign and magnitude."""
    signed = [(value & 0x1F) * (1 if value & 0x20 else -1) for value in (i, q)]
    amplitude = (gain & 0x7F) / 127 * (1.0 if gain & 0x80 else 10 ** (-15 / 20))
    turned = complex(*signed)
    return amplitude * turned / abs(turned)


def test_chip_registers_radiate_the_table(
    spidev: dict[tuple[int, int], Chip], flown: tuple[DeviceCommand, Any, str]
) -> None:
    shot, read, _ = flown
    device = targets.device("adar1000:0.0,0.1", print, list)
    clock = Ticking()
    drive = Drive(
        source=Always(shot),
        device=device,
        update_hz=100.0,
        safe=SafeState.MUTE,
        now_ns=clock.now_ns,
        say=lambda *_: None,
    )
    for n in range(1, 4):
        drive.step()
        assert [chip.loads for chip in spidev.values()] == [n, n]  # one pulse per update
    got = [factor(*one) for key in ((0, 0), (0, 1)) for one in spidev[key].radiates]
    wanted = read.weights[:, list(read.uavs).index("3:1")]
    turn = np.vdot(got, wanted)
    assert abs(turn) / (np.linalg.norm(got) * np.linalg.norm(wanted)) > 0.9995
    steps = np.angle(np.array(got) * turn / wanted)  # a modulator's magnitudes have 5 bits
    assert np.abs(steps).max() < np.radians(2.8)
    np.testing.assert_allclose(np.abs(got), np.abs(wanted), rtol=1e-9)
    assert [spidev[0, n].address for n in (0, 1)] == [0, 1]
    drive.end()
    assert all(gain == 0 for chip in spidev.values() for gain, _, _ in chip.radiates)
    assert all(chip.closed for chip in spidev.values())


def test_attenuated_channel_is_15_db_down(
    spidev: dict[tuple[int, int], Chip], flown: tuple[DeviceCommand, Any, str]
) -> None:
    registers = flown[0].registers
    assert registers is not None
    weak = registers[:4].copy()
    weak[:, 4], weak[:, 5] = 127, [0, 1, 0, 1]
    shot = DeviceCommand(valid_at_ns=0, unfit=None, uav="3:1", registers=weak)
    device = targets.device("adar1000:0.0", print, list)
    Drive(
        source=Always(shot),
        device=device,
        update_hz=100.0,
        safe=SafeState.HOLD,
        now_ns=Ticking().now_ns,
        say=print,
    ).step()
    got = [abs(factor(*one)) for one in spidev[0, 0].radiates]
    assert 20 * np.log10(got) == pytest.approx([0, -15, 0, -15])


def test_too_few_chips_are_rejected(
    spidev: dict[tuple[int, int], Chip], flown: tuple[DeviceCommand, Any, str]
) -> None:
    device = targets.device("adar1000:0.0", print, list)
    drive = Drive(
        source=Always(flown[0]),
        device=device,
        update_hz=100.0,
        safe=SafeState.HOLD,
        now_ns=Ticking().now_ns,
        say=print,
    )
    with pytest.raises(UserError, match="1 chips given, the array needs 2"):
        drive.run(threading.Event())


def test_missing_spi_bus_is_retried_each_second(
    spidev: dict[tuple[int, int], Chip], flown: tuple[DeviceCommand, Any, str]
) -> None:
    clock, said = Ticking(), list[str]()
    device = targets.device("adar1000:9.0", print, list)
    drive = Drive(
        source=Always(flown[0]),
        device=device,
        update_hz=100.0,
        safe=SafeState.HOLD,
        now_ns=clock.now_ns,
        say=into(said),
    )
    for _ in range(300):  # three seconds
        drive.step()
        clock.t_ns += 10_000_000
    assert drive.status().failures == 3
    assert said == ["the device failed: SPI 9.0: No such file or directory"]


# --- Phaser -------------------------------------------------------------------------------------


@pytest.fixture
def iio(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, str]]:
    """Record what is written to libiio: device or channel, attribute, value."""
    log: list[tuple[str, str, str]] = []
    monkeypatch.setitem(sys.modules, "iio", iio_module(log))
    adi = pytest.importorskip("adi")
    monkeypatch.setattr("adi.cn0566.sleep", lambda _: None)
    monkeypatch.setattr(adi, "one_bit_adc_dac", lambda uri: SimpleNamespace(gpio_muxout=0))
    monkeypatch.setattr(adi, "ad7291", lambda uri: SimpleNamespace())
    return log


MAP = {"BEAM0": [7, 8, 5, 6], "BEAM1": [3, 4, 1, 2]}
"""Element of each channel of both chips, as in Analog Devices' class."""


def test_phaser_receives_table_codes_with_one_latch_per_update(
    iio: list[tuple[str, str, str]], flown: tuple[DeviceCommand, Any, str]
) -> None:
    shot, read, text = flown
    device = targets.device("phaser:ip:phaser.local", print, list)
    drive = Drive(
        source=Always(shot),
        device=device,
        update_hz=100.0,
        safe=SafeState.BORESIGHT,
        now_ns=Ticking().now_ns,
        say=print,
    )
    drive.step()
    configured = len(iio)
    before = [entry for entry in iio if entry[1] == "rx_load_spi"]
    codes = {
        int(row[4]): (float(row[6]), int(row[7]), int(row[8]))
        for row in (line.split(",") for line in text.splitlines()[1:])
        if row[1] == "3:1"
    }
    assert len(before) == 2 * 2  # configuration latches each chip once, the update once
    last = {(where, name): value for where, name, value in iio}
    for chip, elements in MAP.items():
        for channel, element in enumerate(elements):
            where = f"{chip}/in/voltage{channel}"
            phase, gain, attenuated = codes[element - 1]
            assert float(last[where, "phase"]) == pytest.approx(phase, abs=1e-4)
            assert int(float(last[where, "hardwaregain"])) == gain
            assert int(last[where, "attenuation"]) == 1 - attenuated
    drive.step()
    latched = Counter(name for _, name, _ in iio[configured:])
    assert latched == {"rx_load_spi": 2}  # unchanged values are not written again
    drive.end()
    last = {(where, name): value for where, name, value in iio}
    assert {value for (_, name), value in last.items() if name == "phase"} == {"0.0"}
    assert read.uavs == ("1:1", "2:1", "3:1", "4:1") or "3:1" in read.uavs


def test_array_of_wrong_size_for_a_phaser_is_rejected(
    iio: list[tuple[str, str, str]], flown: tuple[DeviceCommand, Any, str]
) -> None:
    shot = flown[0]
    assert shot.registers is not None
    half = DeviceCommand(
        valid_at_ns=shot.valid_at_ns, unfit=None, uav=shot.uav, registers=shot.registers[:4]
    )
    device = targets.device("phaser:ip:phaser.local", print, list)
    drive = Drive(
        source=Always(half),
        device=device,
        update_hz=100.0,
        safe=SafeState.HOLD,
        now_ns=Ticking().now_ns,
        say=print,
    )
    with pytest.raises(UserError, match="8 elements, the array has 4"):
        drive.step()


def test_phaser_memory_holds_the_codebook_and_updates_select_a_beam(
    iio: list[tuple[str, str, str]],
) -> None:
    settings = EIGHT.override(codebook={"kind": "dft", "oversampling": 4})
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    pipeline, update = moment.look([log], settings, "3")
    equipment = assembly.equipment(settings, pipeline.array)
    stored = stored_registers(pipeline.array, equipment)
    wanted = BeamRequest(uavs=("3:1",), any_uav=False, takes=DeviceInput.STORED, stored_beams=32)
    shot = command_of(pipeline, equipment, update, wanted)
    told = beam_state.beams(pipeline, equipment, update, age_s=0.0, lead_ms=0.0)
    (beam,) = [one for one in told["beams"] if one["uav"] == "3:1"]
    assert shot.stored == beam["codebook"]["best"]
    assert command_for(told, None, wanted, 0).stored == shot.stored  # the same over HTTP

    device = targets.device("phaser-memory:ip:phaser.local", print, lambda: stored)
    other = replace(shot, stored=(shot.stored + 5) % 32)
    source = Always(shot, shot, other, DeviceCommand(valid_at_ns=0, unfit="no carrier"))
    drive = Drive(
        source=source,
        device=device,
        update_hz=100.0,
        safe=SafeState.MUTE,
        now_ns=Ticking().now_ns,
        say=lambda *_: None,
    )
    drive.step()
    saved = {
        where + "/" + value.split(",")[0]: value
        for where, name, value in iio
        if name == "beam_pos_save"
    }
    assert len(saved) == 8 * (32 + 2)
    for index, registers in enumerate(stored):
        for _, _, element, phase, gain, attenuated, _, _ in registers.tolist():
            chip = next(name for name, elements in MAP.items() if element + 1 in elements)
            place = f"{chip}/in/voltage{MAP[chip].index(element + 1)}"
            state, through, level, degrees = saved[f"{place}/{index}"].split(", ")
            assert (int(state), int(through), int(level)) == (index, 1 - attenuated, gain)
            assert float(degrees) == pytest.approx(phase * 360 / 128)
    assert ("BEAM0", "beam_mem_enable", "1") in iio
    assert ("BEAM1", "beam_mem_enable", "1") in iio

    def said() -> tuple[set[str], Counter[str]]:
        """Positions, and how often what was written, by one more update."""
        begun = len(iio)
        drive.step()
        positions = {value for _, name, value in iio[begun:] if name == "beam_pos_load"}
        return positions, Counter(name for _, name, _ in iio[begun:])

    assert said() == (set(), {"rx_load_spi": 2})  # as before: one latch per chip
    assert said() == ({str(other.stored)}, {"beam_pos_load": 8, "rx_load_spi": 2})
    assert said() == ({"120"}, {"beam_pos_load": 8, "rx_load_spi": 2})
    assert {value for key, value in saved.items() if key.endswith("/120")} == {"120, 0, 0, 0.0"}


def test_stored_beams_of_a_different_codebook_are_not_selected() -> None:
    beam = dict.fromkeys(("bearing_deg", "above_horizon_deg", "lat_deg", "lon_deg", "alt_m"), 0.0)
    beam |= {"uav": "1:1", "codebook": {"best": 3}}
    told = {"unfit": None, "beams": [beam], "codebook_beams": 64}
    fits = command_for(
        told, None, BeamRequest(uavs=(), any_uav=True, takes=DeviceInput.STORED, stored_beams=64), 0
    )
    assert (fits.unfit, fits.stored) == (None, 3)
    for size, held in ((64, 32), (None, 32), (None, None)):
        shot = command_for(
            told | {"codebook_beams": size},
            None,
            BeamRequest(uavs=(), any_uav=True, takes=DeviceInput.STORED, stored_beams=held),
            0,
        )
        assert shot.unfit == "codebook of the service differs from --config, or is missing"


def test_mount_points_at_the_centre_of_several_uavs(flown: tuple[DeviceCommand, Any, str]) -> None:
    """Against their own directions and positions; unwanted UAVs do not count."""
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    pipeline, update = moment.look([log], EIGHT, "3")
    equipment = assembly.equipment(EIGHT, pipeline.array)
    told = beam_state.beams(pipeline, equipment, update, age_s=0.0, lead_ms=0.0)
    two = [beam for beam in told["beams"] if beam["uav"] in ("1:1", "2:1")]
    angles = [np.radians([beam["bearing_deg"], beam["above_horizon_deg"]]) for beam in two]
    mean = sum(
        np.array([np.cos(e) * np.cos(b), np.cos(e) * np.sin(b), np.sin(e)]) for b, e in angles
    )
    wanted = BeamRequest(
        uavs=("9:9", "2:1", "1:1"), any_uav=False, takes=DeviceInput.POINTING, centre=True
    )
    for shot in (
        command_of(pipeline, equipment, update, wanted),
        command_for(told, None, wanted, 0),
    ):
        assert shot.uav == "2:1+1:1"
        assert shot.bearing_rad == pytest.approx(np.arctan2(mean[1], mean[0]))
        assert shot.above_rad == pytest.approx(np.arcsin(mean[2] / np.linalg.norm(mean)))
        assert shot.place is not None
        seen = pipeline.local.position_ned_m(*shot.place)
        mid = np.mean([t.position_ned_m for t in update.tracks if t.uav in ("1:1", "2:1")], axis=0)
        np.testing.assert_allclose(seen, mid, atol=0.01)
    everybody = BeamRequest(uavs=("1:1",), any_uav=True, takes=DeviceInput.POINTING, centre=True)
    around = command_of(pipeline, equipment, update, everybody)
    assert "as they surround the array" in (around.unfit or "")  # four on one circle
    with pytest.raises(UserError, match="works only for a mount"):
        BeamRequest(uavs=(), any_uav=True, takes=DeviceInput.REGISTERS, centre=True)


@pytest.mark.parametrize(("lon_deg", "middle_deg"), [((179.9, -179.7), -179.9), ((7.0, 8.0), 7.5)])
def test_centre_of_uavs_is_correct_across_180_degrees_east(
    lon_deg: tuple[float, float], middle_deg: float
) -> None:
    one = {
        "uav": "1:1",
        "bearing_deg": 350.0,
        "above_horizon_deg": 0.0,
        "lat_deg": 1.0,
        "alt_m": 5.0,
    }
    beams = [
        one | {"lon_deg": lon_deg[0]},
        one | {"uav": "2:1", "bearing_deg": 20.0, "lon_deg": lon_deg[1]},
    ]
    told = {"unfit": None, "beams": beams, "codebook_beams": None}
    wanted = BeamRequest(uavs=(), any_uav=True, takes=DeviceInput.POINTING, centre=True)
    shot = command_for(told, None, wanted, 0)
    assert np.degrees(shot.bearing_rad) == pytest.approx(5.0)
    assert shot.place == pytest.approx((1.0, middle_deg, 5.0))
    beams[1]["bearing_deg"] = 170.0
    assert "as they surround the array" in (command_for(told, None, wanted, 0).unfit or "")


def test_codebook_too_large_for_a_phaser_is_rejected() -> None:
    array = assembly.array(EIGHT)
    with pytest.raises(UserError, match="no stored beams"):
        stored_registers(array, assembly.equipment(EIGHT, array))
    many = EIGHT.override(codebook={"kind": "dft", "oversampling": 15})
    held = stored_registers(array, assembly.equipment(many, array))
    with pytest.raises(UserError, match="a Phaser stores 119 beams, the codebook has 120"):
        targets.device("phaser-memory:ip:x", print, lambda: held)


# --- loop ---------------------------------------------------------------------------------------


class Recorder:
    """A device that records its calls and takes a given time."""

    takes = DeviceInput.POINTING
    lead_s = None
    rejected: ClassVar = {}

    def __init__(self, clock: Ticking, takes_s: float = 0.0) -> None:
        self.did: list[str] = []
        self.fails = False
        self._clock, self._takes_ns = clock, round(takes_s * 1e9)

    def check(self, safe: SafeState) -> None: ...

    def open(self) -> None:
        self.did.append("open")

    def apply(self, shot: DeviceCommand) -> None:
        if self.fails:
            raise DeviceError("cable")
        self._clock.t_ns += self._takes_ns
        self.did.append("apply")

    def rest(self, safe: SafeState) -> None:
        self.did.append(str(safe))

    def close(self) -> None:
        self.did.append("close")


def test_device_rests_once_without_beams_and_at_the_end() -> None:
    clock = Ticking()
    device, said = Recorder(clock), list[str]()
    fit, stale = (BEAM_NOW, DeviceCommand(valid_at_ns=0, unfit="its attitude is too old"))
    source = Always(fit, stale, stale, None, None, fit, fit)
    drive = Drive(
        source=source,
        device=device,
        update_hz=10.0,
        safe=SafeState.MUTE,
        now_ns=clock.now_ns,
        say=into(said),
    )
    for _ in range(7):
        drive.step()
    drive.end()
    assert device.did == ["open", "apply", "mute", "apply", "apply", "mute", "close"]
    assert said == [
        "the device is connected",
        "mute: its attitude is too old",
        "mute: no answer from the service: connection refused",
        "beams are applied",
    ]


def test_lead_is_the_measured_device_time_and_late_updates_are_counted() -> None:
    clock = Ticking()
    device, source = (Recorder(clock, 0.03), Always(BEAM_NOW))
    drive = driven(source, device, print, now_ns=clock.now_ns)
    for _ in range(5):
        drive.step()
    assert source.leads_s == pytest.approx([0.0, 0.03, 0.03, 0.03, 0.03])
    told = drive.status()
    assert (told.p50_ms, told.p99_ms) == pytest.approx((30.0, 30.0))
    assert told.late == 5  # the first lead is 0


def test_failed_device_is_reopened_and_rests_again() -> None:
    clock = Ticking()
    device, said = Recorder(clock), list[str]()
    source = Always(
        DeviceCommand(valid_at_ns=0, unfit="no carrier"),
        BEAM_NOW,
        DeviceCommand(valid_at_ns=0, unfit="no carrier"),
    )
    drive = Drive(
        source=source,
        device=device,
        update_hz=10.0,
        safe=SafeState.BORESIGHT,
        now_ns=clock.now_ns,
        say=into(said),
    )
    drive.step()
    device.fails = True
    drive.step()
    device.fails = False
    drive.step()  # not yet
    clock.t_ns += 1_000_000_000
    drive.step()
    assert device.did == ["open", "boresight", "close", "open", "boresight"]
    assert drive.status().failures == 1


@pytest.mark.parametrize(
    "target",
    [
        "rotctld:here",
        "rotctld:h:0",
        "adar1000:0",
        "phaser:",
        "none:",
        "laser:1",
        "adar1000:0.0,",
        "phaser-memory:",
    ],
)
def test_invalid_target_is_rejected(target: str) -> None:
    with pytest.raises(UserError, match=r"is not (a device|[a-z0-9-]+:)"):
        targets.device(target, print, list)


def test_uav_missing_from_the_device_table_is_not_applied() -> None:
    beam = dict.fromkeys(("bearing_deg", "above_horizon_deg", "lat_deg", "lon_deg", "alt_m"), 0.0)
    told = {"unfit": None, "beams": [beam | {"uav": "1:1"}], "codebook_beams": None}
    shot = command_for(
        told,
        "the head of a table\n",
        BeamRequest(uavs=(), any_uav=True, takes=DeviceInput.REGISTERS),
        0,
    )
    assert shot.unfit == "1:1 has no beam in the device's table"


# --- replies that no device or service should give ------------------------------------------------


class Faulty:
    """A libiio object whose attributes all raise the same."""

    def __init__(self, error: BaseException) -> None:
        object.__setattr__(self, "_error", error)

    def __getattr__(self, name: str) -> Any:
        raise self._error

    def __setattr__(self, name: str, value: Any) -> None:
        raise self._error


class UnprintableError(Exception):
    def __str__(self) -> str:
        raise ValueError("no text")


ERRORS: list[BaseException] = [
    OSError(5, "I/O error"), ValueError("could not convert string to float: '1.2.3'"),
    KeyError("rx_load_spi"), IndexError("list index out of range"), TypeError("NoneType"),
    UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), AttributeError(),
    OverflowError("int too large"), Exception("Device not found!"), SystemExit(1),
    GeneratorExit(), asyncio.CancelledError(), UnprintableError(),
]  # fmt: skip


@pytest.mark.parametrize("target", ["phaser:ip:x", "phaser-memory:ip:x"])
@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_any_error_of_pyadi_iio_is_a_device_error(
    iio: list[tuple[str, str, str]],
    flown: tuple[DeviceCommand, Any, str],
    target: str,
    error: BaseException,
) -> None:
    """While it is applied and while it is opened; then everything is written again."""
    registers = flown[0].registers
    assert registers is not None
    device = targets.device(target, print, lambda: [registers] * 3)
    clock, said = Ticking(), list[str]()
    drive = driven(Always(replace(flown[0], stored=1)), device, into(said), now_ns=clock.now_ns)
    drive.step()
    phaser = device._phaser  # type: ignore[attr-defined]
    device._phaser = SimpleNamespace(  # type: ignore[attr-defined]
        elements=dict.fromkeys(range(1, 9), Faulty(error)),
        latch_rx_settings=lambda: Faulty(error).latched,
    )
    drive.step()
    assert drive.status().failures == 1
    assert said[-1].startswith("the device failed: the Phaser at ip:x: ")
    assert said[-1].isprintable() and not said[-1].endswith(": ")
    clock.t_ns += 1_000_000_000
    written = len(iio)
    drive.step()
    names = {name for _, name, _ in iio[written:]}
    assert ("beam_pos_load" if "memory" in target else "phase") in names
    assert drive.status().applied == 2 and device._phaser is not phaser  # type: ignore[attr-defined]


def test_interrupt_that_a_library_raises_is_a_device_error_on_a_thread() -> None:
    """On the main thread it is the user's."""

    def raises() -> None:
        with library_errors("SPI 0.0"):
            raise KeyboardInterrupt

    with ThreadPoolExecutor(1) as thread, pytest.raises(DeviceError, match=r"SPI 0\.0: Keyboard"):
        thread.submit(raises).result(HANG_S)
    with pytest.raises(KeyboardInterrupt):
        raises()


@pytest.mark.parametrize(
    ("target", "name"), [("phaser:ip:x", "phase"), ("phaser-memory:ip:x", "beam_pos_load")]
)
def test_failed_write_to_a_phaser_is_repeated(
    iio: list[tuple[str, str, str]], target: str, name: str
) -> None:
    """What a failed update has written is unknown: the next one writes it again."""
    device = targets.device(target, print, list)
    device.open()
    device.rest(SafeState.BORESIGHT)
    phaser = device._phaser  # type: ignore[attr-defined]
    device._phaser = SimpleNamespace(  # type: ignore[attr-defined]
        elements=phaser.elements, latch_rx_settings=lambda: Faulty(ValueError("x")).latched
    )
    with pytest.raises(DeviceError):
        device.rest(SafeState.MUTE)
    device._phaser = phaser  # type: ignore[attr-defined]
    written = len(iio)
    device.rest(SafeState.BORESIGHT)
    assert Counter(name for _, name, _ in iio[written:])[name] == 8


BEAM_NOW = DeviceCommand(valid_at_ns=0, unfit=None, uav="1:1")


def driven(
    source: BeamSource,
    device: Device,
    say: Callable[[str, Severity], None],
    *,
    now_ns: Callable[[], int] = time.monotonic_ns,
) -> Drive:
    return Drive(
        source=source, device=device, update_hz=10.0, safe=SafeState.HOLD, now_ns=now_ns, say=say
    )


async def cancelled_after(event: threading.Event, drive: Drive) -> None:
    """Run a drive on its thread, and cancel it after an event."""
    task = asyncio.create_task(driving.run_in_thread(drive))
    await asyncio.to_thread(event.wait, HANG_S)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


def test_device_that_never_answers_is_reported_once() -> None:
    """From another thread, while the update waits."""
    clock, said = Ticking(), list[str]()

    class Hanging(Recorder):
        def apply(self, shot: DeviceCommand) -> None:
            for _ in range(20):
                clock.t_ns += 1_000_000_000
                drive.report_wait()
            super().apply(shot)

    class Slow(Always):
        def ask(self, lead_s: float) -> DeviceCommand:
            clock.t_ns += 6_000_000_000
            drive.report_wait()
            return super().ask(lead_s)

    drive = driven(Slow(BEAM_NOW), Hanging(clock), into(said), now_ns=clock.now_ns)
    drive.step()
    drive.report_wait()
    assert said == [
        "the device is connected",
        "the service has not answered for 5 s; still waiting",
        "the device has not answered for 5 s; still waiting",
    ]


def test_running_drive_reports_a_device_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.node.drive.loop.SLOW_NS", 1)
    monkeypatch.setattr(driving, "STATUS_EVERY_S", 0.001)
    reported, said = threading.Event(), list[str]()

    class Hanging(Recorder):
        def apply(self, shot: DeviceCommand) -> None:
            assert reported.wait(HANG_S)

    def say(text: str, severity: Severity) -> None:
        said.append(text)
        if severity is Severity.WARNING and "has not answered" in text:
            reported.set()

    drive = driven(Always(BEAM_NOW), Hanging(Ticking()), say)

    run_async(cancelled_after(reported, drive))
    assert reported.is_set()


@pytest.mark.parametrize("beside", [False, True], ids=["drive", "run"])
def test_device_that_is_left_as_it_is_is_reported(
    monkeypatch: pytest.MonkeyPatch, beside: bool
) -> None:
    """It does not answer within the time of the end. Once it does, its update is not applied."""
    monkeypatch.setattr(driving, "ENDS_S", 0.05)
    asked, answers, closed = threading.Event(), threading.Event(), threading.Event()
    said = list[str]()

    class Closing(Recorder):
        def close(self) -> None:
            closed.set()

    class Slow(Always):
        def ask(self, lead_s: float) -> DeviceCommand:
            asked.set()
            assert answers.wait(HANG_S)
            return super().ask(lead_s)

    drive = driven(Slow(BEAM_NOW), Closing(Ticking()), into(said))

    if beside:
        run_async(cancelled_after(asked, drive))
    else:
        driving.run_until_stopped(drive, lambda _: None, 0.05)
    assert said[-1] == "the device has not answered: it may not be in its safe state"
    answers.set()
    assert closed.wait(HANG_S)
    assert drive.status().applied == 0


def test_device_that_failed_before_the_end_is_reported() -> None:
    said = list[str]()

    class Failing(Recorder):
        def apply(self, shot: DeviceCommand) -> None:
            raise DeviceError("no answer")

    drive = driven(Always(BEAM_NOW), Failing(Ticking()), into(said))
    drive.step()
    drive.end()
    assert said[-1] == "the device did not go to its safe state: no answer"


@pytest.mark.parametrize("host", ["a..b", "x" * 64, "\udcff"])
@pytest.mark.parametrize("target", ["rotctld:{}:4533", "gimbal:{}:14550:1:154"])
def test_host_that_the_resolver_does_not_take_is_rejected(host: str, target: str) -> None:
    with pytest.raises(UserError, match=r"is not (rotctld|gimbal):HOST:PORT"):
        targets.device(target.format(host), lambda _: None, lambda: [])


BEAM = {"uav": "1:1", "bearing_deg": 10.0, "above_horizon_deg": 5.0, "lat_deg": 47.0,
        "lon_deg": 8.0, "alt_m": 500.0, "codebook": {"best": 3}}  # fmt: skip
ODD = [None, True, "", "x", "\x1b[2J\n", -1, 1e300, 10**400, math.nan, math.inf, [], [[]], {}]
"""Values that JSON can have, in the place of others."""


class Replying:
    """A client whose service gives these answers."""

    def __init__(self, told: Any, text: str) -> None:
        self._told, self._text = told, text

    def beams(self, lead_ms: float) -> Any:
        return self._told

    def table(self, media_type: str, lead_ms: float) -> str:
        return self._text


@pytest.mark.parametrize("takes", DeviceInput)
@given(data=st.data())
def test_any_answer_of_a_service_is_usable_or_a_lost_service(
    takes: DeviceInput, data: st.DataObject
) -> None:
    told: dict[str, Any] = {"unfit": None, "beams": [dict(BEAM)], "codebook_beams": 64}
    where = data.draw(st.sampled_from(["told", "beam", "codebook"]))
    inner = {"told": told, "beam": told["beams"][0], "codebook": {"best": 3}}[where]
    told["beams"][0]["codebook"] = inner if where == "codebook" else {"best": 3}
    key = data.draw(st.sampled_from(sorted(inner)))
    inner[key] = data.draw(st.sampled_from(ODD))
    row = ["0", "1:1", "0", "1", "2", "3", "4.0", "5", "1", "0x1f", "0x3f"]
    row[data.draw(st.integers(0, 10))] = data.draw(
        st.sampled_from(["", "-1", "9" * 5000, "nan", "1e9", "0xfff", "\u0661"])
    )
    text = data.draw(st.sampled_from(["head\n" + ",".join(row) + "\n", "", "head\n1:1,1:1\n"]))
    client: Any = Replying(told, text)
    wanted = BeamRequest(uavs=(), any_uav=True, takes=takes)
    try:
        shot = HttpSource(client, wanted).ask(0.0)
    except SourceLostError as error:
        assert str(error) == "beams are malformed; check the address of the service"
        return
    if shot.unfit is not None:
        return
    gimbals = [of(host="127.0.0.1", port=1, target=Source(1, 154)) for of in (Gimbal, RoiGimbal)]
    for gimbal in gimbals:
        gimbal.say = lambda msgid, payload: None  # type: ignore[method-assign]
        gimbal.apply(shot)
    if shot.registers is not None:
        words: list[list[int]] = []
        chips = Chips([(0, 0)] * (int(shot.registers[:, 0].max()) + 1))
        chips._lines = [SimpleNamespace(xfer2=words.append) for _ in chips._places]
        chips.apply(shot)
        assert all(0 <= byte < 256 for word in words for byte in word)


def test_chip_that_cannot_be_closed_is_forgotten() -> None:
    """An unplugged adapter: its error ended the drive, which would have tried again."""
    closed = list[int]()

    def fails() -> None:
        closed.append(1)
        raise OSError(5, "Input/output error")

    chips = Chips([(0, 0), (0, 1)])
    chips._lines = [SimpleNamespace(close=fails) for _ in chips._places]
    chips.close()
    chips.close()
    assert closed == [1, 1]


def test_table_of_a_service_is_applied_and_its_repetition_is_not(
    flown: tuple[DeviceCommand, Any, str],
) -> None:
    shot, _, text = flown
    told = {"unfit": None, "beams": [BEAM | {"uav": "3:1"}], "codebook_beams": None}
    wanted = BeamRequest(uavs=("3:1",), any_uav=False, takes=DeviceInput.REGISTERS)
    twice: Any = Replying(told, text + "".join(text.splitlines(keepends=True)[1:]))
    once: Any = Replying(told, text)
    np.testing.assert_array_equal(HttpSource(once, wanted).ask(0.0).registers, shot.registers)
    with pytest.raises(SourceLostError, match="beams are malformed"):
        HttpSource(twice, wanted).ask(0.0)


def test_texts_of_a_service_are_reported_in_one_printable_line() -> None:
    said = list[str]()
    unfit = "\x1b[2Jfar\n" + "x" * 5000
    drive = driven(
        Always(DeviceCommand(valid_at_ns=0, unfit=unfit)),
        Recorder(Ticking()),
        into(said),
        now_ns=Ticking().now_ns,
    )
    drive.step()
    assert said[1].startswith("hold: [2Jfar xxx")
    assert len(said[1]) == 200 and said[1].isprintable()


@pytest.mark.parametrize("fails", ["SpiDev", "open", "xfer2", "close"])
@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_any_error_of_spidev_is_a_device_error(
    spidev: dict[tuple[int, int], Chip],
    flown: tuple[DeviceCommand, Any, str],
    fails: str,
    error: BaseException,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Wherever it is raised; the drive goes on."""

    def fail(*_: object) -> None:
        raise error

    module: Any = sys.modules["spidev"]
    clock, said = Ticking(), list[str]()
    device = targets.device("adar1000:0.0,0.1", print, list)
    drive = driven(Always(flown[0]), device, into(said), now_ns=clock.now_ns)
    with monkeypatch.context() as patch:
        patch.setattr(*((module, fails) if fails == "SpiDev" else (module.SpiDev, fails)), fail)
        drive.step()
        drive.end()
    if fails != "close":
        (failed,) = [text for text in said if text.startswith("the device failed: SPI")]
        assert not failed.endswith(": ")
    clock.t_ns += 1_000_000_000
    drive.step()
    assert drive.status().applied == (2 if fails == "close" else 1)


BROKEN = [
    ("raise ImportError('undefined symbol: x')", "undefined symbol: x"),
    ("raise ValueError('numpy.dtype size changed')", "numpy.dtype size changed"),
    ("import sys; sys.exit('no bus')", "no bus"),
    ("import missing_elsewhere", "No module named 'missing_elsewhere'"),
    ("def x(:", "invalid syntax"),
    ("raise GeneratorExit", "GeneratorExit"),
    ("class E(Exception):\n    def __str__(self): raise ValueError\nraise E", "E"),
]


@pytest.mark.parametrize("target", ["adar1000:0.0", "phaser:ip:x"])
@pytest.mark.parametrize(("content", "cause"), BROKEN)
def test_package_that_does_not_load_is_an_error_of_one_line(
    target: str, content: str, cause: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = target.partition(":")[0]
    module = {"adar1000": "spidev", "phaser": "adi"}[kind]
    (tmp_path / f"{module}.py").write_text(content)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in [name for name in sys.modules if name.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    expected = f"{kind}: needs the package {module}, which does not load: {cause}"
    with pytest.raises(UserError, match=re.escape(expected)) as found:
        targets.device(target, print, list).open()
    assert "\n" not in str(found.value)


def test_missing_libiio_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "adi.py").write_text("raise OSError('libiio.so.0: cannot open')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "adi", raising=False)
    with pytest.raises(UserError, match=r"cannot open; is libiio \(Debian: .*\) installed\?"):
        targets.device("phaser:ip:x", print, list).open()


class Silent(Device):
    """Device that can be opened although nothing is there, as a gimbal behind UDP."""

    takes = DeviceInput.POINTING

    def __init__(self) -> None:
        self.is_there = False

    def open(self) -> None:
        pass

    def apply(self, command: DeviceCommand) -> None:
        if not self.is_there:
            raise DeviceError("Connection refused")

    def rest(self, safe: SafeState) -> None:
        pass

    def close(self) -> None:
        pass


def test_device_that_only_seems_to_connect_is_announced_once(
    flown: tuple[DeviceCommand, Any, str],
) -> None:
    device, clock, said = Silent(), Ticking(), list[str]()
    drive = driven(Always(flown[0]), device, into(said), now_ns=clock.now_ns)
    for number in range(60):
        device.is_there = 30 <= number < 40
        drive.step()
        clock.t_ns += 1_100_000_000
    failed = "the device failed: Connection refused"
    assert said == ["the device is connected", failed, "the device is connected", failed]
    assert drive.status().failures == 50


class Flapping(Silent):
    """A device that takes each second update."""

    def apply(self, command: DeviceCommand) -> None:
        self.is_there = not self.is_there
        super().apply(command)


@pytest.mark.parametrize("has_beams", [True, False])
def test_device_that_fails_again_and_again_is_announced_once(
    flown: tuple[DeviceCommand, Any, str], has_beams: bool
) -> None:
    """Two notices a second would displace all others."""
    device, clock, said = Flapping(), Ticking(), list[tuple[str, Severity]]()
    none = DeviceCommand(valid_at_ns=0, unfit="no carrier")
    source = Always(*[flown[0], flown[0] if has_beams else none] * 60)
    drive = driven(source, device, lambda *notice: said.append(notice), now_ns=clock.now_ns)
    for _ in range(120):
        drive.step()
        clock.t_ns += 1_100_000_000
    states = [] if has_beams else ["hold: no carrier", "beams are applied"]
    assert [text for text, _ in said if text not in states] == [
        "the device is connected",
        "the device failed: Connection refused",
    ]
    assert dict(said)["the device failed: Connection refused"] is Severity.WARNING
    assert drive.status().failures > 20
