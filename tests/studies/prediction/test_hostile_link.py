"""The hostile link: each regime behaves as named, and keeps the frame order where stated."""

import numpy as np
import pytest

from companion.studies.prediction.hostile_link import REGIMES, ROUND_NS, arrivals_ns, regimes_at

S = 1_000_000_000
BEGINS_NS = 1_700_000_000 * S
SENT_NS = BEGINS_NS + np.arange(-20 * S, ROUND_NS, S // 20)
NAMES = [regime.name for regime in REGIMES]


def latency_s(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Latencies of the arriving frames, and the regime in which each was sent."""
    came_ns, arrives = arrivals_ns(np.random.default_rng(seed), SENT_NS, BEGINS_NS)
    late_s = (came_ns - SENT_NS)[arrives] * 1e-9
    return late_s, regimes_at(SENT_NS[arrives], BEGINS_NS)


def of(name: str) -> np.ndarray:
    late_s, regime = latency_s()
    return np.asarray(late_s[regime == NAMES.index(name)])


def test_hostile_link_delivers_no_frame_before_its_start() -> None:
    came_ns, arrives = arrivals_ns(np.random.default_rng(1), SENT_NS, BEGINS_NS)
    assert np.array_equal(arrives, SENT_NS >= BEGINS_NS)
    assert came_ns[arrives].min() == BEGINS_NS + 5_000_000


def test_each_regime_has_its_named_latency() -> None:
    first = of("first-fast")
    assert first[0] == pytest.approx(0.005)
    assert first[2:] == pytest.approx(0.3)
    assert of("steady")[20:] == pytest.approx(0.02)  # the earlier queue is empty
    step = of("step")
    assert step[[40, 90, 110, -1]] == pytest.approx([0.02, 0.02, 0.5, 0.5])
    ramp = of("ramp")
    assert ramp.max() == pytest.approx(1.0, abs=1e-3)
    assert ramp[200] == pytest.approx(0.51, abs=0.01)
    assert 0.7 < of("sawtooth").max() < 0.8
    assert of("sawtooth").min() < 0.05
    wandering = of("ar1")
    assert 0.15 < np.median(wandering) < 0.45
    assert wandering.max() - wandering.min() > 0.2
    bursts = of("bursts")
    assert bursts.max() > 1.0
    assert np.median(bursts[bursts < 0.1]) == pytest.approx(0.02)
    changes = of("changes")
    assert np.percentile(changes, 10) < 0.05
    assert np.percentile(changes, 70) > 0.4
    assert 0.7 < of("overtaking").max() < 0.81


def test_burst_frames_arrive_together() -> None:
    came_ns, arrives = arrivals_ns(np.random.default_rng(1), SENT_NS, BEGINS_NS)
    here = arrives & (regimes_at(SENT_NS, BEGINS_NS) == NAMES.index("bursts"))
    at_once = np.unique(came_ns[here], return_counts=True)[1]
    assert at_once.max() > 20


def test_frames_are_reordered_only_in_the_overtaking_regime() -> None:
    came_ns, arrives = arrivals_ns(np.random.default_rng(1), SENT_NS, BEGINS_NS)
    overtakes = regimes_at(SENT_NS, BEGINS_NS) == NAMES.index("overtaking")
    assert (np.diff(came_ns[arrives & ~overtakes]) >= 0).all()
    assert (np.diff(came_ns[overtakes & arrives]) < 0).mean() > 0.2


def test_latency_is_seeded_and_regimes_repeat() -> None:
    assert np.array_equal(latency_s(3)[0], latency_s(3)[0])
    assert not np.array_equal(latency_s(3)[0], latency_s(4)[0])
    again = BEGINS_NS + np.array([0, ROUND_NS - 1, ROUND_NS, 5 * ROUND_NS + 21 * S])
    assert [NAMES[k] for k in regimes_at(again, BEGINS_NS)] == [
        "first-fast", "overtaking", "first-fast", "steady",
    ]  # fmt: skip
