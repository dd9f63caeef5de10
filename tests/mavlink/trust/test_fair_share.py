"""Fair shares of the time, and limits of senders that take more."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from companion.mavlink.trust.fair_share import (
    LEAST_PER_S,
    LIMITED_NS,
    MOST_PER_S,
    Account,
    FairShares,
    Work,
    fair_share,
)
from companion.values import Source

S = 1_000_000_000
FRAME_S = 1e-4


def account(number: int) -> Account:
    return Account(Source(1, number))


def limited(shares: FairShares, rates: list[float], *, most: float, named: int = 0) -> list[bool]:
    """Limit senders by a second in which each sent so many frames; say which are limited."""
    work = {account(n): Work(rate * FRAME_S, round(rate)) for n, rate in enumerate(rates)}
    names = frozenset(account(n) for n in range(named))
    shares.note(work.values())
    shares.limit(0, work, passed_s=1.0, most_s=most, named=names)
    return [shares.is_limited(account(n)) for n in range(len(rates))]


def used(shares: FairShares, number: int, frames: int, *, since_ns: int = 0) -> int:
    """Return how many of the frames of one second are used."""
    return sum(
        shares.admits(account(number), since_ns + n * S // frames, matters=True)
        for n in range(frames)
    )


@example([10.0, 100.0], 50.0)
@given(st.lists(st.floats(0, 100), min_size=1, max_size=20), st.floats(0, 500))
def test_share_is_the_level_up_to_which_all_fits(wanted: list[float], most: float) -> None:
    level = fair_share(most, wanted)
    if sum(wanted) <= most * (1 - 1e-9):
        assert level == math.inf
    if level < math.inf:
        assert sum(min(one, level) for one in wanted) == pytest.approx(most)


def test_those_who_take_less_than_their_share_keep_all_of_it() -> None:
    """Of 0.5 s the four that take 0.03 s leave 0.38 s to the flood."""
    shares = FairShares()
    assert limited(shares, [300, 9000, 300, 300, 300], most=0.5) == [False, True, *[False] * 3]
    assert used(shares, 1, 9000) <= MOST_PER_S


def test_limit_is_the_share_of_many_but_not_less_than_a_vehicle_needs() -> None:
    for senders, rate, per_s in (
        (2, 9000.0, MOST_PER_S),
        (50, 999.0, 100.0),
        (500, 99.0, LEAST_PER_S),
    ):
        shares = FairShares()
        assert all(limited(shares, [rate] * senders, most=0.5))
        assert used(shares, 7 % senders, 5000) == pytest.approx(per_s, abs=1)


def test_senders_of_few_frames_are_not_limited_whatever_their_share() -> None:
    """There are too many of them: the newest are dropped."""
    shares = FairShares()
    assert not any(limited(shares, [9.0] * 1000, most=0.5))


def test_named_vehicles_keep_more() -> None:
    shares = FairShares()
    assert limited(shares, [150.0, *[1000.0] * 99], most=0.5, named=1) == [False, *[True] * 99]
    assert limited(shares, [900.0, *[1000.0] * 99], most=0.5, named=1)[0]
    assert used(shares, 0, 5000) == pytest.approx(MOST_PER_S, abs=1)


def test_messages_that_do_not_matter_are_not_used() -> None:
    shares = FairShares()
    limited(shares, [9000.0, 10.0], most=0.5)
    assert not shares.admits(account(0), 0, matters=False)
    while shares.admits(account(0), S, matters=True):
        pass
    assert shares.is_used_up(account(0), S)
    assert not shares.is_used_up(account(0), S + S // 100)


@pytest.mark.parametrize(
    ("sends", "free", "is_released"), [(0, 0.1, True), (100, 0.1, True), (2000, 0.1, False)]
)
def test_limit_lasts_until_what_it_drops_would_fit(
    sends: int, free: float, is_released: bool
) -> None:
    """Two thousand frames a second take a fifth of the time."""
    shares = FairShares()
    limited(shares, [9000.0, 10.0], most=0.5)
    for second in range(LIMITED_NS // S):
        assert not shares.release(second * S, free)
        for n in range(sends):
            shares.admits(account(0), second * S + n * S // max(1, sends), matters=False)
    assert shares.release(LIMITED_NS, free) is is_released
    assert shares.is_limited(account(0)) is not is_released
    assert shares.release(2 * LIMITED_NS, free) is not is_released  # it ended, or did before


def test_no_more_is_released_at_once_than_fits() -> None:
    shares = FairShares()
    limited(shares, [1000.0] * 10, most=0.5)
    for second in range(LIMITED_NS // S):
        for number in range(10):
            for _ in range(500):  # a twentieth of the time
                shares.admits(account(number), second * S, matters=False)
    assert shares.release(LIMITED_NS, 0.23)
    assert sum(not shares.is_limited(account(number)) for number in range(10)) == 4
