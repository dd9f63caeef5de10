"""Clocks of other nodes: the interval contains the truth for any link and drift."""

from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.pipeline.fleet.neighbours import (
    DELAYS_WINDOW_NS,
    DRIFT_MAX,
    Neighbour,
    NeighbourClock,
    here,
)
from companion.values import RoundTrip, Source

MS = 1_000_000
START_NS = 1_800_000_000_000_000_000


@given(
    offset_ms=st.integers(-5_000_000, 5_000_000),
    drift=st.floats(-0.9 * DRIFT_MAX, 0.9 * DRIFT_MAX),
    ways=st.lists(st.tuples(st.integers(0, 400), st.integers(0, 400)), min_size=1, max_size=30),
    asked_ms=st.integers(-2000, 20_000),
)
@settings(max_examples=examples(200))
def test_neighbour_clock_interval_contains_the_true_offset(
    offset_ms: int, drift: float, ways: list[tuple[int, int]], asked_ms: int
) -> None:
    def remote(t_ns: int) -> int:
        return t_ns - offset_ms * MS + round(drift * (t_ns - START_NS))

    clock = NeighbourClock()
    t_ns = START_NS
    for there_ms, back_ms in ways:
        sent_ns, read_ns = t_ns, t_ns + there_ms * MS
        received_ns = read_ns + back_ms * MS
        assert clock.note_answer(sent_ns, received_ns, remote(read_ns)) is None
        t_ns = received_ns + 500 * MS
    then_ns = t_ns + asked_ms * MS
    ahead = clock.offset(remote(then_ns))
    assert ahead is not None
    assert ahead.low_ns - 2 <= then_ns - remote(then_ns) <= ahead.high_ns + 2
    # No wider than the best round trip plus the drift since.
    best_ns = min(there + back for there, back in ways) * MS
    aged_ns = 2 * DRIFT_MAX * (abs(then_ns - START_NS) + 25_000 * MS)
    assert ahead.width_ns <= best_ns + aged_ns


def test_shared_round_trip_is_not_shortened() -> None:
    clock = NeighbourClock()
    trip = RoundTrip(t_ns=500 * MS, source=Source(1, 1), sent_ns=400 * MS, remote_ns=77)
    assert here(1600 * MS, trip, clock) is None
    # The other clock lags by 1 s; the request took 4 ms, the answer 6 ms.
    clock.note_answer(1000 * MS, 1010 * MS, 4 * MS)
    placed = here(1600 * MS, trip, clock)
    assert placed is not None
    assert placed.sent_ns <= 1400 * MS
    assert placed.t_ns >= 1500 * MS
    assert placed.t_ns - placed.sent_ns <= 100 * MS + 10 * MS + 4 * DRIFT_MAX * 500 * MS
    assert placed.remote_ns == 77
    assert placed.is_shared and not trip.is_shared


def test_round_trips_that_cannot_be_recorded_are_not_used() -> None:
    """Of another time than now, on this node's timeline: long ago, in the future, before 1970."""
    clock, second = NeighbourClock(), 1000 * MS
    clock.note_answer(START_NS, START_NS + MS, 1000 * second)

    def placed(t_ns: int, sent_ns: int, now_ns: int = START_NS) -> RoundTrip | None:
        trip = RoundTrip(t_ns=t_ns, source=Source(1, 1), sent_ns=sent_ns, remote_ns=77)
        return here(now_ns, trip, clock)

    now_ns = 1000 * second
    assert placed(now_ns, now_ns - second) is not None
    for t_ns, sent_ns in (
        (now_ns, now_ns - 700 * second),
        (0, 0),
        (now_ns + 700 * second, now_ns),
        (1 << 62, now_ns),
        (now_ns, 1 << 62),
    ):
        assert placed(t_ns, sent_ns) is None
    assert placed(0, 0, START_NS - now_ns) is not None
    clock = NeighbourClock()
    clock.note_answer(second, second + MS, 1000 * second)
    assert placed(900 * second, 900 * second, second) is None


def test_old_link_delays_expire() -> None:
    """A node that shares no vehicle any more has no delays, however slow its last messages were."""
    node = Neighbour(clock=NeighbourClock())
    node.note_delay(START_NS, 900 * MS)
    node.note_delay(START_NS + DELAYS_WINDOW_NS // 2, 5 * MS)
    assert node.delays_ns(START_NS + DELAYS_WINDOW_NS // 2) == [900 * MS, 5 * MS]
    assert node.delays_ns(START_NS + DELAYS_WINDOW_NS) == [5 * MS]
    assert node.delays_ns(START_NS + 2 * DELAYS_WINDOW_NS) == []
