"""Verdicts in the API."""

from companion.mavlink.links.lag import LagSeen
from companion.values import Blame, Cause, Level, UtcNs, Verdict
from companion.views import health
from companion.views.as_json import Json, as_json

WEAK = Verdict(
    uav="1:1",
    level=Level.WEAK,
    blame=Blame(Cause.RATE, "reports 1.1 s apart", "ask for 10 Hz"),
    since_ns=0,
    needed_gain_db=2.0,
    guaranteed_gain_db=None,
    likely_gain_db=4.5,
)


def shown(found: Verdict | None, machine: Blame | None = None) -> Json | None:
    level, why = health.verdict(found, machine)
    return None if why is None else {"verdict": level} | as_json(why, UtcNs)


def test_verdict_is_shown_with_reason_and_gains() -> None:
    assert shown(WEAK) == {
        "verdict": "weak",
        "cause": "rate",
        "reason": "reports 1.1 s apart",
        "remedy": "ask for 10 Hz",
        "since": "1970-01-01T00:00:00.000Z",
        "needed_gain_db": 2.0,
        "guaranteed_gain_db": None,
        "likely_gain_db": 4.5,
    }
    assert health.verdict(None, None) == (None, None)


def seen(*, behind: bool) -> LagSeen:
    return LagSeen(newest_s=0.1, p95_s=7.0, max_s=9.0, behind=behind, longest_s=7.04)


def test_no_link_is_good_while_the_machine_is_overloaded() -> None:
    """Links that are worse keep their own cause: the machine may not be it."""
    machine = health.behind(seen(behind=True), 0.1, 10.0)
    assert machine is not None
    assert machine.reason == "this machine is overloaded: frames wait up to 7.0 s"
    weak = shown(WEAK, machine)
    assert weak is not None and weak["reason"] == "reports 1.1 s apart"
    good = Verdict(
        uav="1:1",
        level=Level.GOOD,
        blame=None,
        since_ns=0,
        needed_gain_db=2.0,
        guaranteed_gain_db=3.0,
        likely_gain_db=4.5,
    )
    held = shown(good, machine)
    assert held is not None and (held["verdict"], held["cause"]) == ("weak", "machine")
    fine = shown(good)
    assert fine is not None and (fine["verdict"], fine["reason"]) == ("good", None)
    assert health.shown(good, machine).level is Level.WEAK
    assert health.shown(WEAK, machine) is WEAK
    assert health.shown(good, None) is good


def test_old_beams_are_the_machine_fault() -> None:
    quiet = seen(behind=False)
    assert health.behind(quiet, 0.6, 10.0) is None
    assert health.behind(quiet, None, 10.0) is None  # no beams yet
    assert health.behind(quiet, 4.9, 1.0) is None  # five periods
    old = health.behind(quiet, 0.7, 10.0)
    assert old is not None
    assert old.reason == "this machine is overloaded: the newest beams are 0.7 s old"


def test_headline_counts_good_links() -> None:
    good = Verdict(uav="2:1", level=Level.GOOD, blame=None, since_ns=0)
    found = health.summary([WEAK, good, good], None)
    assert (found.good, found.weak, found.none) == (2, 1, 0)
    assert (found.headline, found.behind) == ("2 of 3 links good", None)
    assert health.summary([], None).headline == "no UAV to aim at"


def test_headline_counts_unserved_uavs_and_lists_other_nodes() -> None:
    good = Verdict(uav="2:1", level=Level.GOOD, blame=None, since_ns=0)
    found = health.summary([good], None, unserved=2, elsewhere=3)
    assert (found.none, found.headline) == (2, "1 of 3 links good, 3 with other nodes")
    assert health.summary([], None, elsewhere=3).headline == "3 with other nodes"
