"""What a machine carries, by a clock that is the test's own."""

import pytest

from companion.node import capacity
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Rejection


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small sky: what is flown longer, by more, is nothing else."""
    for name, value in {"FEW": 2, "MORE": 5, "SETTLED_S": 1, "MEASURED_S": 1}.items():
        monkeypatch.setattr(capacity, name, value)


class Slow:
    """A processor that needs a given time for each event, whatever it is."""

    def __init__(self, each_s: float) -> None:
        self.each_s, self.reads = each_s, 0

    def __call__(self) -> float:
        self.reads += 1
        return self.reads // 2 * self.each_s  # read before an event and after it


def test_what_is_carried_follows_from_what_events_take() -> None:
    """Each report takes so long, and each update too, however many beams it has."""
    found = capacity.measure(Settings(), Slow(0.0011))
    assert [found.report_s, found.update_s] == pytest.approx([0.0011, 0.0011])
    spare = capacity.SHARE - 10 * 0.0011  # ten updates a second
    assert found.uavs == int(spare / (capacity.RATE_HZ * 0.0011))
    assert capacity.measure(Settings(), Slow(1e-6)).uavs is None


def test_the_sky_is_one_that_the_pipeline_believes() -> None:
    pipeline = Pipeline(
        Settings().override(center={"source": "47.0,8.0,500.0"}, beams={"targets": "all"})
    )
    refused = []
    for event in capacity._sky(capacity.MORE, 10.0):
        refused += [x for x in pipeline.step(event) if isinstance(x, Rejection)]
    assert refused == []
    assert pipeline.last_update is not None
    assert len(pipeline.last_update.beams.beams) == capacity.MORE
