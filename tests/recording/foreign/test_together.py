"""Logs of single vehicles merged into one flight, and the same flight as a telemetry log."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from support import shared_log

from companion import Pipeline, Settings
from companion.cli.main import main
from companion.node.replay import settings_for
from companion.pipeline.ticks import with_ticks
from companion.recording.reader import (
    LogError,
    center_of,
    flights,
    log_kind,
    read_flight,
    read_log,
    vehicles,
)
from companion.studies.truth import vehicles as truth
from companion.values import Estimate, FloatArray, Frame


def test_log_kind_is_detected_by_content(aeroplane: Path, tmp_path: Path) -> None:
    renamed = shutil.copy(aeroplane, tmp_path / "flight.tlog")
    assert log_kind(renamed) == "dataflash"
    assert log_kind(shared_log("px4_sample_small.ulg")) == "ulog"


def test_two_logs_merge_into_one_flight_on_gps_time(aeroplane: Path, carrier: Path) -> None:
    one, five = vehicles([aeroplane, carrier])
    assert (str(one.source), str(five.source)) == ("1:1", "5:1")
    events = list(read_flight([aeroplane, carrier]))
    times = [event.t_ns for event in events]
    assert times == sorted(times)
    sources = [event.source for event in events if isinstance(event, Frame)]
    assert set(sources) == {one.source, five.source}
    middle = sources[len(sources) // 2 - 200 : len(sources) // 2 + 200]
    assert 100 < middle.count(one.source) < 300  # they fly side by side
    assert one.log.clock and five.log.clock
    assert one.as_json()["clock_uncertainty_s"] == 0.001
    assert "on GPS time to 0.001 s by 100 fixes" in one.notice()


def test_duplicate_sysid_gets_a_new_id(aeroplane: Path, tmp_path: Path) -> None:
    again = Path(shutil.copy(aeroplane, tmp_path / "again.bin"))
    first, second = vehicles([aeroplane, again])
    assert (first.source.sysid, second.source.sysid) == (1, 2)
    assert "id 1 in the log is taken by another" in second.notice()


def test_assigned_id_avoids_ids_of_other_logs(
    aeroplane: Path, carrier: Path, tmp_path: Path
) -> None:
    nameless = tmp_path / "nameless.bin"
    nameless.write_bytes(aeroplane.read_bytes().replace(b"MAV_SYSID", b"MAV_SISID"))
    found = [one.source.sysid for one in vehicles([nameless, aeroplane, carrier])]
    assert found == [2, 1, 5]
    assert "no id in the log" in vehicles([nameless])[0].notice()


def test_carrier_can_be_given_as_a_log_name(aeroplane: Path, carrier: Path, cut_log: Path) -> None:
    both = [aeroplane, carrier]
    assert center_of(both, str(carrier)) == center_of(both, carrier.name) == "5:1"
    assert center_of(both, "7:1") == "7:1"
    assert center_of(both, None) is None
    with pytest.raises(LogError, match="name the carrier's log among the logs, too"):
        center_of(both[:1], str(both[1]))
    with pytest.raises(LogError, match="give the carrier as SYSID:COMPID"):
        center_of([cut_log], cut_log.name)


def test_single_vehicle_logs_form_one_flight_others_stand_alone(
    aeroplane: Path, carrier: Path, cut_log: Path
) -> None:
    assert flights([aeroplane, cut_log, carrier]) == [(aeroplane, carrier), (cut_log,)]


def test_logs_of_different_days_are_rejected_as_one_flight(carrier: Path, tmp_path: Path) -> None:
    table = tmp_path / "late.csv"
    table.write_text("unix_s,lat_deg,lon_deg,alt_m\n1795400000,47,8,500\n1795400001,47,8,500\n")
    with pytest.raises(
        LogError, match=r"late\.csv: begins 2\d\.\d h after .* give the logs of one flight"
    ):
        read_flight([carrier, table])


def test_log_without_gps_time_cannot_be_merged(carrier: Path, tmp_path: Path) -> None:
    table = tmp_path / "plain.csv"
    table.write_text("t_s,lat_deg,lon_deg,alt_m\n0,47,8,500\n1,47,8,500\n")
    assert sum(isinstance(event, Frame) for event in read_log(table)) == 4
    with pytest.raises(LogError, match="no GPS time, so other logs cannot be joined"):
        read_flight([carrier, table])


def replayed(*words: str | Path) -> dict[str, Any]:
    given = ["replay", *map(str, words), "--json"]
    done = CliRunner().invoke(main, given, prog_name="companion")
    assert done.exit_code == 0, done.output
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_recorded_replay_of_merged_logs_has_the_same_digest(
    aeroplane: Path, carrier: Path, tmp_path: Path
) -> None:
    recording = tmp_path / "x.mcap"
    found = replayed(aeroplane, carrier, "--center", carrier.name, "--out", recording)
    assert found["center"] == "5:1"
    assert [log["uav"] for log in found["logs"]] == ["1:1", "5:1"]
    assert found["uavs"]["1:1"]["reports"] == 200
    assert replayed(recording, "--no-record")["digest"] == found["digest"]


def test_replay_applies_the_given_latency(aeroplane: Path) -> None:
    def first_ns(latency_s: float) -> int:
        return next(iter(read_log(aeroplane, latency_s))).t_ns

    assert first_ns(0.2) - first_ns(0.0) == 200_000_000
    at_once, late = (
        replayed(aeroplane, "--no-record", "--latency", latency) for latency in ("0", "0.2")
    )
    assert at_once["uavs"]["1:1"]["reports"] == late["uavs"]["1:1"]["reports"] == 200


def test_simulator_truth_in_the_logs_is_loaded(aeroplane: Path, carrier: Path) -> None:
    flown = truth.load([aeroplane, carrier], "5:1")
    (flight,) = flown.flights
    assert flight.uav == "1:1" and flight.truth.kind == "SIM_STATE"
    assert flown.log == f"{aeroplane.name} + {carrier.name}"
    # The estimator is accurate; its position is offset from its timestamp by about one frame.
    place, _ = flight.truth.at(flight.made_ns)
    error_m = np.linalg.norm(place - flight.position_ned_m, axis=1)
    assert np.nanmedian(error_m) < 1.5 and np.isfinite(error_m).mean() > 0.95


def test_replay_settings_hold_the_clock_offset_uncertainty(
    aeroplane: Path, carrier: Path, tmp_path: Path
) -> None:
    """0.001 s from the fixes plus half of the difference between receivers; a single log has
    none."""
    config = tmp_path / "settings.toml"
    config.write_text('[clocks.apart_s]\n"5:1" = 0.02\n')
    both = [aeroplane, carrier]
    assert settings_for(both, None, "5:1").clocks.apart_s == {"1:1": 0.101, "5:1": 0.101}
    assert settings_for(both, config, "5:1").clocks.apart_s == {"1:1": 0.101, "5:1": 0.02}
    assert settings_for([aeroplane], None, "home").clocks.apart_s == {}


@pytest.mark.parametrize("sign", [-1, 1])
def test_bounds_cover_a_timeline_offset(aeroplane: Path, carrier: Path, sign: int) -> None:
    """An adversary shifts one vehicle's whole log by the stated uncertainty: 0.8 s at 22 m/s."""
    off_ns, tracks_at = sign * 800_000_000, {}
    for name, apart_s, moved_ns in (("true", {}, 0), ("bare", {}, off_ns),
                                    ("said", {"1:1": 0.8}, off_ns)):  # fmt: skip
        place = {"center": {"source": "47.3977419,8.5455937,488.1"}, "clocks": {"apart_s": apart_s}}
        pipeline = Pipeline(Settings().override(**place))
        events = [
            event._replace(t_ns=event.t_ns + moved_ns)
            for event in read_flight([aeroplane])
            if isinstance(event, Frame)
        ]
        middle_ns = events[len(events) // 2].t_ns - moved_ns
        for event in events:
            if event.t_ns > middle_ns:
                break
            pipeline.step(event)
        (tracks_at[name],) = pipeline.tracks(middle_ns, middle_ns)
    off_m = {
        name: np.linalg.norm(track.position_ned_m - tracks_at["true"].position_ned_m)
        for name, track in tracks_at.items()
    }
    assert off_m["bare"] > tracks_at["bare"].bound_m
    assert off_m["said"] <= tracks_at["said"].bound_m
    assert off_m["said"] == pytest.approx(off_m["bare"], rel=0.01)  # the estimate is unchanged


# --- the same flight in another format ------------------------------------------------------------


def tracks(logs: list[Path], uav: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Boot times (N,), s, of a UAV's accepted reports, positions (N, 3), velocities and estimates.

    Each estimate is the observer's answer at the time of its report.
    """
    settings = Settings().override(center={"source": "47.3977419,8.5455937,488.1"})
    pipeline = Pipeline(settings)
    rows = []
    for event in with_ticks(read_flight(logs), 10.0):
        for output in pipeline.step(event):
            if isinstance(output, Estimate) and output.fix.uav == uav:
                fix = output.fix
                assert fix.velocity_ned_mps is not None and fix.report.boot_ms is not None
                state = (*fix.position_ned_m, *fix.velocity_ned_mps)
                rows.append((fix.report.boot_ms * 1e-3, *state, *output.position_ned_m))
    found = np.array(rows)
    return found[:, 0], found[:, 1:7], found[:, 7:]


def between(t_s: FloatArray, known_s: FloatArray, states: FloatArray) -> FloatArray:
    """Positions by cubic Hermite interpolation between reports; NaN outside."""
    after = np.clip(np.searchsorted(known_s, t_s), 1, len(known_s) - 1)
    span = (known_s[after] - known_s[after - 1])[:, None]
    s = ((t_s - known_s[after - 1])[:, None]) / span
    p0, v0 = states[after - 1, :3], states[after - 1, 3:] * span
    p1, v1 = states[after, :3], states[after, 3:] * span
    bend, twist = 3 * (p1 - p0) - 2 * v0 - v1, 2 * (p0 - p1) + v0 + v1
    found = p0 + s * (v0 + s * (bend + s * twist))
    found[(s[:, 0] < 0) | (s[:, 0] > 1)] = np.nan
    return np.asarray(found)


@pytest.mark.full
@pytest.mark.parametrize("uav", ["1:1", "5:1"])
def test_onboard_logs_and_telemetry_log_give_the_same_tracks(uav: str) -> None:
    """Reports at equal boot times have equal positions, and so do the observer's estimates.

    Both logs are sampled at 10 Hz: the aeroplane in the same timer cycle, the copter 20 ms apart.
    """
    bins = [shared_log(f"sitl_planes_circle_{vehicle}.bin") for vehicle in (1, 5)]
    t_s, states, estimates = tracks(bins, uav)
    tlog_s, tlog_states, tlog_estimates = tracks([shared_log("sitl_planes_circle.tlog")], uav)
    settled = tlog_s > t_s[0] + 5.0
    place = between(tlog_s, t_s, states)
    error_m = np.linalg.norm(place - tlog_states[:, :3], axis=1)[settled]
    known = np.isfinite(error_m)
    assert known.sum() > 1900
    assert np.quantile(error_m[known], 0.95) < 0.01 and np.nanmax(error_m) < 0.05
    off_m = np.linalg.norm(estimates - states[:, :3], axis=1)[50:]
    tlog_off_m = np.linalg.norm(tlog_estimates - tlog_states[:, :3], axis=1)[settled]
    assert np.median(off_m) == pytest.approx(np.median(tlog_off_m), abs=0.05)


def test_log_is_cached_until_the_file_changes(aeroplane: Path, tmp_path: Path) -> None:
    log = tmp_path / "uav.bin"
    whole = aeroplane.read_bytes()
    log.write_bytes(whole)
    (first,), (second,) = vehicles([log]), vehicles([log])
    assert second.log is first.log
    log.write_bytes(whole[: len(whole) // 2])
    (cut,) = vehicles([log])
    assert first.log.positions is not None
    assert cut.log.positions is not None
    assert len(cut.log.positions.boot_us) < len(first.log.positions.boot_us)
