"""Duplicates: the same report counts once over any links; different reports are kept."""

import tracemalloc

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.trust.dedupe import LINKS_MAX, WINDOW_NS, Dedupe
from companion.values import Frame, Source

EPOCH_NS = 1_700_000_000_000_000_000
S = 1_000_000_000


def sent(
    t_ns: int = EPOCH_NS,
    link: str = "a",
    *,
    boot_ms: int = 1000,
    seq: int = 0,
    source: tuple[int, int] = (1, 1),
    lat: int = 473977419,
    hdg: int = 35_999,
    v1: bool = False,
) -> Frame:
    mav = dialect.MAVLink(None, *source)
    mav.seq = seq
    message = dialect.MAVLink_global_position_int_message(
        boot_ms, lat, 85455938, 488_000, 25_000, -300, 400, -5, hdg
    )
    raw = bytes(message.pack(mav, force_mavlink1=v1))
    return Frame(t_ns=t_ns, link=link, source=Source(*source), msgid=33, raw=raw)


def test_the_same_report_over_two_links_counts_once() -> None:
    """Each link has its own sequence numbers."""
    dedupe = Dedupe()
    answers = []
    for n in range(50):
        t_ns = EPOCH_NS + n * S // 10
        answers.append(dedupe.is_repeat(sent(t_ns, "a", boot_ms=n * 100, seq=n)))
        answers.append(dedupe.is_repeat(sent(t_ns + 1000, "b", boot_ms=n * 100, seq=200 - n)))
    assert answers == [False, True] * 50


def test_reports_of_a_lagging_link_are_duplicates() -> None:
    dedupe = Dedupe()
    reports = [sent(EPOCH_NS + n * S, boot_ms=n * 1000) for n in range(25)]
    assert not any(dedupe.is_repeat(frame) for frame in reports)
    assert all(dedupe.is_repeat(f._replace(t_ns=f.t_ns + 25 * S, link="b")) for f in reports)


def test_report_repeated_on_one_link_counts_once() -> None:
    dedupe = Dedupe()
    assert [dedupe.is_repeat(sent(EPOCH_NS + n, seq=n)) for n in range(3)] == [False, True, True]


@pytest.mark.parametrize(
    "other",
    [
        sent(boot_ms=1001),
        sent(lat=473977420),
        sent(source=(2, 1)),
        sent(source=(1, 2)),
        sent()._replace(msgid=32, raw=sent().raw[:7] + bytes([32]) + sent().raw[8:]),
    ],
    ids=["boot time", "content", "system", "component", "message"],
)
def test_different_reports_are_not_duplicates(other: Frame) -> None:
    dedupe = Dedupe()
    assert not dedupe.is_repeat(sent())
    assert not dedupe.is_repeat(other)
    assert dedupe.is_repeat(sent())
    assert dedupe.is_repeat(other)


@pytest.mark.parametrize("hdg", [35_999, 255, 0])
def test_the_same_report_in_both_versions_counts_once(hdg: int) -> None:
    """MAVLink 2 truncates the trailing zeros that MAVLink 1 sends: the content is equal."""
    dedupe = Dedupe()
    assert not dedupe.is_repeat(sent(link="a", hdg=hdg))
    assert dedupe.is_repeat(sent(link="b", hdg=hdg, v1=True))


