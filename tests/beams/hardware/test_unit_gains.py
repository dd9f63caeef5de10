"""Gains of a TMYTEK unit: every beam passes the checks of the manufacturer's package."""

import csv
import importlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.beams.hardware.calibration import Calibration
from companion.beams.hardware.devices import Beamformer, Mode
from companion.beams.hardware.tables import DeviceTable, WantedBeam, encode, fit
from companion.beams.hardware.unit_gains import UnitGains, parse_unit_gains
from companion.values import ComplexArray, UserError

UNIT = (
    'mode = "TX"\ncommon_db = [[-1.0, 9.5], [-1.5, 9.0], [0.0, 10.0], [-1.0, 9.5]]\n'
    "element_db = [4.0, 4.5, 4.0, 3.7]\n"
)
SEEDS = st.integers(0, 2**32 - 1)
Board = tuple[tuple[float, float], float]
"""Lowest and highest common gain, and highest element gain, of a board."""
SLACK = 1e-9


def table(gains: UnitGains, seed: int, beams: int) -> DeviceTable:
    """Fit beams of extreme weights, some of them 0, to unequal channels."""
    rng = np.random.default_rng(seed)
    array: ComplexArray = rng.normal(size=(16, beams)) + 1j * rng.normal(size=(16, beams))
    array *= 10 ** rng.uniform(-2, 0, (16, beams)) * (rng.random((16, beams)) > 0.1)
    array[0] = 1
    own: ComplexArray = np.ones((16, 1), complex)
    wanted = [
        WantedBeam(
            uav=f"{i}:1", weights=array[:, i], azimuth_rad=0.0, elevation_rad=0.0, steering=own
        )
        for i in range(beams)
    ]
    levels = rng.uniform(-gains.range_db / 2, gains.range_db / 2, 16)
    uneven = Calibration(
        phase_rad=(0.0,) * 16,
        gain_db=tuple(levels.tolist()),
        order=tuple(rng.permutation(16).tolist()),
    )
    return fit(Beamformer.TMYTEK, wanted, uneven, gains)


def refused(text: str, boards: list[Board]) -> list[str]:
    """Return what the unit rejects by its published limits: element gains relative to their
    board."""
    found: dict[str, list[list[float]]] = {}
    for row in csv.reader(text.splitlines()[1:]):
        found.setdefault(row[1], [[] for _ in boards])[(int(row[6]) - 1) // 4].append(float(row[8]))
    said = []
    for beam, rows in found.items():
        for n, ((low, high), element, gains) in enumerate(
            zip(*zip(*boards, strict=True), rows, strict=True)
        ):
            common = min(high, *gains)
            if common < low - SLACK:
                said.append(f"beam {beam} board {n}: common gain {common}")
            if max(gains) - common > element + SLACK or np.ptp(gains) > boards[-1][1] + SLACK:
                said.append(f"beam {beam} board {n}: elements {gains}")
    return said


@st.composite
def units(draw: st.DrawFn) -> list[Board]:
    """Draw boards that have some common gain."""
    tenths = st.integers(-10, 10).map(lambda tenth: tenth / 10)
    low = draw(st.integers(-20, 20)) / 2
    width, element = draw(st.integers(2, 20)), draw(st.integers(1, 8))
    return [
        ((low + draw(tenths), low + width + 2 + draw(tenths)), element + 1 + draw(tenths))
        for _ in range(4)
    ]


def described(boards: list[Board], mode: str = "TX") -> str:
    """Write the file of a unit."""
    common = [list(pair) for pair, _ in boards]
    return f'mode = "{mode}"\ncommon_db = {common}\nelement_db = {[e for _, e in boards]}\n'


@given(units(), SEEDS)
@settings(max_examples=30, deadline=None)
def test_every_beam_of_every_unit_is_within_its_limits(boards: list[Board], seed: int) -> None:
    gains = parse_unit_gains(described(boards))
    assert refused(encode(table(gains, seed, 4)), boards) == []


def test_strongest_element_gets_largest_gain_common_to_all_boards() -> None:
    gains = parse_unit_gains(UNIT)
    assert gains == UnitGains(Mode.TX, 13.0, 3.5)
    rows = [row.split(",") for row in encode(table(gains, 1, 8)).splitlines()[1:]]
    assert {row[0] for row in rows} == {"TX"}
    assert len(rows) == 8 * 16
    assert max(float(row[8]) for row in rows) == 13.0
    assert min(float(row[8]) for row in rows) == 9.5


def test_relative_gains_exceed_unit_limits() -> None:
    """This is why the unit's own gain limits are required."""
    boards: list[Board] = [((5.0, 9.5), 4.0)] * 4
    relative = fit(Beamformer.TMYTEK, [zero_beam()], Calibration.ideal(range(16)))
    assert refused(encode(relative), boards)


def zero_beam() -> WantedBeam:
    """Return a beam with one element off."""
    weights = np.ones(16, complex)
    weights[3] = 0
    return WantedBeam(
        uav="1:1",
        weights=weights,
        azimuth_rad=0.0,
        elevation_rad=0.0,
        steering=np.ones((16, 1), complex),
    )


def test_unit_without_gain_range_is_controlled_by_phase_alone() -> None:
    gains = parse_unit_gains(described([((1.0, 1.0), 0.0)] * 4, "RX"))
    assert gains == UnitGains(Mode.RX, 1.0, 0.0)
    text = encode(fit(Beamformer.TMYTEK, [zero_beam()], Calibration.ideal(range(16)), gains))
    assert {row.split(",")[8] for row in text.splitlines()[1:]} == {"1.0"}
    assert text.splitlines()[4].split(",")[7] == "1"  # off
    with pytest.raises(UserError, match=r"differ by 1\.0 dB, tmytek can equalise 0\.0 dB"):
        uneven = Calibration(
            phase_rad=(0.0,) * 16, gain_db=(1.0, *[0.0] * 15), order=tuple(range(16))
        )
        fit(Beamformer.TMYTEK, [zero_beam()], uneven, gains)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("mode =", "not TOML"),
        ("mode = 1", "keys are mode; give common_db, element_db, mode"),
        (UNIT.replace('"TX"', '"tx"'), "mode = 'tx'"),
        (UNIT.replace(", 3.7]", "]"), "element_db: give one entry for each of 4 boards"),
        (UNIT.replace("3.7", "nan"), "element_db"),
        (UNIT.replace("3.7", "true"), "element_db"),
        (UNIT.replace("3.7", "-1"), "element_db: give 0 or more"),
        (UNIT.replace("-1.5", "9" * 400), "is not 2 finite numbers within 200 dB"),
        (UNIT.replace("-1.5", "9" * 5000), "a number of thousands of digits"),
        (UNIT.replace("-1.5", "0x" + "f" * 5000), "common_db: a number of thousands of digits"),
        (UNIT.replace("-1.5", "-1e7"), "is not 2 finite numbers within 200 dB"),
        ("x = " + "[" * 5000, "nested too deeply"),
        (UNIT.replace("[0.0, 10.0]", "[0.0]"), "common_db: [0.0] is not 2 finite numbers"),
        (UNIT.replace("[0.0, 10.0]", "[0.0, -1.0]"), "least and largest"),
        (UNIT.replace("[0.0, 10.0]", "[50.0, 60.0]"), "no common gain range"),
    ],
    ids=lambda value: str(value)[-40:],
)
def test_invalid_unit_file_is_reported(text: str, said: str) -> None:
    with pytest.raises(UserError) as error:
        parse_unit_gains(text)
    assert said in str(error.value)


