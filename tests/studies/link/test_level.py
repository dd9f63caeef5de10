"""The link study and its command: causes of errors, and reproducible results."""

import json
import math
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from support import ROOT

from companion.beams.array.steering import steering_matrix
from companion.cli.main import main
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.studies.link import channel, figures
from companion.studies.link.channel import Scattering
from companion.studies.link.level import LinkStudy, simulate, snrs
from companion.studies.link.scenario import PositionSource, Reports, Scenario, circles


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return circles(Settings(), Reports(), 40, np.random.default_rng(1))


def test_noiseless_errors_come_from_interference(scenario: Scenario) -> None:
    """Without noise, a UAV with a signal 20 dB above all interference has no errors, and one
    below the interference has errors in every block. This explains the errors at held
    positions."""
    setting = LinkStudy(snr_db=(80, 80, 1), blocks=3, scattering=Scattering(math.inf))
    counts = simulate(setting, scenario)
    errors = {
        kind: np.array([each.raw_errors for each in counts[kind.value, 80]])
        for kind in PositionSource
    }
    assert not errors[PositionSource.PERFECT].any()
    few, many = (
        np.mean(errors[kind] > 0) for kind in (PositionSource.PREDICTED, PositionSource.HELD)
    )
    assert few < 0.1 and many > 0.5
    precoder = assembly.precoder(Settings())
    for seen, wrong in zip(scenario.instants, errors[PositionSource.HELD], strict=True):
        truly = seen.towards[PositionSource.PERFECT]
        sent = channel.weights(scenario.array, seen, PositionSource.HELD, precoder)
        power = np.abs(steering_matrix(scenario.array, truly).T @ sent) ** 2
        ratio = power.diagonal() / (power.sum(axis=1) - power.diagonal())
        assert not wrong[ratio > 100].any()
        assert (wrong[ratio < 1] > 0).all()


def test_snr_levels_are_equally_spaced_within_the_range() -> None:
    assert snrs(-2, 1, 1) == (-2.0, -1.0, 0.0, 1.0)
    assert snrs(0, 1, 0.3) == (0.0, 0.3, 0.6, 0.9)
    assert snrs(0, 0.3, 0.1) == (0.0, 0.1, 0.2, 0.3)


class Links(HTMLParser):
    """Resources that a page would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.fetched += [value or "" for name, value in attrs if name in ("src", "href")]


def run(*arguments: str | Path) -> Any:
    """Run the command as the console script does."""
    return CliRunner().invoke(main, ["study", "link", *map(str, arguments)])


SMALL = ("--snr", "4:20:8", "--instants", 4, "--blocks", 2)


@pytest.mark.full
def test_link_command_writes_json_figures_and_page(tmp_path: Path) -> None:
    """The command given in the answer reproduces the output."""
    done = run(*SMALL, "--out", tmp_path / "a", "--json")
    assert done.exit_code == 0, done.output
    answer = json.loads((tmp_path / "a" / "link.json").read_text())
    assert json.loads(done.stdout) == answer
    assert {
        (found["positions"], found["coded"], found["snr_db"]) for found in answer["rows"]
    } == {(kind, coded, snr) for kind in ("perfect", "predicted", "held")
          for coded in (False, True) for snr in (4.0, 12.0, 20.0)}  # fmt: skip
    for found in answer["rows"]:
        low, high = found["confidence"]["ber"]
        assert 0 <= low <= found["ber"] <= high <= 1
        assert found["n_bits"] == 4 * 4 * 2 * (306 if found["coded"] else 936)
    assert [found["snr_db"] for found in answer["theory"]] == [4.0, 12.0, 20.0]
    named = run(*answer["command"].split()[3:], "--out", tmp_path / "b")
    assert named.exit_code == 0 and "predicted" in named.stdout
    names = {path.name for path in (tmp_path / "a").iterdir()}
    figures = {f"link_{kind}.{form}" for kind in ("ber", "bler", "rate", "evm")
               for form in ("png", "svg")}  # fmt: skip
    assert names == {"link.json", "link.html", *figures}
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    each_curve_is_drawn(answer)
    page = Links()
    page.feed((tmp_path / "a" / "link.html").read_text())
    assert len(page.fetched) == 4
    assert all(source.startswith("data:image/png;base64,") for source in page.fetched)


def each_curve_is_drawn(answer: dict[str, Any]) -> None:
    """Throughput, uncoded and coded: one distinct line for each kind of positions."""
    _, draw = figures.drawings(answer)["link_rate"]
    for axes, coded in zip(draw().axes, (False, True), strict=True):
        drawn = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
        assert drawn == {
            label: [
                [found["snr_db"], found["rate_bps"] / 1e6]
                for found in answer["awgn"] + answer["rows"]
                if (found["positions"], found["coded"]) == (positions, coded)
            ]
            for positions, label in figures.LABELS.items()
        }
        looks = {(line.get_color(), line.get_linestyle(), line.get_marker()) for line in axes.lines}
        assert len(looks) == len(drawn) == 4


@pytest.mark.full
def test_link_study_reads_a_log_through_the_pipeline(tmp_path: Path) -> None:
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    done = run(log, "--center", "5:1", *SMALL, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    answer = json.loads((tmp_path / "link.json").read_text())
    assert answer["scenario"]["instants"] == 4
    off = {found["positions"]: found.get("pointing_error_median_deg")
           for found in answer["summary"]}  # fmt: skip
    assert off["perfect"] == pytest.approx(0.0, abs=1e-5)
    assert 0 < off["predicted"] < off["held"] < 5


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--snr", "1:2"), "'1:2' is not FROM:TO:STEP in dB"),
        (("--snr", "5:2:1"), "--snr 5:2:1: give FROM:TO:STEP in dB"),
        (("--snr", "0:2:0"), "STEP above 0"),
        (("--snr", "0:nan:1"), "--snr 0:nan:1"),
        (("--snr", "0:20:0.1"), "201 points, at most 100 are allowed"),
        (("--instants", 0), "--instants 0: give 1 to 10000"),
        (("--blocks", 5000), "--blocks 5000: give 1 to 1000"),
        (("--interval", 0), "--interval 0: give seconds"),
        (("--interval", 1e-12), "--interval 1e-12: give seconds from 0.01 to 2"),
        (("--latency", -1), "--latency -1: give seconds"),
        (("--center", "5:1"), "--center needs a LOG"),
        (("nowhere.tlog",), "nowhere.tlog"),
    ],
)
def test_invalid_link_study_input_is_a_one_line_error(
    arguments: tuple[str | int, ...], said: str, tmp_path: Path
) -> None:
    done = run(*map(str, arguments), "--out", tmp_path / "out")
    assert done.exit_code != 0
    assert said in done.stderr and done.stderr.count("\n") == 1


def test_each_instant_has_its_own_bits_and_noise(scenario: Scenario) -> None:
    """The same position twice has different bits and noise, and is reproducible."""
    twice = replace(scenario, instants=scenario.instants[:1] * 2)
    setting = LinkStudy(snr_db=(10, 10, 1), blocks=4)
    first, second = simulate(setting, twice)["perfect", 10]
    again, _ = simulate(setting, twice)["perfect", 10]
    assert (first.raw_errors != second.raw_errors).any()
    assert (first.raw_errors == again.raw_errors).all()
