"""Link faults, each against its documented distribution."""

import math
import random
import statistics
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from sitl_replay.faults.link import (
    BitErrors,
    Burst,
    Delay,
    Duplication,
    Garbage,
    Jitter,
    Loss,
    Reordering,
    Truncation,
)

MANY = 20_000
SENDER = (1, 1)


def rng(seed: int = 1) -> random.Random:
    return random.Random(seed)


def within(count: int, share: float, of: int = MANY) -> bool:
    """Whether a count is within 4.5 standard deviations of a binomial distribution."""
    return abs(count - share * of) <= 4.5 * math.sqrt(of * share * (1.0 - share))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.44, 1.0])
def test_link_faults_affect_the_given_share_of_frames(share: float) -> None:
    loss, doubling = Loss(rng(1), share), Duplication(rng(2), share)
    holding, cutting = Reordering(rng(3), share), Truncation(rng(4), share)
    littering = Garbage(rng(5), share)
    frame = bytes(range(30))
    assert within(sum(loss.loses() for _ in range(MANY)), share)
    lags_s = [lag for _ in range(MANY) if (lag := doubling.lag_s()) is not None]
    assert within(len(lags_s), share)
    held_s = [h for _ in range(MANY) if (h := holding.release_s(5.0, 5.0, SENDER) - 5.0) > 0.0]
    assert within(len(held_s), share)
    cut = [c for _ in range(MANY) if (c := cutting.damaged(frame)) != frame]
    assert within(len(cut), share)
    assert all(c == frame[: len(c)] for c in cut)
    noises = [n for _ in range(MANY) if (n := littering.noise())]
    assert within(len(noises), share)
    if share == 1.0:
        for seconds in (lags_s, held_s):
            assert 0.0 <= min(seconds) < 0.001
            assert 0.199 < max(seconds) <= 0.2 + 1e-9
            assert statistics.fmean(seconds) == pytest.approx(0.1, abs=0.002)
        assert {len(c) for c in cut} == set(range(1, 30))
        assert {len(n) for n in noises} == set(range(1, 65))


@given(low=st.floats(0.0, 1.0), high=st.floats(0.0, 1.0))
@settings(max_examples=examples(30))
def test_larger_share_includes_the_frames_of_a_smaller_one(low: float, high: float) -> None:
    low, high = sorted((low, high))
    for make in (Loss, Duplication, Reordering, Truncation, Garbage):

        def taken(share: float, make: type = make) -> list[bool]:
            fault = make(rng(), share)
            match fault:
                case Loss():
                    return [fault.loses() for _ in range(200)]
                case Duplication():
                    return [fault.lag_s() is not None for _ in range(200)]
                case Reordering():
                    return [fault.release_s(0.0, 0.0, SENDER) > 0.0 for _ in range(200)]
                case Truncation():
                    return [fault.damaged(b"12345") != b"12345" for _ in range(200)]
            return [fault.noise() != b"" for _ in range(200)]

        assert all(more or not less for less, more in zip(taken(low), taken(high), strict=True))


def test_delay_adds_a_constant_time() -> None:
    assert Delay(0.25).release_s(1.0, 2.0, SENDER) == 2.25


def test_jitter_of_isolated_frames_is_exponential() -> None:
    jitter = Jitter(rng(), 0.5)
    late_s = sorted(jitter.release_s(t, t, SENDER) - t for t in range(0, 100 * MANY, 100))
    assert statistics.fmean(late_s) == pytest.approx(0.5, rel=0.03)
    for share in (0.1, 0.5, 0.9, 0.99):
        assert late_s[int(share * MANY)] == pytest.approx(-0.5 * math.log(1.0 - share), rel=0.06)
    assert late_s[-1] <= 5.0


