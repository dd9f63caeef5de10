"""Late frames, reboots, jumps and the wrap: assignment of a stamp to an epoch."""

from itertools import pairwise

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import examples

from companion.mavlink.clock.estimates import Stamp
from companion.mavlink.clock.sender_clock import SenderClock

MS = 1_000_000
S = 1_000_000_000
EPOCH_NS = 1_700_000_000 * S
WRAP_MS = 1 << 32

Seen = list[tuple[int, int]]  # (arrival after the epoch, boot), ms


def observe_all(seen: Seen, clock: SenderClock | None = None) -> list[Stamp | None]:
    clock = clock or SenderClock()
    return [clock.observe(EPOCH_NS + arrival * MS, boot) for arrival, boot in seen]


def reboots(stamps: list[Stamp | None]) -> list[int]:
    return [n for n, stamp in enumerate(stamps) if stamp is not None and stamp.rebooted]


def run(arrival: int, boot: int, count: int, every: int = 200) -> Seen:
    return [(arrival + n * every, boot + n * every) for n in range(count)]


@pytest.mark.parametrize("back_ms", [1_200, 4_800, 9_700])
def test_late_frame_does_not_count_as_reboot(back_ms: int) -> None:
    stamps = observe_all([*run(0, 300_000, 50), (9_810, 309_800 - back_ms), (10_000, 310_000)])
    assert not reboots(stamps)
    late, after = stamps[-2:]
    assert late is not None and after is not None
    assert late.sender_ns == (309_800 - back_ms) * MS
    assert late.latency_s == pytest.approx(back_ms / 1000 + 0.01)
    assert after.latency_s == 0.0


def test_link_lag_of_seconds_does_not_count_as_reboot() -> None:
    """Beside a fast link or alone, after the sender's first seconds."""
    fast, slow = run(0, 300_000, 100), run(4_001, 300_001, 100)
    assert not reboots(observe_all(sorted([*fast, *slow])))
    assert None not in observe_all(sorted([*fast, *slow]))
    assert not reboots(observe_all(fast + run(20_000, 316_000, 40)))


