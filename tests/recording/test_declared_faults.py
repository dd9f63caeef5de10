"""Faults declared in the event list next to a log."""

import json
from pathlib import Path

import pytest
from support import shared_log

from companion.recording.declared_faults import DeclaredFault, declared_faults
from companion.recording.reader import LogError
from companion.studies.truth import vehicles

S = 1_000_000_000


def declare(log: Path, *events: tuple[float, int, str]) -> Path:
    rows = [{"unix": at, "sysid": sysid, "event": name} for at, sysid, name in events]
    log.with_name(log.name + ".events.json").write_text(json.dumps(rows))
    return log


def test_fault_start_and_end_events_form_intervals(tmp_path: Path) -> None:
    log = declare(
        tmp_path / "a.tlog",
        (100.0, 3, "gps_off"), (101.0, 2, "gps_on"), (108.5, 3, "gps_on"),
        (120.0, 2, "glitch25m"), (125.0, 2, "glitch_end"),
        (180.0, 4, "link_drop12s"), (200.0, 1, "storm"),
    )  # fmt: skip
    assert declared_faults(log) == (
        DeclaredFault(sysid=3, name="gps_off", from_ns=100 * S, to_ns=round(108.5 * S)),
        DeclaredFault(sysid=2, name="glitch25m", from_ns=120 * S, to_ns=125 * S),
        DeclaredFault(sysid=4, name="link_drop12s", from_ns=180 * S, to_ns=192 * S),
        DeclaredFault(sysid=1, name="storm", from_ns=200 * S, to_ns=2**62),
    )


def test_missing_fault_list_means_no_faults(tmp_path: Path) -> None:
    assert declared_faults(tmp_path / "a.tlog") == ()


@pytest.mark.parametrize(
    "text",
    [
        "nonsense",
        "[1]",
        "[" * 100_000,
        '[{"unix": 1e999, "sysid": 1}]',
        '[{"unix": 1}]',
        '{"a": 1}',
    ],
    ids=range(6),
)
def test_invalid_fault_list_is_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.tlog.events.json").write_text(text)
    with pytest.raises(LogError, match="must be a list of entries"):
        declared_faults(tmp_path / "a.tlog")


@pytest.mark.full
def test_faults_of_a_simulated_flight_are_read() -> None:
    """Each vehicle has its own fault window, widened until its estimate has settled."""
    flights = vehicles.load(shared_log("sitl_4circle_wander.tlog"), "5:1").flights
    lasts_s = {f.uav: [(b - a) / S for a, b in f.faults] for f in flights}
    assert {uav: len(each) for uav, each in lasts_s.items()} == dict.fromkeys(lasts_s, 1)
    expected = {"1:1": 10.0, "2:1": 11.0, "3:1": 13.6, "4:1": 18.0}
    assert {uav: each[0] for uav, each in lasts_s.items()} == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"\xff\xfe[", "must be a list of entries"),
        (b"[" + b"[]," * 10**6 + b"[]]", "larger than 1 MiB"),
    ],
    ids=["not-utf-8", "large"],
)
def test_unreadable_fault_list_is_rejected(tmp_path: Path, content: bytes, why: str) -> None:
    (tmp_path / "a.tlog.events.json").write_bytes(content)
    with pytest.raises(LogError, match=why):
        declared_faults(tmp_path / "a.tlog")