def test_jitter_keeps_the_frame_order_only_per_sender() -> None:
    jitter = Jitter(rng(), 0.5)
    released: dict[tuple[int, int], list[float]] = {(1, 1): [], (2, 1): []}
    for number in range(4000):
        for sender, times_s in released.items():
            times_s.append(jitter.release_s(number / 20, number / 20, sender))
    for times_s in released.values():
        assert times_s == sorted(times_s)
        late_s = [t_s - n / 20 for n, t_s in enumerate(times_s)]
        assert min(late_s) >= 0.0
        # The distribution stated in the docstring.
        assert statistics.median(late_s) == pytest.approx(
            0.5 * math.log(20 * 0.5 / math.log(2)), rel=0.1
        )
    assert any(a > b for a, b in zip(released[1, 1], released[2, 1][1:], strict=False))


@pytest.mark.parametrize(("share", "shut_s"), [(0.3, 2.0), (0.05, 0.5), (0.9, 1.0)])
def test_burst_closes_the_link_for_the_given_share_of_time(share: float, shut_s: float) -> None:
    burst = Burst(rng(), share, shut_s)
    step_s = shut_s / 20
    times_s = [step_s * number for number in range(120_000)]
    released_s = [burst.release_s(t_s, t_s, SENDER) for t_s in times_s]
    held = [(t, r) for t, r in zip(times_s, released_s, strict=True) if r > t]
    assert len(held) / len(times_s) == pytest.approx(share, rel=0.08)
    assert all(a <= b for a, b in pairwise(released_s))
    assert max(r - t for t, r in held) <= shut_s + 1e-9
    openings_s = sorted({r for _, r in held})
    assert all(b - a >= shut_s for a, b in pairwise(openings_s))
    # Frames that arrive while the link is closed are released together.
    assert max(sum(r == opening for _, r in held) for opening in openings_s[:20]) >= 20
    assert len(burst._block_starts_s) <= 2


def test_burst_release_times_are_independent_of_query_order() -> None:
    forth, back = Burst(rng(), 0.5, 0.3), Burst(rng(), 0.5, 0.3)
    times_s = [number / 50 for number in range(1000)]
    once = {t_s: forth.release_s(t_s, t_s, SENDER) for t_s in times_s}
    shuffled = list(times_s)
    rng(3).shuffle(shuffled)
    assert {t_s: back.release_s(0.0, t_s, SENDER) for t_s in shuffled} == once


def test_zero_burst_share_delays_nothing() -> None:
    burst = Burst(rng(), 0.0, 1.0)
    assert [burst.release_s(t, t, SENDER) for t in (0.0, 5.0, 1e9)] == [0.0, 5.0, 1e9]


@pytest.mark.parametrize("rate", [1e-4, 0.01, 0.5])
def test_bit_errors_are_independent_per_bit(rate: float) -> None:
    errors = BitErrors(rng(), rate)
    counts = [0] * 80
    frame = bytes(10)
    for _ in range(MANY):
        value = int.from_bytes(errors.damaged(frame), "little")
        while value:
            low = value & -value
            counts[low.bit_length() - 1] += 1
            value ^= low
    assert within(sum(counts), rate, MANY * 80)
    assert all(within(count, rate, MANY) for count in counts)


def test_bit_errors_are_independent_of_frame_boundaries() -> None:
    whole, pieces = BitErrors(rng(), 0.02), BitErrors(rng(), 0.02)
    stream = rng(5).randbytes(3000)
    sizes, at, parts = rng(6), 0, []
    while at < len(stream):
        size = sizes.randint(1, 40)
        parts.append(pieces.damaged(stream[at : at + size]))
        at += size
    assert b"".join(parts) == whole.damaged(stream) != stream


def test_zero_bit_error_rate_changes_nothing() -> None:
    errors = BitErrors(rng(), 0.0)
    frame = bytes(100)
    assert all(errors.damaged(frame) is frame for _ in range(1000))


def test_one_byte_frame_is_not_truncated() -> None:
    assert Truncation(rng(), 1.0).damaged(b"a") == b"a"
