"""Measured beams: the splits, the tables, and the predictors on known beams."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from support import shared_log

from companion.cli.main import main
from companion.studies.deepsense import geometry, predictors, study
from companion.studies.deepsense.samples import Samples, blocks, inner, shuffled
from companion.studies.running import measured_beams
from companion.values import BoolArray, FloatArray, IntArray, UserError

BEAMS = 32


def flown(
    seed: int, count: int = 1500, lag: int = 0, height: float = 0.0, y: float = -0.4
) -> tuple[FloatArray, IntArray]:
    """A path past an array at (0.5, y), and its beams from the sine about the array centre."""
    rng = np.random.default_rng(seed)
    turn = np.cumsum(rng.normal(0, 0.05, count))
    place = 0.5 + 0.45 * np.stack(
        [np.sin(0.021 * np.arange(count) + turn), np.cos(0.013 * np.arange(count))], axis=1
    )
    past = place[np.maximum(np.arange(count) - lag, 0)] - np.array([0.5, y])
    sine = past[:, 0] / np.hypot(np.hypot(past[:, 0], past[:, 1]), height)
    beam = np.clip(np.round(16 + 20 * sine + rng.normal(0, 0.3, count)), 1, BEAMS - 1)
    return place, beam.astype(np.int64)


@pytest.mark.parametrize("number", [5, 20, 37])
def test_blocks_are_contiguous_and_each_sample_is_tested_once(number: int) -> None:
    folds = blocks(1000, number, 5)
    assert np.sum(folds, axis=0).tolist() == [1] * 1000
    changes = sum(int((np.diff(fold.astype(int)) != 0).sum()) for fold in folds)
    assert changes == 2 * (number - 1)
    assert np.sum(shuffled(1000, 5, 3), axis=0).tolist() == [1] * 1000
    assert (shuffled(1000, 5, 3)[0] == shuffled(1000, 5, 3)[0]).all()


def test_inner_folds_partition_the_training_samples() -> None:
    tested = blocks(1000, 20, 5)[2]
    parts = inner(~tested, 16, 4)
    assert np.sum(parts, axis=0).tolist() == (~tested).astype(int).tolist()


@pytest.mark.full
def test_no_predictor_sees_the_tested_beams() -> None:
    """Other beams in the tested samples do not change their predictions."""
    place, beam = flown(1)
    tested = blocks(len(beam), 20, 5)[1]
    lied = np.where(tested, (beam * 7 + 3) % BEAMS, beam)
    for predictor in study.PREDICTORS.values():
        honest = predictor(Samples(name="x", place=place, beam=beam, beams=BEAMS), ~tested)(~tested)
        other = predictor(Samples(name="x", place=place, beam=lied, beams=BEAMS), ~tested)(~tested)
        np.testing.assert_array_equal(honest[tested], other[tested])


def test_fit_recovers_geometry_and_lag() -> None:
    place, beam = flown(2, lag=2)
    at = geometry.fit(place, beam, np.ones(len(beam), dtype=bool), BEAMS)
    assert at.lag == 2.0
    assert np.abs(at.beams(place) - beam).mean() < 0.6
    assert abs(at.x - 0.5) < 0.15


def test_fit_recovers_height_and_improves_beams() -> None:
    place, beam = flown(6, height=0.3, y=0.4)
    learned = np.arange(len(beam)) < 1000
    high = geometry.fit(place, beam, learned, BEAMS)
    flat = geometry.fit(place, beam, learned, BEAMS, simple=True)
    assert flat.height == 0.0 and high.height == pytest.approx(0.3, abs=0.05)
    assert (high.x, high.y) == pytest.approx((0.5, 0.4), abs=0.03)
    off, off_flat = (np.abs(at.beams(place) - beam)[~learned].mean() for at in (high, flat))
    assert off < 0.45 and off_flat > 2 * off


def test_expected_beam_matches_hand_computed_values() -> None:
    """3 across, 4 away and 12 up give a sine of 3/13; with the opposite yaw, its negative."""
    at = geometry.Geometry(
        x=0.0, y=0.0, stretch=np.log(2.0), yaw=0.0, middle=16.0, slope=26.0, height=12.0, lag=0.0
    )
    np.testing.assert_allclose(at.beams(np.array([[2.0, 3.0]])), [16 + 26 * 3 / 13])
    turned = replace(at, yaw=np.pi)
    np.testing.assert_allclose(turned.beams(np.array([[2.0, 3.0]])), [16 - 26 * 3 / 13])
    aside = replace(at, yaw=np.pi / 2)
    np.testing.assert_allclose(aside.beams(np.array([[2.0, 3.0]])), [16 - 26 * 4 / 13])


def test_refit_on_fewer_samples_keeps_the_lag() -> None:
    place, beam = flown(3, lag=1)
    learned = np.ones(len(beam), dtype=bool)
    at = geometry.fit(place, beam, learned, BEAMS)
    again = geometry.refit(at, place, beam, np.arange(len(beam)) < 700, BEAMS)
    assert again.lag == at.lag == 1.0 and again != at
    assert np.abs(again.beams(place) - at.beams(place))[:700].mean() < 0.3


def test_delay_shifts_and_interpolates_positions() -> None:
    place = np.random.default_rng(1).random((50, 2))
    np.testing.assert_array_equal(geometry.delayed(place, 0.0), place)
    np.testing.assert_array_equal(geometry.delayed(place, 3.0)[3:], place[:-3])
    halves = geometry.delayed(place, 0.5)[1:]
    np.testing.assert_allclose(halves, (place[1:] + place[:-1]) / 2)


def test_hovering_samples_are_thinned() -> None:
    """All of 500 samples in flight count; of 500 hovering ones, a tenth."""
    way = np.concatenate([np.arange(500.0), np.full(500, 499.0)])
    apart = Samples(
        name="x", place=np.stack([way, 0 * way], axis=1), beam=np.ones(1000, int), beams=BEAMS
    ).apart()
    assert apart[:500].all() and apart[500:].sum() == 50
    rest = Samples(name="x", place=np.zeros((300, 2)), beam=np.ones(300, int), beams=BEAMS).apart()
    assert 25 <= rest.sum() <= 35


def test_density_uses_near_samples_else_the_expected_beam() -> None:
    """Where beams 10 and 12 are expected, 10 and 13 are best; for 20 there are no samples."""
    at = geometry.Geometry(
        x=0.0, y=0.0, stretch=0.0, yaw=0.0, middle=0.0, slope=32.0, height=0.0, lag=0.0
    )
    sine = np.repeat([10.0, 12.0, 20.0], 50) / 32
    place = np.stack([np.sqrt(1 - sine**2), sine], axis=1) * np.linspace(1, 50, 150)[:, None]
    beam = np.repeat([10, 13, 25], 50)
    samples = Samples(name="x", place=place, beam=beam, beams=BEAMS)
    likely = predictors.density(samples, np.arange(150) < 100, at, 0.25, 5.0)
    np.testing.assert_allclose(likely.sum(axis=1), 1.0)
    assert likely[[0, 60, 120]].argmax(axis=1).tolist() == [10, 13, 20]
    assert likely[0, 10] > 0.8 and likely[60, 13] > 0.8 and likely[120, 20] < 0.5
    assert likely[120, 21] > likely[120, 23] > likely[120, 0] > 1e-4
    heavy = predictors.density(samples, np.arange(150) < 100, at, 0.25, 500.0)
    assert heavy[60, 12] > 0.05 > likely[60, 12]
    assert heavy[60, 10] > 2 * heavy[60, 14]  # equally far off, and frequent


def test_predictions_are_averaged_over_geometries() -> None:
    place, beam = flown(5, 600)
    samples, learned = Samples(name="x", place=place, beam=beam, beams=BEAMS), np.arange(600) < 500
    at = geometry.fit(place, beam, learned, BEAMS)
    doubted = predictors._leave_one_out(samples, learned, at)
    assert len(set(doubted)) == 4
    each = [predictors.density(samples, learned, one, 0.5, 5.0) for one in doubted]
    mean = predictors.averaged(samples, learned, doubted, 0.5, 5.0)
    np.testing.assert_allclose(mean, sum(each) / 4)


def test_threshold_covers_held_out_blocks() -> None:
    """Held-out values are uniform on 0 to 1: 99.25 % are above 0.0075."""
    count = 20_000
    beam = np.random.default_rng(3).permutation(count) % 2
    chance = np.random.default_rng(4).permutation(count) / count
    likely = np.where(np.arange(2) == beam[:, None], chance[:, None], 1 - chance[:, None])
    samples = Samples(name="x", place=np.zeros((count, 2)), beam=beam, beams=2)
    seen = []

    def fitted(mask: BoolArray) -> FloatArray:
        seen.append(mask)
        return np.where(mask[:, None], 1.0, likely)

    learned = np.arange(count) % 1000 < 800
    assert study._threshold(samples, fitted, learned) == pytest.approx(0.0075, abs=0.0015)
    assert [int(mask.sum()) for mask in seen] == [12_000] * 4
    assert not any((mask & ~learned).any() for mask in seen)


def test_ranks_and_set_sizes_match_hand_computed_values() -> None:
    likely = np.array([[0.1, 0.6, 0.3], [0.2, 0.3, 0.5]])
    assert predictors.rank_of(likely, np.array([2, 2])).tolist() == [1, 0]
    assert predictors.rank_of(np.ones((1, 5)), np.array([2])).tolist() == [4]
    assert study._sizes(likely, 0.3).tolist() == [2, 2]
    assert study._sizes(likely, 0.55).tolist() == [1, 1]  # no set is empty
    assert study._sizes(likely, 0.0).tolist() == [3, 3]


def written(folder: Path, *, files: bool) -> Path:
    """Write a scenario as a single table, or as the published folder with powers."""
    place, beam = flown(4, 400)
    lines = [
        "index,unit1_pwr_60ghz,unit2_loc,unit1_beam" if files else "index,unit2_pos,unit1_beam"
    ]
    for n, (at, best) in enumerate(zip(place.tolist(), beam.tolist(), strict=True)):
        if not files:
            lines.append(f'{n},"[{at[0]}, {at[1]}]",{best}')
            continue
        power = np.exp(-np.abs(np.arange(BEAMS) - best))
        (folder / f"p{n}.txt").write_text("\n".join(map(str, power)))
        (folder / f"l{n}.txt").write_text(f"{at[0]}\n{at[1]}")
        lines.append(f"{n},./p{n}.txt,./l{n}.txt,{best}")
    (folder / "scenario.csv").write_text("\n".join(lines))
    return folder if files else folder / "scenario.csv"


@pytest.mark.full
@pytest.mark.parametrize("files", [True, False])
def test_deepsense_command_writes_json_page_and_figures(files: bool, tmp_path: Path) -> None:
    where, out = written(tmp_path, files=files), tmp_path / "out"
    given = ["study", "deepsense", str(where), "--out", str(out), "--json"]
    done = CliRunner().invoke(main, given, prog_name="companion")
    assert done.exit_code == 0, done.output
    answer = json.loads((out / "deepsense.json").read_text())
    assert json.loads(done.stdout) == answer
    rows = {(row["split"], row["predictor"]): row for row in answer["rows"]}
    assert set(rows) == {(s, p) for s in ("blocks", "shuffled") for p in study.PREDICTORS}
    ours = rows["blocks", "geometry and kernel"]
    assert ours["top_1"] > 50 and ours["top_5"] > 95
    assert (ours["power_lost_db"] is not None) == files
    if files:
        assert 0 <= ours["power_lost_db"] < 3
    page = (out / "deepsense.html").read_text()
    assert "20 contiguous blocks" in page and "seed of the random split 1" in page
    assert (out / "deepsense_tops.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("a,b\n1,2\n", "columns unit2_pos and unit1_beam are missing"),
        ('unit2_pos,unit1_beam\n"[1,2]",x\n', "row 2"),
        ('unit2_pos,unit1_beam\n"[1,2]",3\n', "at least 200 rows"),
        ("unit2_pos,unit1_beam\n" + '"[1,2]",3\n' * 300, "positions do not change"),
        ("unit2_pos,unit1_beam\n" + "gone.txt,3\n" * 300, "cannot read"),
        ("unit2_pos,unit1_beam\n" + '"[1,2]",99999\n' * 300, "beam index out of range"),
    ],
)
def test_invalid_scenario_is_rejected(text: str, why: str, tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=why):
        measured_beams.read(path)
    (tmp_path / "y.csv").touch()
    with pytest.raises(UserError, match="2 CSV files"):
        measured_beams.read(tmp_path)


@pytest.mark.full
def test_drone_scenario_scores_on_contiguous_blocks() -> None:
    """The published baselines as measured before, and our results beside them."""
    samples = measured_beams.read(shared_log("deepsense_scenario23.csv"))
    assert (len(samples.beam), samples.beams) == (11_387, 32)
    assert samples.neighbours_alike() == pytest.approx(0.82, abs=0.005)
    answer = study.study(samples, 1)
    rows = {(row["split"], row["predictor"]): row for row in answer["rows"]}
    near, plain, ours = (rows["blocks", name] for name in study.PREDICTORS)
    assert near["top_1"] == pytest.approx(41.5, abs=0.7)
    assert plain["top_3"] == pytest.approx(78.2, abs=0.7)
    assert ours["top_1"] > 48 and ours["top_3"] > 87 and ours["top_5"] > 95
    assert ours["set_size_mean"] < 8 and ours["set_coverage"] > 0.99
    assert rows["shuffled", "nearest neighbours"]["top_1"] > near["top_1"] + 5  # leakage
