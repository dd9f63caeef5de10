"""Calibration from responses of arrays with known channels, and from a Phaser's pickles."""

import os
import pickle
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import Array
from companion.beams.array.geometry import uniform_linear as line
from companion.beams.array.geometry import uniform_rectangular as grid
from companion.beams.hardware import phaser_pickles
from companion.beams.hardware.calibration import parse_calibration
from companion.beams.hardware.measured import MEASURED_HEADER, as_text, fitted, parse_responses
from companion.cli.main import main
from companion.values import FloatArray, UserError

EYE = np.eye(3)
ORDER = (6, 7, 4, 5, 2, 3, 0, 1)
AT_DEG = [(-40.0, 0.0), (-10.0, 5.0), (0.0, 0.0), (25.0, -10.0), (50.0, 10.0)]
ARRAYS = {
    "line": line(8, 10.5e9, spacing_wavelengths=0.5, array_from_body=EYE),
    "grid": grid(
        2,
        columns=4,
        frequency_hz=10.5e9,
        spacing_wavelengths=0.6,
        array_from_body=EYE,
        element=Element(ElementPattern.COSINE, 1.0),
    ),
}


def measured(array: Array, phase: FloatArray, gain_db: FloatArray, noise: float) -> str:
    """Return responses to a source by geometry alone, with an arbitrary phase and level per
    direction."""
    rng = np.random.default_rng(5)
    lines = [MEASURED_HEADER]
    for azimuth, elevation in AT_DEG:
        az, el = np.radians([azimuth, elevation])
        u = np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), -np.sin(el)])
        pattern = 1.0 if array.element.pattern is ElementPattern.ISOTROPIC else np.sqrt(4 * u[0])
        turned = 2 * np.pi / array.wavelength_m * (array.elements_m @ u)
        source = rng.uniform(-9, 9), rng.uniform(-3, 3)
        for channel, m in enumerate(ORDER):
            y = pattern * 10 ** ((gain_db[m] + source[0]) / 20)
            y = y * np.exp(1j * (turned[m] + phase[m] + source[1]))
            y *= 1 + noise * complex(*rng.uniform(-0.7, 0.7, 2))
            told = f"{np.degrees(np.angle(y)):.9f},{20 * np.log10(abs(y)):.9f}"
            lines.append(f"{azimuth},{elevation},{channel},{told}")
    return "\n".join(lines) + "\n"


def channels() -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(2)
    phase, gain_db = rng.uniform(-3, 3, 8), rng.uniform(-2, 2, 8)
    return phase - phase[0], gain_db - gain_db.mean()


@pytest.mark.parametrize("name", sorted(ARRAYS))
def test_channel_errors_are_estimated_from_exact_responses(name: str) -> None:
    phase, gain_db = channels()
    found = fitted(
        parse_responses(measured(ARRAYS[name], phase, gain_db, 0.0)), ARRAYS[name], ORDER
    )
    off = np.exp(1j * (np.array(found.calibration.phase_rad) - phase))
    np.testing.assert_allclose(off, 1.0, atol=1e-7)
    np.testing.assert_allclose(found.calibration.gain_db, gain_db, atol=1e-6)
    assert found.calibration.order == ORDER
    assert max(found.phase_deg, found.gain_db, found.cost_db) < 1e-5
    again = parse_calibration(as_text(found.calibration))
    np.testing.assert_allclose(again.phase_rad, found.calibration.phase_rad, atol=1e-7)


