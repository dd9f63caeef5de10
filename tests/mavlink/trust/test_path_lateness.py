"""Lateness of a path: the largest of the last seconds, and unknown after a silence."""

from companion.mavlink.trust.path_lateness import (
    KEPT_NS,
    ROUTE_SENDERS,
    SLOT_NS,
    PathLateness,
    RouteLateness,
)

S = 1_000_000_000


def test_lateness_is_the_largest_of_the_newest_one_or_two_slots() -> None:
    paths = PathLateness()
    assert paths.largest_s("a", 0) is None
    for n in range(40):  # twice a second: late from 5 to 8 s
        paths.note("a", n * S // 2, 2.0 if 10 <= n < 16 else 0.1, 0.2)
        if n == 9:
            assert paths.largest_s("a", n * S // 2) == 0.1 + 0.2
        elif 10 <= n < 26:
            assert paths.largest_s("a", n * S // 2) == 2.0 + 0.2
    assert paths.largest_s("a", 20 * S) == 0.1 + 0.2
    assert paths.largest_s("b", 20 * S) is None
    assert paths.largest_s("a", 19 * S + S // 2 + KEPT_NS + 1) is None


def test_report_is_overdue_after_the_least_interval_of_the_slots() -> None:
    paths = PathLateness()
    for n in range(4):
        paths.note("a", n * S, 0.0, 0.0)
    assert paths.overdue_s("a", 4 * S) == 0.0
    assert paths.overdue_s("a", 6 * S) == 2.0
    assert paths.overdue_s("a", 3 * S + 4 * SLOT_NS) == 10.0


def note(route: RouteLateness, sender: str, t_s: float, late_s: float) -> None:
    route.note("r", sender, round(t_s * S), latency_s=late_s, doubt_s=0.0)


def test_one_late_sender_does_not_make_a_route_late() -> None:
    route = RouteLateness()
    assert route.largest_s("r", 0) is None
    for n in range(20):
        note(route, "late", n / 2, 4.5)
        note(route, "in time", n / 2, 0.1)
    assert route.largest_s("r", 10 * S) == 0.1
    assert route.largest_s("other", 10 * S) is None
    for n in range(20, 32):  # the other one has left
        note(route, "late", n / 2, 4.5)
    assert route.largest_s("r", 16 * S) == 4.5


def test_silent_senders_tell_until_they_are_forgotten() -> None:
    route = RouteLateness()
    note(route, "a", 0.0, 2.0)
    assert route.largest_s("r", 20 * S) == 2.0
    assert route.largest_s("r", KEPT_NS + 1) is None


def test_ever_new_senders_take_bounded_memory() -> None:
    route = RouteLateness()
    for n in range(10_000):
        note(route, str(n), n / 100, 1.0)
    assert len(route._senders["r"]) == len(route._lateness._paths) == ROUTE_SENDERS
    assert route.largest_s("r", 100 * S) == 1.0
