"""Delays of a stream's messages, single wrong times among them, and clocks that are set."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mavlink.wire.stream_lateness import StreamLateness

S = 1_000_000_000
LATE_MAX_NS = 10 * S


def delays(late: StreamLateness, *messages: tuple[float, float]) -> list[float | None]:
    """Return the delays of messages, given arrivals and stated times in seconds."""
    found = [late.observe_ns(round(t_s * S), round(stated_s * S)) for t_s, stated_s in messages]
    return [None if one is None else one / S for one in found]


def on_time(first_s: float, last_s: float, hz: float = 10.0) -> list[tuple[float, float]]:
    count = round((last_s - first_s) * hz)
    return [(first_s + n / hz, first_s + n / hz) for n in range(count)]


@given(st.lists(st.floats(0, 9.9), min_size=1, max_size=30))
def test_delay_is_that_beyond_the_least_delayed(waits_s: list[float]) -> None:
    late = StreamLateness(LATE_MAX_NS)
    found = delays(late, (1000.0, 1000.0), *[(1000.0 + w, 1000.0) for w in sorted(waits_s)])
    assert found == pytest.approx([0.0, *sorted(waits_s)], abs=0.002)
    assert not late.is_late


@pytest.mark.parametrize("off_s", [-3600, -60, -11, 2, 60, 3600])
def test_single_message_with_another_time_is_off(off_s: float) -> None:
    """Also several, as of another clock, if others are between them."""
    late = StreamLateness(LATE_MAX_NS)
    for t_s in (10.0, 20.0, 30.0):
        good = delays(late, *on_time(t_s, t_s + 5))
        assert good == pytest.approx([0.0] * len(good), abs=0.01)
        assert delays(late, (t_s + 5, t_s + 5 + off_s)) == [None]
    for number in range(100):
        t_s = 40 + 0.1 * number
        assert delays(late, (t_s, t_s), (t_s, t_s + off_s))[1] is None
    assert not late.is_late


@pytest.mark.parametrize("hz", [2.0, 100.0])
def test_clock_that_is_set_forward_is_followed(hz: float) -> None:
    late = StreamLateness(LATE_MAX_NS)
    delays(late, *on_time(0, 10, hz))
    found = delays(late, *[(t_s, t_s + 60) for t_s, _ in on_time(10, 20, hz)])
    first = next(n for n, one in enumerate(found) if one is not None)
    assert first == max(4, hz)
    assert found[first:] == pytest.approx([0.0] * (len(found) - first), abs=0.01)


@pytest.mark.parametrize("hz", [2.0, 100.0])
def test_stream_that_is_too_late_is_told(hz: float) -> None:
    late = StreamLateness(LATE_MAX_NS)
    delays(late, *on_time(0, 10, hz))
    told_s = None
    for t_s, _ in on_time(10, 20, hz):
        assert delays(late, (t_s, t_s - 60)) == [None]
        if late.is_late:
            told_s = t_s
            break
    assert told_s == pytest.approx(10 + max(4 / hz, 1.0), abs=0.02)