@pytest.mark.parametrize("before_ms", [300_000, WRAP_MS - 60_000])
@pytest.mark.parametrize(
    "step_ms", [-290_000, 20_000, 500_000, WRAP_MS // 2 - 1, WRAP_MS // 2 + 1, 2_300_000_000]
)
def test_no_step_of_the_boot_clock_turns_time_back(before_ms: int, step_ms: int) -> None:
    """By more than half of its period, a step ahead looks like one back: a reboot, at any rate."""
    after_ms = (before_ms + 10_000 + step_ms) % WRAP_MS
    stamps = observe_all([*run(0, before_ms, 50), *run(10_000, after_ms, 50)])
    assert None not in stamps[55:]
    before, placed = stamps[49], [one for one in stamps[50:] if one is not None]
    assert before is not None
    assert all(two.sender_ns > one.sender_ns for one, two in pairwise(placed))
    assert placed[0].rebooted or placed[0].sender_ns > before.sender_ns


@pytest.mark.parametrize("ahead_ms", [1_100, 4_900])
@pytest.mark.parametrize("again_ms", [0, 10, 1_000])
def test_future_stamps_do_not_move_the_clock(ahead_ms: int, again_ms: int) -> None:
    """One forged stamp, two at one time, or one per second: the vehicle's own stamps are
    unaffected."""
    honest = run(0, 300_000, 50)
    times = [10_050] if not again_ms else [10_050 + n * again_ms for n in range(2)]
    forged = [(at, 300_000 + at + ahead_ms) for at in times]
    clock = SenderClock()
    observe_all(honest, clock)
    before = clock.estimate()
    seen = sorted([*run(10_000, 310_000, 50), *forged])
    stamps = dict(zip(seen, observe_all(seen, clock), strict=True))
    assert [stamps[one] for one in forged] == [None] * len(forged)
    assert all(stamp is not None for one, stamp in stamps.items() if one not in forged)
    after = clock.estimate()
    assert before is not None and after is not None
    assert after.offset_ns == pytest.approx(before.offset_ns, abs=2 * MS)


@pytest.mark.parametrize(("ahead_ms", "moves"), [(900, True), (1_100, False), (4_900, False)])
def test_future_stamp_of_another_message_does_not_move_the_clock(
    ahead_ms: int, moves: bool
) -> None:
    """Reports alone can show that all earlier stamps were late."""
    clock = SenderClock()
    observe_all(run(0, 300_000, 50), clock)
    before_ns = clock.node_ns(310_000 * MS)
    clock.add_stamp(EPOCH_NS + 10_050 * MS, 310_050 + ahead_ms)
    assert (clock.node_ns(310_000 * MS) != before_ns) == moves
    (after,) = observe_all([(10_100, 310_100)], clock)
    assert after is not None and (after.latency_s > 0.5) == moves


@pytest.mark.parametrize("delay_ms", [2_000, 4_000])
def test_clock_follows_a_fast_link_while_delayed_frames_arrive(delay_ms: int) -> None:
    """They arrived for 4 s, during which the fast frames had no time and positions were old."""
    late = run(delay_ms, 300_000, 150)
    fast = run(30_050, 330_050, 40)  # while the last of the late ones arrive
    clock, changes = SenderClock(), []
    for arrival, boot in sorted([*late, *fast]):
        clock.observe(EPOCH_NS + arrival * MS, boot)
        if clock.change is not None:
            assert clock.change.was_late
            changes.append((arrival, clock.change.step_s))
    ((at_ms, step_s),) = changes
    assert at_ms <= 30_050 + 600
    assert step_s == pytest.approx(-delay_ms / 1e3, abs=0.2)
    clock.observe(EPOCH_NS + 40_000 * MS, 340_000)
    assert clock.node_ns(340_000 * MS) == pytest.approx(EPOCH_NS + 40_000 * MS, abs=400 * MS)


@pytest.mark.parametrize("every_ms", [500, 1_000, 4_000])
def test_clock_follows_a_faster_link_that_carries_few_of_the_reports(every_ms: int) -> None:
    """It was never followed, and nothing told, where less than a third came over it."""
    clock, slow, began_ms = SenderClock(), run(3_000, 300_000, 500), 20_050
    fast = run(began_ms, 300_000 + began_ms, 80_000 // every_ms, every=every_ms)
    changes = []
    for arrival, boot in sorted([*slow, *fast]):
        clock.observe(EPOCH_NS + arrival * MS, boot)
        if clock.change is not None:
            changes.append((arrival, clock.change.step_s))
    ((at_ms, step_s),) = changes
    assert at_ms == began_ms + 2 * every_ms
    assert step_s == pytest.approx(-3.0, abs=0.1)


def test_clock_follows_a_link_whose_delay_falls() -> None:
    """All frames of half a minute were 3 s late; the clock follows after half a second."""
    late, prompt = run(3_000, 300_000, 150), run(33_000, 333_000, 20)
    stamps = observe_all([*late, *prompt])
    assert [n for n, stamp in enumerate(stamps) if stamp is None] == [150, 151, 152]
    assert not reboots(stamps)
    latencies = [stamp.latency_s for stamp in stamps[153:] if stamp is not None]
    assert max(latencies) < 0.31  # a tenth of the visible latency is assumed as invisible


@pytest.mark.parametrize("boot_ms", [0, 12_000])
@pytest.mark.parametrize("back_ms", [48_000, 260_000])
def test_reboot_is_detected_once_and_starts_a_new_epoch(back_ms: int, boot_ms: int) -> None:
    before = run(0, boot_ms + back_ms - 9_800, 50)
    stamps = observe_all([*before, *run(10_000, boot_ms, 100)])
    assert reboots(stamps) == [53]  # half a second after the first stamp
    assert [n for n, stamp in enumerate(stamps) if stamp is None] == [50, 51, 52]
    for n, stamp in enumerate(stamps[53:], start=3):
        assert stamp is not None
        assert stamp.sender_ns == (boot_ms + n * 200) * MS
        assert stamp.latency_s == 0.0  # the old offset is gone


def delivered(boots: list[int], lates: list[int], begins_ms: int) -> Seen:
    """Return stamps of a boot that began at a time, in order of arrival: no frame overtakes."""
    times, last = list[int](), 0
    for boot, late in zip(boots, lates, strict=True):
        last = max(last + 1, begins_ms + boot + late)
        times.append(last)
    return list(zip(times, boots, strict=True))


@settings(max_examples=examples(100))
@given(
    latency_max_ms=st.integers(300, 3_000),
    every_ms=st.sampled_from([100, 200, 250, 500, 1_000]),
    slow=st.tuples(st.floats(0, 1), st.integers(1, 40)),
    after=st.lists(st.floats(0, 1), min_size=1, max_size=8),
)
@example(1_500, 250, (1.0, 16), [1.0])
@example(1_500, 1_000, (0.9, 1), [1.0])
def test_clock_after_a_reboot_is_in_its_interval_if_frames_are_no_later_than_before(
    latency_max_ms: int, every_ms: int, slow: tuple[float, int], after: list[float]
) -> None:
    """All frames after it may be as slow as the slowest of a few anywhere in the minute before."""
    boots = list(range(300_000, 345_000, every_ms))
    first = round(slow[0] * (len(boots) - 1 - slow[1]))
    is_slow = [first <= n <= first + slow[1] for n in range(len(boots))]
    lates = [latency_max_ms if one else 7 * n % 11 for n, one in enumerate(is_slow)]
    clock = SenderClock()
    observe_all(delivered(boots, lates, -300_000), clock)
    begins_ms, boots = 48_000, list(range(0, 30_000, every_ms))
    lates = [round(latency_max_ms * after[n * len(after) // len(boots)]) for n in range(len(boots))]
    for at, boot in delivered(boots, lates, begins_ms):
        if clock.observe(EPOCH_NS + at * MS, boot) is None:
            continue
        known = clock.estimate()
        assert known is not None
        off_s = (EPOCH_NS + begins_ms * MS - known.offset_ns) * 1e-9
        assert -known.after_s - 2e-3 <= off_s <= known.before_s + 2e-3


def test_frame_of_the_last_boot_that_arrives_later_shows_how_late_frames_may_be() -> None:
    """The frames of the new boot may all be as late, until one is not."""
    clock = SenderClock()
    observe_all(run(0, 300_000, 150), clock)
    observe_all(run(40_000 + 2_000, 0, 10), clock)
    assert observe_all([(44_000, 342_000)], clock) == [None]  # sent 2 s before
    known = clock.estimate()
    assert known is not None
    assert (known.offset_ns - EPOCH_NS) * 1e-9 - known.after_s <= 40.0


@pytest.mark.parametrize("uptime_ms", [4_000, 9_000])
@pytest.mark.parametrize("late_ms", [0, 400])
def test_reboot_shortly_after_boot_is_detected(uptime_ms: int, late_ms: int) -> None:
    """It steps back by no more than a late frame would, and does not catch up."""
    again = [(t + (late_ms if n % 2 else 0), b) for n, (t, b) in enumerate(run(0, 500, 40, 250))]
    seen = run(0, 0, uptime_ms // 100, 100) + [(uptime_ms + 500 + t, b) for t, b in again]
    stamps = observe_all(seen)
    assert len(reboots(stamps)) == 1
    after = stamps[reboots(stamps)[0] :]
    assert reboots(stamps)[0] <= uptime_ms // 100 + 10
    assert all(stamp is not None and stamp.latency_s <= 0.45 for stamp in after)


@pytest.mark.parametrize(("late_ms", "placed"), [(9_900, True), (10_100, False), (60_000, False)])
def test_stamp_more_than_ten_seconds_late_has_no_time(late_ms: int, placed: bool) -> None:
    """A single stamp that lags by more belongs to another clock and has no time."""
    *_, late, after = observe_all(
        [*run(0, 300_000, 100), (19_810, 319_810 - late_ms), (20_000, 320_000)]
    )
    assert (late is not None) is placed
    assert late is None or late.latency_s == pytest.approx(late_ms / 1000)
    assert after is not None and after.latency_s == 0.0


def test_flushed_queue_after_boot_does_not_count_as_reboot() -> None:
    """Late frames in a burst catch up with the current stamps."""
    queued = [(8_000 + n * 10, 3_000 + n * 100) for n in range(45)]
    stamps = observe_all([*run(0, 0, 80, 100), *queued, *run(8_500, 8_500, 20, 100)])
    assert not reboots(stamps)
    assert None not in stamps


def test_stragglers_of_the_previous_boot_have_no_time() -> None:
    """Single or in a burst, up to seconds after the reboot; the new boot continues."""
    again = run(10_000, 1_000, 100)
    late = [(13_105, 108_000), *((14_110 + n, 108_500 + n * 100) for n in range(10))]
    seen = sorted([*run(0, 100_000, 50), *again, *late])
    stamps = observe_all(seen)
    assert len(reboots(stamps)) == 1
    for (arrival, boot), stamp in zip(seen, stamps, strict=True):
        if arrival > 11_000:
            assert (stamp is None) == (boot > 50_000), arrival


def test_jump_after_a_reboot_belongs_to_the_new_boot() -> None:
    """Ahead of every stamp of either boot: accepted after three stamps."""
    seen = [*run(0, 100_000, 50), *run(10_000, 1_000, 20), *run(14_000, 500_000, 20)]
    stamps = observe_all(seen)
    assert len(reboots(stamps)) == 1
    assert [n for n, stamp in enumerate(stamps) if stamp is None] == [50, 51, 52, 70, 71, 72]
    assert all(stamp is not None and stamp.latency_s == 0.0 for stamp in stamps[73:])


def test_stray_stamps_are_ignored() -> None:
    """One message of the sender carries another clock, ahead or behind, repeatedly."""
    steady = run(0, 100_000, 200, 100)
    for boot in (7, 660_000, 4_000_000_000):
        strays = [(150 + n * 1_000, boot) for n in range(18)]
        seen = sorted([*steady, *strays])
        stamps = observe_all(seen)
        assert not reboots(stamps)
        assert [s is None for s in stamps] == [b == boot for _, b in seen]


def test_forward_jump_does_not_count_as_reboot() -> None:
    seen = [*run(0, 100_000, 50), *run(10_000, 110_000 + 560_000, 50)]
    stamps = observe_all(seen)
    assert not reboots(stamps)
    placed = [s for s in stamps[53:] if s is not None]
    assert len(placed) == 47
    assert [s.sender_ns for s in placed] == [boot * MS for _, boot in seen[53:]]
    assert all(s.latency_s == 0.0 for s in placed)


def test_stalled_clock_continues() -> None:
    stamps = observe_all([*run(0, 100_000, 50), *run(70_000, 110_000, 50)])
    assert not reboots(stamps)
    assert None not in stamps
    lags = [s.latency_s for s in stamps[50:] if s is not None]
    assert lags[:10] == pytest.approx([60.0] * 10)
    assert lags[10:] == pytest.approx([0.0] * 40)


def test_wrap_counts_as_neither_reboot_nor_jump() -> None:
    start = WRAP_MS - 5_000
    stamps = observe_all([(n * 100, (start + n * 100) % WRAP_MS) for n in range(200)])
    assert not reboots(stamps)
    times = [s.sender_ns for s in stamps if s is not None]
    assert len(times) == 200
    assert {b - a for a, b in pairwise(times)} == {100 * MS}
    assert all(s is not None and s.latency_s == 0.0 for s in stamps)


def test_link_lag_after_the_wrap_does_not_count_as_reboot() -> None:
    """The stamps equal those shortly after boot, but the boot was 49.7 days ago."""
    fast = [(at, boot % WRAP_MS) for at, boot in run(0, WRAP_MS - 10_000, 75)]
    slow = [(at, boot % WRAP_MS) for at, boot in run(4_001, WRAP_MS - 9_999, 100)]
    stamps = observe_all(sorted([*fast, *slow]))
    assert not reboots(stamps)
    assert None not in stamps


def test_late_frame_from_before_the_wrap_is_placed() -> None:
    stamps = observe_all([(0, WRAP_MS - 1_000), (1_500, 500), (1_600, WRAP_MS - 700), (1_700, 700)])
    assert not reboots(stamps)
    assert [s.latency_s for s in stamps if s] == pytest.approx([0.0, 0.0, 1.3, 0.0])


@pytest.mark.parametrize("uptime_ms", [100_000, 2_000_000_000, 4_000_000_000])
@pytest.mark.parametrize("wrapped", [False, True])
def test_reboot_is_detected_after_any_uptime(uptime_ms: int, wrapped: bool) -> None:
    before = run(0, WRAP_MS - 1_000, 10) if wrapped else []
    before = [(t, b % WRAP_MS) for t, b in before]
    seen = [*before, *run(uptime_ms, uptime_ms - 1_000, 10), *run(uptime_ms + 5_000, 700, 10)]
    stamps = observe_all(seen)
    assert reboots(stamps) == [len(before) + 13]
    assert stamps[-1] is not None and stamps[-1].sender_ns == 2_500 * MS


@settings(max_examples=examples(300))
@given(
    st.lists(
        st.tuples(st.integers(0, 100_000), st.integers(0, WRAP_MS - 1) | st.integers(0, 60_000)),
        min_size=1,
        max_size=60,
    )
)
def test_stamp_times_never_exceed_their_arrival(steps: Seen) -> None:
    """Jumps, reboots, wraps and invalid stamps: never later than the arrival."""
    clock, arrival_ns = SenderClock(), EPOCH_NS
    for gap_ms, boot_ms in steps:
        arrival_ns += gap_ms * MS
        stamp = clock.observe(arrival_ns, boot_ms)
        if stamp is not None:
            assert clock.node_ns(stamp.sender_ns) <= arrival_ns
            assert stamp.latency_s >= 0.0
            assert stamp.sender_ns // MS % WRAP_MS == boot_ms


def shared_at(seen: Seen) -> list[int]:
    """Return the arrivals, in ms, at which two clocks are detected."""
    clock, found = SenderClock(), []
    for arrival, boot in seen:
        clock.observe(EPOCH_NS + arrival * MS, boot)
        if clock.is_shared(EPOCH_NS + arrival * MS):
            found.append(arrival)
    return found


@pytest.mark.parametrize("apart_ms", [-3_600_000, -40_000, 40_000, 3_600_000])
def test_two_concurrent_clocks_are_reported_as_a_shared_id(apart_ms: int) -> None:
    first, second = run(0, 5_000_000, 100), run(10_050, 5_010_000 + apart_ms, 50)
    found = shared_at(sorted([*first, *second]))
    assert 12_500 <= found[0] <= 13_600
    assert found == [t for t, _ in sorted([*first, *second]) if t >= found[0]]


@pytest.mark.parametrize("late_ms", [12_000, 29_000])
def test_late_copies_beside_newer_stamps_are_no_second_vehicle(late_ms: int) -> None:
    """A router that merges two routes: what the fast one loses comes over the slow one."""
    first, lost = run(0, 5_000_000, 150), run(0, 5_000_050, 150)
    late = [(arrival + late_ms, boot) for arrival, boot in lost if arrival + late_ms < 30_000]
    assert shared_at(sorted([*first, *late])) == []
    clock = SenderClock()
    copies = [
        arrival
        for arrival, boot in sorted([*first, *late])
        if clock.observe(EPOCH_NS + arrival * MS, boot) is None
        and clock.has_late_copies(EPOCH_NS + arrival * MS)
    ]
    assert bool(copies) == (late_ms == 12_000)  # they must arrive for three seconds
    assert not copies or late_ms + 3_000 <= copies[0] <= late_ms + 3_500


def test_more_than_two_concurrent_clocks_are_reported_as_a_shared_id() -> None:
    """Each stamp of one began the run of another again, and the first was believed for ever."""
    first = run(0, 5_000_000, 100)
    ahead, behind = run(10_050, 8_610_000, 50), run(10_100, 1_410_000, 50)
    found = shared_at(sorted([*first, *ahead, *behind]))
    assert 12_500 <= found[0] <= 13_600


def test_first_clock_is_trusted_again_after_the_second_falls_silent() -> None:
    first, second = run(0, 5_000_000, 200), run(5_050, 9_000_000, 40)
    found = shared_at(sorted([*first, *second]))
    assert found[-1] == pytest.approx(5_050 + 39 * 200 + 10_000, abs=250)


def test_single_sender_is_never_reported_as_a_shared_id() -> None:
    """Reboots, late frames, another lagging link, a jump, bursts."""
    alone = run(0, 300_000, 100)
    late = [(12_000 + n, 310_000 - 180 * n) for n in range(20)]
    assert not shared_at([*alone, *run(20_000, 1_000, 100)])
    assert not shared_at(sorted([*alone, *late]))
    assert not shared_at(sorted([*alone, *run(4_001, 300_001, 100)]))
    assert not shared_at([*alone, *run(20_000, 900_000, 100)])
    assert not shared_at([(10_000 * (n // 50 + 1), 300_000 + 200 * n) for n in range(300)])
    # Frames of the previous boot that a slow link still delivers beside the fast one.
    again, left = run(10_000, 1_000, 100), run(12_050, 105_000, 30)
    assert not shared_at(sorted([*run(0, 100_000, 50), *again, *left]))
