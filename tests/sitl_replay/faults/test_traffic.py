"""Frame streams through all faults: no frame is lost or added except as requested."""

import random
from collections import Counter
from itertools import pairwise, permutations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples, rounds

from sitl_replay.faults.asked import KINDS, Fault
from sitl_replay.faults.content import boot_ms_of, msgid_of, sender_of
from sitl_replay.faults.traffic import HELD_MAX, OVERFLOW, Delivery, Network, Senders
from sitl_replay.flight import scenario
from sitl_replay.flight.vehicles import schedule

STREAM = [(sent.t_s, sent.raw) for sent in schedule(scenario.paper(), duration_s=20.0)]


def parsed(*texts: str) -> list[Fault]:
    return [Fault.parse(text) for text in texts]


def through(
    faults: list[Fault], links: int = 1, seed: int = 0, stream: list[tuple[float, bytes]] = STREAM
) -> tuple[list[Delivery], Counter[str]]:
    """The arriving frames, as the player takes them, and the count of affected frames."""
    touched: Counter[str] = Counter()
    senders, network = (
        Senders(faults, seed, touched),
        Network(faults=faults, links=links, seed=seed, touched=touched),
    )
    out = []
    for t_s, raw in stream:
        out += network.due(t_s)
        network.take(t_s, senders.altered(t_s, raw))
        out += network.due(t_s)
    return [*out, *network.due()], touched


def frames(deliveries: list[Delivery], link: int = 0) -> list[bytes]:
    return [one.raw for one in deliveries if one.link == link]


RAWS = [raw for _, raw in STREAM]


def test_without_faults_all_frames_pass_undelayed_on_every_link() -> None:
    out, touched = through([], links=3)
    assert [(one.t_s, one.link, one.raw) for one in out] == [
        (t_s, link, raw) for t_s, raw in STREAM for link in range(3)
    ]
    assert not touched


@pytest.mark.parametrize("text", [kind.example for kind in KINDS.values()])
def test_faults_are_determined_by_the_seed(text: str) -> None:
    faults = parsed(text)
    assert through(faults, 2, seed=4) == through(faults, 2, seed=4)
    if faults[0].name in {"drift", "reboot", "frozen", "spoof", "compass", "delay"}:
        assert through(faults, seed=5) == through(faults, seed=4)
    elif faults[0].name not in {"glitch", "bit-errors"}:  # 30 s in; too few
        assert through(faults, seed=5)[0] != through(faults, seed=4)[0]


TIMING = ["delay=0.3", "jitter=0.4", "burst=0.3:1", "reordering=0.3", "jitter@1=0.2", "delay@2=1"]


@given(st.sets(st.sampled_from(TIMING)), st.integers(0, 3))
@settings(max_examples=examples(25), deadline=None)
def test_delay_faults_lose_and_add_no_frames(texts: set[str], seed: int) -> None:
    out, touched = through(parsed(*texts), seed=seed)
    assert Counter(frames(out)) == Counter(RAWS)
    assert all(a.t_s <= b.t_s for a, b in pairwise(out))
    sent = dict(zip(RAWS, (t_s for t_s, _ in STREAM), strict=True))
    assert all(one.t_s >= sent[one.raw] for one in out)
    assert set(touched) == {text.partition("=")[0] for text in texts}


@pytest.mark.parametrize("text", ["delay=0.3", "jitter=0.4", "burst=0.3:1", "delay@2=1"])
def test_only_the_reordering_fault_reorders_a_sender(text: str) -> None:
    def by_sender(raws: list[bytes]) -> dict[tuple[int, int], list[bytes]]:
        found: dict[tuple[int, int], list[bytes]] = {}
        for raw in raws:
            found.setdefault(sender_of(raw), []).append(raw)
        return found

    assert by_sender(frames(through(parsed(text))[0])) == by_sender(RAWS)
    assert by_sender(frames(through(parsed(text, "reordering=0.3"))[0])) != by_sender(RAWS)


def test_delay_is_exact() -> None:
    out, touched = through(parsed("delay=0.75"))
    assert [(one.t_s, one.raw) for one in out] == [(t_s + 0.75, raw) for t_s, raw in STREAM]
    assert touched == {"delay": len(STREAM)}


