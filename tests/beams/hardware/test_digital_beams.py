"""The digital beam table, read as OpenAirInterface's documentation describes."""

import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from companion.beams.array.geometry import uniform_rectangular
from companion.beams.hardware import codebooks
from companion.beams.hardware.calibration import Calibration
from companion.beams.hardware.codebooks import Codebook, CodebookKind
from companion.beams.hardware.digital_beams import write_oai_dbt
from companion.cli.main import main
from companion.values import ComplexArray, UserError

PANEL = uniform_rectangular(
    4, columns=4, frequency_hz=28e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)
)
COMPLEX = re.compile(r"([+-]?[\d.]+)([+-][\d.]+)[ij]")


def loaded(text: str) -> dict[int, ComplexArray]:
    """Return weights by id in 16-bit units, as the base station loads them."""
    header, *lines = text.splitlines()
    width = header.count(",")
    table = {}
    for line in lines:
        name, *tokens = line.split(",")
        assert len(tokens) == width
        assert 0 <= int(name) < 65536
        assert int(name) not in table
        pairs = np.array([[float(part) for part in COMPLEX.fullmatch(t).groups()] for t in tokens])  # type: ignore[union-attr]
        assert np.abs(pairs).max() <= 1
        fixed = np.rint(pairs * 32767)
        assert fixed.astype(np.int16).tolist() == fixed.tolist()
        table[int(name)] = fixed[:, 0] + 1j * fixed[:, 1]
    return table


@given(st.integers(0, 2**32 - 1))
def test_oai_table_holds_the_codebook_in_16_bit_integers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts = rng.normal(size=(2, 16, 9)) * 10 ** rng.uniform(-3, 0, (16, 9))
    book = codebooks.listed(parts[0] + 1j * parts[1], PANEL)
    text = write_oai_dbt(book, Calibration.ideal(range(16)))
    found = loaded(text)
    assert list(found) == list(range(9))
    off = np.stack(list(found.values()), axis=1) - book.weights * 32767
    assert max(np.abs(off.real).max(), np.abs(off.imag).max()) <= 0.5 + 1e-9
    written = [float(part) * 32767 for part in re.findall(r"-?\d\.\d+", text)]
    assert np.abs(written - np.rint(written)).max() < 0.02  # integers: no further rounding


def test_calibrated_panel_radiates_the_codebook() -> None:
    """The base station's ports are the channels, and the largest component is in range."""
    rng, book = np.random.default_rng(2), codebooks.dft(PANEL)
    calibration = Calibration(
        phase_rad=tuple(rng.uniform(-3, 3, 16).tolist()),
        gain_db=(-30.0, *rng.uniform(-2, 2, 15).tolist()),
        order=tuple(rng.permutation(16).tolist()),
    )
    for beam, ports in loaded(write_oai_dbt(book, calibration)).items():
        radiated = np.zeros(16, complex)
        radiated[list(calibration.order)] = ports
        radiated *= calibration.factors
        wanted = book.weights[:, beam]
        alike = abs(np.vdot(radiated, wanted)) / np.linalg.norm(radiated)
        assert alike == pytest.approx(1.0, abs=1e-4)


def test_oai_table_rejects_more_than_65536_beams() -> None:
    many = Codebook(CodebookKind.LISTED, np.ones((1, 65_537), complex))
    with pytest.raises(UserError, match="65537 beams exceed a digital beam table's 65536"):
        write_oai_dbt(many, Calibration.ideal([0]))


def test_command_writes_the_configured_codebook(tmp_path: Path) -> None:
    config, out = tmp_path / "panel.toml", tmp_path / "beams.csv"
    config.write_text('[array]\nkind = "ura"\nrows = 4\ncolumns = 4\n[codebook]\nkind = "dft"\n')
    run = CliRunner().invoke
    shown = run(main, ["export", "beams", "--format", "oai-dbt", "--config", str(config)])
    assert shown.exit_code == 0, shown.stderr
    assert shown.stdout == write_oai_dbt(codebooks.dft(PANEL), Calibration.ideal(range(16)))
    said = run(main, ["export", "beams", "--config", str(config), "--out", str(out)])
    assert said.stdout == f"{out}: 16 beams of 16 ports\n"
    assert out.read_text() == shown.stdout
    nothing = run(main, ["export", "beams"])
    assert nothing.exit_code == 1
    assert nothing.stderr == (
        'companion: [codebook]: no stored beams; set kind = "dft" or kind = "file"\n'
    )
