"""Beam study of a flight: against a second pipeline, other log readers, and hand calculations."""

import json
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pymap3d
import pytest
from click.testing import CliRunner
from pymavlink import mavutil  # reference implementation: only tests may import it
from support import ROOT, shared_log

from companion.beams.array.coverage import EVERYWHERE, Coverage
from companion.cli.main import main
from companion.mavlink.wire.decode import GPS_RAW_INT
from companion.node.replay import log_events
from companion.pipeline.fold import Pipeline
from companion.recording.reader import read_log
from companion.settings.model import Settings
from companion.studies.beams.charts import charts
from companion.studies.beams.flight import (
    BeamStudy,
    Sight,
    StudiedFlight,
    look,
    sight,
    updates,
    watch,
)
from companion.studies.beams.worth import SHARP, Sample, Worth, summed_up
from companion.studies.truth import array_truth
from companion.studies.truth.vehicles import Trajectory
from companion.values import Frame, Method, Tick, Update

S = 1_000_000_000
UAVS = {"1:1", "2:1", "3:1", "4:1"}


def run(*arguments: str | Path) -> Any:
    """Run the command as the console script does."""
    return CliRunner().invoke(main, ["study", "beams", *map(str, arguments)])


def on_carrier(**sections: dict[str, Any]) -> Settings:
    return Settings().override(center={"source": "5:1"}, **sections)


@pytest.fixture(scope="module")
def cut() -> Path:
    return ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"