def test_loss_and_duplication_counts_are_exact() -> None:
    out, touched = through(parsed("loss=0.2", "duplication=0.3"))
    counts = Counter(frames(out))
    assert set(counts) <= set(RAWS)
    assert touched["loss"] == len(RAWS) - len(counts) > 0.15 * len(RAWS)
    assert touched["duplication"] == sum(n == 2 for n in counts.values()) > 0.2 * len(counts)
    assert max(counts.values()) == 2
    seen: dict[bytes, list[float]] = {}
    for one in out:
        seen.setdefault(one.raw, []).append(one.t_s)
    assert all(0.0 <= times_s[-1] - times_s[0] <= 0.2 for times_s in seen.values())


def test_lost_frames_are_independent_of_other_faults() -> None:
    alone = Counter(frames(through(parsed("loss=0.2"))[0]))
    others = ("jitter=0.3", "burst=0.1:1", "reordering=0.5", "drift=0")
    assert Counter(frames(through(parsed("loss=0.2", *others))[0])) == alone
    doubled = through(parsed("loss=0.2", "duplication=0.5"))[0]
    assert set(frames(doubled)) == set(alone)


def test_faults_select_frames_independently() -> None:
    out, _ = through(parsed("duplication=0.3", "reordering=0.3"))
    times_s: dict[bytes, list[float]] = {}
    for one in out:
        times_s.setdefault(one.raw, []).append(one.t_s)
    held = {raw for t_s, raw in STREAM if times_s[raw][0] > t_s}
    doubled = {raw for raw, found in times_s.items() if len(found) == 2}
    assert len(held & doubled) / len(doubled) == pytest.approx(0.3, abs=0.08)


def test_due_frames_are_released_once() -> None:
    network = Network(faults=parsed("delay=0.5"), links=1, seed=0, touched=Counter())
    network.take(1.0, RAWS[0])
    assert list(network.due(1.4999)) == []
    assert [one.raw for one in network.due(1.5)] == [RAWS[0]]
    assert list(network.due()) == []


def test_losses_are_per_link_and_sender_faults_are_shared() -> None:
    faults = parsed("loss=0.3", "frozen@2=5:5", "drift=1000")
    out, touched = through(faults, links=2)
    first, second = set(frames(out, 0)), set(frames(out, 1))
    senders = Senders(faults, 0, Counter())
    sent = {senders.altered(t_s, raw) for t_s, raw in STREAM}
    assert first | second < sent
    assert first - second and second - first
    assert touched["loss"] == 2 * len(sent) - len(first) - len(second)
    assert touched["frozen@2"] > 10


def test_damage_faults_are_counted() -> None:
    faults = parsed("bit-errors=0.0005", "truncation=0.1", "garbage=0.05")
    out, touched = through(faults)
    got = frames(out)
    assert len(got) == len(RAWS) + touched["garbage"]
    whole = Counter(got) & Counter(RAWS)
    untouched = len(RAWS) - whole.total()
    hit = touched["bit-errors"] + touched["truncation"]
    assert 0.8 * hit < untouched <= hit  # some frames are hit by both
    assert all(count > 0 for count in touched.values())


def test_bit_errors_keep_frame_sizes_and_times() -> None:
    out, touched = through(parsed("bit-errors=0.001"))
    assert [(one.t_s, len(one.raw)) for one in out] == [(t_s, len(raw)) for t_s, raw in STREAM]
    assert touched["bit-errors"] == sum(a.raw != b for a, b in zip(out, RAWS, strict=True)) > 100


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: str(kind.name))
def test_fault_for_one_system_leaves_the_others_unchanged(kind: object) -> None:
    events = {"reboot": "5", "frozen": "5:5", "glitch": "5:100:3", "spoof": "5:2", "compass": "8"}
    chances = {"drift": "9000", "delay": "1", "jitter": "1", "burst": "0.5:1", "bit-errors": "0.1"}
    name = kind.name  # type: ignore[attr-defined]
    value = (events | chances).get(name, "0.5")
    out, touched = through(parsed(f"{name}@2:1={value}"))
    assert touched.keys() == {f"{name}@2:1"}
    assert touched.total() > 0
    others = [(t_s, raw) for t_s, raw in STREAM if sender_of(raw) != (2, 1)]
    strict = [(o.t_s, o.raw) for o in out if len(o.raw) > 9 and sender_of(o.raw) != (2, 1)]
    assert set(others) <= set(strict)
    assert through(parsed(f"{name}@77={value}"))[0] == through([])[0]


