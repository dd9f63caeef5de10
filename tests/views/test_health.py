"""Verdicts as the API shows them."""

from companion.mavlink.links.lag import LagSeen
from companion.values import Blame, Cause, Level, UtcNs, Verdict
from companion.views import health

WEAK = Verdict(
    uav="1:1",
    level=Level.WEAK,
    blame=Blame(Cause.RATE, "reports 1.1 s apart", "ask for 10 Hz"),
    since_ns=0,
    needed_db=2.0,
    guaranteed_db=None,
    likely_db=4.5,
)


def test_a_verdict_is_shown_with_its_reason_and_the_gains() -> None:
    assert health.verdict(WEAK, None, UtcNs) == {
        "verdict": "weak",
        "health": {
            "cause": "rate",
            "reason": "reports 1.1 s apart",
            "remedy": "ask for 10 Hz",
            "since": "1970-01-01T00:00:00.000Z",
            "needed_gain_db": 2.0,
            "guaranteed_gain_db": None,
            "likely_gain_db": 4.5,
        },
    }
    assert health.verdict(None, None, UtcNs) == {"verdict": None, "health": None}


def test_a_machine_that_is_behind_is_to_blame_for_what_is_not_good() -> None:
    machine = health.behind(LagSeen(newest_s=7.0, p95_s=7.0, max_s=7.04, behind=True))
    assert machine is not None
    assert machine.reason == "this machine is behind: frames wait 7.0 s for it"
    assert health.verdict(WEAK, machine, UtcNs)["health"]["reason"] == machine.reason
    good = Verdict(
        uav="1:1",
        level=Level.GOOD,
        blame=None,
        since_ns=0,
        needed_db=2.0,
        guaranteed_db=3.0,
        likely_db=4.5,
    )
    assert health.verdict(good, machine, UtcNs)["health"]["reason"] is None
    assert health.behind(LagSeen(newest_s=7.0, p95_s=7.0, max_s=7.04, behind=False)) is None


def test_the_headline_counts_what_is_good() -> None:
    good = Verdict(uav="2:1", level=Level.GOOD, blame=None, since_ns=0)
    assert health.summary([WEAK, good, good], None) == {
        "good": 2, "weak": 1, "none": 0, "headline": "2 of 3 links good",
        "behind": None,
    }  # fmt: skip
    assert health.summary([], None)["headline"] == "no UAV to aim at"


def test_the_headline_counts_whom_no_node_serves_and_names_whom_others_do() -> None:
    good = Verdict(uav="2:1", level=Level.GOOD, blame=None, since_ns=0)
    found = health.summary([good], None, unserved=2, elsewhere=3)
    assert (found["none"], found["headline"]) == (2, "1 of 3 links good, 3 with other nodes")
    assert health.summary([], None, elsewhere=3)["headline"] == "3 with other nodes"
