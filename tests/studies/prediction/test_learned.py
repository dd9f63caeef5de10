"""The LSTM predictor: training, its file, and its accuracy. Needs PyTorch: extra [learned]."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

torch = pytest.importorskip("torch", reason="PyTorch (the extra [learned]) is not installed")

from companion.cli.main import main  # noqa: E402
from companion.studies.prediction import learned, made_up  # noqa: E402
from companion.studies.prediction.baselines import DeadReckoning, ObservedReport, Predictor  # noqa: E402
from companion.studies.prediction.delivery import deliver  # noqa: E402
from companion.studies.prediction.windows import REPORTS  # noqa: E402

S = 1_000_000_000


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network after short training."""
    path = tmp_path_factory.mktemp("learned") / "net.pt"
    held, loss_m = learned.train(seed=1, epochs=8, flights=40)
    assert loss_m < 0.6
    learned.save(held, path)
    return path


def run(*arguments: str | Path) -> Any:
    return CliRunner().invoke(main, ["study", *map(str, arguments)])


def test_training_is_reproducible_from_the_seed() -> None:
    nets = [learned.train(seed, epochs=1, flights=3)[0]["weights"] for seed in (5, 5, 6)]
    assert all(torch.equal(nets[0][key], nets[1][key]) for key in nets[0])
    assert not all(torch.equal(nets[0][key], nets[2][key]) for key in nets[0])
    assert torch.get_num_threads() == 1


def test_examples_are_deviations_from_straight_flight() -> None:
    seen, leads, ways = learned.examples(3, 4, lambda _text: None)
    assert seen.shape[1:] == (REPORTS, 7)
    assert (np.diff(seen[:, :, 0], axis=1) > 0).all()
    assert np.ptp(np.diff(seen[:, :, 0], axis=1)) > 0.1  # irregular
    assert leads.shape == ways.shape[:2]
    near = leads < 0.1
    # After 0.1 s the deviation is the position noise and a little of the velocity noise.
    assert np.std(ways[near]) == pytest.approx(0.1, rel=0.3)


def rms_m(predictor: Predictor, seed: int, lead_s: float) -> float:
    """On a flight outside the training set, over its own link, at irregular times."""
    rng = np.random.default_rng([seed, 99])
    made = made_up.flight(rng, "1:1")
    observed = deliver(made, made_up.link(rng), seed).observed
    squares = []
    for number, each in enumerate(observed):
        predictor.report(each)
        at_ns = each.arrival_ns + round(lead_s * S)
        true, _ = made.truth.at(np.array([at_ns - made_up.DELAY_NS]))
        found = predictor.predict(each.arrival_ns, at_ns)
        assert found is not None
        if number >= REPORTS:
            squares.append(float(np.sum((found.position_ned_m - true) ** 2)))
    return float(np.sqrt(np.nanmean(squares)))


def test_network_beats_straight_line_prediction(trained: Path) -> None:
    make = learned.load(trained)
    ours = np.array([rms_m(make(), seed, 2.0) for seed in range(12)])
    straight = np.array([rms_m(DeadReckoning(), seed, 2.0) for seed in range(12)])
    assert np.sqrt(np.mean(ours**2)) < 0.85 * np.sqrt(np.mean(straight**2))


def observed(made_s: float, position: list[float], velocity: list[float] | None) -> ObservedReport:
    t_ns = round(made_s * S)
    speed = None if velocity is None else np.array(velocity, dtype=float)
    return ObservedReport(
        arrival_ns=t_ns,
        sent_ns=t_ns,
        sender_ns=t_ns,
        position_ned_m=np.array(position, dtype=float),
        velocity_ned_mps=speed,
    )


def test_network_predicts_for_any_report_sequence(trained: Path) -> None:
    """No report, one, one without velocity, reordered ones, a long gap."""
    predictor = learned.load(trained)()
    assert predictor.predict(0, S) is None
    predictor.report(observed(10, [0, 0, -30], None))
    alone = predictor.predict(10 * S, 10 * S)
    assert alone is not None
    assert alone.position_ned_m == pytest.approx([0, 0, -30])
    predictor.report(observed(12, [20, 0, -30], [10, 0, 0]))
    before = predictor.predict(12 * S, 13 * S)
    predictor.report(observed(10, [5, 5, 5], [0, 0, 0]))  # at the same time as another
    after = predictor.predict(12 * S, 13 * S)
    assert before is not None
    assert after is not None
    assert after.position_ned_m == pytest.approx(before.position_ned_m)
    near = predictor.predict(12 * S, 12 * S + 1000)
    assert near is not None
    assert near.position_ned_m == pytest.approx([20, 0, -30], abs=1e-3)
    far = [predictor.predict(12 * S, (12 + s) * S) for s in (5, 100, 195)]
    places = np.array([each.position_ned_m for each in far if each is not None])
    # After the last lead the prediction is straight.
    assert (places[1] - places[0]) / 95 == pytest.approx((places[2] - places[1]) / 95)


def test_train_and_compare_commands_work(cut_log: Path, tmp_path: Path) -> None:
    """Train and compare; the process count does not change the predictions."""
    net = tmp_path / "deep" / "net.pt"
    done = run("train", "--out", net, "--seed", "3", "--epochs", "1", "--flights", "3", "--json")
    assert done.exit_code == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["file"], told["seed"], told["epochs"]) == (str(net), 3, 1)
    asked = ("prediction", cut_log, "--center", "5:1", "--lead", "0.3", "--learned", net, "--json")
    serial = run(*asked, "--jobs", "1", "--out", tmp_path)
    assert serial.exit_code == 0, serial.stderr
    answer = json.loads(serial.stdout)
    assert sum(row["predictor"] == "lstm" for row in answer["rows"]) == 8
    assert f"--learned {net}" in answer["command"]
    assert run(*asked, "--jobs", "2", "--out", tmp_path).stdout == serial.stdout
    assert "<td>lstm</td>" in (tmp_path / "prediction.html").read_text()


@pytest.mark.parametrize("content", [b"", b"not a network", b"PK\x03\x04rubbish"])
def test_invalid_network_file_is_rejected(cut_log: Path, tmp_path: Path, content: bytes) -> None:
    bad = tmp_path / "bad.pt"
    bad.write_bytes(content)
    done = run("prediction", cut_log, "--learned", bad, "--center", "5:1", "--out", tmp_path)
    assert done.exit_code == 1
    (line,) = done.stderr.splitlines()
    assert "not a network of" in line


def test_incompatible_network_is_rejected(tmp_path: Path) -> None:
    weights = learned.network().state_dict()
    few = dict(list(weights.items())[1:])
    for held in ({"format": "another", "weights": weights}, {"format": learned.FORMAT}, [1]):
        torch.save(held, tmp_path / "other.pt")
        with pytest.raises(ValueError, match="not a network of"):
            learned.load(tmp_path / "other.pt")
    torch.save({"format": learned.FORMAT, "weights": few}, tmp_path / "few.pt")
    with pytest.raises(ValueError, match="not a network of"):
        learned.load(tmp_path / "few.pt")