def test_residual_calibration_error_is_bounded_and_reported() -> None:
    phase, gain_db = channels()
    found = fitted(
        parse_responses(measured(ARRAYS["line"], phase, gain_db, 0.05)), ARRAYS["line"], ORDER
    )
    off = np.angle(np.exp(1j * (np.array(found.calibration.phase_rad) - phase)))
    assert np.degrees(np.abs(off)).max() < 4.0
    assert 0.5 < found.phase_deg < 5.0
    assert 0.05 < found.gain_db < 0.6
    assert 0.1 < found.cost_db < 1.0
    bounds = np.degrees(found.calibration.phase_error_rad)
    assert bounds.max() == pytest.approx(found.phase_deg)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nothing", "is not the header"),
        (MEASURED_HEADER, "file has no responses"),
        (f"{MEASURED_HEADER}\n0,0,0,0,0\n0,0,0,0,0\n", "line 3: channel 0 appears twice"),
        (f"{MEASURED_HEADER}\n0,0,0,0,0\n0,0,2,0,0\n", "channel 1: no measured response"),
        (f"{MEASURED_HEADER}\n0,0,0,nan,0\n", "not a finite number"),
        (
            f"{MEASURED_HEADER}\n0,0,0,0,1e6\n",
            "line 2: gain_db '1e6' is not between -1000 and 1000",
        ),
        (
            f"{MEASURED_HEADER}\n0,0,0,0,-1e6\n",
            "line 2: gain_db '-1e6' is not between -1000 and 1000",
        ),
        (f"{MEASURED_HEADER}\n1e300,0,0,0,0\n", "azimuth_deg '1e300' is not between"),
        (
            "\n".join([MEASURED_HEADER, *(f"{n},0,0,0,0" for n in range(-50_000, 50_001))]),
            "more than 100000 directions",
        ),
    ],
)
def test_invalid_responses_are_rejected(text: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        parse_responses(text)


def test_calibration_requires_two_directions() -> None:
    text = "\n".join([MEASURED_HEADER, *(f"0,0,{c},0,0" for c in range(8))])
    with pytest.raises(UserError, match="two or more"):
        fitted(parse_responses(text), ARRAYS["line"], ORDER)


def test_calibrate_command_writes_a_readable_calibration(tmp_path: Path) -> None:
    responses, out = tmp_path / "responses.csv", tmp_path / "measured.csv"
    before = tmp_path / "order.csv"
    rows = [f"{channel},{m},0,0" for channel, m in enumerate(ORDER)]
    before.write_text("\n".join(["channel,element,phase_deg,gain_db", *rows]) + "\n")
    responses.write_text(measured(ARRAYS["line"], *channels(), 0.02))
    config = tmp_path / "phaser.toml"
    config.write_text(
        f'[array]\nelements = 8\nfrequency_hz = 10.5e9\n[hardware]\ncalibration = "{before}"\n'
    )
    command = ["calibrate", str(responses), "--config", str(config), "--out", str(out)]
    done = CliRunner().invoke(main, command)
    assert done.exit_code == 0, done.stderr
    assert "degrees and" in done.stdout
    assert parse_calibration(out.read_text()).order == ORDER


# --- Phaser pickles -----------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("kind", [float, np.float64, np.float32])
def test_pickles_of_numbers_are_loaded(protocol: int, kind: Any) -> None:
    phases = [kind(10.0 * n) for n in range(8)]
    gains = [kind(1.0 - n / 32) for n in range(8)]
    if protocol < 3 and kind is not float:
        return  # numpy's bytes would then be built by a forbidden function
    found = phaser_pickles.calibration(
        pickle.dumps(phases, protocol), pickle.dumps(gains, protocol)
    )
    np.testing.assert_allclose(np.degrees(found.phase_rad), [-10.0 * n for n in range(8)])
    np.testing.assert_allclose(
        10 ** (-np.array(found.gain_db) / 20), [1 - n / 32 for n in range(8)]
    )
    assert found.order == ORDER


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("touch /tmp/pickled",)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (pickle.dumps([Evil()] * 8), "would call posix.system: only numbers"),
        (pickle.dumps(np.zeros(8)), "would call numpy"),
        (pickle.dumps([1.0] * 7), "list of 8"),
        (pickle.dumps([float("nan")] * 8), "finite"),
        (pickle.dumps(["1"] * 8), "finite numbers"),
        (pickle.dumps([True] * 8), "finite numbers"),
        (pickle.dumps([10**400] * 8), "finite numbers within"),
        (b"", "not a pickle"),
        (pickle.dumps([0.0] * 8)[:-3], "not a pickle"),
        (b"0" * 20_000, "more than a list"),
        (b"\x80\x02]r\xff\xff\xff\x7f.", "list of 8"),  # a memo index of 2^31
        (b"\x80\x02}.", "opcode EMPTY_DICT"),
        (b"\x80\x04\x95" + b"\xff" * 7 + b"\x7f].", "not a"),  # a frame of 2^63 bytes
        (b"(" * 9_000 + b"l.", "list of 8"),
        (b"a.", "not a pickle"),
        (b"h\x00.", "not a pickle"),
    ],
)
def test_pickle_of_other_objects_is_rejected(data: bytes, said: str) -> None:
    with pytest.raises(UserError, match=said):
        phaser_pickles.numbers("phase calibration", data)
    assert not Path("/tmp/pickled").exists()


def test_a_pickle_takes_no_more_memory_than_its_size() -> None:
    data = b"\x80\x02]" + b"r\xff\xff\xff\x7f" * 1_900 + b"."
    tracemalloc.start()
    with pytest.raises(UserError):
        phaser_pickles.numbers("phase calibration", data)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_calibrate_command_reads_a_phaser_folder(tmp_path: Path) -> None:
    for name, value in (("phase", 5.0), ("gain", 0.9)):
        (tmp_path / f"{name}_cal_val.pkl").write_bytes(pickle.dumps([value] * 8))
    out = tmp_path / "measured.csv"
    done = CliRunner().invoke(main, ["calibrate", str(tmp_path), "--out", str(out)])
    assert done.exit_code == 0, done.stderr
    assert parse_calibration(out.read_text()).order == ORDER


def test_error_for_a_long_line_repeats_only_its_start() -> None:
    for text in ("x" * 1_000_000, MEASURED_HEADER + "\n" + "1," * 1_000_000):
        with pytest.raises(UserError, match=r"^line [12]: ") as raised:
            parse_responses(text)
        assert len(str(raised.value)) <= 200
