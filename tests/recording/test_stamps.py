"""Bad timestamps of every kind become a monotonic timeline that can be played."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from companion.recording.stamps import LARGEST_LEAP_NS, RepairedStamps

S = 1_000_000_000
HOUR = 3600 * S


def place_all(stamps: list[int]) -> tuple[list[int], list[bool]]:
    timeline = RepairedStamps(stamps[:3])
    times, bad = [], []
    for stamp in stamps:
        bad.append(timeline.place(stamp) is not None)
        times.append(timeline.t_ns)
    return times, bad


def test_valid_timestamps_are_kept() -> None:
    stamps = [1_700_000_000 * S + i * S for i in range(10)]
    assert place_all(stamps) == (stamps, [False] * 10)


def test_single_time_jump_is_one_bad_timestamp() -> None:
    times, bad = place_all([5 * S, 6 * S, 10**21, 7 * S, 8 * S])
    assert times == [5 * S, 6 * S, 6 * S, 7 * S, 8 * S]
    assert bad == [False, False, True, False, False]


def test_forward_clock_step_is_removed_from_later_times() -> None:
    ahead = 67 * 24 * HOUR
    times, bad = place_all([0, S, 2 * S + ahead, 3 * S + ahead, 5 * S + ahead])
    assert times == [0, S, S, 2 * S, 4 * S]
    assert bad == [False, False, True, False, False]


def test_steps_over_an_hour_are_jumps_not_gaps() -> None:
    assert place_all([0, LARGEST_LEAP_NS])[0] == [0, LARGEST_LEAP_NS]
    assert place_all([0, LARGEST_LEAP_NS + 1])[0] == [0, 0]


def test_interleaved_link_timestamps_are_made_monotonic() -> None:
    times, bad = place_all([100 * S, 99 * S + 1, 101 * S, 100 * S + 1, 102 * S])
    assert times == [100 * S, 100 * S, 101 * S, 101 * S, 102 * S]
    assert bad == [False, True, False, True, False]


def test_backward_clock_step_does_not_freeze_time() -> None:
    stamps = [100 * S + i * S // 10 for i in range(10)]
    stamps += [50 * S + i * S // 10 for i in range(100)]
    times, bad = place_all(stamps)
    assert times[-1] == times[9] + stamps[-1] - stamps[10]
    assert sum(bad) == 10  # a second of 0.1 s steps before the new time is accepted


def test_bad_first_timestamp_does_not_shift_the_others() -> None:
    times, bad = place_all([10**21, 5 * S, 6 * S, 7 * S])
    assert times == [5 * S, 5 * S, 6 * S, 7 * S]
    assert bad == [True, False, False, False]


def test_log_with_invalid_start_time_starts_at_the_epoch() -> None:
    far = 2**64 * 1000
    times, bad = place_all([far, far + S, far + 2 * S])
    assert times == [0, S, 2 * S]
    assert bad == [True, False, False]


@given(st.lists(st.integers(0, 2**64 - 1).map(lambda us: us * 1000) | st.integers(0, 10**13)))
def test_arbitrary_timestamps_give_a_monotonic_timeline(stamps: list[int]) -> None:
    times, _ = place_all(stamps)
    steps = [later - earlier for earlier, later in pairwise(times)]
    assert all(0 <= step <= LARGEST_LEAP_NS for step in steps)
    assert all(0 <= t_ns < 2**63 for t_ns in times)
