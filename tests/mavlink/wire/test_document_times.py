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


def test_old_documents_have_no_time() -> None:
    """Of a receiver that stopped, one by one or in turn; and of a clock that was set."""
    times = DocumentTimes()
    assert told(times, 0, 100 * S) is None
    assert [told(times, n * S, 100 * S) for n in range(1, 5)] == [None] * 4
    assert told(times, 5 * S, 105 * S) is not None
    assert told(times, 6 * S, 100 * S) is None  # an older one
    assert told(times, 7 * S, 101 * S) is not None
    assert told(times, 8 * S, 202 * S) is None  # the clock was set forward
    assert told(times, 9 * S, 203 * S) is not None


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
