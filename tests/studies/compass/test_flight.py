"""Compass study of a flight: what no array knows, and logs that it cannot use."""

from pathlib import Path

import pytest
from click.testing import CliRunner
from support import ROOT

from companion.cli.main import main
from companion.settings.model import Settings
from companion.studies.compass import flight
from companion.studies.compass.flight import METHODS, NONE, ORACLE, Case
from companion.studies.compass.receiver import RECEIVERS

CUT = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"


def test_flight_shorter_than_the_study_needs_is_an_error(tmp_path: Path) -> None:
    words = ["study", "compass", str(CUT), "--center", "5:1", "--out", str(tmp_path / "report")]
    found = CliRunner().invoke(main, words)
    assert found.exit_code == 1
    assert "less than 50 s with all vehicles in the air" in found.stderr


def test_array_sees_more_than_is_reported_and_less_than_the_truth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(flight, "WARM_UP_S", 1.0)
    settings = Settings().override(center={"source": "5:1"}, observations={"enabled": True})
    case = Case(logs=(CUT,), settings=settings, receiver=RECEIVERS[0], mount_deg=2.0, settle_s=2.0)
    rows = {row["method"]: row for row in flight.run(case)}
    assert list(rows) == list(METHODS)
    error = {name: row["pointing_error_p95_deg"] for name, row in rows.items()}
    assert error[ORACLE] < error["array"] < error[NONE]
    assert rows["array"]["pointing_bound_median_deg"] < rows[NONE]["pointing_bound_median_deg"]
    assert rows["array"]["beyond"] == rows[NONE]["beyond"] == 0
