"""The command ``companion study fleet``: its answer, and its reproducibility."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from companion.cli.main import main
from companion.studies.fleet import study
from companion.studies.fleet.sky import Sky
from companion.studies.fleet.world import FleetCounts


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("fleet")
    sizes = ["--nodes", "2..4", "--uavs", "8..16", "--steps", "2", "--seconds", "2"]
    ran = CliRunner().invoke(main, ["study", "fleet", *sizes, "--out", str(out), "--json"])
    assert ran.exit_code == 0, ran.output
    return out, json.loads(ran.stdout)


def test_every_uav_has_one_node_and_node_loss_triggers_takeover(
    found: tuple[Path, dict[str, Any]],
) -> None:
    _, answer = found
    assert [(one["nodes"], one["uavs"]) for one in answer["sizes"]] == [(2, 8), (4, 16)]
    for one in answer["sizes"]:
        assert one["served"] >= 0.99
        assert one["none"] == one["parted_none"] == 0
        assert one["takeover_s"] is None or one["takeover_s"] <= 2.0
        assert one["heal_s"] <= 1.5
        assert one["told_kbps"].keys() == {"heard", "offers", "standing"}
    small, large = answer["sizes"]
    assert large["link_kbps"] > small["link_kbps"]


def test_page_figures_and_json_are_written(found: tuple[Path, dict[str, Any]]) -> None:
    out, answer = found
    page = (out / "fleet.html").read_text(encoding="utf-8")
    assert answer["command"] in page
    assert "<td>16</td>" in page
    for name in ("traffic", "time"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    kept = json.loads((out / "fleet.json").read_text(encoding="utf-8"))
    assert kept == answer


def test_fleet_study_is_reproducible(found: tuple[Path, dict[str, Any]]) -> None:
    _, answer = found
    asked = study.FleetStudy(sizes=((2, 8),), seconds=2.0)
    (again,) = study.answer(asked, list(study.run(asked, lambda: 0.0)), "")["sizes"]
    before = answer["sizes"][0] | {"cpu_share": 0.0}
    assert again == before


@pytest.mark.parametrize("span", ["x", "3..", "0..5", "9..3", "1..99999"])
def test_invalid_node_span_is_rejected(span: str, tmp_path: Path) -> None:
    ran = CliRunner().invoke(main, ["study", "fleet", "--nodes", span, "--out", str(tmp_path)])
    assert ran.exit_code == 2
    assert "Traceback" not in ran.output


def test_sampled_reports_scale_to_the_whole_fleet() -> None:
    all_of_them, half = (
        next(
            study.run(
                study.FleetStudy(sizes=((2, 8),), seconds=1.0, loss=0.0, sampled=n), lambda: 0.0
            )
        )
        for n in (8, 4)
    )
    assert half.told_kbps["heard"] == pytest.approx(all_of_them.told_kbps["heard"], rel=0.3)


def test_shares_of_uavs_served_once_twice_and_unserved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six, one and three of ten; with half of the nodes cut off, four of eight are unserved."""
    counted = [
        FleetCounts(served=6, twice=1, unserved=3, handovers=4),
        FleetCounts(served=4, twice=0, unserved=4),
    ]
    monkeypatch.setattr(study, "_counted", lambda *_: counted.pop(0))
    monkeypatch.setattr(study, "_measure_takeover", lambda _: (1.5, 2))
    monkeypatch.setattr(study, "_measure_healing_s", lambda _: 2.5)
    world: Any = SimpleNamespace(sky=Sky(nodes=2, uavs=8), run=lambda _: None, members={})
    found = study._simulate_size(world, 10.0)
    assert (found.served, found.twice, found.none, found.parted_none) == (0.6, 0.1, 0.3, 0.5)
    assert (found.nodes, found.uavs, found.handovers_per_min) == (2, 8, 24.0)
    assert (found.takeover_s, found.orphans, found.heal_s) == (1.5, 2, 2.5)
