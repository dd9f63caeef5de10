"""Admission of new senders: bounded in number, and the oldest are served first."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mavlink.trust import newcomers
from companion.mavlink.trust.fair_share import LEAST_PER_S, LIMITED_NS, MOST_PER_S, Account
from companion.mavlink.trust.known_peers import PeerRank
from companion.mavlink.trust.newcomers import (
    NEW_PER_S,
    NEW_SAVED,
    STRANGERS_WAIT_NS,
    WINDOW_NS,
    Admission,
    Newcomers,
)
from companion.values import Source

S = 1_000_000_000
LATE_WINDOWS = newcomers.LATE_FOR_NS // WINDOW_NS


def source(number: int) -> Source:
    return Source(1 + number // 250, 1 + number % 250)


def admits(
    senders: Newcomers,
    source: Source,
    now_ns: int,
    rank: PeerRank = PeerRank.FIRST,
    matters: bool = True,
) -> bool:
    return senders.admits(source, now_ns, rank, matters=matters) is not Admission.DROPPED


def served(senders: Newcomers, most: int, now_ns: int) -> list[int]:
    return [number for number in range(most) if admits(senders, source(number), now_ns)]


def end_window(senders: Newcomers, number: int, *, used: float = 1.0, busy: float = 1.0) -> None:
    """End a window: the thread used a share of the time, and the whole process another."""
    passed_s = number * WINDOW_NS * 1e-9
    senders.adapt(number * WINDOW_NS, used * passed_s, busy * passed_s)


def window(
    senders: Newcomers,
    number: int,
    share: float,
    *,
    is_late: bool = False,
    used: float = 1.0,
    busy: float = 1.0,
) -> None:
    """Note a window of time of which frames took a share; the thread and the process used shares.

    All senders that are served took the same time.
    """
    now = served(senders, 100, (number - 1) * WINDOW_NS)
    spent_s = share * WINDOW_NS * 1e-9
    senders.worked_s += spent_s
    for one in now:
        senders.worked(Account(source(one)), spent_s / len(now))
    if is_late:
        senders.late()
    end_window(senders, number, used=used, busy=busy)


def test_process_that_was_stopped_drops_no_sender() -> None:
    """Frames took nearly all of the time by the clock, but little of the processor."""
    for used, all_served in ((0.3, True), (1.0, False)):
        senders = Newcomers()
        served(senders, 20, 0)
        for number in range(1, LATE_WINDOWS):
            window(senders, number, 0.9, is_late=True, used=used)
        assert (len(served(senders, 20, 9 * WINDOW_NS)) == 20) is all_served


def late_windows(senders: Newcomers, first: int, share: float, age_ns: int | None) -> None:
    """Note windows in each of which some frames are late, and at the end of that age, or lost."""
    for number in range(first, first + LATE_WINDOWS):
        senders.late(newcomers.LATE_NS + 1)
        if number == first + LATE_WINDOWS - 1:
            senders.late(age_ns)
        window(senders, number, share)


@pytest.mark.parametrize("age_ns", [None, newcomers.USELESS_NS + 1])
def test_newest_senders_are_dropped_where_other_work_makes_frames_useless(
    age_ns: int | None,
) -> None:
    """Requests and receivers took the time: all frames became 2 s late, the carrier's as well."""
    senders = Newcomers()
    assert len(served(senders, 100, 0)) == 100
    late_windows(senders, 1, 0.4, age_ns)
    now_ns = 5 * WINDOW_NS
    left = served(senders, 100, now_ns)
    assert left == list(range(len(left))) and len(left) in (49, 50)
    assert senders.is_dropped(source(50), now_ns) and not senders.is_dropped(source(48), now_ns)
    # They are not served again at once, which would repeat it.
    end = 4 + newcomers.HELD_NS[0] // WINDOW_NS
    for number in range(5, end):
        window(senders, number, 0.1)
        assert served(senders, 100, now_ns) == left
    window(senders, end, 0.1)
    assert len(served(senders, 100, now_ns)) > len(left)


