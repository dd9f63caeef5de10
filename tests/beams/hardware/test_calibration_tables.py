"""Calibration tables for several frequencies: listed values and interpolation."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.beams.hardware.calibration import CALIBRATION_HEADER, Calibration, parse_calibration
from companion.beams.hardware.calibration_tables import calibration_at
from companion.pipeline import assembly
from companion.settings.files import load
from companion.settings.section import ConfigError
from companion.values import UserError

TWO = """
order = [1, 0, 2]
[[table]]
frequency_hz = 10.5e9
phase_deg = [10.0, -170.0, 30.0]
gain_db = [0.2, 1.0, -1.0]
phase_error_deg = [1.0, 3.0, 1.0]
gain_error_db = [0.3, 0.1, 0.1]
[[table]]
frequency_hz = 10e9
phase_deg = [0.0, 170.0, 50.0]
gain_db = [0.0, 2.0, -1.0]
phase_error_deg = [2.0, 2.0, 1.0]
gain_error_db = [0.1, 0.2, 0.1]
"""
EMPTY = "order = []\n[[table]]\nfrequency_hz = {}e9\nphase_deg = []\ngain_db = []\n"
SEEDS = st.integers(0, 2**32 - 1)


def test_calibration_at_a_listed_frequency_is_unchanged() -> None:
    found = calibration_at(TWO, 10e9)
    assert found.order == (1, 0, 2)
    assert np.degrees(found.phase_rad) == pytest.approx([170, 0, 50])  # by element
    assert found.gain_db == (2.0, 0.0, -1.0)
    assert np.degrees(found.phase_error_rad) == pytest.approx([2, 2, 1])
    assert found.gain_error_db == (0.2, 0.1, 0.1)
    assert calibration_at(TWO, 10.5e9).gain_db == (1.0, 0.2, -1.0)


def test_interpolation_takes_shorter_phase_arc_and_larger_error_bounds() -> None:
    found = calibration_at(TWO, 10.1e9)
    turned = np.exp(1j * (np.array(found.phase_rad) - np.radians([174, 2, 46])))
    assert turned == pytest.approx([1, 1, 1])
    assert found.gain_db == pytest.approx((1.8, 0.04, -1.0))
    assert np.degrees(found.phase_error_rad) == pytest.approx([3, 2, 1])
    assert found.gain_error_db == (0.2, 0.3, 0.1)


@given(SEEDS, st.floats(0, 1))
def test_interpolation_tolerates_any_common_cable_delay(seed: int, share: float) -> None:
    """A delay common to all channels rotates them by any angle; their differences stay small."""
    rng = np.random.default_rng(seed)
    common_s, own_s = rng.uniform(-1e-8, 1e-8), rng.uniform(-2e-11, 2e-11, 4)
    order, ends = rng.permutation(4).tolist(), (10e9, 10.5e9)

    def phases_deg(frequency_hz: float) -> list[float]:
        turned = 360 * frequency_hz * (common_s + own_s)
        wrapped = (turned + 180) % 360 - 180
        return [float(one) for one in wrapped]

    text = f"order = {order}\n" + "".join(
        f"[[table]]\nfrequency_hz = {end}\nphase_deg = {phases_deg(end)}\ngain_db = [0, 0, 0, 0]\n"
        for end in ends
    )
    at_hz = ends[0] + share * (ends[1] - ends[0])
    found = calibration_at(text, at_hz).factors[order]
    wanted = np.exp(1j * np.radians(phases_deg(at_hz)))
    assert abs(np.vdot(found, wanted)) == pytest.approx(4.0)  # up to a common phase


def test_csv_calibration_applies_to_any_frequency() -> None:
    text = "channel,element,phase_deg,gain_db\n0,1,90,-1.5\n1,0,0,0\n"
    assert calibration_at(text, 1e9) == calibration_at(text, 2e9) == parse_calibration(text)


ONE = "order = [0, 1]\n[[table]]\nfrequency_hz = 1e9\nphase_deg = [0, 1]\ngain_db = [0, 0]\n"


@pytest.mark.parametrize(
    ("text", "at_hz", "said"),
    [
        (TWO, 9.99e9, "9.99e+09 Hz is outside the range of the tables, 1e+10 to 1.05e+10 Hz"),
        (TWO, 10.51e9, "is outside the range of the tables"),
        (ONE, 1.01e9, "is outside the range of the tables, 1e+09 to 1e+09 Hz"),
        (TWO.replace("50.0]", "150.0]"), 10.1e9, "channel 2 over channel 0 changes by -130"),
        (TWO.replace("10.5e9", "10e9"), 10e9, "1e+10 Hz has two tables; give one"),
        (TWO.replace("[1, 0, 2]", "[1, 0, 1]"), 10e9, "[1, 0, 1] does not contain each of 0 to 2"),
        (TWO.replace("[1, 0, 2]", "[1, 0, 2.0]"), 10e9, "is not a list of whole numbers"),
        (TWO.replace("[1, 0, 2]", "[1, 0]"), 10e9, "is not 2 finite numbers"),
        (TWO.replace("30.0]", "nan]"), 10e9, "phase_deg at 1.05e+10 Hz is not 3 finite numbers"),
        (TWO.replace("30.0]", "true]"), 10e9, "phase_deg at 1.05e+10 Hz is not 3 finite"),
        (TWO.replace("10.5e9", "-1"), 10e9, "frequency_hz = -1 is out of range"),
        (TWO.replace("gain_error_db = [0.1, 0.2, 0.1]", ""), 10e9, "give frequency_hz, phase_deg"),
        (f"{ONE}[[table]]\nfrequency_hz = 2e9\nphase_deg = [0, 1]\ngain_db = [0, 0]\n"
         "phase_error_deg = [1, 1]\ngain_error_db = [0, 0]\n", 1e9, "give bounds in all"),
        (TWO.replace("1.0, 3.0, 1.0", "-1.0, 3.0, 1.0"), 10.5e9, "0 or more"),
        ("order = [0]\ntable = []\n", 1e9, "[[table]] is missing"),
        ("order = [0]\ntable = [1]\n", 1e9, "[[table]] is not a table"),
        ("order = [0]\n", 1e9, "give an order and a [[table]]"),
        (TWO.replace("30.0]", "9" * 400 + "]"), 10e9, "is not 3 finite numbers within 1000000"),
        (TWO.replace("30.0]", "9" * 5000 + "]"), 10e9, "a number of thousands of digits"),
        (TWO.replace("-1.0]", "1e5]"), 10e9, "gain_db at 1.05e+10 Hz is not 3 finite"),
        (TWO.replace("10.5e9", "9" * 400), 10e9, "out of range; give a number above 0, up to 1e15"),
        (TWO.replace("[1, 0, 2]", "[1, 0, 0x" + "f" * 5000 + "]"), 10e9, "each of 0 to 2 once"),
        (EMPTY.format(1) + EMPTY.format(2)[11:], 1.5e9, "order [] does not contain each of"),
        ("a." * 20_000 + "a = 1", 1e9, "nested too deeply"),
        (f"{CALIBRATION_HEADER}\n{'9' * 5000},0,0,0\n", 1e9, "is not a whole number"),
        (f"{CALIBRATION_HEADER}\n0,0,0,-1e5\n", 1e9, "'-1e5' is not between -1000 and 1000"),
        (f"{CALIBRATION_HEADER}\n0,0,1e300,0\n", 1e9, "phase_deg '1e300' is not between"),
        ("chanel,element\n", 1e9, "neither calibration as CSV nor as TOML"),
    ],
    ids=lambda value: str(value)[-40:],
)  # fmt: skip
def test_invalid_calibration_file_is_reported(text: str, at_hz: float, said: str) -> None:
    with pytest.raises(UserError) as error:
        calibration_at(text, at_hz)
    assert said in str(error.value)
    assert len(str(error.value)) < 600


def test_settings_interpolate_calibration_to_the_array_frequency(tmp_path: Path) -> None:
    table, config = tmp_path / "measured.toml", tmp_path / "settings.toml"
    table.write_text(TWO)
    three = f'elements = 3\n[hardware]\ncalibration = "{table}"\n'
    config.write_text(f"[array]\nfrequency_hz = 10.25e9\n{three}")
    found = assembly.calibration(load(config), 3)
    assert isinstance(found, Calibration)
    assert found.phase_rad[1] == pytest.approx(math.radians(5))
    config.write_text(f"[array]\nfrequency_hz = 28e9\n{three}")
    with pytest.raises(ConfigError, match=r"^hardware\.calibration: 2\.8e\+10 Hz is outside"):
        assembly.calibration(load(config), 3)