def test_faults_are_applied_in_a_fixed_order() -> None:
    """Order: sender faults, loss and duplication, delay, damage; independent of the option
    order."""
    texts = ["truncation=0.2", "delay=0.5", "duplication=0.4", "loss=0.3", "reboot=5", "drift=9000"]
    results = [through(parsed(*order)) for order in list(permutations(texts))[:: rounds(149, 37)]]
    assert all(one == results[0] for one in results)
    out, touched = results[0]
    # The result equals the stages applied one after the other.
    senders = Senders(parsed("drift=9000"), 0, Counter())
    sent = [(t_s, senders.altered(t_s, raw)) for t_s, raw in STREAM]
    senders = Senders(parsed("reboot=5"), 0, Counter())
    sent = [(t_s, senders.altered(t_s, raw)) for t_s, raw in sent]
    lost, _ = through(parsed("loss=0.3"), stream=sent)
    twice, _ = through(parsed("duplication=0.4"), stream=[(o.t_s, o.raw) for o in lost])
    assert touched["loss"] == len(sent) - len(lost)
    assert touched["duplication"] == len(twice) - len(lost)
    assert [o.t_s for o in out] == pytest.approx([o.t_s + 0.5 for o in twice])
    cut = [(o.raw, t.raw) for o, t in zip(out, twice, strict=True) if o.raw != t.raw]
    assert len(cut) == touched["truncation"]
    assert all(t.startswith(o) for o, t in cut)


def test_jitter_does_not_split_bursts() -> None:
    out, touched = through(parsed("burst=0.5:2", "jitter=0.3"))
    openings = Counter(one.t_s for one in out)
    assert max(openings.values()) > 40
    assert touched["burst"] > 0.3 * len(RAWS)


def test_held_frames_are_bounded_and_overflow_is_counted() -> None:
    touched: Counter[str] = Counter()
    network = Network(faults=parsed("delay=10"), links=1, seed=0, touched=touched)
    for number in range(HELD_MAX + 7):
        network.take(number * 1e-6, RAWS[0])
    assert touched[OVERFLOW] == 7
    assert sum(1 for _ in network.due()) == HELD_MAX
    network.take(11.0, RAWS[0])  # there is room again
    assert len(list(network.due())) == 1
    assert OVERFLOW not in through(parsed("delay=0.01"))[1]


def test_ineffective_faults_are_counted_as_zero() -> None:
    _, touched = through(parsed("loss=0", "reboot=1000", "burst=0:1"))
    assert dict(touched) == {"loss": 0, "reboot": 0, "burst": 0}


def test_sender_faults_count_the_changed_frames() -> None:
    stamped = sum(boot_ms_of(raw) is not None for raw in RAWS)
    assert through(parsed("drift=24000"))[1] == {"drift": stamped}
    since = sum(t_s >= 5.0 for t_s, _ in STREAM)
    assert 0.99 * since < through(parsed("reboot=5"))[1]["reboot"] <= since  # but equal numbers
    assert through(parsed("glitch=5:30:4"))[1] == {"glitch": 4 * 5}
    _, touched = through(parsed("frozen@2:1=5:2"))
    reports = [t for t, r in STREAM if sender_of(r) == (2, 1) and msgid_of(r) == 33 and 5 <= t < 7]
    assert touched == {"frozen@2:1": len(reports)}


@given(st.lists(st.sampled_from([k.example for k in KINDS.values()]), unique=True), st.integers())
@settings(max_examples=examples(20), deadline=None)
def test_any_fault_combination_yields_frames_in_time_order(texts: list[str], seed: int) -> None:
    stream = random.Random(seed).choices(STREAM, k=300)
    stream.sort()
    out, _ = through(parsed(*texts), links=2, seed=seed, stream=stream)
    assert all(a.t_s <= b.t_s for a, b in pairwise(out))
    assert {one.link for one in out} == {0, 1}
    assert all(one.raw for one in out)
