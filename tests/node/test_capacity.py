"""Capacity of a machine, measured with the test's own clock."""

from pathlib import Path

import pytest

from companion.node import capacity
from companion.node.machine import processor_share
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Event, Frame, Rejection, Source, Tick


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use little traffic: more and longer traffic would be equivalent."""
    for name, value in {"FEW": 2, "MORE": 5, "SETTLED_S": 1, "MEASURED_S": 1}.items():
        monkeypatch.setattr(capacity, name, value)


class Slow:
    """A processor that needs a given time for each event of any kind."""

    def __init__(self, each_s: float) -> None:
        self.each_s, self.reads = each_s, 0

    def __call__(self) -> float:
        self.reads += 1
        return self.reads // 2 * self.each_s  # read before and after an event


def test_capacity_follows_from_event_times() -> None:
    """Each report and each update takes a fixed time, for any number of beams."""
    found = capacity.measure(Settings(), Slow(0.0011))
    assert [found.report_s, found.update_s] == pytest.approx([0.0011, 0.0011])
    spare = capacity.SHARE - 10 * 0.0011  # ten updates a second
    assert found.uavs == int(spare / (capacity.RATE_HZ * 0.0011))
    assert capacity.measure(Settings(), Slow(1e-6)).uavs is None


def test_reports_and_updates_are_timed_separately(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pipeline that needs 1 ms for a report and 20 ms for an update."""
    now_s = [0.0]

    class Timed:
        def __init__(self, _: Settings) -> None: ...

        def step(self, event: Event) -> None:
            now_s[0] += 0.02 if isinstance(event, Tick) else 0.001

    monkeypatch.setattr(capacity, "Pipeline", Timed)
    found = capacity.measure(Settings(), lambda: now_s[0])
    assert (found.report_s, found.update_s) == pytest.approx((0.001, 0.02))


def test_capacity_traffic_is_accepted_by_the_pipeline() -> None:
    pipeline = Pipeline(
        Settings().override(center={"source": "47.0,8.0,500.0"}, beams={"targets": "all"})
    )
    refused = []
    sources = {one.source for one in capacity._traffic(3, 10.0) if isinstance(one, Frame)}
    assert sources == {Source(sysid=number, compid=1) for number in (1, 2, 3)}
    for event in capacity._traffic(capacity.MORE, 10.0):
        refused += [x for x in pipeline.step(event) if isinstance(x, Rejection)]
    assert refused == []
    assert pipeline.last_update is not None
    assert len(pipeline.last_update.beams.beams) == capacity.MORE


@pytest.mark.parametrize(
    ("groups", "files", "share"),
    [
        ("0::/\n", {"cpu.max": "50000 100000\n"}, 0.5),
        ("0::/a/b\n", {"a/cpu.max": "20000 100000\n", "a/b/cpu.max": "max 100000\n"}, 0.2),
        ("4:cpu,cpuacct:/x\n1:pids:/\n",
         {"cpu/x/cpu.cfs_quota_us": "75000\n", "cpu/x/cpu.cfs_period_us": "100000\n"}, 0.75),
        ("4:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 1.0),
        ("0::/\n", {"cpu.max": "300000 100000\n"}, 1.0),
        ("0::/gone\n", {}, 1.0),
    ],
)  # fmt: skip
def test_cgroup_cpu_quota_is_read(
    tmp_path: Path, groups: str, files: dict[str, str], share: float
) -> None:
    made = {f"sys/fs/cgroup/{name}": text for name, text in files.items()}
    for name, text in {"proc/self/cgroup": groups, **made}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert processor_share(tmp_path) == share


def test_half_a_processor_has_half_the_capacity() -> None:
    found = capacity.measure(Settings(), Slow(0.0011), processor=0.5)
    spare = 0.5 * capacity.SHARE - 10 * 0.0011
    assert found.uavs == int(spare / (capacity.RATE_HZ * 0.0011))


def test_progress_grows_to_the_end() -> None:
    """With thousands of elements the measurement takes half a minute."""
    done = list[float]()
    capacity.measure(Settings(), done=done.append)
    assert done == sorted(done) and 0.0 <= done[0] < 0.05 and 0.95 < done[-1] <= 1.0
