"""Maps of feasible intervals: against a scan by definition, a simulation, and the page."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from companion.cli.main import main
from companion.studies.interval import maps
from companion.studies.interval.maps import Maps
from companion.tracking.design import closed_form


@pytest.fixture(scope="module")
def made(studied: Callable[..., Path]) -> Path:
    """The folder with the output of ``companion study dt``."""
    return studied("dt")


@pytest.fixture(scope="module")
def answer(made: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((made / "dt.json").read_text("utf-8"))
    return found


@pytest.fixture(scope="module")
def drawn() -> Maps:
    return maps.maps()


def margin(dt_s: float, feedthrough_s: float, alpha: float, mu: float) -> float:
    """The best margin of the LMIs over all gains at a mu: a scan by definition."""
    return max(
        closed_form.lmi_margin(
            dt_s, feedthrough_s=feedthrough_s, alpha=alpha, l_gain=l_gain, mu=mu, p=1 / mu
        )
        for l_gain in np.linspace(0.0, 2.0, 401)
    )


@pytest.mark.parametrize("mu", maps.MUS_S2)
def test_interval_limit_is_where_no_feasible_gain_remains(drawn: Maps, mu: float) -> None:
    for row, column in ((10, 10), (25, 24), (40, 24), (55, 40)):
        limit_s = float(drawn.limit_s[mu][row, column])
        d, alpha = float(drawn.feedthrough_s[row]), float(drawn.alpha[column])
        if limit_s > 0.05:
            assert margin(limit_s * 0.97, d, alpha, mu) > -1e-4
            assert margin(limit_s * 1.03, d, alpha, mu) < 0
        else:
            assert margin(0.06, d, alpha, mu) < 0


def test_peak_gain_is_attained_and_at_most_gamma(drawn: Maps) -> None:
    """By simulating an input that always pushes outward."""
    for alpha in maps.ALPHAS:
        peaks, gammas = drawn.peak_gain_s[alpha], drawn.gamma_s[alpha]
        assert (peaks <= gammas + 1e-7).all()
        for row, column in ((0, 79), (20, 20), (45, 70)):
            d, b = float(drawn.feedthrough_s[row]), float(drawn.dt_s[column])
            l_gain = closed_form.gain(b, d, alpha)
            error = 0.0
            for _ in range(3000):
                error = abs((1 - l_gain) * error) + abs(l_gain * d - b)
            assert peaks[row, column] == pytest.approx(error, abs=1e-6)


def test_map_shapes_match_their_axes(answer: dict[str, Any]) -> None:
    rows = len(answer["feedthrough_s"])
    for values in answer["limit_s"].values():
        assert np.shape(values) == (rows, len(answer["alpha"]))
    for name in ("gamma_s", "peak_gain_s"):
        for values in answer[name].values():
            assert np.shape(values) == (rows, len(answer["dt_s"]))


def test_map_contains_the_published_limits(drawn: Maps) -> None:
    row = int(np.argmin(np.abs(drawn.feedthrough_s - 0.5)))
    column = int(np.argmin(np.abs(drawn.alpha - 0.5)))
    found = [drawn.limit_s[mu][row, column] for mu in maps.MUS_S2]
    assert found == pytest.approx([0.8873, 1.0, 1.2906], abs=5e-5)


@pytest.mark.full
def test_longest_interval_follows_error_speed_and_feedthrough(answer: dict[str, Any]) -> None:
    """At feedthrough 0 the interval is error / speed (alpha near 1). A lag shortens it by the
    lag; with a lead it is at least almost twice the lead."""
    for row in answer["rates"]:
        reach_s, d = row["error_m"] / row["speed_mps"], row["feedthrough_s"]
        if d == 0:
            assert row["dt_max_s"] == pytest.approx(reach_s, rel=0.006)
        elif d < 0:
            assert row["dt_max_s"] == pytest.approx(max(0.0, reach_s + d), abs=0.02 * reach_s)
        else:
            assert row["dt_max_s"] >= max(1.98 * d, d + 0.99 * reach_s)
    axes = (maps.ERRORS_M, maps.SPEEDS_MPS, maps.FEEDTHROUGHS_S)
    assert len(answer["rates"]) == math.prod(map(len, axes))


def test_page_is_self_contained(made: Path) -> None:
    text = (made / "dt.html").read_text("utf-8")
    assert "<script" not in text and "http" not in text.replace("http-equiv", "")
    assert text.count("<figure") == 3
    assert [len(list(made.glob(kind))) for kind in ("*.png", "*.svg")] == [3, 3]
    assert "companion study dt" in text


@pytest.mark.full
def test_command_output_is_reproducible(made: Path, tmp_path: Path) -> None:
    assert CliRunner().invoke(main, ["study", "dt", "--out", str(tmp_path)]).exit_code == 0
    names = sorted(path.name for path in made.iterdir())
    assert names == sorted(path.name for path in tmp_path.iterdir())
    for name in names:
        assert (made / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_terminal_output_lists_the_longest_intervals(answer: dict[str, Any]) -> None:
    lines = maps.text(answer).splitlines()
    assert len(lines) == 1 + len(answer["rates"])
    for line, one in zip(lines[1:], answer["rates"], strict=True):
        shown = line.split()[3]
        assert (shown == "none") == (one["dt_max_s"] == 0)
        assert shown == "none" or abs(float(shown) - one["dt_max_s"]) <= 5e-4