def test_duplicate_window_starts_at_the_first_copy() -> None:
    """Counted from the first copy, so that a report repeated forever is accepted again."""
    dedupe = Dedupe()
    assert not dedupe.is_repeat(sent(EPOCH_NS))
    assert dedupe.is_repeat(sent(EPOCH_NS + WINDOW_NS // 2))
    assert dedupe.is_repeat(sent(EPOCH_NS + WINDOW_NS))
    assert not dedupe.is_repeat(sent(EPOCH_NS + WINDOW_NS + 1))
    assert dedupe.is_repeat(sent(EPOCH_NS + WINDOW_NS + 2))
    assert dedupe.is_repeat(sent(EPOCH_NS + 2 * WINDOW_NS + 1))
    assert not dedupe.is_repeat(sent(EPOCH_NS + 2 * WINDOW_NS + 2))


def test_memory_is_bounded_by_the_window() -> None:
    dedupe = Dedupe()
    sizes = []
    per_window = WINDOW_NS * 20 // S
    tracemalloc.start()
    try:
        for n in range(1, 10 * per_window + 1):
            dedupe.is_repeat(sent(EPOCH_NS + n * S // 20, boot_ms=n))
            if n in (2 * per_window, 10 * per_window):
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert sizes[0] > per_window * 30  # the window is remembered
    assert sizes[1] < 1.2 * sizes[0]


def test_number_of_counted_links_is_bounded() -> None:
    dedupe = Dedupe()
    for number in range(LINKS_MAX + 100):
        assert not dedupe.is_repeat(sent(link=f"udp:{number}", boot_ms=number))
        dedupe.set_latency(0.1, 0.1)
    assert len(dedupe.shares) == LINKS_MAX
    assert dedupe.is_repeat(sent(link="udp:0", boot_ms=LINKS_MAX + 50))
    assert dedupe.shares["udp:0"].repeats == 1


def test_first_link_and_link_latencies_are_counted() -> None:
    """Link b delivers everything of a 40 ms later, and every tenth frame that a lost."""
    dedupe = Dedupe()
    for n in range(100):
        t_ns = EPOCH_NS + n * S // 10
        for link, late_ns in (("a", 0), ("b", S // 25)):
            if link == "a" and n % 10 == 0:
                continue
            if not dedupe.is_repeat(sent(t_ns + late_ns, link, boot_ms=n * 100)):
                dedupe.set_latency(0.1 + late_ns / S, 0.2)
    a, b = dedupe.shares["a"], dedupe.shares["b"]
    assert (a.first, a.repeats, b.first, b.repeats) == (90, 0, 10, 90)
    assert list(a.latencies_s) == pytest.approx([0.1] * 90)
    assert list(b.latencies_s) == pytest.approx([0.14] * 100)


def test_messages_over_a_link_that_only_repeats_are_as_late_as_its_repeats() -> None:
    """For as long as it delivers them; while the next one is overdue, they may be later."""
    dedupe = Dedupe()
    for n in range(600):
        t_ns = EPOCH_NS + n * S // 10
        if not dedupe.is_repeat(sent(t_ns, "fast", boot_ms=n * 100)):
            dedupe.set_latency(0.1, 0.3)
        if n > 50:
            assert dedupe.is_repeat(sent(t_ns, "slow", boot_ms=(n - 30) * 100))
            assert dedupe.late_s(sent(t_ns, "slow")) == pytest.approx(3.1 + 0.2)
        assert dedupe.late_s(sent(t_ns, "fast")) == pytest.approx(0.3)
    assert dedupe.late_s(sent(t_ns + 2 * S, "fast")) == pytest.approx(0.3 + 1.9)
    assert dedupe.late_s(sent(t_ns + 31 * S, "fast")) == 0.0


def test_late_copy_beside_a_fast_one_makes_messages_as_late_for_seconds() -> None:
    """Two radios on one link: the copies cannot be told apart."""
    dedupe = Dedupe()
    for n in range(200):
        t_ns = EPOCH_NS + n * S // 10
        if not dedupe.is_repeat(sent(t_ns, boot_ms=n * 100)):
            dedupe.set_latency(0.1, 0.1)
        if n == 100:
            assert dedupe.is_repeat(sent(t_ns, boot_ms=(n - 40) * 100))
        late_s = dedupe.late_s(sent(t_ns))
        assert late_s == pytest.approx(4.1 if 100 <= n < 150 else late_s)
        assert late_s == pytest.approx(0.1) or 100 <= n < 210
    assert dedupe.late_s(sent(EPOCH_NS + 25 * S)) > 5.0, "overdue"


def test_unknown_latency_is_not_recorded() -> None:
    dedupe = Dedupe()
    assert not dedupe.is_repeat(sent(EPOCH_NS))
    assert dedupe.is_repeat(sent(EPOCH_NS + S))
    assert not dedupe.shares["a"].latencies_s
