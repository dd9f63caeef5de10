"""When polled documents were written: always within the stated limits, and those narrow."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mavlink.wire.document_times import SPAN_MAX_NS, DocumentTimes, Written

S = 1_000_000_000
MS = 1_000_000


class Server:
    """Server of a document that is rewritten every ``period_ns``, with a clock of its own."""

    def __init__(self, *, period_ns: int, phase_ns: int, offset_ns: int, drift: float) -> None:
        self.period_ns = period_ns
        self.phase_ns = phase_ns
        self.offset_ns = offset_ns
        self.drift = drift

    def written_ns(self, at_ns: int) -> int:
        """When the document that is served at a time was written."""
        return (at_ns - self.phase_ns) // self.period_ns * self.period_ns + self.phase_ns

    def stated_ns(self, written_ns: int) -> int:
        """By its own clock, in tenths of seconds."""
        own_ns = self.offset_ns + written_ns + self.drift * written_ns
        return round(own_ns / (100 * MS)) * 100 * MS


@given(
    period=st.integers(100, 3000),
    phase=st.integers(0, 3000),
    offset=st.integers(-(10**9), 10**9),
    drift=st.floats(-4e-4, 4e-4),
    polls=st.lists(
        st.tuples(st.integers(1, 4000), st.integers(0, 2000), st.integers(0, 2000)),
        min_size=2,
        max_size=40,
    ),
)
def test_document_was_written_within_the_limits(
    period: int, phase: int, offset: int, drift: float, polls: list[tuple[int, int, int]]
) -> None:
    """Whatever the delays of requests and answers are."""
    server = Server(period_ns=period * MS, phase_ns=phase * MS, offset_ns=offset * MS, drift=drift)
    times, now_ns, is_first = DocumentTimes(), 10**18, True
    for pause, there, back in polls:
        now_ns += pause * MS
        times.requested(now_ns)
        now_ns += there * MS
        written_ns = server.written_ns(now_ns)
        now_ns += back * MS
        stated_ns = server.stated_ns(written_ns)
        is_new = times.is_new(stated_ns)
        found = times.arrived(now_ns, stated_ns)
        assert (found is not None) == (is_new and not is_first)
        is_first = False
        if found is not None:
            assert found.earliest_ns <= written_ns <= found.latest_ns <= now_ns


def test_limits_become_narrow() -> None:
    """A server that answers at once, polled each 1.02 s; alone, each document has 1.2 s."""
    server, times = Server(period_ns=S, phase_ns=0, offset_ns=0, drift=0.0), DocumentTimes()
    found: Written | None = None
    for number in range(100):
        now_ns = 10**18 + number * 1_020 * MS
        times.requested(now_ns)
        found = times.arrived(now_ns, server.stated_ns(server.written_ns(now_ns)))
    assert found is not None and found.latest_ns - found.earliest_ns < 400 * MS


@pytest.mark.parametrize("drift", [-4e-4, 4e-4])
def test_clock_that_is_slewed_is_followed(drift: float) -> None:
    server, times = Server(period_ns=S, phase_ns=0, offset_ns=0, drift=drift), DocumentTimes()
    for number in range(3000):
        now_ns = number * 1_020 * MS
        times.requested(now_ns)
        written_ns = server.written_ns(now_ns)
        found = times.arrived(now_ns, server.stated_ns(written_ns))
        if number:
            assert found is not None and found.earliest_ns <= written_ns <= found.latest_ns


def told(times: DocumentTimes, t_ns: int, stated_ns: int) -> Written | None:
    times.requested(t_ns)
    return times.arrived(t_ns, stated_ns)


def test_document_of_a_receiver_that_stopped_has_no_time() -> None:
    times = DocumentTimes()
    assert [told(times, n * S, 100 * S) for n in range(5)] == [None] * 5
    assert told(times, 5 * S, 105 * S) is not None


def test_clock_that_is_set_forward_is_followed() -> None:
    times = DocumentTimes()
    for n in range(5):
        told(times, n * S, (100 + n) * S)
    found = [told(times, n * S, (200 + n) * S) for n in range(5, 10)]
    assert found[:3] == [None] * 3  # one document may be wrong
    for n, one in enumerate(found[3:], 8):
        assert one is not None and n * S - one.earliest_ns < 2 * S
    assert not times.is_late


@pytest.mark.parametrize("late_s", [2, 8])
def test_late_document_may_also_be_of_a_clock_that_was_set_back(late_s: int) -> None:
    times = DocumentTimes()
    for n in range(10):
        told(times, n * S, n * S)
    for n in range(10, 200):
        found = told(times, n * S, (n - late_s) * S)
        assert found is not None
        assert found.earliest_ns <= (n - late_s) * S and found.latest_ns == n * S
    assert not times.is_late


def test_documents_that_are_too_late_are_not_used() -> None:
    """Of a proxy that becomes later and later, by 0.4 s each second."""
    times, used = DocumentTimes(), list[float]()
    for n in range(10):
        told(times, n * S, n * S)
    for n in range(60):
        late_s = 0.4 * n
        found = told(times, (10 + n) * S, round((10 + n - late_s) * S))
        if found is not None:
            used.append(late_s)
            assert found.earliest_ns <= round((10 + n - late_s) * S) <= found.latest_ns
    assert 8.0 < max(used) < 10.0
    assert times.is_late


@pytest.mark.parametrize("ages_s", [(60, 120), (120, 60), (0, 30), (30, 0)])
def test_servers_of_different_age_behind_one_address_are_late(ages_s: tuple[int, int]) -> None:
    times = DocumentTimes()
    found = [told(times, n * S, (1000 + n - ages_s[n % 2]) * S) for n in range(8)]
    assert times.is_late
    newest = 0 if ages_s[0] < ages_s[1] else 1
    assert all(one is None for one in found[1 - newest :: 2])


@pytest.mark.parametrize("pause_ns", [SPAN_MAX_NS // 2, 2 * SPAN_MAX_NS])
def test_document_after_a_pause(pause_ns: int) -> None:
    """The offset is known from before; without it the limits may be too wide."""
    for known in (False, True):
        times = DocumentTimes()
        told(times, 0, 0)
        if known:
            assert told(times, S, S) is not None
        found = told(times, S + pause_ns, S + pause_ns)
        assert (found is not None) == (known or pause_ns < SPAN_MAX_NS)