class Unit:
    """Stand-in unit with the calls that ``TMYBeamConfig`` makes."""

    def __init__(self, boards: list[Board], ok: Any) -> None:
        self._ok = ok
        self._common = [[list(pair) for pair, _ in boards]] * 2
        self._element = [[element for _, element in boards]] * 2
        self.beams: dict[int, Any] = {}

    def _said(self, data: Any = None) -> Any:
        return SimpleNamespace(RetCode=self._ok, RetData=data, RetMsg="")

    def getAAKitInfo(self, sn: str) -> Any:  # noqa: N802
        return self._said()

    def getChannelCount(self, sn: str) -> Any:  # noqa: N802
        return self._said(16)

    def getDR(self, sn: str) -> Any:  # noqa: N802
        return self._said({"TX": [-5.0, 15.0], "RX": [-5.0, 15.0]})

    def getCOMDR(self, sn: str) -> Any:  # noqa: N802
        return self._said(self._common)

    def getELEDR(self, sn: str) -> Any:  # noqa: N802
        return self._said(self._element)

    def getBeamPattern(self, sn: str, mode: Any, beam: int) -> Any:  # noqa: N802
        return self._said(self.beams.get(beam))

    def setBeamPattern(self, sn: str, mode: Any, beam: int, kind: Any, config: Any) -> Any:  # noqa: N802
        self.beams[beam] = {"beam_type": kind.value, "channel_config": config}
        return self._said()


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # files that it leaves behind
def test_manufacturer_package_applies_every_beam(tmp_path: Path) -> None:
    """Its own checks, on a unit that keeps the previously applied settings."""
    batch = pytest.importorskip("tlkcore.TMYBeamConfig")
    codes = importlib.import_module("tlkcore.TMYPublic").RetCode
    boards: list[Board] = [((-1.0, 9.5), 4.0), ((-1.5, 9.0), 4.5), ((0.0, 10.0), 4.0)]
    boards.append(((-1.0, 9.5), 3.7))
    unit, path = Unit(boards, codes.OK), tmp_path / "beams.csv"
    for seed in range(2):
        path.write_text(encode(table(parse_unit_gains(UNIT), seed, 64)))
        assert batch.TMYBeamConfig("D2252E058-28", unit, str(path)).applyBeams()
        assert len(unit.beams) == 64
        for beam in unit.beams.values():
            for (low, high), element, board in zip(
                *zip(*boards, strict=True), beam["channel_config"].values(), strict=True
            ):
                assert low <= board["common_db"] <= high
                ours = [one["db"] for name, one in board.items() if name != "common_db"]
                assert -SLACK <= min(ours) <= max(ours) <= element + SLACK
    path.write_text(encode(fit(Beamformer.TMYTEK, [zero_beam()], Calibration.ideal(range(16)))))
    assert not batch.TMYBeamConfig("D2252E058-28", Unit(boards, codes.OK), str(path)).applyBeams()