def without(path: Path, out: Path, unwanted: Callable[[Frame], bool]) -> Path:
    """Write the log without some frames, as .tlog."""
    with out.open("wb") as file:
        for event in read_log(path):
            if isinstance(event, Frame) and not unwanted(event):
                file.write(struct.pack(">Q", event.t_ns // 1000) + event.raw)
    return out


@pytest.fixture(scope="module")
def short(cut: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first eight seconds of the log."""
    ends_ns = next(read_log(cut)).t_ns + 8 * S
    return without(cut, tmp_path_factory.mktemp("log") / "8s.tlog", lambda f: f.t_ns > ends_ns)


@pytest.fixture(scope="module")
def watched(cut: Path) -> StudiedFlight:
    return watch([cut], on_carrier(), 0.5)


@pytest.fixture(scope="module")
def looked(cut: Path) -> tuple[Pipeline, Update]:
    """A pipeline in mid-flight, and its update."""
    pipeline = Pipeline(on_carrier())
    for t_s, update in updates([cut], pipeline, 1.0):
        if t_s >= 14.0:
            return pipeline, update
    raise AssertionError


# --- hand calculations --------------------------------------------------------------------------


def worth(gain_db: float = 10.0, **given: Any) -> Worth:
    blank = Worth(
        gain_db=gain_db,
        loss_db=1.0,
        guaranteed_gain_db=None,
        true_gain_db=None,
        sinr_db=20.0,
        spectral_efficiency=6.0,
        group=0,
        widened=False,
        method=Method.ZERO_FORCING,
        condition_number=2.0,
    )
    return replace(blank, **given)


def test_summary_matches_hand_computed_values() -> None:
    """Four samples, one without a beam and one without a guarantee."""
    samples = [
        Sample(t_s=0.0, uav="1:1"),
        Sample(
            t_s=1.0,
            uav="1:1",
            pointing_bound_rad=0.02,
            off_rad=0.01,
            codebook_best=3,
            sweep_share=0.25,
            missed=False,
            as_set=worth(12.0, true_gain_db=11.0, guaranteed_gain_db=9.0, widened=True),
            sharp=worth(18.0, true_gain_db=16.0, guaranteed_gain_db=16.5),
        ),
        Sample(
            t_s=2.0,
            uav="1:1",
            pointing_bound_rad=0.04,
            off_rad=0.05,
            codebook_best=3,
            sweep_share=0.5,
            missed=True,
            as_set=worth(14.0, true_gain_db=7.0, guaranteed_gain_db=8.0, spectral_efficiency=3.0),
            sharp=worth(17.0, true_gain_db=1.0),
        ),
        Sample(
            t_s=3.0,
            uav="1:1",
            pointing_bound_rad=None,
            off_rad=None,
            codebook_best=3,
            sweep_share=1.0,
            missed=None,
            as_set=worth(
                6.0, method=Method.REGULARISED, condition_number=50.0, group=2, sinr_db=-math.inf
            ),
            sharp=worth(16.0),
        ),
    ]
    row = summed_up(samples)
    assert (row["n"], row["without_beam"], row["n_true"]) == (3, 1, 2)
    assert row["pointing_bound_median_deg"] == pytest.approx(math.degrees(0.04))
    assert row["pointing_bound_p95_deg"] is None
    assert row["pointing_error_p95_deg"] == pytest.approx(math.degrees(0.05))
    assert (row["bound_violations"], row["violations"], row["codebook_misses"]) == (1, 1, 1)
    within = ("violations_within_bound", "codebook_misses_within_bound")
    assert [row[key] for key in within] == [0, 0]
    near = [replace(sample, off_rad=0.001) for sample in samples[1:]]
    assert [summed_up(near)[key] for key in within] == [1, 1]
    assert row["sweep_share_mean"] == pytest.approx(1.75 / 3)
    assert row["sweep_share_p95"] == 1.0
    assert (row["gain_p5_db"], row["gain_median_db"]) == (6.0, 12.0)
    assert row["guaranteed_share"] == pytest.approx(2 / 3)
    assert (row["guaranteed_gain_p5_db"], row["guaranteed_gain_median_db"]) == (None, 8.0)
    assert (row["true_gain_p5_db"], row["true_gain_median_db"]) == (7.0, 7.0)
    assert row["sinr_median_db"] == 20.0
    assert row["spectral_efficiency_mean"] == pytest.approx(5.0)
    assert row["widened_share"] == row["regularised_share"] == pytest.approx(1 / 3)
    assert (row["turns_max"], row["condition_number_max"]) == (3, 50.0)
    assert (row[SHARP + "n"], row[SHARP + "gain_median_db"]) == (3, 17.0)
    assert row[SHARP + "guaranteed_share"] == pytest.approx(1 / 3)
    assert row[SHARP + "guaranteed_gain_median_db"] is None
    assert row[SHARP + "violations"] == row[SHARP + "violations_within_bound"] == 1


def test_summary_without_beams_is_unknown() -> None:
    row = summed_up([Sample(t_s=0.0, uav="1:1"), Sample(t_s=1.0, uav="1:1")])
    assert (row["n"], row["without_beam"]) == (0, 2)
    counts = {"n", "without_beam", "n_true", "sharp_n"}
    assert all(row[key] is None for key in row.keys() - counts)


# --- samples ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "hz", [*(pytest.param(hz, marks=pytest.mark.full) for hz in (5.0, 100.0)), 7.0]
)
def test_samples_are_taken_at_the_last_tick(short: Path, hz: float) -> None:
    """Each update is sampled once, whatever the sampling rate."""
    settings = Settings().override(center={"source": "home"}, beams={"targets": "telemetry"})
    pipeline, ticks, begins_ns, ends_ns = Pipeline(settings), [], None, 0
    for event in log_events([short], settings):
        begins_ns = event.t_ns if begins_ns is None else begins_ns
        pipeline.step(event)
        ends_ns = event.t_ns
        if isinstance(event, Tick):
            ticks.append(event.t_ns)
    assert begins_ns is not None
    period_ns = round(S / hz)
    due = [begins_ns + k * period_ns for k in range(1, 1 + (ends_ns - begins_ns) // period_ns)]
    last = [max((t for t in ticks if t <= at), default=None) for at in due if at < ends_ns]
    expected = [t_ns for t_ns in dict.fromkeys(last) if t_ns is not None]
    seen = list(updates([short], Pipeline(settings), hz))
    assert [update.t_ns for _, update in seen] == expected
    late_s = [t_s - (update.t_ns - begins_ns) * 1e-9 for t_s, update in seen]
    assert -1e-9 <= min(late_s) <= max(late_s) < 1 / settings.beams.update_hz
    assert len(seen) == pytest.approx(8 * min(hz, settings.beams.update_hz), abs=2)


def test_sharp_beams_equal_a_pipeline_without_widening(cut: Path, watched: StudiedFlight) -> None:
    sharp = watch([cut], on_carrier(beams={"widen": False}), 0.5)
    assert (watched.widen, sharp.widen) == (True, False)
    assert len(watched.samples) == len(sharp.samples) > 40
    for ours, theirs in zip(watched.samples, sharp.samples, strict=True):
        assert (ours.t_s, ours.uav) == (theirs.t_s, theirs.uav)
        assert ours.sharp is not None
        assert theirs.as_set is not None
        # Their id arrives with a delay, as in flight.
        assert replace(ours.sharp, method=theirs.as_set.method) == theirs.as_set
    assert not any(s.sharp.widened for s in watched.samples if s.sharp)
    assert any(s.as_set.widened for s in watched.samples if s.as_set)


def test_guaranteed_gain_and_bounds_hold(watched: StudiedFlight) -> None:
    row = summed_up(watched.samples)
    assert watched.truth == "SIM_STATE"
    assert set(watched.by_uav) == UAVS
    assert row["n_true"] == row["n"] == len(watched.samples)
    assert row["bound_violations"] == row["violations"] == row[SHARP + "violations"] == 0
    assert row["codebook_misses"] == 0
    assert row["pointing_bound_median_deg"] < 8.0
    assert row["sweep_share_mean"] < 0.15
    # The cost and the benefit of widening.
    assert row["gain_median_db"] < row[SHARP + "gain_median_db"] - 0.5
    assert row["guaranteed_share"] > 0.8
    assert row[SHARP + "guaranteed_share"] < 0.5


def brute_gain_db(pipeline: Pipeline, towards: np.ndarray, weights: np.ndarray) -> float:
    """The gain, summed element by element."""
    array = pipeline.array
    total = 0j
    for place_m, weight in zip(array.elements_m, weights, strict=True):
        phase = 2 * math.pi / array.wavelength_m * float(place_m @ towards)
        total += complex(math.cos(phase), math.sin(phase)) * complex(weight)
    return 10 * math.log10(abs(total) ** 2 / sum(abs(complex(w)) ** 2 for w in weights))


def around(towards: np.ndarray, bound_rad: float, rng: np.random.Generator) -> np.ndarray:
    """A direction within the bound."""
    aside = np.cross(towards, rng.standard_normal(3))
    aside /= np.linalg.norm(aside)
    turn = bound_rad * rng.random()
    return math.cos(turn) * towards + math.sin(turn) * aside


@pytest.mark.full
def test_sample_matches_brute_force(cut: Path, looked: tuple[Pipeline, Update]) -> None:
    pipeline, update = looked
    truth = array_truth.load([cut], pipeline)
    assert truth is not None
    assert update.carrier is not None
    seen = sight(pipeline)
    assert seen.codebook is not None
    samples = {sample.uav: sample for sample in look(seen, update, truth, 14.0)}
    truly = truth.directions(update.tracks, update.carrier, pipeline.array)
    rng = np.random.default_rng(5)
    for i, beam in enumerate(update.beams.beams):
        sample, weights = samples[beam.uav], update.beams.weights[:, i]
        towards = _unit(beam.azimuth_rad, beam.elevation_rad)
        assert sample.as_set is not None
        assert sample.pointing_bound_rad is not None
        assert sample.off_rad == pytest.approx(math.acos(towards @ truly[i]), abs=1e-6)
        true_db = brute_gain_db(pipeline, truly[i], weights)
        assert sample.as_set.true_gain_db == pytest.approx(true_db, abs=1e-6)
        assert sample.as_set.gain_db == pytest.approx(brute_gain_db(pipeline, towards, weights))
        within = [around(towards, sample.pointing_bound_rad, rng) for _ in range(400)]
        seen_db = [brute_gain_db(pipeline, direction, weights) for direction in within]
        if sample.as_set.guaranteed_gain_db is not None:
            assert min(seen_db) >= sample.as_set.guaranteed_gain_db
            assert min(seen_db) < sample.as_set.guaranteed_gain_db + 3
        best = {_best(pipeline, seen, direction) for direction in within}
        assert sample.sweep_share is not None
        assert len(best) <= round(64 * sample.sweep_share) <= len(best) + 2
        assert sample.codebook_best == _best(pipeline, seen, towards)
        assert sample.missed is False


def _unit(azimuth_rad: float, elevation_rad: float) -> np.ndarray:
    level = math.cos(elevation_rad)
    x, y = level * math.cos(azimuth_rad), level * math.sin(azimuth_rad)
    return np.array([x, y, -math.sin(elevation_rad)])


def _best(pipeline: Pipeline, seen: Sight, towards: np.ndarray) -> int:
    assert seen.codebook is not None
    beams = seen.codebook.weights.T
    return int(np.argmax([brute_gain_db(pipeline, towards, beam) for beam in beams]))


def test_codebook_miss_is_reported(looked: tuple[Pipeline, Update], cut: Path) -> None:
    """The true direction is far off: outside the bound, and its best beam is not swept."""
    pipeline, update = looked
    truth = array_truth.load([cut], pipeline)
    assert truth is not None
    swapped = replace(truth, flights={"1:1": truth.flights["2:1"], "2:1": truth.flights["1:1"]})
    samples = {sample.uav: sample for sample in look(sight(pipeline), update, swapped, 0.0)}
    for uav in ("1:1", "2:1"):
        assert samples[uav].missed
        assert samples[uav].beyond
    for uav in ("3:1", "4:1"):
        assert samples[uav].off_rad is samples[uav].missed is None
        assert samples[uav].as_set is not None
        assert samples[uav].as_set.true_gain_db is None


def test_no_guarantee_beyond_the_coverage_edge(looked: tuple[Pipeline, Update]) -> None:
    pipeline, update = looked
    (sample,) = (s for s in look(sight(pipeline), update, None, 0.0) if s.uav == "2:1")
    (beam,) = (beam for beam in update.beams.beams if beam.uav == "2:1")
    assert sample.as_set is not None
    assert sample.as_set.guaranteed_gain_db is not None
    assert sample.pointing_bound_rad is not None
    off_rad = math.acos(_unit(beam.azimuth_rad, beam.elevation_rad)[0])
    for share, sure in ((0.9, False), (1.1, True)):
        pipeline.coverage = Coverage(
            field_of_view_rad=2 * (off_rad + share * sample.pointing_bound_rad)
        )
        found = {s.uav: s.as_set for s in look(sight(pipeline), update, None, 0.0)}["2:1"]
        pipeline.coverage = EVERYWHERE
        assert found is not None
        assert (found.guaranteed_gain_db is not None) == sure


def test_spectral_efficiency_accounts_for_time_slots(looked: tuple[Pipeline, Update]) -> None:
    pipeline, update = looked
    grouped = replace(
        update.beams, beams=tuple(replace(b, group=i) for i, b in enumerate(update.beams.beams))
    )
    assert update.carrier is not None
    found = sight(pipeline).worths(grouped, update.carrier, {})
    for one in found.values():
        alone = math.log2(1 + 10 ** (one.sinr_db / 10))
        assert one.spectral_efficiency == pytest.approx(alone / 4)
    assert sorted(one.group for one in found.values()) == [0, 1, 2, 3]


def test_untracked_carrier_yields_samples_without_beam(looked: tuple[Pipeline, Update]) -> None:
    pipeline, update = looked
    lost = replace(update, carrier=None)
    samples = look(sight(pipeline), lost, None, 3.0)
    assert samples == [Sample(t_s=3.0, uav=track.uav) for track in update.tracks]


# --- the truth ----------------------------------------------------------------------------------


def simulated(path: Path) -> dict[str, np.ndarray]:
    """By source: arrival s, latitude, longitude, height, roll, pitch, yaw, by another reader."""
    reader = mavutil.mavlogfile(str(path))
    found: dict[str, list[list[float]]] = {}
    while (m := reader.recv_match(type="SIM_STATE")) is not None:
        source = f"{m.get_srcSystem()}:{m.get_srcComponent()}"
        place = [m.lat_int * 1e-7, m.lon_int * 1e-7, m.alt]
        found.setdefault(source, []).append([m._timestamp, *place, m.roll, m.pitch, m.yaw])
    reader.close()
    return {source: np.array(rows) for source, rows in found.items()}


def test_true_directions_match_pymap3d(cut: Path, looked: tuple[Pipeline, Update]) -> None:
    """By pymavlink, pymap3d, and Euler angles instead of the quaternion. The predicted attitude
    is off by a degree and would fail this test."""
    pipeline, update = looked
    truth = array_truth.load([cut], pipeline)
    assert truth is not None
    assert update.carrier is not None
    at_s = update.beams.valid_at_ns * 1e-9
    at = {
        source: np.array([np.interp(at_s, rows[:, 0], np.unwrap(c)) for c in rows[:, 1:].T])
        for source, rows in simulated(cut).items()
    }
    roll, pitch, yaw = at["5:1"][3:]
    found = truth.directions(update.tracks, update.carrier, pipeline.array)
    for track, towards in zip(update.tracks, found, strict=True):
        ned = np.array(pymap3d.geodetic2ned(*at[track.uav][:3], *at["5:1"][:3]))
        body = _about("x", roll) @ _about("y", pitch) @ _about("z", yaw) @ ned
        apart = math.acos(min(1.0, float(towards @ body) / float(np.linalg.norm(body))))
        assert math.degrees(apart) < 0.15
    predicted = replace(truth, carrier=None)
    off = predicted.directions(update.tracks, update.carrier, pipeline.array)
    apart_deg = np.degrees(np.arccos(np.sum(off * found, axis=1)))
    assert apart_deg.max() > 0.7


def _about(axis: str, angle: float) -> np.ndarray:
    """Rotation of the frame about an axis."""
    c, s = math.cos(angle), math.sin(angle)
    return {
        "x": np.array([[1, 0, 0], [0, c, s], [0, -s, c]]),
        "y": np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]),
        "z": np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]),
    }[axis]


def test_true_directions_are_nan_outside_the_truth(
    cut: Path, looked: tuple[Pipeline, Update]
) -> None:
    pipeline, update = looked
    truth = array_truth.load([cut], pipeline)
    assert truth is not None
    assert update.carrier is not None
    later = replace(update.carrier, valid_at_ns=update.carrier.valid_at_ns + 60 * S)
    assert np.isnan(truth.directions(update.tracks, later, pipeline.array)).all()
    assert truth.carrier is not None
    whole = truth.carrier.flight.truth
    begun = Trajectory(
        kind=whole.kind,
        t_ns=whole.t_ns[:9],
        position_ned_m=whole.position_ned_m[:9],
        velocity_ned_mps=whole.velocity_ned_mps[:9],
    )
    lost = replace(truth.carrier, flight=replace(truth.carrier.flight, truth=begun))
    unseen = replace(truth, carrier=lost)
    assert np.isnan(unseen.directions(update.tracks, update.carrier, pipeline.array)).all()


def test_carrier_truth_alone_gives_no_truth(short: Path, tmp_path: Path) -> None:
    log = without(short, tmp_path / "own.tlog", lambda f: f.msgid == 108 and f.source.sysid < 5)
    assert watch([log], on_carrier(), 0.5).truth is None


def test_carrier_without_truth_uses_its_predicted_pose(short: Path, tmp_path: Path) -> None:
    log = without(short, tmp_path / "some.tlog", lambda f: f.msgid == 108 and f.source.sysid == 5)
    found = watch([log], on_carrier(), 0.5)
    row = summed_up(found.samples)
    assert found.truth == "SIM_STATE, carrier as predicted"
    assert row["n_true"] == row["n"] > 0
    assert row["bound_violations"] == row["violations"] == row["codebook_misses"] == 0
    assert row["pointing_error_p95_deg"] < 0.5


@pytest.mark.full
def test_log_without_truth_leaves_true_values_unknown(short: Path, tmp_path: Path) -> None:
    log = without(short, tmp_path / "none.tlog", lambda frame: frame.msgid == 108)
    done = run(log, "--center", "5:1", "--hz", "0.5", "--out", tmp_path, "--json")
    assert done.exit_code == 0, done.stderr
    summary = json.loads(done.stdout)["summary"]
    unknown = {"true_gain_p5_db", "true_gain_median_db", "violations", "codebook_misses"}
    unknown |= {"violations_within_bound", "codebook_misses_within_bound"}
    assert all(summary[key] is None for key in unknown | {"bound_violations"})
    assert summary["n"] > 0


def test_fixed_station_violates_no_bound(short: Path) -> None:
    """A fixed station has no attitude error."""
    found = watch([short], Settings().override(center={"source": "47.3977419,8.5455938,500"}), 0.5)
    row = summed_up(found.samples)
    assert found.truth == "SIM_STATE"
    assert set(found.by_uav) == UAVS | {"5:1"}
    assert row["pointing_error_p95_deg"] < 0.5
    assert row["n_true"] > 0
    assert row["bound_violations"] == row["violations"] == row["codebook_misses"] == 0


# --- codebooks ----------------------------------------------------------------------------------


@pytest.mark.full
def test_sweep_of_a_tenth_of_the_beams_holds_the_best_beam(cut: Path) -> None:
    """The 64 beams of 8 × 8 elements, once the track has its bound."""
    panel = on_carrier(array={"kind": "ura"}, codebook={"kind": "dft"})
    samples = watch([cut], panel, 5.0).samples
    assert not any(sample.missed for sample in samples)
    assert sum(sample.missed is False for sample in samples) > 440
    shares = [s.sweep_share for s in samples if s.t_s > 3 and s.sweep_share is not None]
    assert len(shares) > 400
    assert max(shares) <= 0.1


def test_codebook_follows_the_settings(short: Path) -> None:
    fine = watch([short], on_carrier(codebook={"kind": "dft", "oversampling": 2}), 0.5)
    assert fine.codebook_beams == 128
    assert summed_up(fine.samples)["codebook_misses"] == 0
    circle = watch([short], on_carrier(array={"kind": "uca", "elements": 8}), 0.5)
    row = summed_up(circle.samples)
    assert circle.codebook_beams is None
    assert charts(circle).keys() == {"gain", "gain_had"}
    assert row["sweep_share_mean"] is row["codebook_misses"] is None
    assert row["violations"] == 0


# --- the figures --------------------------------------------------------------------------------


def test_figures_show_the_worst_value_and_gaps() -> None:
    """Forty samples; ten have no guarantee, and one gain is low."""
    samples = tuple(
        Sample(
            t_s=float(t),
            uav="1:1",
            pointing_bound_rad=0.1,
            off_rad=None,
            codebook_best=0,
            sweep_share=0.5 if t == 7 else 0.25,
            missed=None,
            as_set=worth(
                0.0 if t == 31 else 10.0, guaranteed_gain_db=None if 10 <= t < 20 else 5.0
            ),
        )
        for t in range(40)
    )
    watched = StudiedFlight(
        log="log",
        center="home",
        array="array",
        codebook_beams=64,
        truth=None,
        widen=True,
        looks=40,
        samples=samples,
    )
    drawn = charts(watched)
    gain = curves(drawn["gain"]().axes[0])
    assert gain.keys() == {"predicted", "guaranteed"}  # without truth there are no true values
    told = charts(replace(watched, truth="SIM_STATE"))
    assert curves(told["gain"]().axes[0]).keys() == gain.keys() | {"true"}
    # Two samples per bin; the worst of each.
    assert list(gain["predicted"][1]) == [0.0 if n == 31 * 20 // 39 else 10.0 for n in range(20)]
    assert np.isnan(gain["guaranteed"][1]).nonzero()[0].tolist() == [5, 6, 7, 8, 9]
    (share,) = curves(drawn["sweep"]().axes[0]).values()
    assert list(share[1]) == [50.0 if n == 7 * 20 // 39 else 25.0 for n in range(20)]
    as_set, _ = drawn["gain_had"]().axes
    had = curves(as_set)
    low = as_set.get_xlim()[0]
    # Three samples of four have a guarantee, all equal.
    assert (had["guaranteed"][0][0], had["guaranteed"][1][0]) == (low, 75.0)
    assert (had["guaranteed"][0][-1], had["guaranteed"][1].max()) == (5.0, 75.0)
    assert had["predicted"][1][0] == 100.0


def test_isolated_value_between_gaps_is_a_dot() -> None:
    samples = tuple(
        Sample(
            t_s=float(t),
            uav="1:1",
            pointing_bound_rad=0.1,
            off_rad=None,
            codebook_best=0,
            sweep_share=0.5,
            missed=None,
            as_set=worth(10.0, guaranteed_gain_db=5.0 if t in (8, 9) else None),
        )
        for t in range(20)
    )
    axes = charts(
        StudiedFlight(
            log="log",
            center="home",
            array="array",
            codebook_beams=64,
            truth=None,
            widen=True,
            looks=20,
            samples=samples,
        )
    )["gain"]().axes[0]
    dots = [line.get_xydata() for line in axes.lines if line.get_marker() == "."]
    places = np.concatenate([np.asarray(each) for each in dots])
    assert len(places) == 1
    assert 8 <= places[0, 0] <= 9 and places[0, 1] == 5.0


def curves(axes: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The named lines of a panel: their x and y values."""
    return {
        line.get_label(): (np.asarray(line.get_xdata()), np.asarray(line.get_ydata()))
        for line in axes.lines
        if not line.get_label().startswith("_")
    }


# --- the command --------------------------------------------------------------------------------


class Page(HTMLParser):
    """Elements of a page; fails if one is left open."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.count: dict[str, int] = {}
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src")]
        if tag not in ("meta", "br", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.mark.full
def test_command_writes_the_files_it_reports(short: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "report"
    done = run(short, "--center", "5:1", "--hz", "0.5", "--out", out, "--json")
    assert done.exit_code == 0, done.stderr
    assert done.stderr == ""
    answer = json.loads(done.stdout, parse_constant=pytest.fail)
    assert json.loads((out / "beams.json").read_text()) == answer
    assert set(answer) == {"rows", "summary", "modes", "logs", "command", "versions", "hz"}
    assert answer["command"] == f"companion study beams {short} --center 5:1 --hz 0.5"
    assert {row["uav"] for row in answer["rows"]} == UAVS
    assert all({"log", "truth"} | answer["summary"].keys() <= row.keys() for row in answer["rows"])
    assert sum(row["n"] for row in answer["rows"]) == answer["summary"]["n"]
    figures = {f"{name}.{form}" for name in ("gain", "gain_had", "sweep")
               for form in ("png", "svg")}  # fmt: skip
    assert {path.name for path in out.iterdir()} == figures | {"beams.json", "beams.html"}
    for name in figures:
        data = (out / name).read_bytes()
        assert data.startswith(b"\x89PNG\r\n\x1a\n") or ElementTree.fromstring(data) is not None
    text = (out / "beams.html").read_text()
    page = Page(text)
    assert page.open == []
    assert len(page.addresses) == page.count["img"] == 3
    assert all(address.startswith("data:image/png;base64,") for address in page.addresses)
    assert "url(" not in text
    assert "--center 5:1" in text


@pytest.mark.full
def test_two_logs_are_tabulated_and_plotted_separately(short: Path, tmp_path: Path) -> None:
    done = run(short, short, "--center", "5:1", "--hz", "0.5", "--out", tmp_path)
    assert done.exit_code == 0, done.stderr
    assert done.stdout.count("true gain below guaranteed") == 2
    answer = json.loads((tmp_path / "beams.json").read_text())
    assert len(answer["rows"]) == 8
    assert len(answer["logs"]) == 2
    assert (tmp_path / "gain.svg").read_bytes() == (tmp_path / "gain_2.svg").read_bytes()
    assert Page((tmp_path / "beams.html").read_text()).count["img"] == 6


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--hz", "0"], "--hz 0: give updates per second, 0.001 to"),
        (["--hz", "nan"], "--hz nan: give updates per second"),
        (["--hz", "x"], "'x'"),
        (["--center", "9:1"], "no UAV gets a beam while"),
        (["--center", "nowhere"], "'nowhere' is not SYSID:COMPID"),
        (["--config", "no-such.toml"], "no-such.toml"),
    ],
)
def test_command_error_is_one_line(
    short: Path, tmp_path: Path, arguments: list[str], says: str
) -> None:
    center = [] if "--center" in arguments else ["--center", "5:1"]
    done = run(short, *center, *arguments, "--out", tmp_path)
    assert done.exit_code not in (0, None)
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("companion: ")
    assert says in line
    assert not list(tmp_path.iterdir())


def test_missing_center_reports_the_assumed_array_position(tmp_path: Path) -> None:
    done = run(shared_log("real_bluerobotics_server.tlog"), "--out", tmp_path)
    assert done.exit_code == 1
    said, line = done.stderr.splitlines()
    assert "array placed at the position of the first report" in said
    assert "no UAV gets a beam" in line


def test_invalid_rate_is_rejected() -> None:
    with pytest.raises(ValueError, match="--hz 1001"):
        BeamStudy(flights=(), settings=(), hz=1001.0)


def test_guarantee_fails_only_where_the_bound_fails(short: Path, tmp_path: Path) -> None:
    """Overconfident settings: the guarantee fails where the bound fails, and only there.

    Nothing shows that they are: the receivers' heights are left out.
    """
    bare = without(short, tmp_path / "bare.tlog", lambda frame: frame.msgid == GPS_RAW_INT)
    bold = {"follow_accuracy": False, "position_noise_m": 0.05, "velocity_noise_mps": 0.05}
    held = {"attitude_bound_deg": 0.1, "turn_acceleration_max_degps2": 0.0}
    settings = on_carrier(observer=bold).override(center=held)
    row = summed_up(watch([bare], settings, 2.0).samples)
    assert 0 < row["bound_violations"] < row["n"]
    assert row["violations"] > 0
    assert row["codebook_misses"] > 0
    assert row["violations_within_bound"] == row[SHARP + "violations_within_bound"] == 0
    assert row["codebook_misses_within_bound"] == 0
