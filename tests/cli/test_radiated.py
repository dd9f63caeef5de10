"""Guaranteed gains of a device's radiated beams: its table read back, with all errors drawn."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from device_reading import parse

from companion.beams.array.geometry import uniform_rectangular
from companion.beams.array.steering import steering_matrix, unit_directions
from companion.beams.hardware.calibration import BOUNDED_HEADER, parse_calibration
from companion.beams.hardware.devices import Beamformer
from companion.beams.worth.guarantee import guaranteed_gains_db
from companion.cli.main import main
from companion.pipeline import assembly
from companion.settings.files import embedded, load
from companion.settings.model import Settings
from companion.settings.section import ConfigError

ARRAY = '[array]\nkind = "ura"\nrows = 4\ncolumns = 4\n'
DEAD = (5,)


def told(log: Path, config: Path, form: str) -> bytes:
    command = ["weights", str(log), "--at", "3", "--center", "5:1", "--format", form]
    answer = CliRunner().invoke(main, [*command, "--config", str(config)])
    assert answer.exit_code == 0, answer.stderr
    return answer.stdout_bytes


def test_guaranteed_gain_holds_within_calibration_bounds(cut_log: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    lines = [f"{c},{15 - c},{20 * c},{-0.1 * c},{3 + c % 3},{0.4}" for c in range(16)]
    measured = tmp_path / "measured.csv"
    measured.write_text("\n".join([BOUNDED_HEADER, *lines]) + "\n")
    mixed = np.eye(16) + rng.standard_normal((2, 16, 16)).T @ [1, 1j] * 0.03
    np.save(tmp_path / "coupling.npy", mixed)
    config = tmp_path / "settings.toml"
    config.write_text(
        f'{ARRAY}dead = [5]\ncoupling = "{tmp_path / "coupling.npy"}"\n'
        f'[hardware]\ndevice = "adar1000"\ncalibration = "{measured}"\n'
    )
    calibration = parse_calibration(measured.read_text())
    device = parse(Beamformer.ADAR1000, told(cut_log, config, "adar1000").decode(), calibration)
    answer: dict[str, Any] = json.loads(told(cut_log, config, "json"))
    live = np.ones(16)
    live[list(DEAD)] = 0.0
    assert not np.array(answer["re"])[list(DEAD)].any()
    array = uniform_rectangular(
        4, columns=4, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)
    )
    known = 0
    for i, beam in enumerate(answer["beams"]):
        if beam["guaranteed_gain_db"] is None:
            continue
        known += 1
        fed = device.weights[:, i] * live
        towards = unit_directions(
            np.radians([beam["azimuth_deg"]]), np.radians([beam["elevation_deg"]])
        )
        bound = np.radians(beam["pointing_bound_deg"])
        (of_the_table,) = guaranteed_gains_db(
            assembly.array(load(config)), towards, [bound], device.weights[:, [i]]
        )
        assert beam["guaranteed_gain_db"] == pytest.approx(of_the_table, abs=1e-3)
        for _ in range(300):
            aside = np.cross(towards, rng.standard_normal((20, 3)))
            aside /= np.linalg.norm(aside, axis=1, keepdims=True)
            off = bound * np.sqrt(rng.uniform(size=(20, 1)))
            true = np.cos(off) * towards + np.sin(off) * aside
            draws = rng.uniform(-1, 1, (2, 16))
            phase = np.radians(np.degrees(calibration.phase_error_rad) * draws[0])
            factor = 10 ** (np.array(calibration.gain_error_db) * draws[1] / 20)
            carried = mixed @ (fed * factor * np.exp(1j * phase))
            gains = np.abs(steering_matrix(array, true).T @ carried) ** 2 / np.sum(np.abs(fed) ** 2)
            assert 10 * np.log10(gains.min()) >= beam["guaranteed_gain_db"] - 1e-9
    assert known >= 1


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ("dead = [16]", "array.dead: 16 does not exist"),
        (f"dead = {list(range(16))}", "or no element is left; list some of 0..15, not all"),
    ],
)
def test_invalid_dead_elements_are_rejected(tmp_path: Path, keys: str, said: str) -> None:
    (tmp_path / "there.toml").write_text(f"{ARRAY}{keys}\n")
    with pytest.raises(ConfigError, match=said):
        assembly.array(load(tmp_path / "there.toml"))


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (np.eye(3), "shape .3, 3.*give a finite 16 x 16 matrix"),
        (np.ones((16, 16)), "nearly singular"),
        (np.full((16, 16), np.nan), "finite"),
        (np.eye(16) * 1e150, "outside 1e-06"),
        (np.eye(16) * 1e-300, "outside 1e-06"),
        (np.ones(16), "not a matrix"),
    ],
)
def test_invalid_coupling_is_rejected(tmp_path: Path, matrix: Any, said: str) -> None:
    np.save(tmp_path / "c.npy", matrix)
    settings = Settings.from_toml(f'{ARRAY}coupling = "{tmp_path / "c.npy"}"\n', "there")
    with pytest.raises(ConfigError, match=said):
        assembly.array(settings)


def test_recording_includes_the_coupling(tmp_path: Path) -> None:
    np.save(tmp_path / "c.npy", np.eye(16) * 0.5j)
    settings = embedded(Settings.from_toml(f'{ARRAY}coupling = "{tmp_path / "c.npy"}"\n', "there"))
    (tmp_path / "c.npy").unlink()
    again = Settings.from_recording(settings.to_toml(), "there", settings.files)
    np.testing.assert_array_equal(assembly.array(again).coupling, np.eye(16) * 0.5j)