def test_senders_that_were_there_in_calm_times_are_not_dropped_for_other_work() -> None:
    """Twenty vehicles were halved again and again, and kept out after the load had ended."""
    senders, calm = Newcomers(), 2 * newcomers.CALM_NS // WINDOW_NS
    for number in range(1, calm + 2):
        assert len(served(senders, 20, number * WINDOW_NS)) == 20
        end_window(senders, number)
    end = 2 * calm + 2
    for number in range(calm + 2, end):
        senders.late()
        window(senders, number, 0.4)  # of a hundred senders
    assert served(senders, 100, end * WINDOW_NS)[:20] == list(range(20))
    assert len(served(senders, 100, end * WINDOW_NS)) < 50


def test_first_senders_are_not_dropped_for_other_work() -> None:
    """An honest UAV that came 4 s before a flood and its requests had no beams for 12 s."""
    senders, end = Newcomers(), 200
    for number in range(1, end):
        senders.late()
        window(senders, number, 0.4)
    assert served(senders, 100, end * WINDOW_NS) == list(range(newcomers.FIRST))


def test_frames_that_waited_cost_no_more_senders_their_place() -> None:
    """What waits in the socket is two seconds old, for a cause that is gone."""
    senders = Newcomers()
    late_windows(senders, 1, 0.4, None)
    left = len(served(senders, 100, 5 * WINDOW_NS))
    for number in range(5, 4 + newcomers.BACKLOG_NS // WINDOW_NS):
        senders.late()
        window(senders, number, 0.4)
        assert len(served(senders, 100, number * WINDOW_NS)) == left
    senders.late()
    window(senders, 4 + newcomers.BACKLOG_NS // WINDOW_NS, 0.4)
    assert len(served(senders, 100, 20 * WINDOW_NS)) < left


def test_senders_are_served_again_at_once_when_the_process_is_free() -> None:
    """A burst that ended kept vehicles that joined later out for a minute."""
    senders = Newcomers()
    late_windows(senders, 1, 0.4, None)
    assert len(served(senders, 100, 5 * WINDOW_NS)) < 100
    for number in range(5, 11):
        # Until the fourth window the process used all of the time, and 0.3 of it since.
        window(senders, number, 0.02, busy=(4 + 0.3 * (number - 4)) / number)
    served(senders, 120, 11 * WINDOW_NS)
    assert len(served(senders, 120, 12 * WINDOW_NS)) == 120


def spent(senders: Newcomers, account: Account, seconds: float, frames: int) -> None:
    for _ in range(frames):
        senders.worked(account, seconds / frames)


def flooded_window(
    senders: Newcomers, number: int, floods: list[Account], others: list[int]
) -> list[Account]:
    """Note a late window of which floods took a share, if they are not limited.

    Return the floods of which all frames were used. All other senders are always served.
    """
    began_ns, window_s = (number - 1) * WINDOW_NS, WINDOW_NS * 1e-9
    whole, share, frames = list[Account](), 0.9, 1000
    for flood in floods:
        rank = PeerRank.LATER if flood.is_later else PeerRank.FIRST
        said = [senders.admits(flood.source, began_ns, rank) for _ in range(frames)]
        used = len(said) - said.count(Admission.DROPPED)
        spent(senders, flood, share / len(floods) * window_s * used / frames, used)
        if Admission.ALL in said:
            whole.append(flood)
    senders.worked_s += share * window_s  # the bytes of a dropped flood take it too
    for one in others:
        assert admits(senders, source(one), began_ns, matters=False)
        spent(senders, Account(source(one)), 0.008 * window_s, 5)
    senders.late()
    end_window(senders, number)
    return whole


@pytest.mark.parametrize("floods", [[7], [1], [0], [0, 1, 2], [*range(30)]], ids=len)
def test_floods_cost_no_other_sender_its_place(floods: list[int]) -> None:
    """Whenever they came. One that was there before six vehicles cost these their place."""
    most = max(8, len(floods) + 6)
    senders, others = Newcomers(), sorted({*range(most)} - {*floods})
    assert len(served(senders, most, 0)) == most
    for number in range(1, 5):
        whole = flooded_window(senders, number, [Account(source(one)) for one in floods], others)
    assert not whole
    for one in others:
        assert admits(senders, source(one), WINDOW_NS * 5, matters=False)


def test_flood_in_the_name_of_a_vehicle_costs_its_first_peer_nothing() -> None:
    senders, flood = Newcomers(), Account(source(0), is_later=True)
    assert len(served(senders, 4, 0)) == 4
    for number in range(1, 9):
        whole = flooded_window(senders, number, [flood], [0, 1, 2, 3])
    assert not whole


def test_no_more_senders_are_limited_than_take_what_is_too_much() -> None:
    senders = Newcomers()
    assert len(served(senders, 4, 0)) == 4
    shares = [0.12, 0.11, 0.01, 0.6]
    for one, share in enumerate(shares):
        spent(senders, Account(source(one)), share * WINDOW_NS * 1e-9, 300)
        senders.worked_s += share * WINDOW_NS * 1e-9
    senders.late()
    end_window(senders, 1)
    now = [admits(senders, source(one), 3 * WINDOW_NS, matters=False) for one in range(4)]
    assert now == [True, True, True, False]


@pytest.mark.parametrize("is_new", [True, False])
def test_ids_that_flood_in_turn_gain_nothing(is_new: bool) -> None:
    """Each floods for less than a window, before it could be limited; then the next one does."""
    senders, turns = Newcomers(), 20
    assert len(served(senders, 4 if is_new else 4 + turns, 0)) >= 4
    used = 0
    for number in range(1, turns):
        began_ns, flood = (number - 1) * WINDOW_NS, Account(source(4 + number))
        said = [admits(senders, flood.source, began_ns + n * S // 20_000) for n in range(3000)]
        spent(senders, flood, sum(said) * 2e-4, sum(said))
        senders.worked_s += sum(said) * 2e-4
        used += sum(said) if number > 1 else 0
        for one in range(4):
            assert admits(senders, source(one), began_ns + WINDOW_NS // 2, matters=False)
        senders.late()
        end_window(senders, number)
    assert used <= turns * (5 if is_new else 150)


def test_invented_ids_take_bounded_memory_while_floods_are_watched() -> None:
    senders = Newcomers()
    assert len(served(senders, 4, 0)) == 4
    for number in range(1, 300):  # a minute and more, in all of which there is too little time
        flooded_window(senders, number, [Account(source(4))], [0])
        for one in range(200):
            admits(senders, source(10 + 200 * number + one), number * WINDOW_NS)
    assert len(senders._shares) <= NEW_SAVED + NEW_PER_S * 75 + 10
    for one in range(2 * newcomers.SENDERS_MAX):
        senders._number(Account(source(one), is_later=True))
    assert not len(senders._shares)  # of senders that are remembered no more


def test_limited_sender_keeps_some_of_the_frames_that_matter() -> None:
    """It may be a vehicle whose log is downloaded: its positions are still used."""
    senders = Newcomers()
    assert len(served(senders, 4, 0)) == 4
    flooded_window(senders, 1, [Account(source(0))], [1, 2, 3])
    frames = [
        (matters, admits(senders, source(0), WINDOW_NS + number * S // 5000, matters=matters))
        for number in range(5000)
        for matters in (False, True)
    ]
    assert not any(used for matters, used in frames if not matters)
    assert LEAST_PER_S < sum(used for _, used in frames) <= MOST_PER_S
    while admits(senders, source(0), WINDOW_NS + S):
        pass
    assert senders.is_dropped(source(0), WINDOW_NS + S)
    assert not senders.is_dropped(source(0), WINDOW_NS + S + S // 10)


def test_sender_is_limited_until_its_flood_ends() -> None:
    """Each time that it was served in full again, frames of all others were lost."""
    senders, flood, others = Newcomers(), source(1), [0, 2, 3]
    assert len(served(senders, 4, 0)) == 4
    assert flooded_window(senders, 1, [Account(flood)], others)
    ends = 3 * LIMITED_NS // WINDOW_NS
    said = []
    for number in range(2, 2 * ends):
        for _ in range(500 if number < ends else 2):  # 2000 frames/s, which would take half
            said.append((number, senders.admits(flood, number * WINDOW_NS)))
        spent(senders, Account(source(0)), 0.02 * WINDOW_NS * 1e-9, 10)
        senders.worked_s += 0.02 * WINDOW_NS * 1e-9
        end_window(senders, number)
    whole = [number for number, one in said if one is Admission.ALL]
    assert ends <= whole[0] <= ends + 2 * LIMITED_NS // WINDOW_NS


def test_senders_that_are_dropped_again_wait_longer() -> None:
    senders, first, waits_ns = Newcomers(), 1, []
    for _ in range(6):
        late_windows(senders, first, 0.4, None)
        end = first + LATE_WINDOWS - 1
        waits_ns.append(senders._held_until_ns - end * WINDOW_NS)
        first = senders._held_until_ns // WINDOW_NS + 1
    least_ns, most_ns = newcomers.HELD_NS
    assert waits_ns == [min(least_ns << number, most_ns) for number in range(6)]


@pytest.mark.parametrize(("share", "age_ns"), [(0.19, None), (0.4, newcomers.USELESS_NS)])
def test_late_frames_that_are_few_or_of_use_cost_nobody_a_place(
    share: float, age_ns: int | None
) -> None:
    senders = Newcomers()
    late_windows(senders, 1, share, age_ns)
    assert len(served(senders, 100, 5 * WINDOW_NS)) == 100


def test_named_vehicles_are_not_reported_as_dropped() -> None:
    senders, now_ns = Newcomers(lambda uav: uav == str(source(98))), 5 * WINDOW_NS
    late_windows(senders, 1, 0.4, None)
    assert not senders.is_dropped(source(98), now_ns) and senders.is_dropped(source(97), now_ns)
    assert not senders.is_dropped(Source(250, 1), now_ns)


def test_new_senders_are_limited_and_known_ones_are_not() -> None:
    senders = Newcomers()
    assert served(senders, 2000, 0) == list(range(int(NEW_SAVED)))
    assert senders.refused == 1500
    later = served(senders, 2000, S)
    assert later == list(range(int(NEW_SAVED + NEW_PER_S)))


def test_new_vehicle_is_admitted_during_a_flood_of_invented_ids() -> None:
    senders = Newcomers()
    vehicle, number = Source(255, 255), 0
    for tick in range(100):  # 3000 invented ids and ten frames of the vehicle a second
        for _ in range(300):
            admits(senders, source(number % 60_000), tick * S // 10)
            number += 1
        if tick >= 20 and admits(senders, vehicle, tick * S // 10):
            break
    assert tick < 100
    assert admits(senders, vehicle, 100 * S)


def test_named_vehicles_are_admitted_during_a_flood() -> None:
    """Also if the service starts under attack, and while the newest senders are dropped."""
    senders = Newcomers(lambda uav: uav == "255:255")
    served(senders, 2000, 0)
    window(senders, 1, 0.9, is_late=True)
    assert admits(senders, Source(255, 255), 0)
    assert not admits(senders, Source(255, 254), 0)
    assert not admits(senders, Source(255, 255), WINDOW_NS, PeerRank.STRANGER)


def test_active_senders_are_not_evicted_by_invented_ones() -> None:
    senders = Newcomers()
    for tick in range(2000):
        assert admits(senders, Source(255, 255), tick * S // 10)
        for number in range(10):
            admits(senders, source(tick * 10 + number), tick * S // 10)
    assert len(senders._numbers) <= newcomers.SENDERS_MAX


def test_newest_senders_are_dropped_while_frames_are_late() -> None:
    """And are served again afterwards."""
    senders = Newcomers()
    window(senders, 1, 0.0)
    assert len(served(senders, 100, 0)) == 100
    window(senders, 2, 0.9)  # busy, but in time
    assert len(served(senders, 100, 0)) == 100
    window(senders, 3, 0.9, is_late=True)
    assert served(senders, 100, 0) == list(range(55))
    window(senders, 4, 0.9, is_late=True)
    assert served(senders, 100, 0) == list(range(30))
    window(senders, 5, 0.4)
    assert served(senders, 100, 0) == list(range(30))
    for number in range(6, 20):
        window(senders, number, 0.1)
    assert len(served(senders, 100, 0)) == 100


@pytest.mark.parametrize("receiver", sorted(newcomers.RECEIVERS))
def test_receiver_ranks_behind_vehicles_but_not_behind_a_flood(receiver: Source) -> None:
    for vehicles, receiver_stays in ((20, False), (newcomers.RECEIVERS_AFTER + 100, True)):
        senders = Newcomers()
        assert admits(senders, receiver, 0)
        now = served(senders, vehicles, 0)
        spent_s = 0.55 * WINDOW_NS * 1e-9
        senders.worked_s += spent_s
        for one in (*map(source, now), receiver):
            senders.worked(Account(one), spent_s / (1 + len(now)))
        senders.late()
        end_window(senders, 1)
        assert admits(senders, receiver, WINDOW_NS) is receiver_stays


def test_strangers_are_dropped_before_any_sender_while_frames_are_late() -> None:
    senders, now_ns = Newcomers(), 2 * WINDOW_NS
    assert admits(senders, source(0), 0, PeerRank.STRANGER)
    assert len(served(senders, 100, 0)) == 100
    window(senders, 1, 0.0)
    window(senders, 2, 0.9, is_late=True)
    assert not admits(senders, source(0), now_ns, PeerRank.STRANGER)
    assert len(served(senders, 100, now_ns)) == 100
    window(senders, 3, 0.9, is_late=True)  # the rest is too much too
    assert served(senders, 100, now_ns) == list(range(55))
    assert not admits(senders, source(0), now_ns + STRANGERS_WAIT_NS, PeerRank.STRANGER)
    assert admits(senders, source(0), now_ns + STRANGERS_WAIT_NS + WINDOW_NS, PeerRank.STRANGER)


def test_dropped_senders_are_served_again_while_others_take_much_of_the_time() -> None:
    """Honest vehicles took 0.4 of the time: whoever was dropped once was never served again."""
    senders = Newcomers()
    assert len(served(senders, 100, 0)) == 100
    for number in (1, 2):
        window(senders, number, 0.9, is_late=True)
    assert len(served(senders, 100, WINDOW_NS)) < 100
    least = newcomers.CALM_NS // WINDOW_NS
    for number in range(3, 12 * least):
        window(senders, number, 0.4)
    assert len(served(senders, 100, number * WINDOW_NS)) == 100


@given(st.lists(st.tuples(st.floats(0, 5), st.booleans()), max_size=60))
def test_oldest_sender_is_always_served(loads: list[tuple[float, bool]]) -> None:
    """Whatever the load: those served are the oldest ones."""
    senders = Newcomers()
    served(senders, 50, 0)
    for number, (share, late) in enumerate(loads, 1):
        window(senders, number, share, is_late=late)
        now = served(senders, 50, 0)
        assert now == list(range(len(now)))
        assert now


def test_lost_frames_are_answered_before_the_window_ends() -> None:
    """A socket is full after a tenth of a second of a flood."""
    senders = Newcomers()
    window(senders, 1, 0.1)
    assert senders.adapts_ns == 2 * WINDOW_NS
    senders.late(newcomers.LATE_NS + 1)
    assert senders.adapts_ns == 2 * WINDOW_NS
    senders.late()
    assert senders.adapts_ns == WINDOW_NS + newcomers.LOSSY_WINDOW_NS


def test_one_late_window_costs_nobody_a_place() -> None:
    """A long update makes frames late once; a flood, or frames that are lost, do not stop."""
    senders = Newcomers()
    window(senders, 0, 0.9)
    assert all(admits(senders, source(number), 0) for number in range(100))
    for number in range(1, 9):
        if number % 2:
            senders.late(newcomers.LATE_NS + 1)
        window(senders, number, 0.9)
        assert all(admits(senders, source(one), number * WINDOW_NS) for one in range(100))
    for number in (9, 10):
        senders.late(newcomers.LATE_NS + 1)
        window(senders, number, 0.9)
    assert not admits(senders, source(99), 10 * WINDOW_NS)
